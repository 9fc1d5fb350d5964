"""Macro-actions: sequences that executed plans repeat, and a Markov chain over actions and macro-actions."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, log2
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior import MarkovPrior, Plans, Prior
from neuroprior._checks import check_sizes
from neuroprior._hashing import row_hashes
from neuroprior.priors.learning import training_plans
from neuroprior.sampling.states import State


@dataclass(frozen=True)
class Macro:
    """A sequence of actions that is taken as one.

    Attributes:
        actions: of the plans, two or more.
        count: how often it replaced its two halves when it was learned.
        gain: bits by which it shortened the plans then, each symbol coded by its frequency, less the bits that its
            definition costs; it may be negative.
    """

    actions: tuple[int, ...]
    count: int
    gain: float


def learn_macros(plans: Plans, num_macros: int) -> tuple[list[Macro], Plans]:
    """Finds the macro-actions of executed plans, and recodes the plans with them.

    Again and again the pair of consecutive symbols that occurs most often is replaced, wherever it occurs, from left to
    right, by a new symbol: byte-pair encoding (Gage 1994; of actions: Iba 1989, McGovern 1998). The search ends when no
    pair occurs twice.

    Args:
        plans: of A actions; their context is ignored.
        num_macros: M, the most macros to find.

    Returns:
        At most M macros, in the order in which they were found, and the plans with A + M actions, of which A + i is
        macro i. A macro may be made of earlier ones; its `actions` are always those of the plans.

    Raises:
        ValueError: the plans have an end symbol.

    Example:
        >>> macros, shorter = learn_macros(Plans(torch.tensor([[0, 1, 2, 0, 1, 2, 0, 1, 2]]).repeat(5, 1), 3), 2)
        >>> [macro.actions for macro in macros], shorter.max_length
        ([(0, 1), (0, 1, 2)], 3)
    """
    if plans.end is not None:
        raise ValueError("plans: an end symbol cannot be part of a macro; learn from plans without one")
    symbols = plans.actions.long().masked_fill(~plans.mask(), -1)
    meaning: list[tuple[int, ...]] = [(action,) for action in range(plans.num_actions)]
    macros: list[Macro] = []
    while len(macros) < num_macros and (best := _best_pair(symbols, len(meaning))) is not None:
        first, second, gain = best
        starts = _pair_starts(symbols, first, second)
        symbols = _replace_pairs(symbols, starts, len(meaning))
        meaning.append(meaning[first] + meaning[second])
        macros.append(Macro(meaning[-1], int(starts.sum()), gain))
    lengths = (symbols >= 0).sum(1)
    actions = symbols[:, : int(lengths.max()) if len(lengths) else 0].clamp(min=0)
    return macros, Plans(actions, plans.num_actions + num_macros, lengths, group=plans.group)


def _pair_starts(symbols: Tensor, one: int | None = None, two: int | None = None) -> Tensor:
    """Where pairs, or the pair (one, two), begin: `[N, L - 1]`; of overlapping pairs of equals, every other one."""
    first, second = symbols[:, :-1], symbols[:, 1:]
    same = first == second
    place = torch.arange(first.shape[1], device=symbols.device).expand_as(first)
    run = torch.where(same, -1, place).cummax(1).values if first.shape[1] else place
    begins: Tensor = (second >= 0) & (~same | ((place - run) % 2 == 1))
    return begins if one is None else begins & (first == one) & (second == two)


def _best_pair(symbols: Tensor, kinds: int) -> tuple[int, int, float] | None:
    """The most frequent pair, and the bits that it saves; of equals the first. None where no pair occurs twice."""
    starts = _pair_starts(symbols)
    code, count = (symbols[:, :-1] * kinds + symbols[:, 1:])[starts].unique(return_counts=True)
    if len(code) == 0 or int(count.max()) < 2:
        return None
    best = int(count.argmax())
    first, second = divmod(int(code[best]), kinds)
    single = symbols[symbols >= 0].bincount(minlength=kinds).double()
    return first, second, _gain(single.tolist(), first, second, int(count[best]))


def _gain(single: Sequence[float], first: int, second: int, count: int) -> float:
    """The bits that a pair saves: symbols that occur n of N times take log2(N / n) each."""

    def weight(number: float) -> float:
        return number * log(number) if number > 0 else 0.0

    total = sum(single)
    if first == second:
        change = weight(single[first] - 2 * count) - weight(single[first])
    else:
        change = sum(weight(single[one] - count) - weight(single[one]) for one in (first, second))
    saved = weight(total) - weight(total - count) + change + weight(count)
    return saved / log(2) - 2 * log2(len(single))


def _replace_pairs(symbols: Tensor, starts: Tensor, new: int) -> Tensor:
    """The symbols with the pairs that begin at `starts [N, L - 1]` replaced by `new`; rows are filled up with -1."""
    symbols = symbols.clone()
    symbols[:, :-1][starts] = new
    symbols[:, 1:][starts] = -1
    return symbols.gather(1, (symbols < 0).int().argsort(dim=1, stable=True))


class MacroPrior(Prior):
    """A Markov chain over actions and macro-actions, sequences of actions that it takes as one.

    The chain is over A + M symbols: the actions, and the macros numbered from A. A plan may arise from several
    sequences of symbols, its parses. Its probability is the sum over all of them; a plan that is cut off within a macro
    counts, too. After each action the parses of the prefix are known with their probabilities. Parses after which the
    chain is in the same state are merged, so that there are few.

    Args:
        num_actions: A.
        num_macros: M, the most macros.
        order: of the chain.

    Attributes:
        macros: those that `fit` learned, at most M.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2, 0, 1, 2]]).repeat(5, 1), 3)
        >>> [macro.actions for macro in MacroPrior(3, 2, order=1).fit(plans).macros]
        [(0, 1), (0, 1, 2)]
    """

    actions_at_once = 2**14

    symbol_actions: Tensor
    """`[A + M, longest]`: the actions of each symbol; -1 beyond."""

    symbols_from: Tensor
    """`[A, most]`: the symbols that begin with each action; -1 beyond."""

    def __init__(self, num_actions: int, num_macros: int = 16, order: int = 2) -> None:
        check_sizes(num_actions=num_actions, num_macros=num_macros)
        super().__init__(num_actions)
        self.num_macros = num_macros
        self.chain = MarkovPrior(num_actions + num_macros, order)
        self._set_macros([])

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learns macros, and then the chain from the plans as recoded with them; returns self.

        Args:
            plans: `Plans` without context, or integers `[N, L]`.
            generator: not used.
            settings: none.

        Raises:
            ValueError: the plans do not fit this prior, or have an end symbol; or a setting.
        """
        self.check_settings(settings)
        plans = self.as_plans(plans)
        macros, recoded = learn_macros(plans, self.num_macros)  # raises before anything is changed
        training_plans(self, plans)
        self.chain.fit(recoded)
        self._set_macros(macros)
        return self

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        logits, state = self.chain.start(batch_size)
        row = torch.arange(batch_size, device=logits.device)
        return self._sum_parses(self._parses(row, logits.new_zeros(batch_size), logits, state), batch_size)

    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        action, parses = action.long(), _Parses.unpadded(*state)
        within, extended = parses.within(action, self.symbol_actions), self._extend(parses, action)
        both = _Parses(*(torch.cat(parts) for parts in zip(within, extended, strict=True)))
        return self._sum_parses(_merge(both), len(action))

    def _extend(self, parses: "_Parses", action: Tensor) -> "_Parses":
        """The parses with one more symbol, which begins with `action [N]`."""
        row, weight, _, log_probs, state = parses.select(parses.place == 0)
        symbols = self.symbols_from[action[row]]
        parse, which = (symbols >= 0).nonzero(as_tuple=True)
        symbol = symbols[parse, which]
        weight = weight[parse] + log_probs[parse, symbol]
        logits, state = self.chain.step(symbol, state[parse])
        extended = self._parses(row[parse], weight, logits, state)
        longer = (self.symbol_actions[symbol] >= 0).sum(1) > 1
        return extended._replace(place=torch.where(longer, symbol * self.symbol_actions.shape[1] + 1, 0))

    def _parses(self, row: Tensor, weight: Tensor, logits: Tensor, state: Tensor) -> "_Parses":
        """Parses at whose end the chain gives `logits`; macros that were not learned have probability 0."""
        unknown = torch.arange(logits.shape[1], device=logits.device) >= self.num_actions + len(self.macros)
        log_probs = logits.masked_fill(unknown, -torch.inf).log_softmax(-1)
        return _Parses(row, weight, torch.zeros_like(row), log_probs, state)

    def _sum_parses(self, parses: "_Parses", batch: int) -> tuple[Tensor, State]:
        """Logits and state of `batch` plans: probabilities are summed over parses, whose weights then sum to one."""
        total = _log_sums(parses.weight, parses.row, batch)
        weight = (parses.weight.double() - total[parses.row]).exp()
        probs = torch.zeros(batch, self.num_actions, dtype=torch.float64, device=self.device)
        probs.index_add_(0, parses.row, weight[:, None] * self._next_probs(parses))
        return probs.log().float(), parses._replace(weight=weight.log()).padded(batch)

    def _next_probs(self, parses: "_Parses") -> Tensor:
        """The probabilities `[R, A]` of the next action under each parse."""
        first = torch.nn.functional.one_hot(self.symbol_actions[:, 0], self.num_actions).double()
        free = parses.log_probs.double().exp() @ first
        size = self.symbol_actions.shape[1]
        coming = self.symbol_actions[parses.place.div(size, rounding_mode="floor"), parses.place % size]
        certain = torch.nn.functional.one_hot(coming, self.num_actions).double()
        return torch.where((parses.place > 0)[:, None], certain, free)

    def _set_macros(self, macros: Sequence[Macro]) -> None:
        """Sets the macros, and the tables of their actions."""
        self.macros = tuple(macros)
        meaning = [(action,) for action in range(self.num_actions)] + [macro.actions for macro in macros]
        begun = [[k for k, actions in enumerate(meaning) if actions[0] == a] for a in range(self.num_actions)]
        meaning += [(0,)] * (self.num_macros - len(macros))  # which are never taken
        self.register_buffer("symbol_actions", _pad_lists(meaning).to(self.device), persistent=False)
        self.register_buffer("symbols_from", _pad_lists(begun).to(self.device), persistent=False)


