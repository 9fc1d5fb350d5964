"""How long actions take: for each action, or each action and the next one, a law chosen by held-out likelihood."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor
from torch.nn import functional

from neuroprior._checks import check_range, check_sizes
from neuroprior._random import generator_on
from neuroprior.behaviour.durations.laws import (
    LAW_NAMES,
    LAWS,
    MOST_PARAMETERS,
    LawName,
    Sets,
    by_law,
    fit_laws,
    log_likelihood,
    log_survival,
    resolution,
)
from neuroprior.behaviour.recorded_plans import RecordedPlans, durations_of
from neuroprior.plans import Plans
from neuroprior.plans.folds import FEWEST_UNITS, FOLDS, divisible, folds, num_units
from neuroprior.priors.prior import as_actions
from neuroprior.priors.saved import SavedModule

FEWEST = 10
"""The fewest known durations above 0 with which an action has a law of its own."""

FEWEST_OF_TRANSITION = 30
"""The fewest with which an action has a law of its own before a certain next action."""

NATS_A_PARAMETER = 2.0
"""Nats of held-out log-likelihood that a law must gain for each parameter that it has more than another.

The held-out likelihood of a law that contains the true one is often a little higher by chance. Of 60 sets of 500
exponential durations, the exponential law was chosen for 45 without this, and for 59 with it.
"""

AT_ONCE = 2**18
"""Durations, each as often as there are parts without it, that laws are fitted to together: of more, part by part."""


class DurationLaw(NamedTuple):
    """The law of the durations of an action."""

    action: int
    next_action: int | None  # the law holds where this one follows; None: wherever there is no other
    law: LawName  # of durations above 0
    parameters: dict[str, float]  # by name; logarithms are of the unit of the durations
    zero: float  # probability of a duration of 0
    number: int  # known durations above 0 that it was fitted to; 0: too few, it is that of all actions together


class DurationModel(SavedModule):
    """The distribution of how long each action takes, given the actions: the dwell times of a semi-Markov process.

    Each action has a probability that it takes no time at all (point events), the share of such durations among the
    known ones, and a law of its other durations: exponential, gamma, lognormal, Weibull, or a mixture of two lognormal
    ones (Johnson, Kotz and Balakrishnan 1994, chapters 14, 17, 19 and 21). Each law is fitted without a part of the
    plans and scored on it; the best is taken, where it gains `NATS_A_PARAMETER` for each parameter that it has more
    than another one. In the same way it is decided whether the durations of an action depend on the action that follows
    it: they then have a law for each next action that is frequent enough, all of one kind.
    Parts are held out by group (by plan, where there are no two groups; by time, where there is one plan).

    Of durations that were cut off only the probability counts that they are longer. Unknown ones are left out. An
    action with fewer than `FEWEST` known ones has the law of all actions together.
    The laws are continuous: where durations were rounded, to frames or seconds, no law is narrower than the rounding.

    Args:
        num_actions: A.
        laws: names of the laws to choose from, of `LAW_NAMES`; all by default.
        transitions: whether durations may depend on the next action.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> durations = torch.tensor([[1.0, 4.0, 1.2, 3.5]]).repeat(20, 1) * torch.linspace(0.5, 2, 20)[:, None]
        >>> actions = torch.tensor([[0, 1, 0, 1]]).repeat(20, 1)
        >>> model = DurationModel(2).fit(RecordedPlans(actions, 2, durations=durations))
        >>> model.num_actions
        2
    """

    tables = ("pair", "law", "zero", "values", "number")

    pair: Tensor  # int64 [T], ascending: action * A + next action, of the laws of transitions
    law: Tensor  # int64 [A + T]: its number in LAW_NAMES
    zero: Tensor  # float64 [A + T]
    values: Tensor  # float64 [A + T, MOST_PARAMETERS]: of their parameters
    number: Tensor  # int64 [A + T]

    def __init__(self, num_actions: int, laws: Sequence[LawName] = LAW_NAMES, transitions: bool = True) -> None:
        super().__init__()
        check_sizes(num_actions=num_actions)
        if isinstance(laws, str) or not laws or set(laws) - set(LAW_NAMES):
            raise ValueError(f"`laws` must be some of {', '.join(LAW_NAMES)}, got {laws!r}.")
        self.num_actions, self.transitions = num_actions, transitions
        self.laws = tuple(law for law in LAW_NAMES if law in laws)
        whole = torch.zeros(num_actions, dtype=torch.long)
        ones = torch.ones(num_actions, MOST_PARAMETERS, dtype=torch.double)
        self._keep(whole[:0], whole, ones[:, 0] * 0, ones, whole)

    def __repr__(self) -> str:
        return f"DurationModel({self.num_actions}, laws={list(self.laws)}, transitions={self.transitions})"

    @property
    def config(self) -> dict[str, Any]:
        return {"num_actions": self.num_actions, "laws": list(self.laws), "transitions": self.transitions}

    def _keep(self, *tables: Tensor) -> None:
        for name, table in zip(self.tables, tables, strict=True):
            self.register_buffer(name, table)

    def table(self) -> list[DurationLaw]:
        """The law of each action, then those of transitions."""
        keys = [
            *((a, None) for a in range(self.num_actions)),
            *(divmod(p, self.num_actions) for p in self.pair.tolist()),
        ]
        rows = []
        for row, (action, after) in enumerate(keys):
            name = LAW_NAMES[int(self.law[row])]
            values = dict(zip(LAWS[name].names, self.values[row].tolist(), strict=False))
            rows.append(DurationLaw(action, after, name, values, float(self.zero[row]), int(self.number[row])))
        return rows

    @torch.no_grad()
    def fit(self, plans: RecordedPlans) -> Self:
        """Fit and choose the laws anew; returns self. Nothing is drawn at random.

        Args:
            plans: with durations; an end symbol has none.

        Raises:
            ValueError: plans of other actions, without durations, or of which none is known.
        """
        self._check(plans)
        timed = self._timed_mask(plans)
        if not bool(timed.any()):
            raise ValueError("`durations` must have one at least that is known, and not NaN.")
        action, after = plans.actions[timed].long().cpu(), self._next(plans)[timed].cpu()
        time, fold = durations_of(plans)[timed].double().cpu(), _fold_numbers(plans, timed)[timed].cpu()
        zeros = time == 0
        count = action.bincount(minlength=self.num_actions)
        pooled = zeros.double().mean()
        zero = action[zeros].bincount(minlength=self.num_actions) / count.double()
        zero = torch.where(count < FEWEST, pooled, zero)
        action, after, time, fold = action[~zeros], after[~zeros], time[~zeros], fold[~zeros]
        held = _Held(action, after, time, fold.unique(return_inverse=True)[1], _cut_off(plans)[timed].cpu()[~zeros])
        chosen, fits, number = self._action_laws(held)
        law = torch.tensor([LAW_NAMES.index(name) for name in self.laws])
        action_parameters = fits[chosen, -1, torch.arange(self.num_actions)]
        tables = [law[chosen], zero, action_parameters, number.masked_fill(number < FEWEST, 0)]
        pair = after[:0]
        if self.transitions and len(time):
            pair, of_transitions, parameters, number = self._transition_laws(held, chosen, fits)
            more = [law[of_transitions], zero[pair // self.num_actions], parameters, number]
            tables = [torch.cat(both) for both in zip(tables, more, strict=True)]
        self._keep(*(table.to(self.law.device) for table in (pair, *tables)))
        return self

    def _action_laws(self, held: "_Held") -> tuple[Tensor, Tensor, Tensor]:
        """Laws of actions.

        Returns:
            The places in `laws` of those that were chosen `[A]`, the parameters of all `[K, F + 1, A, ...]` without
            each part and of all durations, and how many durations each action has.
        """
        size, laws = self.num_actions, len(self.laws)
        number = held.action[~held.cut_off].bincount(minlength=size)
        if not len(held.time):  # actions take no time at all, or none is known: the law is never used
            ones = torch.ones(laws, 1, size, MOST_PARAMETERS, dtype=torch.double)
            return torch.zeros(size, dtype=torch.long), ones, number
        # Last, all actions together, which stand for those with too few.
        cell = torch.cat([held.action, torch.full_like(held.action, size)])
        time, fold, cut_off = held.time.repeat(2), held.fold.repeat(2), held.cut_off.repeat(2)
        fits, count = _fit_without_folds(time, cut_off, cell, size + 1, fold, self.laws)
        few = count < FEWEST
        few[:, size] = False
        fits = torch.where(few[..., None], fits[:, :, size:], fits)
        score = torch.zeros(laws, size + 1, dtype=torch.double)
        if len(count) > 2:
            for place, name in enumerate(self.laws):
                score[place].index_add_(0, cell, log_likelihood(LAWS[name], time, cut_off, fits[place, fold, cell]))
        chosen = (score - self._prices()[:, None]).argmax(0)
        return torch.where(number < FEWEST, chosen[size], chosen[:size]), fits[:, :, :size], number

    def _transition_laws(
        self, held: "_Held", law_of: Tensor, of_actions: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The laws of transitions, of those actions that they predict better: pairs, places, parameters and numbers."""
        size, laws = self.num_actions, len(self.laws)
        code = held.action * size + held.after
        pair, count = code[(held.after >= 0) & ~held.cut_off].unique(return_counts=True)
        pair = pair[count >= FEWEST_OF_TRANSITION]
        kept = (held.after >= 0) & torch.isin(code, pair)
        action, time, fold, cut_off = held.action[kept], held.time[kept], held.fold[kept], held.cut_off[kept]
        cell, doing = torch.searchsorted(pair, code[kept]), pair // size
        # The law of the action comes last.
        score = torch.zeros(laws + 1, size, dtype=torch.double)
        if not len(fold) or bool((fold == fold[0]).all()):
            return pair[:0], pair[:0], score.new_zeros(0, MOST_PARAMETERS), pair[:0]
        fits, count = _fit_without_folds(time, cut_off, cell, len(pair), fold, self.laws, of_actions.shape[1] - 1)
        fits = torch.where((count < FEWEST)[..., None], of_actions[:, :, doing], fits)
        for place, name in enumerate(self.laws):
            score[place].index_add_(0, action, log_likelihood(LAWS[name], time, cut_off, fits[place, fold, cell]))
            same = law_of[action] == place
            parameters = of_actions[place, fold[same], action[same]]
            likely = log_likelihood(LAWS[name], time[same], cut_off[same], parameters)
            score[laws].index_add_(0, action[same], likely)
        # The law of the action is needed in either case: for rare transitions, and at the end of a plan.
        score[:laws] -= self._prices()[:, None] * doing.bincount(minlength=size)
        best, chosen = score[:laws].max(0)
        better = (best > score[laws])[doing]
        places, number = chosen[doing], count[-1]
        return pair[better], places[better], fits[places, -1, torch.arange(len(pair))][better], number[better]

    def _prices(self) -> Tensor:
        """What a law `[K]` must gain, in nats."""
        return NATS_A_PARAMETER * torch.tensor([float(len(LAWS[name].names)) for name in self.laws]).double()

    def log_prob(self, plans: RecordedPlans) -> Tensor:
        """The log-density of each known duration, given its action and the next one; of a 0, its log-probability.

        Of a duration that was cut off it is the log-probability that it is longer.

        Args:
            plans: with durations.

        Returns:
            `[N, L]`, float64, nats, of durations in their unit; 0 where a duration is unknown, at an end symbol and
            beyond a plan's end; -inf for a duration of 0 of an action that always took some time, and the reverse.

        Raises:
            ValueError: plans of other actions, or without durations.
        """
        self._check(plans)
        timed, row = self._timed_mask(plans), self._rows(plans)
        time, row = durations_of(plans).double()[timed], row[timed]
        positive = time > 0
        density = by_law("log_density", self.law[row[positive]], time[positive], self.values[row[positive]])
        longer = _cut_off(plans)[timed][positive]
        above = by_law(
            "cdf", self.law[row[positive]][longer], time[positive][longer], self.values[row[positive]][longer]
        )
        density[longer] = log_survival(above)
        log_probs = self.zero[row].log()
        log_probs[positive] = torch.log1p(-self.zero[row[positive]]) + density
        return torch.zeros(timed.shape, dtype=torch.double, device=timed.device).masked_scatter(timed, log_probs)

    def cdf(self, action: int, times: Tensor) -> Tensor:
        """The probability that an action takes at most so long, whatever follows it.

        Args:
            action: its number.
            times: of any shape, at least 0.

        Returns:
            float64, of the same shape.

        Raises:
            ValueError: there is no such action.
        """
        check_range("action", torch.tensor([action]), self.num_actions, "actions")
        time = times.double().flatten().clamp(min=torch.finfo(torch.double).tiny)
        row = torch.full_like(time, action, dtype=torch.long)
        above = by_law("cdf", self.law[row], time, self.values[row]).where(times.flatten() > 0, 0.0)
        return (self.zero[action] + (1 - self.zero[action]) * above).view(times.shape)

    def sample(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None) -> Tensor:
        """How long the actions of plans take, drawn independently of each other.

        Args:
            plans: `Plans`, or integers `[N, L]`.
            generator: source of randomness; one number is drawn for each of the `[N, L]` places.

        Returns:
            `[N, L]`, float32; 0 at an end symbol and beyond a plan's end.

        Raises:
            ValueError: plans of other actions.
        """
        plans = plans if isinstance(plans, Plans) else Plans(as_actions(plans), self.num_actions)
        self._check(plans, durations=False)
        row, device = self._rows(plans).flatten(), plans.actions.device
        drawn = torch.rand(len(row), generator=generator_on(generator, device), device=device, dtype=torch.double)
        zero = self.zero[row]
        # What is left of the number above the probability of 0 is uniform again.
        rest = ((drawn - zero) / (1 - zero)).clamp(2.0**-53, 1 - 2.0**-53).nan_to_num(0.5)
        time = by_law("quantile", self.law[row], rest, self.values[row]).float()
        limits = torch.finfo(torch.float32)
        time = time.clamp(limits.tiny, limits.max).masked_fill(drawn < zero, 0).view(plans.actions.shape)
        return time.masked_fill(~plans.mask(end=False), 0)  # an end symbol takes no time

    def _rows(self, plans: Plans) -> Tensor:
        """`[N, L]`: the row of the tables for each action, given the next one."""
        action, after = plans.actions.long(), self._next(plans)
        if not len(self.pair):
            return action
        code = action * self.num_actions + after
        at = torch.searchsorted(self.pair, code).clamp(max=len(self.pair) - 1)
        return torch.where((after >= 0) & (self.pair[at] == code), self.num_actions + at, action)

    def _next(self, plans: Plans) -> Tensor:
        """`[N, L]`: the action after each, -1 after the last of a plan."""
        after = plans.actions.long().masked_fill(~plans.mask(), -1)
        return functional.pad(after[:, 1:], (0, min(plans.max_length, 1)), value=-1)

    def _timed_mask(self, plans: RecordedPlans) -> Tensor:
        times = durations_of(plans)
        return plans.mask(end=False) & ~times.isnan() & ~(_cut_off(plans) & (times == 0))

    def _check(self, plans: Plans, durations: bool = True) -> None:
        if plans.num_actions != self.num_actions:
            raise ValueError(f"`plans` must have {self.num_actions} actions, as this model, got {plans.num_actions}.")
        if durations:
            durations_of(plans)

    def tables_fit(self) -> bool:
        rows = self.num_actions + len(self.pair)
        return (
            self.pair.dim() == 1
            and self.law.shape == self.zero.shape == self.number.shape == (rows,)
            and self.values.shape == (rows, MOST_PARAMETERS)
            and bool(((self.law >= 0) & (self.law < len(LAW_NAMES))).all())
            and bool(((self.zero >= 0) & (self.zero <= 1)).all())
            and bool((self.pair.diff() > 0).all())
            and bool(((self.pair >= 0) & (self.pair < self.num_actions**2)).all())
        )


