"""The macro prior: any prior over actions and macro-actions, as a prior over actions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._hashing import row_hashes
from neuroprior.plans import Plans
from neuroprior.priors.construction import as_prior, described
from neuroprior.priors.learning import training_plans
from neuroprior.priors.macros.macros import CRITERIA, Criterion, Macro, macros_of
from neuroprior.priors.prior import Prior
from neuroprior.sampling.states import State, join_rows, map_state, select_rows, tensors_in


class MacroPrior(Prior):
    """A prior that chooses between actions and macro-actions, sequences of actions that it takes as one.

    `inner` is a prior over A + M symbols: the actions, and the macros numbered from A. A plan may arise from several
    sequences of symbols, its parses; its probability is the sum over all of them (a plan that is cut off within a macro
    counts, too). After each action the parses of the prefix are known with their probabilities; parses after which
    `inner` is in the same state are merged. This is exact as long as a prefix has at most `MOST` parses; of more, the
    least probable are dropped. A chain soon reaches the same state and so has few parses; a network has all of them,
    hundreds after a dozen actions, and takes time and memory in proportion.

    Args:
        num_actions: A.
        inner: a prior over A + M actions without context; or, as in a saved `config`, an object with `prior`, the name
            of a class, and its `config`.
        by: how macros are chosen, see `learn_macros`.

    Attributes:
        macros: those that `fit` learned, at most M.

    Raises:
        ValueError: an argument is out of range, or the inner prior does not fit.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2, 0, 1, 2]]).repeat(5, 1), 3)
        >>> prior = MacroPrior(3, MarkovPrior(5, 1)).fit(plans)
        >>> [macro.actions for macro in prior.macros]
        [(0, 1), (0, 1, 2)]
    """

    MOST = 128

    actions_at_once = 2**14

    symbol_actions: Tensor
    """`[A + M, longest]`: the actions of each symbol; -1 beyond."""

    symbols_from: Tensor
    """`[A, most]`: the symbols that begin with each action; -1 beyond."""

    def __init__(self, num_actions: int, inner: Prior | Mapping[str, Any], by: Criterion = "count") -> None:
        check_sizes(num_actions=num_actions)
        if by not in CRITERIA:
            raise ValueError(f"`by` must be one of {', '.join(map(repr, CRITERIA))}, got {by!r}")
        made = as_prior(inner)
        if made.num_actions <= num_actions:
            raise ValueError(
                f"`inner` must be a prior over more than {num_actions} actions, one for each macro,"
                f" got {made.num_actions}"
            )
        if isinstance(made, MacroPrior):
            raise ValueError("`inner` must be a prior without macros; give this one more of them")
        if made.takes_context:
            raise ValueError("`inner` must be a prior without context: a macro is one step with many contexts")
        super().__init__(num_actions)
        self.inner, self.by = made, by
        self._set_macros([])

    @property
    def num_macros(self) -> int:
        """M, the most macros."""
        return self._inner().num_actions - self.num_actions

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"inner": described(self._inner()), "by": self.by}

    @property
    def learned(self) -> dict[str, Any]:
        macros = [[list(macro.actions), macro.count, macro.gain] for macro in self.macros]
        return super().learned | {"macros": macros, "inner": self._inner().learned}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        macros = [Macro(tuple(actions), count, gain) for actions, count, gain in learned["macros"]]
        known = all(isinstance(a, int) and 0 <= a < self.num_actions for macro in macros for a in macro.actions)
        if not known or len(macros) > self.num_macros or any(len(macro.actions) < 2 for macro in macros):
            raise ValueError(f"`macros` must be at most {self.num_macros} sequences of at least two actions")
        self._set_macros(macros)
        self._inner().restore(learned["inner"])

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return self._inner().fit_settings

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn macros, and then the inner prior from the plans as recoded with them; returns self.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: passed on to the inner prior.
            settings: passed on to the inner prior.

        Raises:
            ValueError: the plans do not fit this prior, or have an end symbol, or a setting that the inner prior does
                not have.
        """
        self.check_settings(settings)
        given = plans if isinstance(plans, Plans) else Plans(torch.as_tensor(plans), self.num_actions)
        held_out = [some for some in (settings.get("validation"),) if isinstance(some, Plans)]
        macros, recoded = macros_of(given, self.num_macros, self.by, *held_out)  # raises before anything is changed
        training_plans(self, given)
        settings |= {"validation": recoded[1]} if held_out else {}
        self._inner().fit(recoded[0], generator=generator, **settings)
        self._set_macros(macros)
        return self

    @torch.no_grad()  # `fit` trains the inner prior itself
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        logits, state = self._inner().start(batch_size)
        row = torch.arange(batch_size, device=logits.device)
        return self._joined([self._parses(row, logits.new_zeros(batch_size), logits, state)], batch_size)

    @torch.no_grad()
    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        action, groups = action.long(), [_Parses.unpadded(*group) for group in state]
        after = [[parses.within(action, self.symbol_actions)] for parses in groups]
        for place, parses in enumerate(groups):
            extended = self._extended(parses, action)
            # Parses with one more symbol form a group of their own, since their states may be of another size.
            further = place + (not isinstance(extended.state, Tensor) or extended.state.dim() > 1)
            if further == len(after):
                after.append([])
            after[further].append(extended)
        return self._joined(_most_probable([_merged(some) for some in after], len(action), self.MOST), len(action))

    def _extended(self, parses: "_Parses", action: Tensor) -> "_Parses":
        """The parses with one more symbol, which begins with `action [N]`."""
        free = parses.place == 0
        row, weight, _, log_probs, state = parses.taken(free)
        symbols = self.symbols_from[action[row]]
        parse, which = (symbols >= 0).nonzero(as_tuple=True)
        symbol = symbols[parse, which]
        weight = weight[parse] + log_probs[parse, symbol]
        possible = weight > -torch.inf
        parse, symbol, weight = parse[possible], symbol[possible], weight[possible]
        inner = self._inner()
        if len(parse) == 0:
            return parses.taken(parse)
        logits, after = inner.step(symbol, select_rows(state, parse))
        found = self._parses(row[parse], weight, logits, after)
        longer = (self.symbol_actions[symbol] >= 0).sum(1) > 1
        place = torch.where(longer, symbol * self.symbol_actions.shape[1] + 1, 0)
        return found._replace(place=place)

    def _parses(self, row: Tensor, weight: Tensor, logits: Tensor, state: State) -> "_Parses":
        """Parses at whose end the inner prior gives `logits`; macros that were not learned have probability 0."""
        unknown = torch.arange(logits.shape[1], device=logits.device) >= self.num_actions + len(self.macros)
        log_probs = logits.masked_fill(unknown, -torch.inf).log_softmax(-1)
        return _Parses(row, weight, torch.zeros_like(row), log_probs, state)

    def _joined(self, groups: Sequence["_Parses"], batch: int) -> tuple[Tensor, State]:
        """Logits and state of `batch` plans: probabilities are summed over parses, whose weights then sum to one."""
        total = torch.full((batch,), -torch.inf, dtype=torch.float64, device=self.device)
        for parses in groups:
            total = torch.logaddexp(total, _log_sums(parses.weight, parses.row, batch))
        probs = torch.zeros(batch, self.num_actions, dtype=torch.float64, device=self.device)
        state: list[State] = []
        for parses in groups:
            weight = (parses.weight.double() - total[parses.row]).exp()
            probs.index_add_(0, parses.row, weight[:, None] * self._next(parses))
            state.append(parses._replace(weight=weight.log()).padded(batch))
        return probs.log().float(), tuple(state)

    def _next(self, parses: "_Parses") -> Tensor:
        """The probabilities `[R, A]` of the next action under each parse."""
        first = torch.zeros(len(self.symbol_actions), self.num_actions, dtype=torch.float64, device=self.device)
        first[torch.arange(len(first)), self.symbol_actions[:, 0]] = 1
        free = parses.log_probs.double().exp() @ first
        size = self.symbol_actions.shape[1]
        coming = self.symbol_actions[parses.place.div(size, rounding_mode="floor"), parses.place % size]
        certain = torch.nn.functional.one_hot(coming, self.num_actions).double()
        return torch.where((parses.place > 0)[:, None], certain, free)

    def _set_macros(self, macros: Sequence[Macro]) -> None:
        """Set the macros, and the tables of their actions."""
        self.macros = tuple(macros)
        meaning = [(a,) for a in range(self.num_actions)] + [macro.actions for macro in macros]
        meaning += [(0,)] * (self.num_macros - len(macros))  # which are never taken
        longest = max(len(actions) for actions in meaning)
        table = torch.tensor([[*actions, *[-1] * (longest - len(actions))] for actions in meaning])
        self.register_buffer("symbol_actions", table.to(self.device), persistent=False)
        known = meaning[: self.num_actions + len(macros)]
        begun = [[k for k, actions in enumerate(known) if actions[0] == a] for a in range(self.num_actions)]
        most = max(map(len, begun))
        table = torch.tensor([[*symbols, *[-1] * (most - len(symbols))] for symbols in begun])
        self.register_buffer("symbols_from", table.to(self.device), persistent=False)

    def _inner(self) -> Prior:
        inner = self.inner
        assert isinstance(inner, Prior)
        return inner


