"""The tree of the histories in plans and what followed each: the counts behind Markov priors and context trees.

Counting goes through the plans once, some at a time, and counts each action after its longest history only; the counts
after shorter histories are sums of these.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._threads import share
from neuroprior.plans import Plans

ACTIONS_AT_ONCE = 2**18
"""Actions that are counted together; small enough for a processor's cache."""

MAX_TABLE_BYTES = 2**31
"""The most memory that the tables of a prior may take."""

MOST_NGRAMS = 2**16
"""Possible n-grams of actions up to which a table of all of them is counted first."""


class TooLargeError(ValueError):
    """The tables of a prior would take too much memory."""


class Tree(NamedTuple):
    """The histories that occurred, as a state machine.

    Node 0 is the empty history; then come the histories of 1, 2, ..., `depth` actions, wherever in a plan they stood;
    then the openings: all 0, 1, ..., `depth` - 1 actions since the beginning of a plan. The parent of a history is the
    history without its oldest action; of an opening, the same actions wherever they stood. Parents come first.
    """

    next_node: Tensor  # int32 [M, A]: the longest history of the tree after one more action
    parent: Tensor  # int64 [M]; of node 0: itself
    start: int  # the node before the first action
    bounds: list[int]  # each level's nodes are bounds[i] to bounds[i + 1] - 1

    @staticmethod
    def empty(num_actions: int, device: torch.device) -> "Tree":
        next_node = torch.zeros(1, num_actions, dtype=torch.int32, device=device)
        return Tree(next_node, torch.zeros(1, dtype=torch.long, device=device), 0, [0, 1])


@dataclass(frozen=True, eq=False)
class Counts:
    """How often each action followed each history of a tree.

    Only what occurred is stored: R rows, each a node with a context, and P entries, each a row with an action.
    """

    row_code: Tensor  # int64 [R]: node * contexts + context of each row, ascending
    row: Tensor  # int64 [P], ascending
    action: Tensor  # int64 [P], ascending within a row
    count: Tensor  # int64 [P]
    kinds: Tensor  # int64 [P]: after how many different histories longer by one symbol; for the longest: the count

    @staticmethod
    def empty(device: torch.device) -> "Counts":
        none = torch.zeros(0, dtype=torch.long, device=device)
        return Counts(none, none, none, none, none)

    def total(self) -> Tensor:
        """`[R]`: how many actions followed each row."""
        return torch.zeros_like(self.row_code).index_add_(0, self.row, self.count)

    def pooled(self, contexts: int, num_actions: int, values: Tensor) -> Tensor:
        """`[A]`: the sums of `values [P]` after the empty history, over all contexts."""
        first = int(torch.searchsorted(self.row_code, contexts))
        until = int(torch.searchsorted(self.row, first))
        sums = torch.zeros(num_actions, dtype=values.dtype, device=values.device)
        return sums.index_add_(0, self.action[:until], values[:until])

    def dense(self, first: int, until: int, num_actions: int, values: Tensor) -> Tensor:
        """`values [P]` of the rows from `first` to `until` - 1 as a table `[until - first, A]`, float64."""
        span = slice(int(torch.searchsorted(self.row, first)), int(torch.searchsorted(self.row, until)))
        table = torch.zeros(until - first, num_actions, dtype=torch.double, device=self.row.device)
        table[self.row[span] - first, self.action[span]] = values[span].double()
        return table


def parent_rows(tree: Tree, counts: Counts, contexts: int) -> Tensor:
    """`[R]`: the row of each row's parent in the same context; R for the empty history."""
    node = counts.row_code.div(contexts, rounding_mode="floor")
    parent = torch.searchsorted(counts.row_code, tree.parent[node] * contexts + counts.row_code % contexts)
    return parent.masked_fill_(node == 0, len(node))


def level_bounds(tree: Tree, counts: Counts, contexts: int) -> list[int]:
    """The rows of level i are those from entry i to entry i + 1, less one."""
    bounds = torch.tensor(tree.bounds, device=counts.row.device)
    return torch.searchsorted(counts.row_code, bounds * contexts).tolist()


