"""The macro prior: any prior over actions and macro-actions, as a prior over actions."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._hashing import row_hashes
from neuroprior.plans import Plans
from neuroprior.priors.ensembles.packing import pack, unpack
from neuroprior.priors.macros.macros import CRITERIA, Criterion, Macro, learn_macros
from neuroprior.priors.prior import Prior


class MacroPrior(Prior):
    """A prior that chooses between actions and macro-actions, sequences of actions that it takes as one.

    `inner` is a prior over the A actions and M macros, numbered from A. What it draws is read as actions: the same plan
    may come about in several ways, with macros and without, and its probability is the sum over all of them (a plan
    that is cut off within a macro counts, too). After each action the ways that fit it are known with their
    probabilities; ways that `inner` cannot tell apart from there on are one. So all is exact, as long as a prefix has
    no more than `MOST` ways; of more, the least probable are left out. A chain forgets, and so has few ways; a network
    has all of them, hundreds after a dozen actions, and takes time and memory in proportion.

    Args:
        num_actions: A.
        inner: a prior over A + M actions without context; or, as in a saved `config`, an object with `prior`, the name
            of a class, and its `config`.
        by: how macros are chosen, see `learn_macros`.

    Attributes:
        macros: those that `fit` learned, at most M.

    Raises:
        ValueError: an argument is out of range, or the inner prior does not fit.
    """

    MOST = 128

    actions_at_once = 2**14

    ahead: Tensor
    """`[A + M, longest]`: the actions of each symbol; -1 beyond."""

    begun: Tensor
    """`[A, most]`: the symbols that begin with each action; -1 beyond."""

    def __init__(self, num_actions: int, inner: Prior | Mapping[str, Any], by: Criterion = "count") -> None:
        check_sizes(num_actions=num_actions)
        if by not in CRITERIA:
            raise ValueError(f"by: one of {', '.join(map(repr, CRITERIA))} is expected, not {by!r}")
        made = inner if isinstance(inner, Prior) else Prior.known[inner["prior"]](**inner["config"])
        if made.num_actions <= num_actions:
            raise ValueError(
                f"inner: a prior over more than {num_actions} actions is expected, one for each macro;"
                f" it has {made.num_actions}"
            )
        if isinstance(made, MacroPrior):
            raise ValueError("inner: a prior without macros is expected; give this one more of them")
        if made.takes_context:
            raise ValueError("inner: a prior without context is expected: a macro is one step of many sights")
        super().__init__(num_actions)
        self.inner, self.by = made, by
        self._take([])

    @property
    def num_macros(self) -> int:
        """M, the most macros."""
        return self._inner().num_actions - self.num_actions

    @property
    def config(self) -> dict[str, Any]:
        inner = self._inner()
        return super().config | {"inner": {"prior": type(inner).__name__, "config": inner.config}, "by": self.by}

    @property
    def learned(self) -> dict[str, Any]:
        macros = [[list(macro.actions), macro.count, macro.gain] for macro in self.macros]
        return super().learned | {"macros": macros, "inner": self._inner().learned}

    def restore(self, learned: dict[str, Any]) -> None:
        super().restore(learned)
        macros = [Macro(tuple(actions), count, gain) for actions, count, gain in learned["macros"]]
        known = all(isinstance(a, int) and 0 <= a < self.num_actions for macro in macros for a in macro.actions)
        if not known or len(macros) > self.num_macros or any(len(macro.actions) < 2 for macro in macros):
            raise ValueError(f"macros: at most {self.num_macros} sequences of at least two actions are expected")
        self._take(macros)
        self._inner().restore(learned["inner"])

    def fit(self, plans: Plans | Tensor, **settings: Any) -> Self:
        """Learn macros, and then the inner prior from the plans as recoded with them; returns self.

        Args:
            plans: what to learn from.
            settings: passed on to the inner prior.

        Raises:
            ValueError: the plans do not fit this prior, or have an end symbol.
        """
        given = plans if isinstance(plans, Plans) else Plans(torch.as_tensor(plans), self.num_actions)
        macros, recoded = learn_macros(given, self.num_macros, self.by)  # which refuses before anything is noted
        self.training_plans(given)
        self._inner().fit(recoded, **settings)
        self._take(macros)
        return self

    @torch.no_grad()  # what is learned is learned by `fit`
    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, memory = self._inner().start(batch_size)
        row = torch.arange(batch_size, device=logits.device)
        return self._joined([self._ways(row, logits.new_zeros(batch_size), logits, memory)], batch_size)

    @torch.no_grad()
    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if len(state) == 0:  # of which nothing can be unpacked
            return torch.zeros(0, self.num_actions, device=self.device), state
        action, groups = action.long(), self._open(state)
        after = [[ways.within(action, self.ahead)] for ways in groups]
        for place, ways in enumerate(groups):
            begun = self._begun(ways, action)
            # A way to which a symbol was added goes on among those with one more, whose states may be of another size.
            further = place + (begun.memory.dim() > 1)
            if further == len(after):
                after.append([])
            after[further].append(begun)
        return self._joined(_likeliest([_merged(some) for some in after], len(state), self.MOST), len(state))

    def _begun(self, ways: "_Ways", action: Tensor) -> "_Ways":
        """The ways that add a symbol which begins with `action [N]`."""
        free = ways.place == 0
        row, weight, told, memory = ways.row[free], ways.weight[free], ways.told[free], ways.memory[free]
        symbols = self.begun[action[row]]
        way, which = (symbols >= 0).nonzero(as_tuple=True)
        symbol = symbols[way, which]
        weight = weight[way] + told[way, symbol]
        possible = weight > -torch.inf
        way, symbol, weight = way[possible], symbol[possible], weight[possible]
        inner = self._inner()
        if len(way) == 0:
            return ways.taken(way)
        logits, after = inner.step(symbol, memory[way])
        found = self._ways(row[way], weight, logits, after)
        longer = (self.ahead[symbol] >= 0).sum(1) > 1
        place = torch.where(longer, symbol * self.ahead.shape[1] + 1, 0)
        return found._replace(place=place)

    def _ways(self, row: Tensor, weight: Tensor, logits: Tensor, memory: Tensor) -> "_Ways":
        """Ways at whose end the inner prior gives `logits`; macros that were not learned are never taken."""
        unknown = torch.arange(logits.shape[1], device=logits.device) >= self.num_actions + len(self.macros)
        told = logits.masked_fill(unknown, -torch.inf).log_softmax(-1)
        return _Ways(row, weight, torch.zeros_like(row), told, memory)

    def _joined(self, groups: Sequence["_Ways"], batch: int) -> tuple[Tensor, Tensor]:
        """Logits and state of `batch` plans: probabilities are summed over ways, whose weights then sum to one."""
        total = torch.full((batch,), -torch.inf, dtype=torch.float64, device=self.device)
        for ways in groups:
            total = torch.logaddexp(total, _log_sums(ways.weight, ways.row, batch))
        probs = torch.zeros(batch, self.num_actions, dtype=torch.float64, device=self.device)
        parts: list[Tensor] = []
        for ways in groups:
            weight = (ways.weight.double() - total[ways.row]).exp()
            probs.index_add_(0, ways.row, weight[:, None] * self._next(ways))
            parts += ways._replace(weight=weight.log()).padded(batch)
        logits = probs.log().float()
        groups_of = torch.full((batch, 1), float(len(groups)), device=self.device)
        return logits, torch.cat([groups_of, pack(parts)], 1)

    def _next(self, ways: "_Ways") -> Tensor:
        """The probabilities `[R, A]` of the next action in each way."""
        first = torch.zeros(len(self.ahead), self.num_actions, dtype=torch.float64, device=self.device)
        first[torch.arange(len(first)), self.ahead[:, 0]] = 1
        free = ways.told.double().exp() @ first
        size = self.ahead.shape[1]
        coming = self.ahead[ways.place.div(size, rounding_mode="floor"), ways.place % size]
        certain = torch.nn.functional.one_hot(coming, self.num_actions).double()
        return torch.where((ways.place > 0)[:, None], certain, free)

    def _open(self, state: Tensor) -> list["_Ways"]:
        """What was `_joined`."""
        groups = int(state[0, 0])
        parts = unpack(state[:, 1:], 4 * groups)
        return [_Ways.unpadded(*parts[k : k + 4]) for k in range(0, 4 * groups, 4)]

    def _take(self, macros: Sequence[Macro]) -> None:
        """Take over macros, and their tables."""
        self.macros = tuple(macros)
        meaning = [(a,) for a in range(self.num_actions)] + [macro.actions for macro in macros]
        meaning += [(0,)] * (self.num_macros - len(macros))  # which are never taken
        longest = max(len(actions) for actions in meaning)
        ahead = torch.tensor([[*actions, *[-1] * (longest - len(actions))] for actions in meaning])
        known = meaning[: self.num_actions + len(macros)]
        begun = [[k for k, actions in enumerate(known) if actions[0] == a] for a in range(self.num_actions)]
        most = max(map(len, begun))
        self.register_buffer("ahead", ahead.to(self.device), persistent=False)
        table = torch.tensor([[*symbols, *[-1] * (most - len(symbols))] for symbols in begun])
        self.register_buffer("begun", table.to(self.device), persistent=False)

    def _inner(self) -> Prior:
        inner = self.inner
        assert isinstance(inner, Prior)
        return inner


class _Ways(NamedTuple):
    """R ways in which some plans may have come about, with equally many symbols.

    Attributes:
        row: `[R]`: the plan, from 0.
        weight: `[R]`: the logarithm of the probability.
        place: `[R]`: 0 at the end of a symbol; within symbol s, before its action i: s * longest + i.
        told: `[R, A + M]`: the log-probabilities of the next symbol.
        memory: `[R]` or `[R, D]`: the inner prior's state.
    """

    row: Tensor
    weight: Tensor
    place: Tensor
    told: Tensor
    memory: Tensor

    def taken(self, some: Tensor) -> "_Ways":
        """Some of the ways, by number or by mask."""
        return _Ways(*(part[some] for part in self))

    def within(self, action: Tensor, ahead: Tensor) -> "_Ways":
        """The ways within a symbol that go on with `action [N]`."""
        size = ahead.shape[1]
        symbol, turn = self.place.div(size, rounding_mode="floor"), self.place % size
        left = self.taken((turn > 0) & (ahead[symbol, turn] == action[self.row]))
        turn = left.place % size + 1
        symbol = left.place.div(size, rounding_mode="floor")
        more = (turn < size) & (ahead[symbol, turn.clamp(max=size - 1)] >= 0)
        return left._replace(place=torch.where(more, left.place + 1, 0))

    def padded(self, batch: int) -> list[Tensor]:
        """Weight, place, told and memory as `[batch, K, ...]`; beyond a plan's ways the weight is -inf."""
        ways = self.taken(self.row.argsort(stable=True))
        count = ways.row.bincount(minlength=batch)
        turn = torch.arange(len(ways.row), device=ways.row.device) - (count.cumsum(0) - count)[ways.row]
        wide = max(int(count.max()) if batch else 0, 1)
        parts = []
        for part, nothing in ((ways.weight.float(), -torch.inf), (ways.place, 0), (ways.told, 0), (ways.memory, 0)):
            room = part.new_full((batch, wide, *part.shape[1:]), nothing)
            room[ways.row, turn] = part
            parts.append(room)
        return parts

    @classmethod
    def unpadded(cls, weight: Tensor, place: Tensor, told: Tensor, memory: Tensor) -> "_Ways":
        """What was `padded`."""
        row, turn = (weight > -torch.inf).nonzero(as_tuple=True)
        return cls(row, *(part[row, turn] for part in (weight, place, told, memory)))