class _Parses(NamedTuple):
    """R parses of prefixes of some plans, with equally many symbols.

    Attributes:
        row: `[R]`: the plan, from 0.
        weight: `[R]`: the logarithm of the probability.
        place: `[R]`: 0 at the end of a symbol; within symbol s, before its action i: s * longest + i.
        log_probs: `[R, A + M]`: the log-probabilities of the next symbol.
        state: the inner prior's, of R plans.
    """

    row: Tensor
    weight: Tensor
    place: Tensor
    log_probs: Tensor
    state: Any

    def taken(self, some: Tensor) -> "_Parses":
        """Some of the parses, by index or by mask."""
        return _Parses(*(map_state(lambda values: values[some], part) for part in self))

    def within(self, action: Tensor, symbol_actions: Tensor) -> "_Parses":
        """The parses within a symbol whose next action is `action [N]`."""
        size = symbol_actions.shape[1]
        symbol, turn = self.place.div(size, rounding_mode="floor"), self.place % size
        left = self.taken((turn > 0) & (symbol_actions[symbol, turn] == action[self.row]))
        turn = left.place % size + 1
        symbol = left.place.div(size, rounding_mode="floor")
        more = (turn < size) & (symbol_actions[symbol, turn.clamp(max=size - 1)] >= 0)
        return left._replace(place=torch.where(more, left.place + 1, 0))

    def padded(self, batch: int) -> tuple[State, ...]:
        """Weight, place, log_probs and state as `[batch, K, ...]`; beyond a plan's parses the weight is -inf."""
        parses = self.taken(self.row.argsort(stable=True))
        count = parses.row.bincount(minlength=batch)
        turn = torch.arange(len(parses.row), device=parses.row.device) - (count.cumsum(0) - count)[parses.row]
        wide = max(int(count.max()) if batch else 0, 1)

        def pad(values: Tensor, fill: float = 0.0) -> Tensor:
            padded = values.new_full((batch, wide, *values.shape[1:]), fill)
            padded[parses.row, turn] = values
            return padded

        rest = (parses.place, parses.log_probs, parses.state)
        return (pad(parses.weight.float(), -torch.inf), *(map_state(pad, part) for part in rest))

    @classmethod
    def unpadded(cls, weight: Tensor, place: Tensor, log_probs: Tensor, state: State) -> "_Parses":
        """The inverse of `padded`."""
        row, turn = (weight > -torch.inf).nonzero(as_tuple=True)
        parts = (weight, place, log_probs, state)
        return cls(row, *(map_state(lambda values: values[row, turn], part) for part in parts))


