"""A prior that learns the individual: along a sequence, its predictions follow what this one did before."""

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from math import inf, log
from typing import Any, Self, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from neuroprior._checks import check_memory, is_number
from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.plans.folds import FOLDS, folds, num_units
from neuroprior.priors.construction import as_prior, described
from neuroprior.priors.learning import (
    counted_plans,
    known_plans,
    plans_for,
    pop_validation,
    split_validation,
    training_plans,
)
from neuroprior.priors.prior import Prior
from neuroprior.sampling.states import State
from neuroprior.sampling.stepping import check_outputs

START_CONCENTRATIONS = (1.0, 10.0, 100.0)
"""From these the likeliest concentrations are searched."""

MIN_CONCENTRATION, MAX_CONCENTRATION = 1e-2, 1e5
"""Bounds of the search; at the upper one counts change next to nothing, and the concentration is set to infinity."""

MIN_GAIN_NATS = 2.0
"""What counting at a level must save on held-out groups in all, or it is left out."""

PAIRS_AT_ONCE = 2**24
"""Pairs of actions, a present and a past one, that are compared at once; bounds memory."""


AnyPrior = TypeVar("AnyPrior", bound=Prior)


class AdaptivePrior(Prior):
    """A base prior whose predictions are drawn towards what was done before in the same sequence.

    At level k it counts which actions followed the last k actions. With the prediction of the base as level -1,

        p_k(a) = (n_k(a) + c_k p_{k-1}(a)) / (n_k + c_k),

    n_k(a) being how often action a followed these k actions before, and n_k the sum over actions: the predictions of
    Dirichlet-multinomials, each around that of the level below (MacKay and Peto 1995, "A hierarchical Dirichlet
    language model"). Level 0 alone is Pólya's urn. The concentrations c_k say how alike individuals are: with infinite
    ones this prior is its base. `fit` sets them to those under which groups that the base has not learned from are
    likeliest. With a `decay` below 1 old counts fade: each time the k actions come again, what followed them before
    counts so many times less.

    Counts begin at zero with each sequence, or with those of earlier sequences of an individual, see `adapt`.

    Args:
        base: a prior; or, as in a saved `config`, an object with `prior`, the name of its class, and its `config`.
        concentrations: c_0, c_1, ..., above 0. Nothing is counted at a level with an infinite one (None, in a saved
            `config`). `fit` keeps their number and sets their values.
        decay: from 0 to 1.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> urn = AdaptivePrior(UniformPrior(2), [2.0])
        >>> urn.log_prob(torch.tensor([[0, 0, 0]])).exp().item()  # 1/2 * 2/3 * 3/4
        0.25
    """

    def __init__(
        self,
        base: Prior | Mapping[str, Any],
        concentrations: Sequence[float | None] = (10.0, 10.0),
        decay: float = 1.0,
    ) -> None:
        inner = as_prior(base)
        levels = [inf if c is None else c for c in concentrations]
        if not levels:
            raise ValueError("`concentrations` must have at least one number")
        for level, c in enumerate(levels):
            if not is_number(c) or not c > 0:
                raise ValueError(f"`concentrations[{level}]` must be above 0, got {c!r}")
        if not is_number(decay) or not 0 <= decay <= 1:
            raise ValueError(f"`decay` must be between 0 and 1, got {decay!r}")
        super().__init__(inner.num_actions, inner.num_contexts, inner.context_size, inner.num_patterns)
        self.base, self.decay = inner, float(decay)
        self.concentrations = tuple(map(float, levels))
        for level in range(len(levels)):
            self.register_buffer(f"earlier_{level}", torch.zeros(0, self.num_actions))
        self.tables = tuple(f"earlier_{level}" for level in range(len(levels)))
        self._know_as_base()

    def _know_as_base(self) -> None:
        base = self.base
        self.context_per, self.end, self.has_learned = base.context_per, base.end, base.has_learned
        self.action_names, self.context_names = base.action_names, base.context_names

    @property
    def num_weights(self) -> int:
        return self.base.num_weights

    @property
    def config(self) -> dict[str, Any]:
        concentrations = [c if c < inf else None for c in self.concentrations]
        return {"base": described(self.base), "concentrations": concentrations, "decay": self.decay}

    @property
    def learned(self) -> dict[str, Any]:
        return super().learned | {"base": self.base.learned}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        self.base.restore(learned["base"])

    def tables_fit(self) -> bool:
        tables = [(level, getattr(self, name)) for level, name in enumerate(self.tables)]
        shapes = [
            table.shape in ((0, self.num_actions), (self.num_actions**k, self.num_actions)) for k, table in tables
        ]
        return all(shapes) and all(bool((table.isfinite() & (table >= 0)).all()) for _, table in tables)

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return self.base.fit_settings

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        outputs = self.base.start(batch_size, context)
        logits, state = check_outputs(outputs, batch_size, self.num_actions, "start")
        before = torch.zeros(batch_size, 0, dtype=torch.long, device=logits.device)
        return self._adapt(logits[:, None], before, 0)[:, 0], (before, state)

    def step(self, action: Tensor, state: State, context: Tensor | None = None) -> tuple[Tensor, State]:
        before, inner = state
        outputs = self.base.step(action, inner, context)
        logits, inner = check_outputs(outputs, len(action), self.num_actions, "step")
        before = torch.cat([before, action.long()[:, None]], 1)
        return self._adapt(logits[:, None], before, before.shape[1])[:, 0], (before, inner)

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        logits = self.base(plans, context)
        out = torch.empty_like(logits)
        for rows, now in _blocks(*plans.shape):
            out[rows, now] = self._adapt(logits[rows, now], plans[rows].long(), now.start)
        return out

    def _adapt(self, logits: Tensor, actions: Tensor, first: int) -> Tensor:
        """Log-probabilities `[N, T, A]` of the steps from `first` on, from the `logits` of the base at these.

        `actions [N, L]` holds at least the actions before each of these steps.
        """
        if all(c == inf for c in self.concentrations):
            return logits
        probs = logits.softmax(-1)
        levels = [level for level, c in enumerate(self.concentrations) if c < inf]
        for level, (counts, total) in zip(levels, self._counts(actions, first, logits.shape[1], levels), strict=True):
            c = self.concentrations[level]
            probs = (counts + c * probs) / (total + c)
        return probs.log()

    def _counts(self, actions: Tensor, first: int, steps: int, levels: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
        """What was counted before each of the steps from `first` on.

        Args:
            actions: int64 `[N, L]`; -1 where there is none, between sequences.
            first, steps: of the T steps.
            levels: ascending.

        Returns:
            For each of the levels how often each action followed, `[N, T, A]`, and their sum, `[N, T, 1]`.
        """
        now = torch.arange(first, first + steps, device=actions.device)
        past = torch.arange(min(first + steps - 1, actions.shape[1]), device=actions.device)
        alike = (past < now[:, None]).expand(len(actions), -1, -1)
        before = actions[:, : len(past)]
        one_hot = functional.one_hot(before.clamp(min=0), self.num_actions).float() * (before >= 0)[..., None]
        code, columns = torch.zeros(len(actions), steps, dtype=torch.long, device=actions.device), []
        for level in range(levels[-1] + 1):
            if level > 0:
                # The action so many steps before each; -1, before the first, is like no other.
                padded = functional.pad(actions, (level, 0), value=-1)
                then, last = padded[:, : len(past)], padded[:, now]
                alike = alike & (last[..., None] == then[:, None]) & (then >= 0)[:, None]
                code = code + last.clamp(min=0) * self.num_actions ** (level - 1)
            if level not in levels:
                continue
            weights = alike.float()
            if self.decay < 1:
                weights = weights * self.decay ** (weights.sum(-1, keepdim=True) - weights.cumsum(-1))
            counts = weights @ one_hot
            earlier = getattr(self, self.tables[level])
            if len(earlier) and level <= first + steps:
                complete = (now >= level)[:, None]
                counts = counts + earlier[code] * complete * self.decay ** alike.sum(-1, keepdim=True)
            columns.append((counts, counts.sum(-1, keepdim=True)))
        return columns

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Fit the base, and the concentrations on groups that it has not learned from; returns self.

        A base that counts is fitted to all but a fifth of the groups five times, and then to all; one that is trained
        is trained once, without its `validation`, on which the concentrations are learned.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the held-out plans, and is passed on to the base.
            settings: of the base.

        Raises:
            ValueError: plans that the base cannot learn from, or a setting that it does not have.
        """
        self.check_settings(settings)
        plans = training_plans(self, plans)
        generator = generator_on(generator, "cpu")
        for name in self.tables:
            self.register_buffer(name, getattr(self, name)[:0])
        if self.fit_settings:
            learned, held_out = split_validation(plans, pop_validation(self, settings), generator)
            base_settings = {"validation": held_out, **settings}
            self.base.fit(plans_for(self.base, learned), generator=generator, **base_settings)
            self.learn_concentrations([(self.base, held_out)])
            self.base.recount(plans)
        else:
            parts = folds(plans, min(FOLDS, num_units(plans))) if num_units(plans) > 1 else []
            self.learn_concentrations([(deepcopy(self.base).fit(plans[rest]), plans[out]) for rest, out in parts])
            self.base.fit(plans)
        self._know_as_base()
        return self

    def recount(self, plans: Plans) -> Self:
        self.base.recount(counted_plans(self, plans))
        return self

    @torch.no_grad()
    def learn_concentrations(self, predicted: Sequence[tuple[Prior, Plans]]) -> None:
        """Set the concentrations to those under which plans are likeliest, infinite where that saves little.

        Args:
            predicted: bases, and plans that they have not learned from; none: concentrations are infinite.

        Raises:
            ValueError: plans of other actions or contexts than this prior's.
        """
        columns = [self._action_statistics(base, known_plans(self, plans)) for base, plans in predicted]
        if not columns:
            self.concentrations = (inf,) * len(self.concentrations)
            return
        self.concentrations = likeliest_concentrations(*join_columns(columns))

    def _action_statistics(self, base: Prior, plans: Plans) -> tuple[Tensor, Tensor, Tensor]:
        """Of M actions: the base's probability `[M]`, and its count and their sum at the K levels, `[K, M]` each."""
        parts = []
        for chunk, log_probs in base.forecasts(plans):
            actions, mask, length = chunk.actions.long(), chunk.mask(), chunk.max_length
            for rows, now in _blocks(len(chunk), length):
                index, inside = actions[rows, now, None], mask[rows, now]
                steps = min(now.stop, length) - now.start
                counted = self._counts(actions[rows], now.start, steps, range(len(self.tables)))
                values = [log_probs[rows, now].exp(), *(counts for counts, _ in counted)]
                taken = [value.gather(-1, index)[inside][:, 0].double() for value in values]
                totals = [total[inside][:, 0].double() for _, total in counted]
                parts.append((taken[0], torch.stack(taken[1:]), torch.stack(totals)))
        return join_columns(parts)

    @torch.no_grad()
    def individual_log_probs(self, plans: Plans) -> Tensor:
        """The log-probability of each action, given those before it and all earlier plans of its group.

        The counts of a group go on from plan to plan, in their order; a history ends with its plan.

        Args:
            plans: with groups, the individuals; without, each plan is one.

        Returns:
            `[N, L]`, nats; 0 beyond a plan's end.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        plans = plans_for(self, self.as_plans(plans))
        base = torch.cat([log_probs for _, log_probs in self.base.forecasts(plans)])
        mask, pause = plans.mask(), len(self.tables)
        group = torch.arange(len(plans), device=mask.device) if plans.group is None else plans.group
        row = group.unique(return_inverse=True)[1]
        sizes = mask.sum(1) + pause
        order = row.argsort(stable=True)
        begin = sizes[order].cumsum(0) - sizes[order]  # in all groups together, and then in its own
        begin = begin - begin[torch.searchsorted(row[order], row[order])]
        place = torch.empty_like(begin).index_copy_(0, order, begin)[:, None] + torch.arange(
            plans.max_length, device=mask.device
        )
        at = row[:, None].expand(mask.shape)[mask], place[mask]
        length = int(place[mask].max()) + 1 if mask.any() else 0
        actions = torch.full((int(row.max()) + 1, length), -1, device=mask.device)
        logits = base.new_zeros(*actions.shape, self.num_actions)
        actions[at], logits[at] = plans.actions[mask].long(), base[mask]
        for rows, now in _blocks(*actions.shape):
            logits[rows, now] = self._adapt(logits[rows, now], actions[rows], now.start)
        taken = base.new_zeros(mask.shape)
        taken[mask] = logits[at].log_softmax(-1).gather(-1, plans.actions[mask].long()[:, None])[:, 0]
        return taken

    @torch.no_grad()
    def count(self, plans: Plans | Tensor, retention: float = 1.0) -> None:
        """Add earlier sequences of an individual to the counts with which each sequence begins, in place.

        Args:
            plans: of the individual; nothing fades within them.
            retention: from 0 to 1: what was counted before counts so many times less.

        Raises:
            ValueError: plans of other actions than this prior's, or tables that would not fit into memory.
        """
        plans = counted_plans(self, plans) if isinstance(plans, Plans) else self.as_plans(plans)
        check_memory(4 * self.num_actions ** len(self.tables), concentrations=len(self.tables))
        for level, name in enumerate(self.tables):
            windows = plans.actions.long().unfold(1, level + 1, 1)[plans.mask()[:, level:]]
            place = self.num_actions ** torch.arange(level, -1, -1, device=windows.device)
            counts = (windows * place).sum(-1).bincount(minlength=self.num_actions ** (level + 1))
            earlier, counts = getattr(self, name), counts.view(-1, self.num_actions).float()
            self.register_buffer(name, retention * earlier + counts if len(earlier) else counts)


def adapt(prior: AnyPrior, plans: Plans | Tensor) -> AnyPrior:
    """Return a copy of a prior that begins each sequence with the counts of an individual's earlier ones.

    Counts add up: `adapt(adapt(prior, first), second)` has counted in both. A planner whose candidates come from the
    copy follows what the individual did.

    Args:
        prior: an `AdaptivePrior`, or one with such experts, as the combined prior has where plans are long.
        plans: earlier ones of the individual; nothing fades within them. A tensor is int64 `[N, L]`.

    Raises:
        ValueError: nothing in the prior learns along a sequence; other actions than the prior's, or tables that would
            not fit into memory.

    Example:
        >>> adapt(AdaptivePrior(UniformPrior(2), [2.0]), torch.tensor([[0, 0]])).log_prob(torch.tensor([[0]])).exp()
        tensor([0.7500])
    """
    if not isinstance(prior, Prior):
        raise ValueError(f"`prior` must be a fitted prior, got {type(prior).__name__}.")
    adapted = deepcopy(prior)
    parts = [learner for learner in adapted.modules() if isinstance(learner, AdaptivePrior)]
    if not parts:
        raise ValueError(
            f"`prior` must learn along a sequence, as an `AdaptivePrior` does (`neuroprior fit --prior adaptive`), or a"
            f" combined prior of sequences of a hundred actions or more; this {type(prior).__name__} does not."
        )
    for learner in parts:
        learner.count(plans)
    return adapted


def join_columns(parts: Sequence[tuple[Tensor, Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the triples of tensors as one, joined along their last dimension."""
    first, second, third = (torch.cat(column, -1) for column in zip(*parts, strict=True))
    return first, second, third


def likeliest_concentrations(probs: Tensor, counts: Tensor, totals: Tensor) -> tuple[float, ...]:
    """Return the K concentrations under which M actions are likeliest, infinite where a finite one saves little.

    Args:
        probs: float64 `[M]`: of each action, by the base.
        counts, totals: float64 `[K, M]`: how often it followed the history of each level before, and their sum.
    """
    from scipy.optimize import minimize  # takes a second to import: only where it is needed

    def search(levels: tuple[int, ...]) -> tuple[float, dict[int, float]]:
        """The loss of the likeliest finite concentrations of these levels, and these."""

        def loss(logs: np.ndarray[Any, Any]) -> tuple[float, np.ndarray[Any, Any]]:
            free = torch.tensor(logs, requires_grad=True)
            with torch.enable_grad():
                now = probs
                for level, c in zip(levels, free.exp(), strict=True):
                    now = (counts[level] + c * now) / (totals[level] + c)
                total = -now.clamp(min=1e-300).log().sum()
                slope = torch.autograd.grad(total, free)[0] if levels else free
            return float(total.detach()), slope.detach().numpy()

        if not levels:
            return loss(np.empty(0))[0], {}
        bounds = [(log(MIN_CONCENTRATION), log(MAX_CONCENTRATION))] * len(levels)
        tries = [
            minimize(loss, [log(first)] * len(levels), jac=True, method="L-BFGS-B", bounds=bounds)
            for first in START_CONCENTRATIONS
        ]
        best = min(tries, key=lambda solution: float(solution.fun))
        return float(best.fun), dict(zip(levels, np.exp(best.x).tolist(), strict=True))

    levels = tuple(range(len(counts)))
    least, finite = search(levels)
    while levels:
        fewer = [search(tuple(other for other in levels if other != level)) for level in levels]
        loss, rest = min(fewer, key=lambda outcome: outcome[0])
        if loss - least >= MIN_GAIN_NATS:
            break
        least, finite, levels = loss, rest, tuple(rest)
    return tuple(finite.get(level, inf) for level in range(len(counts)))


def _blocks(num: int, length: int) -> Iterator[tuple[slice, slice]]:
    """Slices of rows and of steps in which so many plans are taken, so that not too many pairs are compared at once."""
    rows = max(PAIRS_AT_ONCE // max(length, 1) ** 2, 1)
    steps = max(PAIRS_AT_ONCE // (rows * max(length, 1)), 1)
    for row in range(0, num, rows):
        for first in range(0, length, steps):
            yield slice(row, row + rows), slice(first, first + steps)
