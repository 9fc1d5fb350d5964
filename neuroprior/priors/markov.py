"""Markov priors of any order: counts of what followed the last k actions, with back-off to shorter histories."""

from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior.plans import Plans, sees_each_step
from neuroprior.priors.prior import Prior

_TABLES = ("next_node", "parent", "start_node", "row_code", "counts", "log_probs")


class MarkovPrior(Prior):
    """A Markov chain of order k over actions (Hyvärinen, the section on Markov models).

    The probability of action a after the history h of the last k actions is

        p(a | h) = (n(h, a) + smoothing * p(a | h')) / (n(h) + smoothing),

    with n the counts of training and h' the history without its oldest action; the empty history backs off to the
    uniform distribution. So a history never seen takes the probabilities of the longest one that was, and nothing is
    ever impossible. Sampling goes on past the training length with the same probabilities.

    With a context index every history is counted apart for each context; (context, empty history) backs off to the
    frequencies of actions in all contexts together.

    The histories that occurred are the nodes of a tree, and the state is the number of the longest one that ends the
    plan so far (times `num_contexts`, plus the context seen last): `step` is two gathers, for any order.

    Args:
        num_actions: A.
        order: k >= 0, the number of past actions that count.
        smoothing: > 0, how many observations the shorter history is worth.
        initial: the first k actions. "joint": from the distribution of the openings of the plans (which backs off to
            "lower" where an opening was never seen). "lower": action t < k from the chain of order t, wherever in a
            plan those t actions stood (the paper's footnote 2).
        num_contexts: number of context indices, where the prior sees one.

    Raises:
        ValueError: an argument is out of range.
    """

    next_node: Tensor
    parent: Tensor
    start_node: Tensor
    row_code: Tensor
    counts: Tensor
    log_probs: Tensor

    def __init__(
        self,
        num_actions: int,
        order: int = 1,
        smoothing: float = 1.0,
        initial: Literal["joint", "lower"] = "joint",
        num_contexts: int | None = None,
    ) -> None:
        super().__init__(num_actions, num_contexts)
        if not isinstance(order, int) or isinstance(order, bool) or order < 0:
            raise ValueError(f"order: an integer of at least 0 is expected, not {order!r}")
        if not 0 < smoothing < float("inf"):
            raise ValueError(f"smoothing: a positive finite number is expected, not {smoothing!r}")
        if initial not in ("joint", "lower"):
            raise ValueError(f'initial: "joint" or "lower" is expected, not {initial!r}')
        self.order, self.smoothing, self.initial = order, float(smoothing), initial
        self._set_tables(_Tree.empty(num_actions), torch.empty(0, dtype=torch.long), torch.empty(0, num_actions))

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"order": self.order, "smoothing": self.smoothing, "initial": self.initial}

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        node = self.start_node.expand(batch_size)
        return self._at(node, torch.zeros_like(node) if context is None else context.long())

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        contexts = self.num_contexts or 1
        node = self.next_node.view(-1)[state.div(contexts, rounding_mode="floor") * self.num_actions + action]
        return self._at(node, state % contexts if context is None else context.long())

    def fit(self, plans: Plans | Tensor) -> Self:
        """Count; whatever was learned before is forgotten. Returns self."""
        plans = self.training_plans(plans)
        actions = plans.actions.to(self.device).long()
        mask = None if plans.lengths is None else plans.mask().to(self.device)
        context = None if plans.context is None else plans.context.to(self.device).long()
        if context is not None and not sees_each_step(context):
            context = context[:, None].expand_as(actions)
        tree, nodes = _grow_tree(actions, mask, self.num_actions, self.order, self.initial == "joint")
        codes, tables = [], []
        for first, node in nodes:
            columns = slice(first, first + node.shape[1])
            here = None if mask is None else mask[:, columns]
            seen = 0 if context is None else _take(context[:, columns], here)
            distinct, row = _number(_take(node, here) * (self.num_contexts or 1) + seen)
            pair = row * self.num_actions + _take(actions[:, columns], here)
            codes.append(distinct)
            tables.append(pair.bincount(minlength=len(distinct) * self.num_actions).view(-1, self.num_actions))
        self._set_tables(tree, torch.cat(codes), torch.cat(tables).float())
        return self

    def transition_matrix(self) -> Tensor:
        """`[A, A]`: the probability of each action (column) after each action (row), wherever in a plan.

        Raises:
            ValueError: the order is 0, or the prior sees a context.
        """
        if self.order == 0 or self.takes_context:
            raise ValueError("transition_matrix: a prior of order 1 or more without context is expected")
        return self.log_probs[self.next_node[0]].exp()

    def _at(self, node: Tensor, context: Tensor) -> tuple[Tensor, Tensor]:
        """The logits and the state at `node [N]` where `context [N]` is seen."""
        contexts = self.num_contexts or 1
        return self.log_probs[self._row(node, context)], node * contexts + context

    def _row(self, node: Tensor, context: Tensor) -> Tensor:
        """The row of `log_probs` for each history and context: that of the longest history seen in the context."""
        if self.num_contexts is None or len(self.row_code) == 0:
            return node
        fallback = len(self.row_code)
        row = torch.full_like(node, fallback)
        for _ in range(self.order + 2):
            code = node * self.num_contexts + context
            at = torch.searchsorted(self.row_code, code).clamp_(max=fallback - 1)
            row = torch.where((row == fallback) & (self.row_code[at] == code), at, row)
            node = self.parent[node]
        return row

    def _set_tables(self, tree: "_Tree", row_code: Tensor, counts: Tensor) -> None:
        """Make the tables of a tree and of the counts `[R, A]` of each (history, context) `row_code [R]`, sorted."""
        contexts, device = self.num_contexts or 1, self.device
        uniform = torch.full((1, self.num_actions), 1 / self.num_actions, dtype=torch.double, device=device)
        base = uniform
        node = row_code.div(contexts, rounding_mode="floor")
        if self.num_contexts is not None:
            base = _blend(counts[node == 0].double().sum(0, keepdim=True), base, self.smoothing)
        # The last row, `base`, is what a context never seen gets; every row's parent has a lower history or is it.
        probs = base.repeat(len(row_code) + 1, 1)
        above = torch.searchsorted(row_code, tree.parent.to(device)[node] * contexts + row_code % contexts)
        above[node == 0] = len(row_code)
        for generation in range(int(tree.generation.max()) + 1):
            rows = (tree.generation.to(device)[node] == generation).nonzero()[:, 0]
            probs[rows] = _blend(counts[rows].double(), probs[above[rows]], self.smoothing)
        values = (tree.next_node, tree.parent, tree.start, row_code, counts, probs.clamp(min=1e-300).log().float())
        for name, value in zip(_TABLES, values, strict=True):
            self.register_buffer(name, value.to(device))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        # The tables' sizes depend on what was learned, so they are taken from the file.
        for name in _TABLES:
            if prefix + name in state_dict:
                value = state_dict[prefix + name]
                self.register_buffer(name, torch.empty_like(value, device=self.device))
        super()._load_from_state_dict(state_dict, prefix, *args)
        nodes, rows, contexts = len(self.next_node), len(self.log_probs), self.num_contexts or 1
        fits = (
            self.next_node.shape == (nodes, self.num_actions)
            and self.log_probs.shape == (rows, self.num_actions)
            and self.parent.shape == (nodes,)
            and self.row_code.shape == (rows - 1,)
            and all(int(t.min()) >= 0 and int(t.max()) < nodes for t in (self.next_node, self.parent, self.start_node))
            and (rows == 1 or int(self.row_code.max()) < nodes * contexts)
            and not bool(self.log_probs.isnan().any())
        )
        if not fits:
            raise RuntimeError("the tables of a MarkovPrior do not fit one another")


