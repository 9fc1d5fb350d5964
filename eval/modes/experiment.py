"""Hidden modes of mice in a labyrinth: priors fitted in folds, and what their modes do there."""

from dataclasses import dataclass
from math import log
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from eval.worlds.labyrinth import DATA, arrivals, arrives_within
from neuroprior import Plans, read_plans
from neuroprior.behaviour.analysis.comparison import action_bits, score_bits
from neuroprior.behaviour.analysis.modes import STABLE, agreements, mode_plans
from neuroprior.plans import folds
from neuroprior.priors import SwitchingPrior
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import WATER

FOLDS, SKIP = 5, 1
"""Of the cross-validation over sequences, and moves at the beginning of each that do not count."""

WITHIN, FEW = 8, 5
"""Moves within which a place is reached, and visits of a node in a mode from which its share is shown."""

BINS = (0, 1, 2, 4, 8, 16, 32, 64, 128)
"""Beginnings of classes of moves since the water."""


@dataclass(frozen=True)
class ModeSettings:
    """How modes are fitted; see `eval.modes.command.modes`."""

    restarts: int
    seed: int


class Job(NamedTuple):
    """A prior: the number of its modes, the order of their chains, and the fold that is held out; FOLDS: none."""

    modes: int
    order: int
    fold: int

    def __str__(self) -> str:
        return f"modes{self.modes}-order{self.order}-fold{self.fold}"


def fitted(job: Job, settings: ModeSettings, plans: Plans) -> SwitchingPrior:
    """The prior of a job, which learned from the plans that are not held out."""
    learned = plans if job.fold == FOLDS else plans[folds(plans, FOLDS, settings.seed)[job.fold][0]]
    prior = SwitchingPrior(plans.num_actions, job.modes, job.order, labyrinth().num_states, restarts=settings.restarts)
    return prior.fit(learned, generator=torch.Generator().manual_seed(settings.seed * FOLDS + job.fold))


def fit_and_infer(job: Job, settings: ModeSettings) -> dict[str, np.ndarray[Any, Any]]:
    """ "nats": `[N, L]`, of each move of all sequences; "modes": `[N, L, K]`, their posterior given all of these."""
    plans = read_plans(DATA)
    prior = fitted(job, settings, plans)
    return {
        "nats": (log(2) * action_bits(prior, plans)).numpy(),
        "modes": prior.posterior(plans).smoothed.to(torch.float16).numpy(),
    }


def likelihoods(results: dict[Job, dict[str, np.ndarray[Any, Any]]], plans: Plans, seed: int) -> pd.DataFrame:
    """A row each order and number of modes: `nats` per held-out move, with `low` and `high`, and which modes come back.

    `correlation`: of each mode with its like in the prior of each fold, the least over the folds; `stable`: how many of
    these are at least `STABLE`.
    """
    parts, mask = folds(plans, FOLDS, seed), plans.mask()
    mask[:, :SKIP] = False
    rows = []
    for modes, order in dict.fromkeys((job.modes, job.order) for job in results):
        nats, least = torch.zeros(plans.actions.shape, dtype=torch.double), torch.ones(modes)
        whole = torch.from_numpy(results[Job(modes, order, FOLDS)]["modes"]).double()
        for fold, (_, held_out) in enumerate(parts):
            inferred = results[Job(modes, order, fold)]
            nats[held_out] = torch.from_numpy(inferred["nats"]).double()[held_out]
            agreement = agreements(whole, torch.from_numpy(inferred["modes"]).double(), plans.mask())
            least = torch.minimum(least, agreement)
        mean, low, high, _ = score_bits("", "", nats, plans, mask).bits_per_action()
        row = {"order": order, "modes": modes, "nats": mean, "low": low, "high": high}
        rows.append(row | {"stable": int((least >= STABLE).sum()), "correlation": [round(float(c), 3) for c in least]})
    return pd.DataFrame(rows)


def described(frame: pd.DataFrame) -> tuple[int, int] | None:
    """The number of modes and the order that are described: of those whose modes all come back, the likeliest."""
    stable = frame[(frame["modes"] > 1) & (frame["stable"] == frame["modes"])]
    if stable.empty:
        return None
    best = stable.sort_values("nats").iloc[0]
    return int(best["modes"]), int(best["order"])


