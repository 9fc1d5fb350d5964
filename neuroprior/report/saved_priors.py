"""Saved priors, scored on a file of plans: actions and contexts are told apart by their names."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from neuroprior import Prior
from neuroprior.analysis.comparison import Score, score_bits, units
from neuroprior.plans import Plans, read_plans
from neuroprior.report import fits
from neuroprior.report.crossval import ACTIONS, CONTEXT, counted
from neuroprior.report.scores import Model


def read_for(file: str, priors: dict[str, Prior], num_actions: int | None, action_names: list[str] | None) -> Plans:
    """The plans of a file; where it does not tell their names, those that the first prior knows."""
    names = action_names or _names(next(iter(priors.values())))
    return _read(file, num_actions, names, bool(action_names))


def score_saved(folder: str, prior: Prior, read: Plans, skip: int) -> tuple[Model, Score]:
    """A saved prior, and what it pays for plans.

    Args:
        folder: where it was saved; its name in the table.
        prior: what was saved there.
        read: the plans.
        skip: actions at the beginning of each plan that do not count.

    Raises:
        ValueError: the prior does not know these actions or contexts.
    """
    known = prior.num_actions - (prior.end is not None)
    if read.num_actions > known:
        raise ValueError(f"{folder}: knows {known} actions, the file has {read.num_actions}")
    seen = _with_actions_of(prior, read, folder)
    seen = _with_contexts_of(prior, replace(seen, num_actions=known, action_names=None), folder)
    if not prior.takes_context:
        seen = replace(seen, context=None, context_names=None)
    seen = seen if prior.end is None else seen.with_end()
    mask = counted(seen, skip)
    sees = CONTEXT if prior.takes_context else ACTIONS
    try:
        arrays = fits.scored_by(prior, seen, mask, units(seen, mask))
        score = score_bits(folder, sees, torch.from_numpy(arrays["bits"]), seen, mask)
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    return Model(folder, sees, type(prior).__name__, arrays.get), score


def numbers(known: Sequence[str], names: Sequence[str], before: str, after: str) -> Tensor:
    """The number under which each of the names is known.

    Raises:
        ValueError: a name is not known; it stands between `before` and `after`, and those that are follow.
    """
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"{before} {unknown[0]!r}{after} {', '.join(known)}")
    return torch.tensor([known.index(name) for name in names])


def _names(prior: Prior) -> list[str] | None:
    """The names of the actions that a prior has learned, without that of its end symbol."""
    return None if prior.action_names is None else [n for a, n in enumerate(prior.action_names) if a != prior.end]


def _read(file: str, num_actions: int | None, names: list[str] | None, given: bool) -> Plans:
    # Other files tell their names themselves, and perhaps that of an end symbol, or number fewer actions.
    names = names if given or Path(file).suffix.lower() in (".csv", ".tsv") else None
    read = read_plans(file, num_actions=num_actions, action_names=names)
    return read if read.end is None else read.without_end()


def _with_actions_of(prior: Prior, read: Plans, folder: str) -> Plans:
    """The plans with their actions numbered as the prior has learned them, by name."""
    names = _names(prior)
    if names is None or read.action_names is None:
        return read
    number = numbers(names, read.action_names, f"{folder}: does not know the action", "; it knows")
    return replace(read, actions=number[read.actions.long()], num_actions=len(names), action_names=None)


def _with_contexts_of(prior: Prior, read: Plans, folder: str) -> Plans:
    """The plans with their contexts numbered as the prior has learned them, by name."""
    if prior.context_names is None or read.context_names is None or read.context is None:
        return read
    number = numbers(prior.context_names, read.context_names, f"{folder}: has not seen the context", "; it knows")
    return replace(read, context=number[read.context.long()], context_names=None)
