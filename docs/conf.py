"""The site: `make docs` builds it into docs/_build/html; nothing is fetched, and a warning is an error."""

import importlib
import pkgutil
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.config import Config
from sphinx.environment import BuildEnvironment
from sphinx.pycode import ModuleAnalyzer

import neuroprior

HERE = Path(__file__).parent

project = "neuroprior"
author = "The neuroprior developers"
copyright = author
version = release = neuroprior.__version__

smartquotes = False  # "lower" is a value

extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon", "myst_nb", "sphinx_design"]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_templates", "_static", "**/runs"]
html_theme = "pydata_sphinx_theme"
html_title = "neuroprior"
html_theme_options = {
    "show_prev_next": False,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "header_links_before_dropdown": 5,
}
html_sidebars = {page: [] for page in ("index", "contributing", "changelog", "glossary", "search")}  # no sections
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
toc_object_entries_show_parents = "hide"
maximum_signature_line_length = 60  # on a phone a line has about 40 characters

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4

nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600  # of a cell; each notebook takes seconds on a free machine
nb_merge_streams = True
nb_output_stderr = "remove"  # progress

nitpicky = True
# names of other libraries, which only their own sites could resolve
OTHERS = "torch|Tensor|numpy|np|pandas|matplotlib|networkx|lightning|rich|collections|contextlib|pathlib|abc|os"
nitpick_ignore_regex = [
    ("py:.*", rf"({OTHERS})(\..*)?"),
    ("py:.*", r"(typing\.Literal\[|neuroprior\.[\w.]+ \| ).*"),  # parts of the types of grouped attributes
]
autosummary_generate = True
autodoc_default_options = {"members": True, "show-inheritance": True}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_inherit_docstrings = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

ROOMS = {
    "neuroprior.plans": "Plans",
    "neuroprior.priors": "Priors",
    "neuroprior.priors.counts": "Priors that count",
    "neuroprior.priors.ensembles": "Priors made of priors",
    "neuroprior.priors.neural": "Neural priors",
    "neuroprior.priors.switching": "Priors with hidden modes",
    "neuroprior.sampling": "Sampling",
    "neuroprior.worlds": "Worlds",
    "neuroprior.planners": "Planners",
    "neuroprior.comparison": "Comparisons",
    "neuroprior.agents": "Agents",
    "neuroprior": "The top level",
    "neuroprior.behaviour": "Recorded behaviour",
    "neuroprior.behaviour.reporting": "Reports",
    "neuroprior.control": "Actions that are vectors",
    "neuroprior.puzzles": "Puzzles",
    "neuroprior.training": "Training",
    "neuroprior.testing": "Conformance suites",
}


def public(room: str) -> dict[str, Any]:
    """The public names of a module: those of `__all__`, or what it defines itself."""
    module = importlib.import_module(room)
    if hasattr(module, "__all__"):
        return {name: getattr(module, name) for name in module.__all__ if name != "__version__"}
    own = {name: value for name, value in vars(module).items() if getattr(value, "__module__", None) == room}
    return {name: value for name, value in own.items() if not name.startswith("_")}


NAMES: dict[str, dict[str, Any]] = {room: public(room) for room in ROOMS}
HOMES: dict[int, str] = {}
"""Where each public object is described, by its identity: in the first room that has it."""
for room, found in NAMES.items():
    for name, value in found.items():
        HOMES.setdefault(id(value), f"{room}.{name}")
LOWER = [home.lower() for home in HOMES.values()]
# where files' names ignore case, Score and score would be one page
autosummary_filename_map = {h: f"{h}-class" for h in HOMES.values() if LOWER.count(h.lower()) > 1 and h != h.lower()}
BY_NAME = {home.rpartition(".")[2]: home for home in HOMES.values()}
MODULES = [module.name for module in pkgutil.walk_packages(neuroprior.__path__, "neuroprior.")]
REFERENCE = re.compile(r"(?<![`:\w])`([^`]+)`(?![`_])")