class Events(NamedTuple):
    """What happens at each move, `[N, L]` bool each: the water, or home, is reached within `WITHIN`; the mouse turns.

    Of the last moves of a sequence it is not known what is reached: `complete` leaves these out.
    """

    water: Tensor
    home: Tensor
    turns: Tensor
    complete: Tensor


def events(plans: Plans) -> Events:
    """The events of sequences of moves; a mouse turns that walks out after in, or in after out."""
    assert plans.context is not None
    after = labyrinth().next_state[plans.context, plans.actions.long()]
    out = plans.actions >= 2
    turns = torch.zeros_like(out)
    turns[:, 1:] = out[:, 1:] != out[:, :-1]
    complete = torch.arange(plans.max_length) <= plans.max_length - WITHIN
    # At node 0 alone a move leads back to its node: home and back.
    reached = (arrivals(plans), after == plans.context)
    padded = (torch.cat([one, one.new_zeros(len(one), WITHIN - 1)], 1) for one in reached)
    water, home = (arrives_within(one, WITHIN) for one in padded)
    return Events(water, home, turns, complete.expand(out.shape))


def mode_rows(prior: SwitchingPrior, plans: Plans) -> pd.DataFrame:
    """A row a mode of the most probable path, and what is measured: its `mean` with `low` and `high`.

    Shares of the moves: in the mode; and in it, those that turn, and from which water or home is reached.
    """
    path, flags, rows = mode_plans(prior, plans).actions, events(plans), []
    every = plans.mask()
    for k in range(prior.num_modes):
        in_mode = path == k
        measures = {"moves": (in_mode, every), "turns": (flags.turns, in_mode & (torch.arange(plans.max_length) > 0))}
        measures |= {name: (getattr(flags, name), in_mode & flags.complete) for name in ("water", "home")}
        for name, (values, mask) in measures.items():
            mean, low, high, _ = score_bits("", "", values.double(), plans, mask).bits_per_action()
            rows.append({"mode": k + 1, "what": name, "mean": mean, "low": low, "high": high})
    return pd.DataFrame(rows)


def node_shares(prior: SwitchingPrior, plans: Plans) -> dict[str, Tensor]:
    """By what is shown, `[K, 127]` of each node: the share of its moves in each mode, and of these, see `Events`.

    NaN where there are fewer than `FEW` moves.
    """
    context = plans.context
    assert context is not None
    path, flags, states = mode_plans(prior, plans).actions, events(plans), labyrinth().num_states
    modes = torch.arange(prior.num_modes)[:, None, None]

    def count(mask: Tensor) -> Tensor:
        return torch.stack([context[one].long().bincount(minlength=states).double() for one in mask])

    def share(of: Tensor, among: Tensor) -> Tensor:
        total = count(among)
        return (count(of) / total).masked_fill(total < FEW, torch.nan)

    in_mode = (path == modes) & plans.mask()
    shown = {"moves": share(in_mode, plans.mask().expand_as(in_mode)), "turns": share(in_mode & flags.turns, in_mode)}
    complete = in_mode & flags.complete
    return shown | {name: share(complete & getattr(flags, name), complete) for name in ("water", "home")}


def since_water(prior: SwitchingPrior, plans: Plans) -> pd.DataFrame:
    """A row a mode and a class of `BINS` of moves since the water was left: the share of the moves in it, `mean`."""
    assert plans.context is not None
    step = torch.arange(plans.max_length).expand(plans.actions.shape)
    last = torch.where(plans.context == WATER, step, -plans.max_length * 2).cummax(1).values
    moves, path, rows = step - last, mode_plans(prior, plans).actions, []
    edges = torch.tensor([*BINS, plans.max_length])
    for low_edge, high_edge in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        mask = (moves >= low_edge) & (moves < high_edge) & plans.mask()
        for k in range(prior.num_modes):
            mean, low, high, _ = score_bits("", "", (path == k).double(), plans, mask).bits_per_action()
            rows.append({"mode": k + 1, "from": low_edge, "share": mean, "low": low, "high": high})
    return pd.DataFrame(rows)
