"""Whether mice are on their way to the water, by priors of moves that lead there and of others, and by hidden modes."""

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.nn.utils.rnn import pad_sequence

from eval.worlds.labyrinth import DATA, arrivals, arrives_within
from neuroprior import MarkovPrior, Plans, read_plans
from neuroprior.priors import SwitchingPrior, infer
from neuroprior.worlds import labyrinth

BLOCKS = 10
"""Blocks of consecutive sequences, each held out once."""

STRETCH = 32
"""Moves before an arrival at the water that lead there; it is assumed that intentions last as long on average."""

INNER = 3
"""Parts of the other blocks: of each the priors and counts of the rest say what the regressions learn from."""

ORDER = 3
"""Order of the chains, with the node as context."""

MODES, MODE_ORDER = 2, 2
"""Number of hidden modes, and the order of their chains, with the node as context."""

EM: dict[str, Any] = {"restarts": 1, "max_iterations": 25}
"""How the modes are fitted: fewer starts than by default, for time."""

SMOOTHING = 4.0
"""Pseudo-counts of the baselines, distributed as without the last move, and as without the node."""

FEATURES = {
    "node": (0,),
    "node, move": (1,),
    "node, posterior": (0, 2),
    "node, move, posterior": (1, 2),
    "node, modes": (0, 3),
    "node, move, modes": (1, 3),
}
"""What the probability of arriving is regressed on, by kind: columns of `features_of`."""


def stretches(plans: Plans, arrives: Tensor) -> tuple[Plans, Plans]:
    """The moves that arrive at the water within `STRETCH`, and the others, as plans; each arrival ends one.

    The last moves of a sequence, of which this is not known, are left out, unless one of them arrives.
    """
    assert plans.context is not None
    length = arrives.shape[1]
    leads = arrives_within(torch.cat([arrives, arrives.new_zeros(len(arrives), STRETCH - 1)], 1), STRETCH)
    observed = leads | (torch.arange(length) <= length - STRETCH)
    new = torch.ones_like(leads)
    new[:, 1:] = (leads[:, 1:] != leads[:, :-1]) | (observed[:, 1:] != observed[:, :-1]) | arrives[:, :-1]
    first = new.flatten().nonzero()[:, 0]
    sizes = torch.cat([first, torch.tensor([leads.numel()])]).diff()
    actions, nodes = (values.flatten().split(sizes.tolist()) for values in (plans.actions, plans.context))
    every = Plans(pad_sequence(actions, True), plans.num_actions, sizes, context=pad_sequence(nodes, True))
    leads, observed = leads.flatten()[first], observed.flatten()[first]
    return every[leads], every[observed & ~leads]


def log_odds(learned: Plans, plans: Plans) -> Tensor:
    """The posterior log-odds `[N, L + 1]` that a mouse is on its way to the water, given the moves before."""
    parts = stretches(learned, arrivals(learned))
    priors = [MarkovPrior(p.num_actions, ORDER, num_contexts=labyrinth().num_states).fit(p) for p in parts]
    posterior = infer(priors, plans, weights=[float(p.mask().sum()) for p in parts], switch=1 / STRETCH).log_probs
    return posterior[..., 0] - posterior[..., 1]


def mode_weights(learned: Plans, plans: Plans) -> tuple[Tensor, Tensor]:
    """The modes of a switching prior that learned from `learned`, given the moves up to each, in both: `[N, L, K]`."""
    prior = SwitchingPrior(learned.num_actions, MODES, MODE_ORDER, labyrinth().num_states, **EM)
    prior.fit(learned, generator=torch.Generator().manual_seed(0))
    return prior.posterior(learned).filtered, prior.posterior(plans).filtered


def features_of(
    learned: Plans, plans: Plans, number: int, posterior: Tensor, modes: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Log-odds `[N, T, 4]` of arriving within some moves: by node, by node and last move, of the posterior, by modes.

    All but the posterior is counted in `learned`. By modes: by node, counted in each mode before the move by how
    probable that is. Also whether the mice arrived, `[N, T]`. A sequence's first move, before which there is none, does
    not count, nor its last ones.
    """
    truth, keys = [], []
    for sequences in (learned, plans):
        assert sequences.context is not None
        truth.append(arrives_within(arrivals(sequences), number)[:, 1:].double())
        node = sequences.context[:, 1 : 1 + truth[-1].shape[1]].long()
        keys.append((node, sequences.num_actions * node + sequences.actions[:, : node.shape[1]]))
    times, columns = truth[0].shape[1], []
    share = truth[0].mean().expand(truth[1].shape)
    for train_keys, others in zip(*keys, strict=True):
        size = learned.num_actions * labyrinth().num_states
        total, arrived = (
            train_keys.flatten().bincount(values, minlength=size) for values in (None, truth[0].flatten())
        )
        share = (arrived[others] + SMOOTHING * share) / (total[others] + SMOOTHING)
        columns.append(share.logit())
    before, now = (weights[:, :times] for weights in modes)
    counts = torch.zeros(2, labyrinth().num_states, before.shape[-1], dtype=torch.double)
    for count, weights in zip(counts, (before, before * truth[0][..., None]), strict=True):
        count.index_add_(0, keys[0][0].flatten(), weights.flatten(0, 1))
    total, arrived = (values[keys[1][0]] for values in counts)
    by_mode = (arrived + SMOOTHING * columns[0].sigmoid()[..., None]) / (total + SMOOTHING)
    columns += [posterior[:, 1 : 1 + times], (now * by_mode).sum(-1).logit()]
    return torch.stack(columns, -1), truth[1]


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
    plans = read_plans(DATA)
    held_out = torch.arange(len(plans)) * BLOCKS // len(plans) == block  # consecutive: they may be of one mouse
    learned, test = plans[~held_out], plans[held_out]
    inner = torch.arange(len(learned)) * INNER // len(learned)
    folds = [*((learned[inner != k], learned[inner == k]) for k in range(INNER)), (learned, test)]
    inferred = [(log_odds(*fold), mode_weights(*fold)) for fold in folds]
    for number in numbers:
        pairs = [features_of(*fold, number, *one) for fold, one in zip(folds, inferred, strict=True)]
        rows, happened = (torch.cat([pair[k].flatten(0, 1) for pair in pairs[:-1]]) for k in (0, 1))
        features, truth = pairs[-1]
        for kind, columns in FEATURES.items():
            weights = regression(rows[:, columns], happened)
            loss = binary_cross_entropy_with_logits(features[..., columns] @ weights[:-1] + weights[-1], truth)
            row = {"kind": kind, "plans": 0, "measure": "water", "at": number, "agents": len(test)}
            yield row | {"loss": float(loss), "probability": float(truth.mean()), "weight": float(weights[-2])}