def target(written: str) -> str | None:
    """The full public name that a docstring means by `MarkovPrior`, `Plans.with_end` or `neuroprior.sample`."""
    written = written.removesuffix("()")
    if written in NAMES or written in HOMES.values():
        return written
    for room in ("neuroprior", *NAMES):
        written = written.removeprefix(f"{room}.") if written.removeprefix(f"{room}.") in BY_NAME else written
    name, _, member = written.partition(".")
    if name not in BY_NAME or "." in member:
        return None
    room, _, _ = BY_NAME[name].rpartition(".")
    own = vars(NAMES[room][name]).get(member) if member else None
    if member and not (own is not None and own.__doc__ and (callable(own) or isinstance(own, property | classmethod))):
        return None
    return f"{BY_NAME[name]}.{member}".rstrip(".")


def link_names(app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Single backticks, as the docstrings have them, become links to public names, and code where there is no such."""
    if what == "data":
        described = (ModuleAnalyzer.for_module(module).find_attr_docs() for module in MODULES)
        key = ("", name.rpartition(".")[2])
        lines[:] = next((list(docs[key]) for docs in described if key in docs), [])

    def linked(match: re.Match[str]) -> str:
        found = target(match[1])
        return f":py:obj:`{match[1]} <{found}>`" if found else f"``{match[1]}``"

    text = REFERENCE.sub(linked, "\n".join(lines))
    # napoleon takes `low, high:` among attributes for a type and a name
    head, attributes, fields = text.partition("Attributes:\n")
    fields = re.sub(r"^( +)(\w+(?:, \w+)+):", lambda m: m[1] + m[2].replace(" ", "") + ":", fields, flags=re.MULTILINE)
    lines[:] = (head + attributes + fields).split("\n")


def skip_fields(app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any) -> bool | None:
    """The fields of named tuples are described in the docstrings of these."""
    return True if type(value).__name__ == "_tuplegetter" else None


def to_home(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element) -> nodes.Node | None:
    """Links of type hints, which name the module that defines a class, lead to the room in which it is described.

    Of names that are not public, such as aliases of types, the text stays, without a link.
    """
    if node.get("refdomain") != "py":
        return None
    module, _, name = node["reftarget"].rpartition(".")
    try:
        value = pkgutil.resolve_name(f"{module}:{name}") if module else None
    except (ImportError, AttributeError, ValueError):  # of a union of types only a part is a name
        value = None
    home = HOMES.get(id(value)) if module else BY_NAME.get(name)
    if home is None and value is not None and module.startswith("neuroprior"):
        return content
    if home is None or home == node["reftarget"]:
        return None
    return env.domains.python_domain.resolve_xref(env, node["refdoc"], app.builder, "obj", home, node, content)


def write_rooms(app: Sphinx, config: Config) -> None:
    """A page for each room: what it is for, and its names, each with a page of its own."""
    for room, title in ROOMS.items():
        own = [name for name, value in NAMES[room].items() if HOMES[id(value)] == f"{room}.{name}"]
        others = sorted({HOMES[id(value)] for value in NAMES[room].values()} - {f"{room}.{name}" for name in own})
        lines = [title, "=" * len(title), "", f".. automodule:: {room}", "   :no-members:", ""]
        lines += [f".. currentmodule:: {room}", "", ".. autosummary::", "   :toctree: names", "   :nosignatures:", ""]
        lines += [f"   {name}" for name in sorted(own, key=str.lower)]
        if others:
            lines += ["", "Also here: " + ", ".join(f":py:obj:`~{home}`" for home in others) + "."]
        page, text = HERE / "api" / f"{room}.rst", "\n".join(lines) + "\n"
        if not page.exists() or page.read_text(encoding="utf-8") != text:
            page.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("config-inited", write_rooms)
    app.connect("autodoc-process-docstring", link_names, priority=100)  # before napoleon
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("missing-reference", to_home)
