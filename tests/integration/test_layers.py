"""The imports of the code go one way, in the order that CONTRIBUTING.md gives."""

import ast
import re
from functools import cache
from pathlib import Path

import networkx

from neuroprior._registry import WINGS

ROOT = Path(__file__).parents[2]
PACKAGES = ("neuroprior", "train", "eval")
EXPERIMENTS = "eval/worlds"
"""What the experiments share; every other folder of eval is an experiment."""


def sources() -> dict[str, Path]:
    """The file of each module, by its dotted name."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imports(path: Path, modules: set[str]) -> set[str]:
    """The modules of this project that a file imports, wherever in it the import stands."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: a relative import"
            # `from package import name` takes a module, or what the package's __init__ holds
            whole = {f"{node.module}.{alias.name}": node.module for alias in node.names}
            found |= {name if name in modules else str(package) for name, package in whole.items()}
    return found & modules


@cache
def graph() -> "networkx.DiGraph[str]":
    modules = sources()
    edges = {name: imports(path, set(modules)) - {name} for name, path in modules.items()}
    return networkx.DiGraph(edges)


def layers() -> list[str]:
    """The paths of the layers, the lowest first, as CONTRIBUTING.md lists them."""
    for block in re.findall(r"```[a-z]*\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL):
        lines = [line.split()[0] for line in block.splitlines() if re.match(r"(neuroprior|train|eval)/\S*\s{2,}", line)]
        if len(lines) > 5:
            return lines
    raise AssertionError("CONTRIBUTING.md: no list of layers")


def layer(path: Path, order: list[str]) -> int:
    """The number of the layer that a file belongs to: the longest path that it begins with."""
    own = str(path.relative_to(ROOT))
    fitting = [
        entry for entry in order if own == entry or own == entry + ".py" or own.startswith(entry.rstrip("/") + "/")
    ]
    assert fitting, f"{own}: in no layer of CONTRIBUTING.md"
    return order.index(max(fitting, key=len))


def test_every_layer_exists() -> None:
    missing = [entry for entry in layers() if not (ROOT / entry).exists()]
    assert not missing


def test_no_import_goes_up() -> None:
    modules, order = sources(), layers()
    upward = [
        f"{first} imports {second}"
        for first, second in graph().edges
        if first != "neuroprior" and layer(modules[first], order) < layer(modules[second], order)
    ]
    assert not upward


def test_no_circle() -> None:
    circles = [sorted(group) for group in networkx.strongly_connected_components(graph()) if len(group) > 1]
    assert not circles
    without_torch = {"neuroprior", "neuroprior.behaviour", "neuroprior.behaviour.recordings"}
    hidden = [
        name for name, path in sources().items() if name not in without_torch and "TYPE_CHECKING" in path.read_text()
    ]
    assert not hidden


def test_experiments_do_not_import_one_another() -> None:
    def experiment(module: str) -> str | None:
        parts = module.split(".")
        return parts[1] if parts[0] == "eval" and len(parts) > 2 and f"eval/{parts[1]}" != EXPERIMENTS else None

    across = [
        f"{first} imports {second}"
        for first, second in graph().edges
        if experiment(second) is not None and experiment(first) != experiment(second) and first != "eval.__main__"
    ]
    assert not across


def test_the_core_imports_no_wing_and_no_wing_another() -> None:
    def wing(module: str) -> str | None:
        return next((name for name in WINGS if module == name or module.startswith(f"{name}.")), None)

    users = ("neuroprior.cli", "neuroprior.__main__")
    across = [
        f"{first} imports {second}"
        for first, second in graph().edges
        if first.startswith("neuroprior.") and not first.startswith(users)
        if wing(second) not in (None, wing(first))
    ]
    assert len(WINGS) == 3
    assert not across


def test_the_library_stands_alone() -> None:
    for first, second in graph().edges:
        if first.startswith("neuroprior"):
            assert second.startswith("neuroprior"), f"{first} imports {second}"
        if first.startswith("neuroprior."):
            assert second != "neuroprior", f"{first} imports from the top level"
