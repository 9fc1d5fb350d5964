"""The base of priors that count: a state machine over the histories that occurred, with tables of probabilities."""

from abc import abstractmethod
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor, nn

from neuroprior._checks import check_count
from neuroprior._random import draw_seed
from neuroprior._threads import share
from neuroprior.plans import Plans, action_dtype
from neuroprior.priors.counts.histories import MAX_TABLE_BYTES, Counts, Tree, count_histories
from neuroprior.priors.learning import training_plans
from neuroprior.priors.prior import Prior

COMPILE_FROM = 2**20
"""Actions of plans from which they are drawn from alias tables, by a compiled loop: the first call in a process loads
numba, which takes about a second.
"""

LARGEST, RUNS = 2**17, 256
"""The most numbers in the tables that it draws from, and in a row of them."""

MOST_DEPTH = 10_000
"""Actions of a history; more take too long to walk through."""

_TABLES = ("next_node", "parent", "start_node", "row_code", "log_probs")


def check_depth(name: str, depth: int) -> None:
    """Raise ValueError, naming the argument, unless it is a number of past actions, from 0 to `MOST_DEPTH`."""
    check_count(name, depth, 0)
    if depth > MOST_DEPTH:
        raise ValueError(f"`{name}` must be at most {MOST_DEPTH}, got {depth}")