class _Parses(NamedTuple):
    """R parses of prefixes of several plans.

    Attributes:
        row: `[R]`: the plan, from 0.
        weight: `[R]`: the logarithm of the probability.
        place: `[R]`: 0 at the end of a symbol; within symbol s, before its action i: s * longest + i.
        log_probs: `[R, A + M]`: the log-probabilities of the next symbol.
        state: `[R]`, the chain's.
    """

    row: Tensor
    weight: Tensor
    place: Tensor
    log_probs: Tensor
    state: Tensor

    def select(self, index: Tensor) -> "_Parses":
        """Some of the parses, by index or by mask."""
        return _Parses(*(values[index] for values in self))

    def within(self, action: Tensor, symbol_actions: Tensor) -> "_Parses":
        """The parses within a symbol whose next action is `action [N]`."""
        size = symbol_actions.shape[1]
        symbol, turn = self.place.div(size, rounding_mode="floor"), self.place % size
        left = self.select((turn > 0) & (symbol_actions[symbol, turn] == action[self.row]))
        turn = left.place % size + 1
        symbol = left.place.div(size, rounding_mode="floor")
        more = (turn < size) & (symbol_actions[symbol, turn.clamp(max=size - 1)] >= 0)
        return left._replace(place=torch.where(more, left.place + 1, 0))

    def padded(self, batch: int) -> tuple[Tensor, ...]:
        """Weight, place, log_probs and state as `[batch, K, ...]`; beyond a plan's parses the weight is -inf."""
        parses = self.select(self.row.argsort(stable=True))
        count = parses.row.bincount(minlength=batch)
        turn = torch.arange(len(parses.row), device=parses.row.device) - (count.cumsum(0) - count)[parses.row]
        wide = max(int(count.max()) if batch else 0, 1)

        def pad(values: Tensor, fill: float = 0.0) -> Tensor:
            padded = values.new_full((batch, wide, *values.shape[1:]), fill)
            padded[parses.row, turn] = values
            return padded

        return pad(parses.weight.float(), -torch.inf), pad(parses.place), pad(parses.log_probs), pad(parses.state)

    @classmethod
    def unpadded(cls, weight: Tensor, place: Tensor, log_probs: Tensor, state: Tensor) -> "_Parses":
        """The inverse of `padded`."""
        row, turn = (weight > -torch.inf).nonzero(as_tuple=True)
        return cls(row, *(values[row, turn] for values in (weight, place, log_probs, state)))