class _Held(NamedTuple):
    """Durations above 0 `[n]`, the part that each is held out with, from 0, and whether it was cut off."""

    action: Tensor
    after: Tensor  # the next action; -1: there is none
    time: Tensor
    fold: Tensor
    cut_off: Tensor


def _cut_off(plans: RecordedPlans) -> Tensor:
    """Which durations `[N, L]` were cut off."""
    return torch.zeros_like(plans.mask()) if plans.cut_off is None else plans.cut_off


def _fit_without_folds(
    time: Tensor,
    cut_off: Tensor,
    cell: Tensor,
    cells: int,
    fold: Tensor,
    laws: Sequence[LawName],
    num_folds: int | None = None,
) -> tuple[Tensor, Tensor]:
    """K laws `[K, F + 1, C, ...]` fitted to each cell without each of F parts, and last to all; and of how many."""
    num_folds = int(fold.max()) + 1 if num_folds is None else num_folds
    step, batches = resolution(time), []
    for left_out in torch.arange(num_folds + 1).split(max(AT_ONCE // max(len(time), 1), 1)):
        without, index = (fold != left_out[:, None]).nonzero(as_tuple=True)
        sets = Sets(time[index].log(), without * cells + cell[index], len(left_out) * cells, step, cut_off[index])
        count = sets.cell[~sets.cut_off].bincount(minlength=sets.number).view(-1, cells)
        batches.append((fit_laws(sets, laws).unflatten(1, (len(left_out), cells)), count))
    fits, counts = zip(*batches, strict=True)
    return torch.cat(fits, 1), torch.cat(counts)


def _fold_numbers(plans: Plans, timed: Tensor) -> Tensor:
    """`[N, L]`: the part of the plans that each duration is held out with."""
    plans = divisible(plans)
    units = num_units(plans)
    fold = torch.zeros(plans.actions.shape, dtype=torch.long, device=timed.device)
    if units < FEWEST_UNITS:
        place = timed.flatten().cumsum(0).view(timed.shape) - 1
        return (place * FOLDS).div(max(int(timed.sum()), 1), rounding_mode="floor")
    for number, (_, held_out) in enumerate(folds(plans, min(FOLDS, units))):
        fold[held_out] = number
    return fold