def _merged(some: Sequence[_Parses]) -> _Parses:
    """All of these parses; those of the same plan in the same state are merged into one."""
    # The state of an empty group may be of another size.
    there = [parses for parses in some if len(parses.row)] or some[:1]
    parses = _Parses(*(join_rows(*parts) for parts in zip(*there, strict=True)))
    if len(parses.row) < 2:
        return parses
    columns = [parses.row[:, None].double(), parses.place[:, None].double()]
    columns += [values.reshape(len(parses.row), -1).double() for values in tensors_in(parses.state)]
    key = torch.cat(columns, 1)
    _, group = row_hashes(key).unique(return_inverse=True)
    groups = int(group.max()) + 1
    first = torch.full((groups,), len(group), device=group.device)
    first.scatter_reduce_(0, group, torch.arange(len(group), device=group.device), "amin")
    # In order of first occurrence: of equally probable parses the same must be dropped in equal plans.
    first, order = first.sort()
    return parses.taken(first)._replace(weight=_log_sums(parses.weight, group, groups)[order].to(parses.weight))


def _most_probable(groups: Sequence[_Parses], batch: int, most: int) -> list[_Parses]:
    """The most probable parses of each of `batch` plans, at most `most` in all groups together."""
    row, weight, place = (
        torch.cat([getattr(parses, part) for parses in groups]) for part in ("row", "weight", "place")
    )
    if len(row) <= most or int(row.bincount(minlength=batch).max()) <= most:
        return list(groups)
    # One of them is always at the end of a symbol, so that no action becomes impossible.
    free = weight.masked_fill(place > 0, -torch.inf)
    best = torch.full((batch,), -torch.inf, device=row.device, dtype=weight.dtype).scatter_reduce(0, row, free, "amax")
    weight = weight.masked_fill((place == 0) & (free == best[row]), torch.inf)
    order = (-weight).argsort(stable=True)
    order = order[row[order].argsort(stable=True)]
    count = row.bincount(minlength=batch)
    turn = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row[order]]
    kept = torch.zeros_like(row, dtype=torch.bool)
    kept[order[turn < most]] = True
    return [parses.taken(some) for parses, some in zip(groups, kept.split([len(w.row) for w in groups]), strict=True)]


def _log_sums(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """The logarithms of sums of `exp(values [R])` over the members of each group, float64 `[groups]`."""
    values = values.double()
    top = torch.full((groups,), -torch.inf, dtype=torch.float64, device=values.device)
    top.scatter_reduce_(0, group, values, "amax")
    rest = (values - top[group]).nan_to_num(-torch.inf, neginf=-torch.inf).exp()
    return torch.zeros_like(top).scatter_add_(0, group, rest).log() + top