def _merge(parses: _Parses) -> _Parses:
    """The parses, with those of the same plan at the same place in the same state merged into one."""
    if len(parses.row) < 2:
        return parses
    key = torch.stack([parses.row, parses.place, parses.state.long()], 1)
    _, group = row_hashes(key).unique(return_inverse=True)
    groups = int(group.max()) + 1
    first = torch.full((groups,), len(group), device=group.device)
    first.scatter_reduce_(0, group, torch.arange(len(group), device=group.device), "amin")
    first, order = first.sort()
    return parses.select(first)._replace(weight=_log_sums(parses.weight, group, groups)[order].to(parses.weight))


def _log_sums(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """The logarithms of sums of `exp(values [R])` over the members of each group, float64 `[groups]`."""
    values = values.double()
    top = torch.full((groups,), -torch.inf, dtype=torch.float64, device=values.device)
    top.scatter_reduce_(0, group, values, "amax")
    rest = (values - top[group]).nan_to_num(-torch.inf, neginf=-torch.inf).exp()
    return torch.zeros_like(top).scatter_add_(0, group, rest).log() + top


def _pad_lists(lists: Sequence[Sequence[int]]) -> Tensor:
    """The lists as rows `[N, longest]`, filled up with -1."""
    longest = max(map(len, lists))
    return torch.tensor([[*numbers, *[-1] * (longest - len(numbers))] for numbers in lists])
