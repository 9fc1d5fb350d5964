"""The reference: each public name stands on the site, says what its arguments are, and has an example that runs."""

import ast
import doctest
import importlib
import inspect
import pkgutil
import re
from contextlib import chdir
from pathlib import Path
from typing import Any

import pytest
import torch

import neuroprior

ROOT = Path(__file__).parents[2]


def rooms() -> list[str]:
    """Those that `docs/conf.py` lists."""
    tree = ast.parse((ROOT / "docs/conf.py").read_text(encoding="utf-8"))
    found = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "ROOMS"
    ]
    return list(ast.literal_eval(found[0]))


def public(room: str) -> dict[str, Any]:
    """Its public names, as `docs/conf.py` takes them."""
    module = importlib.import_module(room)
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", None) == room]
    return {name: getattr(module, name) for name in getattr(module, "__all__", own) if not name.startswith("_")}


ROOMS = {room: public(room) for room in rooms()}
EVERY = {name: value for names in (*ROOMS.values(), public("neuroprior")) for name, value in names.items()}
DESCRIBED = {id(value): (room, name) for room, names in reversed(ROOMS.items()) for name, value in names.items()}
"""Where each public object is described: in the first room that has it."""
OBJECTS = [(room, name) for room, name in DESCRIBED.values() if inspect.isroutine(ROOMS[room][name])] + [
    (room, name)
    for room, name in DESCRIBED.values()
    if inspect.isclass(ROOMS[room][name]) and ROOMS[room][name].__module__.startswith("neuroprior")
]

WITHOUT_EXAMPLE = {
    "interfaces, which how-to guides implement": """
        BestFirstPlanner ContinuousWorld HistoryPrior MujocoWorld NeuralPrior Planner Prior PriorPlanner
        PuzzleWorld Steppable Stepper VectorPlanner VectorPrior World
    """,
    "results, which the functions that return them show": """
        Baseline Batch Comparison ConditionComparison ConditionFamily ConditionInteraction ConditionPrediction
        Control Decision Difference DurationLaw DurationSurvival Execution GaussianForecast GroupDrift
        HorizonRound HowFarBack Individuality Individuals InteractionFamily Interval Leaf Memory ModeChoice
        ModePosterior Motif PermutationDesign PlanDrift PositionDrift Posterior RateDrift Rollout Row Score Search
        Sizes Steps Sweep TooLargeError Transitions Tuned Types VectorDecision
    """,
    "made by a function that has one": "PocketCube SimulatorWorld SlidingTilesWorld SokobanWorld",
    "of packages or data that not everybody has": "from_mujoco read_minari write_minari",
    "figures of the report's tables": """
        budget_figure budget_strips condition_figure course_figure dendrogram_figure drift_figure dwell_figure
        group_transition_figure lag_figure motif_figure occupancy_figure plane_figure score_figure survival_figure
        transition_figure transition_graph_figure
    """,
    "what fit uses": "PlansModule PriorModule bits train",
}


def documentation(room: str, name: str) -> str:
    return inspect.cleandoc(ROOMS[room][name].__doc__ or "")


def test_every_public_name_has_a_room() -> None:
    packages = [m.name for m in pkgutil.walk_packages(neuroprior.__path__, "neuroprior.") if m.ispkg]
    for package in ["neuroprior", *packages]:
        names = getattr(importlib.import_module(package), "__all__", ())
        lost = [
            n for n in names if n != "__version__" and id(getattr(importlib.import_module(package), n)) not in DESCRIBED
        ]
        assert not lost, package


@pytest.mark.parametrize(("room", "name"), OBJECTS, ids=[".".join(one) for one in OBJECTS])
def test_arguments_are_described(room: str, name: str) -> None:
    """Each by its name among `Args` or `Attributes`, or in the text."""
    text, value = documentation(room, name), ROOMS[room][name]
    assert text, "no docstring"
    assert text.partition("\n\n")[0].endswith((".", "?", ":")), "the first paragraph is no sentence"
    if inspect.isclass(value) and (issubclass(value, tuple | BaseException) or getattr(value, "_is_protocol", False)):
        return
    given = [
        p.name for p in inspect.signature(value).parameters.values() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)
    ]
    if len(given) == 1:  # the sentence says what it is
        return
    named = set(re.findall(r"\w+", " ".join(re.findall(r"`[^`]+`|^ +[\w*, ]+:", text, re.MULTILINE))))
    named |= set(re.findall(r'^    (\w+): .*\n    """', inspect.getsource(value), re.MULTILINE))  # fields of their own
    assert not [argument for argument in given if argument not in named]


def test_examples_are_where_they_are_natural() -> None:
    without = {name for room, name in OBJECTS if ">>>" not in documentation(room, name)}
    assert without == set(" ".join(WITHOUT_EXAMPLE.values()).split())


@pytest.mark.parametrize("room", ROOMS)
def test_examples_run(room: str, tmp_path: Path) -> None:
    """With `torch`, `Path` and the public names, those of the own room first."""
    names = {"torch": torch, "Path": Path, **EVERY, **ROOMS[room]}
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    said: list[str] = []
    with chdir(tmp_path):
        for home, name in DESCRIBED.values():
            text = documentation(home, name) if home == room else ""
            test = doctest.DocTestParser().get_doctest(text, dict(names), f"{room}.{name}", None, None)
            runner.run(test, out=said.append)
    assert not runner.failures, "".join(said)