def row_blocks(tree: Tree, counts: Counts, contexts: int, num_actions: int) -> Iterator[tuple[int, int, int]]:
    """Blocks of rows to compute together: the level, the first row and the one after the last; parents come first."""
    size = max(2**22 // num_actions, 1)
    ends = level_bounds(tree, counts, contexts)
    for level in range(len(ends) - 1):
        for first in range(ends[level], ends[level + 1], size):
            yield level, first, min(first + size, ends[level + 1])


def count_histories(
    plans: Plans,
    depth: int,
    num_contexts: int | None,
    openings: bool,
    device: torch.device,
    *,
    max_bytes: int = MAX_TABLE_BYTES,
) -> tuple[Tree, Counts]:
    """The histories of up to `depth` actions in `plans`, and what followed them.

    Beside the plans and the tree this takes memory for one part of the plans alone.

    Args:
        plans: with context indices where `num_contexts` is given.
        depth: the longest history, in actions.
        num_contexts: number of contexts that are counted apart; None: one.
        openings: False leaves openings out, and the tree starts in the empty history.
        device: where to count.
        max_bytes: the most memory that the tables may take.

    Raises:
        TooLargeError: the tables would be larger than `max_bytes`.
    """
    histories = _Histories(plans.num_actions, depth, num_contexts or 1, device, max_bytes)
    size = max(ACTIONS_AT_ONCE // max(plans.max_length, 1), 1)
    number = plans.num_actions ** (depth + 1)
    few = 0 < depth < plans.max_length and number <= min(MOST_NGRAMS, plans.actions.numel() // 4)
    if few and num_contexts is None and plans.lengths is None:
        # A table of n-grams is small: each that occurs is then counted once.
        histories.add(*_ngrams(plans.actions[:, :depth], depth, plans.num_actions, size, device))
        histories.add(*_ngrams(plans.actions, depth + 1, plans.num_actions, size, device), begins=False)
        return histories.finish(openings)
    for at in range(0, len(plans), size):
        chunk = plans[at : at + size]
        actions, mask, context = chunk.actions.to(device).long(), None, None
        if chunk.lengths is not None:
            actions = actions[:, : int(chunk.lengths.max())]
            mask = chunk.mask()[:, : actions.shape[1]].to(device)
        if num_contexts is not None and chunk.context is not None:
            context = chunk.context.to(device).long()
            context = context[:, : actions.shape[1]]
        histories.add(actions, None, mask, context)
    return histories.finish(openings)


def _ngrams(actions: Tensor, length: int, num_actions: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The n-grams of `length` actions in `actions [N, L]` `[n, length]`, and how often each occurs `[n]`.

    `size` plans are read at a time.
    """
    times = torch.zeros(num_actions**length, dtype=torch.long, device=device)
    last, alone = actions.shape[1] - length + 1, Lock()

    def count(chunk: Tensor) -> None:
        chunk = chunk.to(device)
        code = chunk[:, :last].to(torch.int32, copy=True)
        for place in range(1, length):
            code = code.mul_(num_actions).add_(chunk[:, place : place + last])
        counts = code.flatten().bincount(minlength=len(times))
        with alone:
            times.add_(counts)

    share(count, actions.split(size))
    codes = times.nonzero()[:, 0]
    base = num_actions ** torch.arange(length - 1, -1, -1, device=device)
    return codes[:, None] // base % num_actions, times[codes]


class _Tally:
    """How often each of some integer codes occurred, where most codes that are possible never do."""

    def __init__(self, device: torch.device) -> None:
        none = torch.zeros(0, dtype=torch.long, device=device)
        self.parts = [(none, none)]
        self.size = self.merged = 0

    def add(self, codes: Tensor, below: int, times: Tensor | None = None) -> None:
        """Count `codes [n]`, all below `below`, each `times [n]` (None: once)."""
        if times is not None:
            distinct, counts, _ = _merge([(codes, times)])
        elif below <= 4 * len(codes) + 2**16:
            table = codes.bincount()
            distinct = table.nonzero()[:, 0]
            counts = table[distinct]
        else:
            distinct, counts = torch.unique(codes, return_counts=True)
        self.parts.append((distinct, counts))
        self.size += len(distinct)
        if self.size > 2 * self.merged + 2**20:
            distinct, counts, _ = _merge(self.parts)
            self.parts, self.size, self.merged = [(distinct, counts)], len(distinct), len(distinct)


class _Level:
    """Histories of one length, numbered from 0 in the order in which they first occurred."""

    def __init__(self, num_actions: int, device: torch.device, size: int = 0) -> None:
        self.follow = torch.full((size, num_actions), -1, dtype=torch.int32, device=device)
        self.parent = torch.zeros(size, dtype=torch.long, device=device)
        self.tally = _Tally(device)

    def __len__(self) -> int:
        return len(self.parent)

    def extend(self, parent: Tensor, last: bool) -> None:
        self.parent = torch.cat([self.parent, parent])
        if not last:
            self.follow = torch.cat([self.follow, self.follow.new_full((len(parent), self.follow.shape[1]), -1)])


class _Histories:
    """Counts each action after its longest history; `finish` adds up those of the shorter ones."""

    def __init__(self, num_actions: int, depth: int, contexts: int, device: torch.device, max_bytes: int) -> None:
        self.num_actions, self.contexts, self.max_bytes = num_actions, contexts, max_bytes
        # Level t has the histories of t actions; opening t, the beginnings of plans with t actions.
        self.levels = [_Level(num_actions, device, int(t == 0)) for t in range(depth + 1)]
        self.openings = [_Level(num_actions, device, int(t == 0)) for t in range(depth)]

    def add(
        self,
        actions: Tensor,
        times: Tensor | None,
        mask: Tensor | None = None,
        context: Tensor | None = None,
        begins: bool = True,
    ) -> None:
        """Count `actions [n, L]` (int64) where `mask [n, L]` is True (None: everywhere), in contexts `context [n, L]`.

        With `times [n]` each row counts so often; it then has at most `depth` + 1 actions. `begins` says whether rows
        are the beginnings of plans.
        """
        length, depth = actions.shape[1], len(self.openings)
        node, opening = torch.zeros_like(actions), torch.zeros_like(actions[:, :1])
        for t in range(min(depth, length)):
            if begins:
                self._count(self.openings[t], opening, actions, context, mask, slice(t, t + 1), times)
            if t + 1 == length:
                return
            now, after = actions[:, t:-1], None if mask is None else mask[:, t + 1 :]
            node = self._go(self.levels, t, node[:, :-1], now, node[:, 1:], after)
            if begins and t + 1 < depth:
                first = None if after is None else after[:, :1]
                opening = self._go(self.openings, t, opening, now[:, :1], node[:, :1], first)
        if length > depth:
            self._count(self.levels[depth], node, actions, context, mask, slice(depth, None), times)

    def _count(
        self,
        level: _Level,
        node: Tensor,
        actions: Tensor,
        context: Tensor | None,
        mask: Tensor | None,
        steps: slice,
        times: Tensor | None,
    ) -> None:
        """Count the actions of some steps, which followed `node`."""
        row = node if context is None else node * self.contexts + context[:, steps]
        codes = row * self.num_actions + actions[:, steps]
        codes = codes.reshape(-1) if mask is None else codes[mask[:, steps]]
        level.tally.add(codes, len(level) * self.contexts * self.num_actions, times)

    def _go(
        self, levels: list[_Level], t: int, node: Tensor, actions: Tensor, parent: Tensor, mask: Tensor | None
    ) -> Tensor:
        """The nodes of level t + 1 that `actions` lead to from nodes of level t; new ones are added."""
        level, below = levels[t], levels[t + 1]
        codes = node * self.num_actions + actions
        nodes = level.follow.view(-1)[codes]
        new = nodes < 0 if mask is None else (nodes < 0) & mask
        if bool(new.any()):
            distinct, rank = _rank(codes[new], level.follow.numel())
            self._check_size(len(distinct))
            level.follow.view(-1)[distinct] = torch.arange(
                len(below), len(below) + len(distinct), dtype=torch.int32, device=codes.device
            )
            parents = torch.empty_like(distinct)
            parents[rank] = parent[new]
            below.extend(parents, last=t + 2 == len(levels))
            nodes = level.follow.view(-1)[codes]
        # Beyond the end of a plan there may be no node; nothing is counted there.
        return nodes.long() if mask is None else nodes.long().clamp_(min=0)

    def _check_size(self, more: int, rows: int | None = None) -> None:
        nodes = more + sum(len(level) for level in (*self.levels, *self.openings))
        rows = nodes if rows is None else rows
        size = 4 * self.num_actions * (nodes + rows)
        if size > self.max_bytes:
            raise TooLargeError(
                f"plans: tables of {max(nodes, rows):,} histories x {self.num_actions} actions, or more, need"
                f" {size / 1e9:.1f} GB, over the limit of {self.max_bytes / 1e9:.1f} GB;"
                f" with histories of fewer than {len(self.openings)} actions they would be smaller"
            )

    def finish(self, openings: bool) -> tuple[Tree, Counts]:
        """The tree and its counts; after this nothing can be added."""
        if not any(level.tally.size for level in (self.levels[-1], *self.openings)):
            device = self.levels[0].parent.device
            return Tree.empty(self.num_actions, device), Counts.empty(device)
        pairs = self._sum_up()
        keep = [*self.levels, *(self.openings if openings else [])]
        bounds = torch.tensor([0, *map(len, keep)]).cumsum(0).tolist()
        below = self.contexts * self.num_actions
        codes = torch.cat([codes + first * below for (codes, _, _), first in zip(pairs, bounds, strict=False)])
        count, kinds = (torch.cat([pair[i] for pair in pairs[: len(keep)]]) for i in (1, 2))
        codes = codes[: len(count)]
        code = codes.div(self.num_actions, rounding_mode="floor")
        row_code, row = torch.unique_consecutive(code, return_inverse=True)
        self._check_size(0, len(row_code))
        return self._tree(keep, bounds, openings), Counts(row_code, row, codes % self.num_actions, count, kinds)

    def _sum_up(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """For each level, then for the openings: codes (node * contexts + context) * A + action, counts and kinds."""
        below = self.contexts * self.num_actions

        def lift(level: _Level, codes: Tensor) -> Tensor:
            return level.parent[codes.div(below, rounding_mode="floor")] * below + codes % below

        first = [_merge(level.tally.parts) for level in self.openings]
        codes, count, _ = _merge(self.levels[-1].tally.parts)
        out = [(codes, count, count)]
        for t in range(len(self.openings) - 1, -1, -1):
            longer = lift(self.levels[t + 1], out[0][0]), out[0][1]
            begun = lift(self.openings[t], first[t][0]), first[t][1]
            out.insert(0, _merge([longer, begun]))
        return [*out, *((codes, count, count) for codes, count, _ in first)]

    def _tree(self, keep: list[_Level], bounds: list[int], openings: bool) -> Tree:
        depth, device = len(self.openings), self.levels[0].parent.device
        next_node = torch.zeros(bounds[-1], self.num_actions, dtype=torch.int32, device=device)
        parents = []
        for i, level in enumerate(keep):
            # Openings have their parents among the histories of as many actions.
            parent = level.parent + (bounds[max(i - 1, 0)] if i <= depth else bounds[i - depth - 1])
            # Where the longer history did not occur, an action leads where it leads from the parent.
            rows = next_node[parent]
            if len(level.follow) and i + 1 < len(keep):
                rows = torch.where(level.follow >= 0, level.follow + bounds[i + 1], rows)
            next_node[bounds[i] : bounds[i + 1]] = rows
            level.follow = level.follow[:0]
            parents.append(parent)
        start = bounds[depth + 1] if openings and depth else 0
        return Tree(next_node, torch.cat(parents), start, bounds)


def _rank(codes: Tensor, below: int) -> tuple[Tensor, Tensor]:
    """The distinct codes, all below `below`, in ascending order, and the rank of each code among them."""
    if below > 4 * len(codes) + 2**16:
        distinct, rank = torch.unique(codes, return_inverse=True)
        return distinct, rank
    present = torch.zeros(below, dtype=torch.bool, device=codes.device)
    present[codes] = True
    return present.nonzero()[:, 0], (present.cumsum(0) - 1)[codes]


def _merge(parts: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """The distinct codes of all parts in ascending order, the sum of their counts, and how often each was listed."""
    codes, counts = (torch.cat(values) for values in zip(*parts, strict=True))
    distinct, rank, places = torch.unique(codes, return_inverse=True, return_counts=True)
    return distinct, torch.zeros_like(distinct).index_add_(0, rank, counts), places
