"""`python -m eval compare --world module:function`: priors and planners compared in anybody's world."""

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import torch

from eval.compare.priors import load_for
from eval.worlds.macros import MacroPrior
from eval.worlds.runs import check_distinct
from neuroprior import World, compare
from neuroprior.comparison.contestants import PLANNERS, PriorSource

KINDS = ("markov", "gru", "combined")
"""Kinds of priors that are fitted if no others are asked for."""


def compare_in(
    world: str,
    *,
    num_plans: Sequence[int],
    priors: Sequence[str],
    kinds: Sequence[str] | None,
    planners: Sequence[str] | None,
    length: int | None,
    seeds: int,
    starts: int,
    training_starts: int,
    seconds: float,
    seed: int,
    processes: int | None,
    out: str,
) -> None:
    """Compare priors and planners in a world, print the comparison, and write it to a folder.

    Args:
        world: `module:function`; see `load_world`.
        num_plans: budgets.
        priors: folders of saved priors.
        kinds: kinds of priors that are fitted; None: `KINDS`, but none if there are saved ones.
        planners: names; None: all.
        length, seeds, starts, training_starts, seconds: see `neuroprior.compare`.
        seed: of everything random.
        processes: how many seeds are run at a time.
        out: the folder.

    Raises:
        ValueError: an argument is out of range.
        ImportError: the module is not there.
    """
    names = tuple(PLANNERS if planners is None else planners)
    check_distinct(num_plans=num_plans, planners=names)
    where = load_world(world)
    fitted = tuple(() if priors else KINDS) if kinds is None else tuple(kinds)
    sources: dict[str, PriorSource] = {kind: MacroPrior if kind == "macro" else kind for kind in fitted}
    saved = {folder: load_for(folder, world, where.num_actions, where.action_names) for folder in priors}
    comparison = compare(
        where,
        sources | saved,
        names,
        num_plans,
        length=length,
        starts=starts,
        training_starts=training_starts,
        seeds=seeds,
        seconds=seconds,
        jobs=processes,
        generator=torch.Generator().manual_seed(seed),
    )
    print(comparison)
    comparison.save(out)
    print(f"\nTables and figure: {Path(out)}/comparison.csv, .json and .png")


def load_world(name: str) -> World:
    """The world that a function without arguments makes.

    Args:
        name: `module:function`; the module is in the current folder, or installed.

    Raises:
        ValueError: it is not of this form, there is no such function, or it returns no world.
        ImportError: the module is not there.
    """
    module, _, function = name.partition(":")
    if not module or not function:
        raise ValueError(f"`world` must be module:function, such as my_module:make_world, got {name!r}")
    make = getattr(import_module(module), function, None)
    if not callable(make):
        raise ValueError(f"`world` must name a function of {module}, got {function!r}")
    world = make()
    if not isinstance(world, World):
        raise ValueError(f"`world` must name a function that returns a World, got {type(world).__name__} from {name}")
    return world
