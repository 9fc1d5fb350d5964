"""What `python -m eval plans` fits, and what it keeps of each fit: scores, calibration, information by lag, samples."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from neuroprior import GRUPrior, MarkovPrior, MixturePrior, Plans, Prior, StackedPrior, TabularWorld, TransformerPrior
from neuroprior.analysis import Reliability, pieces, reliability
from neuroprior.analysis.comparison import Score, action_bits, rivals, score_bits
from neuroprior.plans import is_per_step
from neuroprior.plans.folds import FEWEST_UNITS, divisible
from neuroprior.priors.counts import TooLargeError
from neuroprior.sampling.ancestral import sample, sample_in_world

if TYPE_CHECKING:
    from neuroprior.report.crossval import Design

KINDS = ("mixture", "gru-large", "stacked", "transformer", "gru", "lags", "counts")
"""What one job fits; the slowest first."""

NEURAL: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "gru": (GRUPrior, {}),
    "transformer": (TransformerPrior, {}),
    # It hardly learns by heart: few plans will do to find the best moment.
    "stacked": (StackedPrior, {"learning_rate": 4e-3, "validation": 0.02}),
    # For long sequences of few subjects: without lags, which such plans let it learn by heart.
    "gru-large": (
        partial(GRUPrior, hidden_size=256, lags=1, dropout=0.5),
        {"learning_rate": 4e-3, "validation": 0.02},
    ),
}
"""How neural priors are made and trained; the first two by default recipes."""

MIXED = ("stacked", "gru-large")
"""The experts of the mixture, each by its own recipe but for the training, which is that of the first."""

ONCE = ("lags",)
"""What is fitted in the first fold alone."""

COUNTED = "markov"
"""The count-based model of the information by lag; the other is the GRU."""

VALIDATION = 0.1
"""Share of what is learned from on which the settings of count-based models are chosen."""

MOST_PIECES, PIECES_A_STEP = 20_000, 512
MOST_GENERATED = 1000
"""Bounds of what is cut into pieces, read in a step, and sampled."""


def recipes() -> str:
    """All that decides a fit beside the plans and the design; after a change of it, old fits do not count."""
    return repr((NEURAL, MIXED, VALIDATION, MOST_PIECES, PIECES_A_STEP, torch.__version__))


@dataclass(frozen=True)
class Outcome:
    """What is kept of a fitted model.

    Attributes:
        how: its settings.
        arrays: by name. `bits [n, L]`, float32: what each held-out action cost. `calibration`: the sums of a
            `Reliability`. `generated [g, L]`: plans sampled from it. Or, of information by lag, `bits` and `actions`
            `[J, U]`: what the same actions cost with 0, 1, ... J - 1 past ones known, by unit.
    """

    how: str
    arrays: dict[str, np.ndarray[Any, Any]]


def outcomes(
    kind: str, learned: Plans, scored: Plans, mask: Tensor, unit: Tensor, design: "Design", fold: int
) -> dict[str, Outcome]:
    """Fit the models of a kind and score them.

    Args:
        kind: one of `KINDS`.
        learned: plans to learn from.
        scored: held-out plans, n of them.
        mask: `[n, L]` bool: their actions that count.
        unit: `[n, L]`: the independent unit of each, numbered over all folds.
        design: of the study.
        fold: its number.

    Raises:
        ValueError: plans that cannot be learned from.
    """
    seed = design.seed * 1000 + fold
    if kind == "lags":
        return _by_lag(learned, scored, design, seed)
    found = {}
    world = None if fold else _world(learned, _sizes(learned, scored).get("num_contexts", 0))
    for name, how, prior in _fitted(kind, learned, scored, design, seed):
        arrays = scored_by(prior, scored, mask, unit)
        if fold == 0:
            generated = _generated(prior, scored, world, seed)
            arrays |= {} if generated is None else {"generated": generated.numpy()}
        found[name] = Outcome(how, arrays)
    return found


def packed(found: dict[str, Outcome]) -> dict[str, np.ndarray[Any, Any]]:
    """Outcomes as arrays for one file."""
    arrays = {f"{name}/{key}": array for name, one in found.items() for key, array in one.arrays.items()}
    return arrays | {f"{name}/how": np.array(one.how) for name, one in found.items()}


def _fitted(kind: str, learned: Plans, scored: Plans, design: "Design", seed: int) -> Iterator[tuple[str, str, Prior]]:
    sizes = _sizes(learned, scored)
    learned = divisible(learned)
    if kind == "counts":
        if "context_size" in sizes:
            return  # features cannot be counted
        training, validation = _split(learned, seed)
        for rival in rivals(training, validation, sizes.get("num_contexts"), always_see=True):
            if rival.prior is not None:
                # Chosen on the validation plans; then these are learned from as well.
                yield rival.model, rival.how, rival.prior.fit(learned)
        return
    if kind in ("stacked", "mixture") and "context_size" in sizes:
        return  # their experts count
    how = _training(design) | NEURAL[MIXED[0] if kind == "mixture" else kind][1]
    prior = _made(kind, learned.num_actions, seed=seed, **sizes)
    yield kind, "", prior.fit(learned, generator=torch.Generator().manual_seed(seed), **how)


def _made(kind: str, num_actions: int, **how: Any) -> Any:
    """A neural prior, or a mixture of them, before training."""
    if kind == "mixture":
        return MixturePrior(num_actions, [_made(expert, num_actions, **how) for expert in MIXED])
    return NEURAL[kind][0](num_actions, **how)


def _training(design: "Design") -> dict[str, Any]:
    """How neural priors are trained."""
    patience = max(ceil(design.patience * design.max_steps), 1)
    return {"max_steps": design.max_steps, "patience": patience, "progress": False}


def _split(learned: Plans, seed: int) -> tuple[Plans, Plans]:
    """Plans to count and plans to choose settings on, the latter of two actions or more where that can be."""
    training, validation = learned.split(VALIDATION, torch.Generator().manual_seed(seed))
    if int(validation.mask().sum()) < FEWEST_UNITS:
        training, validation = learned.split(0.5, torch.Generator().manual_seed(seed))
    return training, validation


def _sizes(*some: Plans) -> dict[str, int]:
    """The arguments that let a prior see the context of these plans."""
    contexts = [plans.context for plans in some if plans.context is not None]
    if not contexts:
        return {}
    if contexts[0].is_floating_point():
        return {"context_size": contexts[0].shape[-1]}
    most = max((int(context.max()) + 1 for context in contexts if context.numel()), default=1)
    return {"num_contexts": max(most, *(len(plans.context_names or ()) for plans in some))}


def scored_by(prior: Prior, scored: Plans, mask: Tensor, unit: Tensor) -> dict[str, np.ndarray[Any, Any]]:
    """The bits of each action, and the calibration over units of the fold."""
    bits = torch.zeros(scored.actions.shape)
    total: Reliability | None = None
    at = 0
    with torch.no_grad():
        for part, log_probs in prior.forecasts(scored):
            rows = slice(at, at + len(part))
            at += len(part)
            taken = log_probs.gather(-1, part.actions.long()[..., None])[..., 0]
            bits[rows] = -taken.masked_fill(~part.mask(), 0) / np.log(2)
            counts = mask[rows]
            if counts.any():
                one = reliability(log_probs[counts], part.actions[counts].long(), unit[rows][counts])
                total = one if total is None else total + one
    return {"bits": bits.numpy()} | ({} if total is None else {"calibration": total.sums.numpy()})


def _by_lag(learned: Plans, scored: Plans, design: "Design", seed: int) -> dict[str, Outcome]:
    """What the last actions of short pieces cost, with 0, 1, 2 and more of the actions before them known."""
    reach = _reach(learned, scored, design.reach)
    if reach < 1:
        return {}
    sizes = _sizes(learned, scored)
    generator = torch.Generator().manual_seed(seed)
    late = _after(scored, 0 if design.cut else design.skip - reach)
    if int(late.mask().sum(1).max()) <= reach:
        return {}
    held_out = pieces(late, reach + 1, MOST_PIECES, generator)
    short = pieces(learned, reach + 1, MOST_PIECES * 5, generator)
    if held_out.group is None or len(held_out.group.unique()) < FEWEST_UNITS:
        return {}
    neural = GRUPrior(learned.num_actions, seed=seed, **sizes)
    neural.fit(divisible(short), generator=generator, batch_size=PIECES_A_STEP, **_training(design))
    found = {"gru": [_of_last(neural, held_out, known) for known in range(reach + 1)]}
    if "context_size" not in sizes:
        found[COUNTED] = _chains(learned, held_out, reach, sizes.get("num_contexts"))
    return {
        name: Outcome("", {what: np.stack([getattr(s, what) for s in scores]) for what in ("bits", "actions")})
        for name, scores in found.items()
    }


def _chains(learned: Plans, held_out: Plans, reach: int, num_contexts: int | None) -> list[Score]:
    """What the last action of pieces costs a chain of order j, for each j.

    Each order is a prior of its own: in one of a high order the shorter histories only serve to lean on.
    """
    scores = []
    for order in range(reach + 1):
        chain = MarkovPrior(learned.num_actions, order, initial="lower", num_contexts=num_contexts)
        try:
            chain.fit(learned)
        except TooLargeError:
            break
        scores.append(_of_last(chain, held_out, order))
    return scores


def _of_last(prior: Prior, held_out: Plans, known: int) -> Score:
    """What the last action of each piece costs, with so many before it known: the same actions whatever is known."""
    bits = action_bits(prior, _ending(held_out, known + 1))
    return score_bits("", "", bits[:, -1:], _ending(held_out, 1))


def _ending(plans: Plans, length: int) -> Plans:
    """The last actions of plans of the same length."""
    first = plans.max_length - length
    context = plans.context[:, first:] if is_per_step(plans.context) and plans.context is not None else plans.context
    return replace(plans, actions=plans.actions[:, first:], lengths=None, context=context)


def _after(plans: Plans, skip: int) -> Plans:
    """The plans without their first `skip` actions."""
    skip = min(max(skip, 0), max(plans.max_length - 1, 0))
    lengths = (plans.mask().sum(1) - skip).clamp(min=0)
    context = plans.context[:, skip:] if is_per_step(plans.context) and plans.context is not None else plans.context
    return replace(plans, actions=plans.actions[:, skip:], lengths=lengths, context=context)


def _reach(learned: Plans, scored: Plans, most: int) -> int:
    """Past actions that are known at most: half of what the median plan has, so that pieces stand anywhere in plans."""
    halves = (int(plans.mask().sum(1).double().median()) // 2 for plans in (learned, scored))
    return min(most, *halves)


def _world(learned: Plans, num_contexts: int) -> TabularWorld | None:
    """How the context a step follows from the one before and the action there, where these alone decide it."""
    context, actions = learned.context, learned.num_actions
    if context is None or context.is_floating_point() or not is_per_step(context):
        return None
    goes_on = learned.mask()[:, 1:]
    code = (context.long() * actions + learned.actions.long())[:, :-1][goes_on]
    after = context[:, 1:][goes_on].long()
    table = torch.arange(num_contexts).repeat_interleave(actions)
    table[code] = after
    if not bool((table[code] == after).all()) or len(code) == 0:
        return None
    legal = torch.zeros(num_contexts * actions, dtype=torch.bool)
    legal[code] = True
    legal = legal.view(num_contexts, actions)
    legal[~legal.any(1)] = True
    return TabularWorld(table.view(num_contexts, actions), torch.zeros(1, num_contexts), legal)


def _generated(prior: Prior, scored: Plans, world: TabularWorld | None, seed: int) -> Tensor | None:
    """A plan sampled for each of the first held-out plans, as long, in its place; None where that cannot be told."""
    like, generator = scored[:MOST_GENERATED], torch.Generator().manual_seed(seed)
    if not prior.takes_context:
        return sample(prior, len(like), like.max_length, generator=generator)
    assert like.context is not None
    if not is_per_step(like.context):
        return sample(prior, len(like), like.max_length, like.context, generator=generator)
    if world is None or like.max_length == 0:
        return None
    return sample_in_world(prior, world, like.context[:, 0].long(), 1, like.max_length, generator=generator)[0][:, 0]
