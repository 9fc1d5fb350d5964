"""Whether mice are on their way to the water, by priors of moves that lead there and of others."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.nn.utils.rnn import pad_sequence

from eval.worlds.labyrinth import DATA
from neuroprior import MarkovPrior, Plans, read_plans
from neuroprior.analysis import infer
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import WATER

BLOCKS = 10
"""Blocks of consecutive sequences, each held out once."""

STRETCH = 32
"""Moves before an arrival at the water that lead there; it is assumed that intentions last as long on average."""

INNER = 3
"""Parts of the other blocks: of each the priors and counts of the rest say what the regressions learn from."""

ORDER = 3
"""Order of the chains, with the node as context."""

SMOOTHING = 4.0
"""Pseudo-counts of the baselines, distributed as without the last move, and as without the node."""

FEATURES = {
    "node": (0,),
    "node, move": (1,),
    "node, posterior": (0, 2),
    "node, move, posterior": (1, 2),
}
"""What the chance of arriving is regressed on, by kind: columns of `_features`."""


class Moves(NamedTuple):
    """Sequences of moves `[N, L]`, and whether each arrives at the water."""

    plans: Plans
    arrives: Tensor

    def part(self, rows: Tensor) -> "Moves":
        """Some of the sequences."""
        return Moves(self.plans[rows], self.arrives[rows])


def read_moves() -> Moves:
    """The mice's moves, in blocks of consecutive sequences: these may be of one mouse."""
    plans, world = read_plans(DATA), labyrinth()
    assert plans.context is not None
    block = torch.arange(len(plans)) * BLOCKS // len(plans)
    after = world.next_state[plans.context, plans.actions.long()]
    return Moves(replace(plans, group=block), (after == WATER) & (plans.context != WATER))


def arrives_within(arrives: Tensor, number: int) -> Tensor:
    """`[N, L - number + 1]`: whether the water is reached by one of the next `number` moves."""
    return arrives.unfold(1, number, 1).any(-1)


def stretches(moves: Moves) -> tuple[Plans, Plans]:
    """The moves that arrive at the water within `STRETCH`, and the others, as plans; each arrival ends one.

    The last moves of a sequence, of which this is not known, are left out, unless one of them arrives.
    """
    plans, arrives = moves.plans, moves.arrives
    assert plans.context is not None
    length = arrives.shape[1]
    padded = torch.cat([arrives, arrives.new_zeros(len(arrives), STRETCH - 1)], 1)
    leads = arrives_within(padded, STRETCH)
    known = leads | (torch.arange(length) <= length - STRETCH)
    new = torch.ones_like(leads)
    new[:, 1:] = (leads[:, 1:] != leads[:, :-1]) | (known[:, 1:] != known[:, :-1]) | arrives[:, :-1]
    sizes = torch.cat([new.flatten().nonzero()[:, 0], torch.tensor([leads.numel()])]).diff()
    first = sizes.cumsum(0) - sizes
    actions, nodes = (values.flatten().split(sizes.tolist()) for values in (plans.actions, plans.context))
    every = Plans(pad_sequence(actions, True), plans.num_actions, sizes, context=pad_sequence(nodes, True))
    leads, known = leads.flatten()[first], known.flatten()[first]
    return every[leads], every[known & ~leads]


def _features(learned: Moves, moves: Moves, number: int, posterior: Tensor) -> tuple[Tensor, Tensor]:
    """Log-odds of arriving within some moves by node, and by node and last move; and of the posterior: `[N, T, 3]`.

    All but the posterior is counted in `learned`. Also whether they arrived, `[N, T]`. A sequence's first move, before
    which there is none, does not count, nor its last ones.
    """
    happened, keys = [], []
    for one in (learned, moves):
        assert one.plans.context is not None
        happened.append(arrives_within(one.arrives, number)[:, 1:])
        node = one.plans.context[:, 1 : 1 + happened[-1].shape[1]].long()
        keys.append((node, 4 * node + one.plans.actions[:, : node.shape[1]]))
    share = happened[0].double().mean().expand(keys[1][0].shape)
    columns = []
    for own, others in zip(*keys, strict=True):
        size = 4 * labyrinth().num_states
        total = own.flatten().bincount(minlength=size)
        found = own.flatten().bincount(happened[0].flatten().double(), minlength=size)
        share = (found[others] + SMOOTHING * share) / (total[others] + SMOOTHING)
        columns.append(share.logit())
    columns.append(posterior[:, 1 : 1 + share.shape[1]])
    return torch.stack(columns, -1), happened[1].double()


def log_odds(learned: Moves, moves: Moves) -> Tensor:
    """The posterior log-odds `[N, L + 1]` that a mouse is on its way to the water, given the moves before."""
    parts = stretches(learned)
    contexts, numbers = labyrinth().num_states, [int(part.mask().sum()) for part in parts]
    priors = [MarkovPrior(part.num_actions, ORDER, num_contexts=contexts).fit(part) for part in parts]
    found = infer(priors, moves.plans, weights=[float(n) for n in numbers], switch=1 / STRETCH).log_probs
    return found[..., 0] - found[..., 1]


def regression(features: Tensor, happened: Tensor) -> Tensor:
    """The weights of a logistic regression on features `[M, C]` and a constant, by Newton's method: `[C + 1]`."""
    rows = torch.cat([features, torch.ones_like(features[:, :1])], 1)
    weights = rows.new_zeros(rows.shape[1])
    for _ in range(25):
        probs = (rows @ weights).sigmoid()
        slope = rows.T @ (happened - probs)
        weights = weights + torch.linalg.solve((rows * (probs * (1 - probs))[:, None]).T @ rows, slope)
    return weights


def mice_entries(block: int, numbers: tuple[int, ...]) -> Iterator[dict[str, Any]]:
    """How well each kind of `FEATURES` predicts arrivals in one block, learned from the others alone."""
    every = read_moves()
    assert every.plans.group is not None
    held_out = every.plans.group == block
    learned, test = every.part(~held_out), every.part(held_out)
    inner = torch.arange(len(learned.plans)) * INNER // len(learned.plans)
    folds = [(learned.part(inner != k), learned.part(inner == k)) for k in range(INNER)]
    folds.append((learned, test))
    posteriors = [log_odds(own, others) for own, others in folds]
    for number in numbers:
        found = [_features(*fold, number, odds) for fold, odds in zip(folds, posteriors, strict=True)]
        rows, happened = (torch.cat([pair[k].flatten(0, 1) for pair in found[:-1]]) for k in (0, 1))
        features, truth = found[-1]
        for kind, columns in FEATURES.items():
            weights = regression(rows[:, columns], happened)
            loss = binary_cross_entropy_with_logits(features[..., columns] @ weights[:-1] + weights[-1], truth)
            row = {"kind": kind, "plans": 0, "measure": "water", "at": number, "agents": len(test.plans)}
            yield row | {"loss": float(loss), "probability": float(truth.mean()), "weight": float(weights[-2])}