class _Tree(NamedTuple):
    """The histories that occurred. Node 0 is the empty one; then those of length 1, 2, ..., k; then the openings."""

    next_node: Tensor  # [M, A]: the node after one more action
    parent: Tensor  # [M]: the node to back off to (of the empty history: itself)
    generation: Tensor  # [M]: parents have a lower generation
    start: Tensor  # []: the node before the first action

    @staticmethod
    def empty(num_actions: int) -> "_Tree":
        zero = torch.zeros(1, dtype=torch.long)
        return _Tree(torch.zeros(1, num_actions, dtype=torch.long), zero, zero, zero[0])


def _blend(counts: Tensor, lower: Tensor, smoothing: float) -> Tensor:
    return (counts + smoothing * lower) / (counts.sum(-1, keepdim=True) + smoothing)


def _number(codes: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct codes in ascending order, and the rank among them of each code."""
    size = int(codes.max()) + 1 if len(codes) else 0
    if size > 4 * len(codes) + 2**20:
        distinct, rank = torch.unique(codes, return_inverse=True)
        return distinct, rank
    present = torch.zeros(size, dtype=torch.bool, device=codes.device)
    present[codes] = True
    return present.nonzero()[:, 0], (present.cumsum(0) - 1)[codes]


def _grow_tree(
    actions: Tensor, mask: Tensor | None, num_actions: int, order: int, joint: bool
) -> tuple[_Tree, list[tuple[int, Tensor]]]:
    """The tree of the histories in `actions [N, L]`, and, level by level, the node `[N, n]` of each of n positions.

    `mask [N, L]` tells which actions count; None: all.
    A level's list entry is the first position that it covers and the nodes from there on.
    """
    node = torch.zeros_like(actions)
    levels = [(0, node)]
    if actions.numel() == 0 or (mask is not None and not mask.any()):
        return _Tree.empty(num_actions), levels
    parents = [torch.zeros(1, dtype=torch.long, device=actions.device)]
    follow = torch.zeros(1, num_actions, dtype=torch.long, device=actions.device)
    for depth in range(1, order + 1):
        here = None if mask is None else mask[:, depth:]
        if depth >= actions.shape[1] or (here is not None and not here.any()):
            break
        # A history of this length is the one before its last action, and that action.
        above = levels[-1][1]
        distinct, rank = _number(_take(above[:, :-1] * num_actions + actions[:, depth - 1 : -1], here))
        node = _put(rank + len(follow), above[:, 1:], here)
        parent = torch.empty_like(distinct)
        parent[rank] = _take(above[:, 1:], here)
        levels.append((depth, node))
        parents.append(parent)
        follow = _extend(follow, distinct, parent)
    openings = min(order, len(levels)) if joint else 0
    start = torch.tensor(len(follow) if openings else 0)
    before = torch.zeros_like(actions[:, 0])
    for depth in range(openings):
        here = None if mask is None else mask[:, depth]
        code = before * num_actions + actions[:, depth - 1] if depth else before
        distinct, rank = _number(_take(code, here))
        before = _put(rank + len(follow), before, here)
        parent = torch.empty_like(distinct)
        parent[rank] = _take(levels[depth][1][:, 0], here)
        levels.append((depth, before[:, None]))
        parents.append(parent)
        follow = _extend(follow, distinct if depth else distinct[:0], parent)
    generation = torch.cat([torch.full_like(p, g) for g, p in enumerate(parents)])
    return _Tree(follow, torch.cat(parents), generation, start), levels


def _take(values: Tensor, here: Tensor | None) -> Tensor:
    """`values` where `here` is True, in one dimension; None: all of them, which is far faster than a mask of True."""
    return values.reshape(-1) if here is None else values[here]


def _put(values: Tensor, like: Tensor, here: Tensor | None) -> Tensor:
    """The inverse of `_take`, in the shape of `like`; 0 elsewhere."""
    return values.view(like.shape) if here is None else torch.zeros_like(like).masked_scatter(here, values)


def _extend(follow: Tensor, codes: Tensor, parent: Tensor) -> Tensor:
    """Add nodes to `follow [M, A]`: `codes` (node * A + action) lead to them, in order; they back off to `parent`."""
    follow.view(-1)[codes] = torch.arange(len(follow), len(follow) + len(codes), device=follow.device)
    # Where no longer history occurred, one more action leads where it leads from the shorter one.
    return torch.cat([follow, follow[parent]])