class HistoryPrior(Prior):
    """A prior whose next action depends on the longest of the histories that occurred in training.

    The histories are the nodes of a tree, and the state is the number of the history (times `num_contexts`, plus the
    last context), int64 `[N]`: `step` is two gathers, for any depth. A subclass writes `estimate`.

    Args:
        num_actions: A.
        depth: >= 0, the most past actions that count.
        num_contexts: number of context indices, for a prior that takes an index.

    Raises:
        ValueError: an argument is out of range.
    """

    next_node: Tensor
    parent: Tensor
    start_node: Tensor
    row_code: Tensor
    log_probs: Tensor

    tables: tuple[str, ...] = _TABLES
    """The names of the buffers whose sizes depend on what was learned."""

    log_tables = ("log_probs",)

    openings = True
    """Whether all actions since a plan's beginning are a history of their own."""

    max_table_bytes: ClassVar[int] = MAX_TABLE_BYTES
    """The most memory that the tables may take; `fit` raises beyond it."""

    chunk_length: ClassVar[int] = 256
    """Actions of a long plan that `forward` walks through one after the other."""

    def __init__(self, num_actions: int, depth: int, num_contexts: int | None = None) -> None:
        super().__init__(num_actions, num_contexts)
        self._depth = depth
        self.learn(Tree.empty(num_actions, self.device), Counts.empty(self.device))

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_start(batch_size, context)
        node = self.start_node.expand(batch_size)
        return self._outputs_at(node, torch.zeros_like(node) if context is None else context.long())

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        self.check_step(action, context)
        contexts = self.num_contexts or 1
        place = state.div(contexts, rounding_mode="floor") * self.num_actions + action.long()
        return self._outputs_at(
            self.next_node.view(-1)[place].long(), state % contexts if context is None else context.long()
        )

    def draw_plans(
        self, state: Tensor, counts: Tensor, length: int, temperature: float, generator: torch.Generator
    ) -> Tensor | None:
        """Many plans from few states, drawn by a compiled loop; see `neuroprior.sampling.Steppable`."""
        actions, contexts, total = self.num_actions, self.num_contexts or 1, int(counts.sum())
        states, drawn = len(self.next_node) * contexts, total * length
        worth = drawn >= COMPILE_FROM and 8 * states * actions <= drawn
        able = type(self).step is HistoryPrior.step and self.device.type == "cpu" and self.end is None
        fits = states * actions <= LARGEST
        if not (worth and able and fits):
            return None
        from neuroprior.priors.counts import compiled_draws

        every, dtype, run = torch.arange(states), action_dtype(actions), 1
        room = min(LARGEST, max(drawn // 4, states * actions)) // states
        while actions ** (2 * run) <= min(RUNS, room) and 2 * run <= 8 // dtype.itemsize and run < length:
            run *= 2
        logits, _ = self._outputs_at(every.div(contexts, rounding_mode="floor"), every % contexts)
        single = (logits.double() / temperature).softmax(-1)
        if not single.isfinite().all():
            return None  # which is refused when plans are stepped
        follow = torch.stack([self.step(torch.full_like(every, a), every)[1] for a in range(actions)], 1)
        probs, after = single, follow
        for _ in range(run - 1):
            probs, after = (probs[..., None] * single[after]).flatten(1), follow[after].flatten(1)
        runs = torch.cartesian_prod(*[torch.arange(actions)] * run).view(-1, run).to(dtype).numpy()
        tables = compiled_draws.tables(probs.numpy(), after.numpy(), runs)
        plans = np.empty((total, -(-length // run)), tables.actions.dtype)
        ends, start, seed = counts.cumsum(0).numpy(), state.numpy(), draw_seed(generator)

        def draw_chunk(first: int) -> None:
            compiled_draws.draw(tables, start, ends, seed, first, plans[first : first + compiled_draws.PLANS])

        share(draw_chunk, range(0, total, compiled_draws.PLANS))
        return torch.from_numpy(plans.view(runs.dtype))[:, :length].contiguous()

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        return self.log_probs[self._places(plans, context)[0]]

    def _places(self, plans: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        """Of each action of `plans [N, L]` the row of `log_probs` that holds for it, and the context: `[N, L]` each."""
        node = self._nodes(plans.long())
        each = torch.zeros_like(node) if context is None else context.long()
        return self._row(node.flatten(), each.flatten()).view(plans.shape), each

    def entries(self, plans: Plans) -> Tensor:
        """Which of the flattened `log_probs` holds for each action of `plans`: int64 `[S]`, for S actions in all.

        Actions behind the one that ends a plan, which are certain, are left out.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        self.check_plans(plans)
        plans = plans.to(self.device)
        size = max(self.actions_at_once // max(plans.max_length, 1), 1)
        entries = [torch.zeros(0, dtype=torch.long, device=self.device)]
        for at in range(0, len(plans), size):
            chunk = plans[at : at + size]
            actions, mask = chunk.actions.long(), chunk.mask()
            if self.end is not None:
                mask[:, 1:] &= actions[:, :-1] != self.end
            entries.append((self._places(actions, chunk.context)[0] * self.num_actions + actions)[mask])
        return torch.cat(entries)

    def _nodes(self, actions: Tensor) -> Tensor:
        """The node before each action of `actions [N, L]`."""
        num, length = actions.shape
        chunk = max(self.chunk_length, self._depth)  # so that a chunk depends on itself and the one before it alone
        if num and length > 2 * (chunk + self._depth):
            # A node depends on the last `depth` actions alone, so the chunks of long plans are walked through side by
            # side, each from that many actions before it.
            first = self._walk(actions[:, :chunk], self.start_node.long().expand(num))
            padded = nn.functional.pad(actions[:, chunk - self._depth :], (0, -(length - chunk) % chunk))
            chunks = padded.unfold(1, chunk + self._depth, chunk).flatten(0, 1)
            late = self._walk(chunks, torch.zeros_like(chunks[:, 0]))[:, self._depth :]
            return torch.cat([first, late.reshape(num, -1)[:, : length - chunk]], 1)
        return self._walk(actions, self.start_node.long().expand(num))

    def _walk(self, actions: Tensor, node: Tensor) -> Tensor:
        """The node before each action, `[N, L]`, from `node [N]` on."""
        follow, nodes = self.next_node.view(-1), actions.new_empty(actions.shape[1], len(actions))
        for action, before in zip(actions.unbind(1), nodes, strict=True):  # of one step each
            before.copy_(node)
            node = follow.index_select(0, (node * self.num_actions).add_(action)).long()
        return nodes.t().contiguous()

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Count anew; returns self.

        The plans are counted some at a time: beside them and the tables this takes little memory.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: not used; counting is deterministic.
            settings: there are none.

        Raises:
            ValueError: the plans do not fit this prior, any setting is given, or so many histories occur that the
                tables would need more than `max_table_bytes`.
        """
        self.check_settings(settings)
        self.learn(*self.count(plans))
        return self

    def count(self, plans: Plans | Tensor) -> tuple[Tree, Counts]:
        """What `fit` counts and `learn` takes over; the same for all priors of one depth and kind of context.

        Raises:
            ValueError: as `fit`.
        """
        plans = training_plans(self, plans)
        limit = self.max_table_bytes
        return count_histories(plans, self._depth, self.num_contexts, self.openings, self.device, max_bytes=limit)

    @abstractmethod
    def estimate(self, tree: Tree, counts: Counts) -> Tensor:
        """The log-probabilities `[R + 1, A]` (float32) after each row of `counts`; last: in contexts without counts."""

    def learn(self, tree: Tree, counts: Counts) -> None:
        """Take over a tree and its counts."""
        self.hold(tree, counts, self.estimate(tree, counts))

    def hold(self, tree: Tree, counts: Counts, log_probs: Tensor) -> None:
        """Take over a tree and log-probabilities as `estimate` makes them; for `entries` alone the tree is enough."""
        values = (tree.next_node, tree.parent, torch.tensor(tree.start), counts.row_code, log_probs)
        for name, value in zip(_TABLES, values, strict=True):
            self.register_buffer(name, value.to(self.device))

    def _outputs_at(self, node: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """The logits and the state at `node [N]` in `context [N]`."""
        contexts = self.num_contexts or 1
        return self.log_probs[self._row(node, context)], node * contexts + context

    def _row(self, node: Tensor, context: Tensor) -> Tensor:
        """The row of `log_probs` for each history and context: of the longest history that occurred in the context."""
        if self.num_contexts is None or len(self.row_code) == 0:
            return node
        fallback = len(self.row_code)
        row = torch.full_like(node, fallback)
        for _ in range(self._depth + 2):
            code = node * self.num_contexts + context
            at = torch.searchsorted(self.row_code, code).clamp_(max=fallback - 1)
            row = torch.where((row == fallback) & (self.row_code[at] == code), at, row)
            node = self.parent[node]
        return row

    def tables_fit(self) -> bool:
        """Whether the tables are those of a prior of this kind; checks what was read from a file."""
        nodes, rows, contexts = len(self.next_node), len(self.log_probs), self.num_contexts or 1
        return (
            self.next_node.shape == (nodes, self.num_actions)
            and self.log_probs.shape == (rows, self.num_actions)
            and self.parent.shape == (nodes,)
            and self.start_node.shape == ()
            and self.row_code.shape == (rows - 1,)
            and all(int(t.min()) >= 0 and int(t.max()) < nodes for t in (self.next_node, self.parent, self.start_node))
            and (rows == 1 or (int(self.row_code.min()) >= 0 and int(self.row_code.max()) < nodes * contexts))
            and (self.num_contexts is not None or rows == 1 or rows == nodes + 1)
        )
