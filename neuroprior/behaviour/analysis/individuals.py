"""How individuals differ: how far each is from the others, where it stands among them, and whether there are types."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp, rel_entr

from neuroprior._random import generator_on
from neuroprior.behaviour.analysis.flat import FlatPlans
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, numbered_names
from neuroprior.behaviour.recordings import Recordings

Array = NDArray[np.float64]

PRIOR_COUNTS = 5.0
"""Transitions as in all individuals that are added to those of each after each action, as rare ones are noisy."""

DRAWS = 199
"""Times that all individuals are drawn, for intervals and for what distance chance alone gives."""

STARTS, ROUNDS = 10, 100
"""Starts of the fit of types, and most rounds of each."""

MOST_TYPES = 4

FEWEST_INDIVIDUALS = 6
"""Below, no types are sought."""


@dataclass(frozen=True, eq=False, repr=False)
class Individuals:
    """S individuals (subjects; groups of plans) and their transitions.

    The distance of two individuals is the square root of the Jensen-Shannon divergence, in bits, of the transition
    probabilities after each action, weighted by how often this action is taken by all.

    Attributes:
        names: S of them.
        action_names: A of them.
        probs: `[S, A, A]`: the transition probabilities of each, smoothed towards those of all.
        distances: `[S, S]`: of each two.
        places: `[S, 2]`: each in a plane, by classical scaling (Torgerson 1952) of the distances.
        from_others: `[S, 3]`: how far each is from all others together, with a 95 % interval: of individuals drawn
            with its own transition probabilities and as many transitions.
        by_chance: `[S]`: the distance that 95 % stay below where all individuals are alike: Markov chains of order 1
            with as many transitions. `transitions` tests whether they are, whatever chains they are.
    """

    names: Sequence[str]
    action_names: Sequence[str]
    probs: Array
    distances: Array
    places: Array
    from_others: Array
    by_chance: Array

    def __repr__(self) -> str:
        """Return how many there are, and which is the farthest from the others."""
        farthest = self.names[int(self.from_others[:, 0].argmax())]
        return f"Individuals({len(self.names)}, farthest from the others: {farthest})"

    def frame(self, listed: int = 3) -> pd.DataFrame:
        """Return a row an individual: `individual, distance, low, high, by_chance, differs_in, x, y`.

        Args:
            listed: how many transitions are named in `differs_in`, those that differ most from the others'.
        """
        columns = dict(zip(("distance", "low", "high"), self.from_others.T, strict=True))
        frame = pd.DataFrame({"individual": self.names} | columns | {"by_chance": self.by_chance})
        number = len(self.names)
        gaps = (self.probs - self.probs.mean(0)) * number / max(number - 1, 1)
        flat = gaps.reshape(number, -1)
        most = np.argsort(-np.abs(flat), axis=1, kind="stable")[:, :listed]
        names, size = self.action_names, len(self.action_names)
        frame["differs_in"] = [
            ", ".join(f"{names[c // size]} → {names[c % size]} {100 * row[c]:+.0f} %" for c in cells)
            for row, cells in zip(flat, most, strict=True)
        ]
        return frame.assign(x=self.places[:, 0], y=self.places[:, 1])


def individuals(plans: RecordedPlans | Recordings, generator: torch.Generator | None = None) -> Individuals:
    """How far each individual is from the others in its transitions.

    Args:
        plans: with groups, the individuals; or recordings. An individual without transitions is left out.
        generator: draws individuals for intervals and tests.

    Raises:
        ValueError: fewer than two individuals have transitions.

    Example:
        >>> actions = torch.tensor([[0, 1] * 20, [0, 1] * 20, [0, 0, 1, 1] * 10])
        >>> result = individuals(RecordedPlans(actions, 2, group=torch.arange(3)), torch.Generator().manual_seed(0))
        >>> result.frame().individual[result.from_others[:, 0].argmax()]
        'group 2'
    """
    names, action_names, counts = _counts(plans)
    draws = np.random.default_rng(int(torch.randint(2**31, (), generator=generator_on(generator, "cpu"))))
    total = counts.sum(0)
    weight = total.sum(1) / total.sum()
    probs = _smooth(counts, total)
    distances = np.stack([_distance(probs, row, weight) for row in probs])
    probs_of_others = _smooth(total - counts, total)
    observed = _distance(probs, probs_of_others, weight)
    sizes = counts.sum(-1).astype(np.int64)

    def drawn_from(base: Array) -> Array:
        """The distances `[DRAWS, S]` from the others of individuals drawn with transition probabilities `base`."""
        rows = []
        for _ in range(DRAWS):
            sample = draws.multinomial(sizes, base).astype(np.float64)
            whole = sample.sum(0)
            rows.append(_distance(_smooth(sample, total), _smooth(whole - sample, total), weight))
        return np.stack(rows)

    # Drawn ones are noisier than what they were drawn from: their distances are too large by as much.
    spread = drawn_from(probs)
    low, high = (observed + np.quantile(spread - np.median(spread, axis=0), level, axis=0) for level in (0.025, 0.975))
    alike = drawn_from(np.broadcast_to(_smooth(total, total), probs.shape))
    from_others, chance = np.stack([observed, low.clip(min=0), high], 1), np.quantile(alike, 0.95, axis=0)
    return Individuals(names, action_names, probs, distances, _scale(distances), from_others, chance)


def _counts(plans: RecordedPlans | Recordings) -> tuple[list[str], list[str], Array]:
    """The names of the individuals and of the actions, and the transitions `[S, A, A]` of each that has any."""
    if isinstance(plans, Recordings):
        plans = plans.plans()
    plans = RecordedPlans.of(plans)
    flat, size = FlatPlans.of(plans), plans.num_actions
    at = flat.starts(2)
    group = torch.arange(len(plans)) if plans.group is None else plans.group.cpu().long()
    present, rank = group[flat.plan[at].cpu()].unique(return_inverse=True)
    if len(present) < 2:
        raise ValueError(f"`plans` must have at least two groups with transitions, got {len(present)}.")
    cell = (flat.actions[at] * size + flat.actions[at + 1]).cpu()
    counts = (rank * size**2 + cell).bincount(minlength=len(present) * size**2).view(-1, size, size)
    names = numbered_names(plans.group_names, present, "plan" if plans.group is None else "group")
    return names, action_names(plans), counts.double().numpy()


def _smooth(counts: Array, total: Array) -> Array:
    """Transition probabilities `[..., A, A]` of counts, with `PRIOR_COUNTS` more as in `total [A, A]`."""
    usual = (total + 1e-9) / (total + 1e-9).sum(1, keepdims=True)
    smoothed: Array = (counts + PRIOR_COUNTS * usual) / (counts.sum(-1, keepdims=True) + PRIOR_COUNTS)
    return smoothed


def _distance(probs: Array, others: Array, weight: Array) -> Array:
    """The distance of transition probabilities `[..., A, A]` with rows of this weight `[A]`."""
    distance: Array = np.sqrt((divergence(probs, others) * weight).sum(-1))
    return distance


def divergence(probs: Array, others: Array) -> Array:
    """The Jensen-Shannon divergence `[...]`, in bits, of probabilities `[..., A]`."""
    middle = (probs + others) / 2
    bits: Array = (rel_entr(probs, middle) + rel_entr(others, middle)).sum(-1) / (2 * np.log(2))
    return bits.clip(min=0)


def _scale(distances: Array) -> Array:
    """Places `[S, 2]` whose distances are as near as possible to these."""
    squares = distances**2
    centred = -(squares - squares.mean(0) - squares.mean(1, keepdims=True) + squares.mean()) / 2
    values, vectors = np.linalg.eigh(centred)
    places: Array = vectors[:, ::-1][:, :2] * np.sqrt(values[::-1][:2].clip(min=0))
    places = np.pad(places, ((0, 0), (0, 2 - places.shape[1])))
    return places * np.where(places[np.abs(places).argmax(0), [0, 1]] < 0, -1, 1)  # the sign of a vector is arbitrary


@dataclass(frozen=True, eq=False, repr=False)
class Types:
    """Whether individuals fall into types: mixtures of Markov chains of order 1 over individuals.

    Attributes:
        number: of types, chosen on held-out individuals.
        bits: `[K]`: bits per transition of held-out individuals with 1 to K types.
        more, error: `[K]`: more than with the best number, paired over individuals, and the standard error of this.
        names: S individuals.
        shares: `[S, number]`: how probable it is that each individual is of each type.
        sentence: says it.
    """

    number: int
    bits: Array
    more: Array
    error: Array
    names: Sequence[str]
    shares: Array
    sentence: str

    def __repr__(self) -> str:
        """Return the number of types."""
        return f"Types({self.number})"

    def frame(self) -> pd.DataFrame:
        """Return a row for each number of types: `types, bits, more, error, chosen`."""
        number = np.arange(1, len(self.bits) + 1)
        columns = {"types": number, "bits": self.bits, "more": self.more, "error": self.error}
        return pd.DataFrame(columns | {"chosen": number == self.number})


def individual_types(plans: RecordedPlans | Recordings, generator: torch.Generator | None = None) -> Types:
    """Whether individuals fall into types, each with transition probabilities of its own.

    Each number of types up to `MOST_TYPES` is fitted by expectation maximisation without each fifth of the individuals,
    and scored on these. Chosen is the smallest number that is no more than a standard error behind the best.

    Args:
        plans: with groups, the individuals; or recordings.
        generator: draws the starts and the folds.

    Raises:
        ValueError: fewer than `FEWEST_INDIVIDUALS` individuals have transitions.

    Example:
        >>> actions = torch.tensor([[0, 1] * 20] * 6 + [[0, 0, 1, 1] * 10] * 6)
        >>> individual_types(RecordedPlans(actions, 2, group=torch.arange(12)), torch.Generator().manual_seed(0)).number
        2
    """
    names, _, counts = _counts(plans)
    if len(names) < FEWEST_INDIVIDUALS:
        raise ValueError(f"`plans` must have at least {FEWEST_INDIVIDUALS} individuals for types, got {len(names)}.")
    draws = np.random.default_rng(int(torch.randint(2**31, (), generator=generator_on(generator, "cpu"))))
    fold = draws.permutation(len(names)) % 5
    most = min(MOST_TYPES, len(names) // 3)
    scores = np.zeros((most, len(names)))
    for number in range(1, most + 1):
        for held_out in range(5):
            log_weights, log_probs = _fit_mixture(counts[fold != held_out], number, draws)
            scores[number - 1, fold == held_out] = logsumexp(
                log_weights + np.einsum("sab,kab->sk", counts[fold == held_out], log_probs), axis=1
            )
    sizes = counts.sum((1, 2))
    bits = -scores.sum(1) / np.log(2) / sizes.sum()
    gaps = -(scores - scores[bits.argmin()]) / np.log(2)  # [K, S], bits
    more = gaps.sum(1) / sizes.sum()
    error = np.sqrt(len(names) * (gaps - more[:, None] * sizes).var(1, ddof=1)) / sizes.sum()
    number = int(np.argmax(more <= error)) + 1
    log_weights, log_probs = _fit_mixture(counts, number, draws)
    logits = log_weights + np.einsum("sab,kab->sk", counts, log_probs)
    shares = np.exp(logits - logsumexp(logits, axis=1, keepdims=True))
    if number == 1:
        sentence = f"One type: the {len(names)} individuals do not fall into groups with transitions of their own."
    else:
        members = ", ".join(str(size) for size in sorted(np.bincount(shares.argmax(1), minlength=number))[::-1])
        saved = bits[0] - bits[number - 1]
        sentence = (
            f"{number} types of individuals, with {members} members: held-out individuals take {saved:.3g} bits per"
            " action less than with one."
        )
    return Types(number, bits, more, error, names, shares, sentence)


def _fit_mixture(counts: Array, number: int, draws: np.random.Generator) -> tuple[Array, Array]:
    """The logarithms of the weights `[K]` and transition probabilities `[K, A, A]` of the likeliest mixture found."""
    total = counts.sum(0)
    starts = 1 if number == 1 else STARTS
    shares = draws.dirichlet(np.full(number, 0.2), (starts, len(counts)))  # [starts, S, K]
    before = np.full(starts, -np.inf)
    for _ in range(ROUNDS):
        log_probs = np.log(_smooth(np.einsum("isk,sab->ikab", shares, counts), total))
        log_weights = np.log((shares.sum(1) + 1) / (len(counts) + number))
        logits = log_weights[:, None] + np.einsum("sab,ikab->isk", counts, log_probs)
        whole = logsumexp(logits, axis=2, keepdims=True)
        shares, likelihood = np.exp(logits - whole), whole.sum((1, 2))
        if np.all(likelihood - before < 1e-6 * np.abs(likelihood)):
            break
        before = likelihood
    best = int(likelihood.argmax())
    return log_weights[best], log_probs[best]