def _merged(some: Sequence[_Ways]) -> _Ways:
    """All of these ways; those that go on alike are one."""
    # Of none the memory may be of another size.
    there = [ways for ways in some if len(ways.row)] or some[:1]
    ways = _Ways(*(torch.cat(parts) for parts in zip(*there, strict=True)))
    if len(ways.row) < 2:
        return ways
    memory = ways.memory.reshape(len(ways.row), -1)
    alike = torch.cat([ways.row[:, None].double(), ways.place[:, None].double(), memory.double()], 1)
    _, group = row_hashes(alike).unique(return_inverse=True)
    groups = int(group.max()) + 1
    first = torch.full((groups,), len(group), device=group.device)
    first.scatter_reduce_(0, group, torch.arange(len(group), device=group.device), "amin")
    # In the order in which they were met: of equally probable ways the same must be left out in equal plans.
    first, order = first.sort()
    return ways.taken(first)._replace(weight=_log_sums(ways.weight, group, groups)[order].to(ways.weight))


def _likeliest(groups: Sequence[_Ways], batch: int, most: int) -> list[_Ways]:
    """Of each of `batch` plans the most probable ways, at most so many in all groups together."""
    row, weight, place = (torch.cat([getattr(ways, part) for ways in groups]) for part in ("row", "weight", "place"))
    if len(row) <= most or int(row.bincount(minlength=batch).max()) <= most:
        return list(groups)
    # One at the end of a symbol is always among them: from there every action can be taken.
    free = weight.masked_fill(place > 0, -torch.inf)
    best = torch.full((batch,), -torch.inf, device=row.device, dtype=weight.dtype).scatter_reduce(0, row, free, "amax")
    weight = weight.masked_fill((place == 0) & (free == best[row]), torch.inf)
    order = (-weight).argsort(stable=True)
    order = order[row[order].argsort(stable=True)]
    count = row.bincount(minlength=batch)
    turn = torch.arange(len(row), device=row.device) - (count.cumsum(0) - count)[row[order]]
    kept = torch.zeros_like(row, dtype=torch.bool)
    kept[order[turn < most]] = True
    return [ways.taken(some) for ways, some in zip(groups, kept.split([len(w.row) for w in groups]), strict=True)]


def _log_sums(values: Tensor, group: Tensor, groups: int) -> Tensor:
    """The logarithms of sums of `exp(values [R])` over the members of each group, float64 `[groups]`."""
    values = values.double()
    top = torch.full((groups,), -torch.inf, dtype=torch.float64, device=values.device)
    top.scatter_reduce_(0, group, values, "amax")
    rest = (values - top[group]).nan_to_num(-torch.inf, neginf=-torch.inf).exp()
    return torch.zeros_like(top).scatter_add_(0, group, rest).log() + top
