"""Context tree weighting: sums over all trees of histories, and the best of them, from counts."""

import math

import torch
from torch import Tensor

from neuroprior.priors.counts.histories import Counts, Tree, row_blocks, row_ends, rows_above


class Weighting:
    """The recursion of `ContextTreePrior` over the rows of `counts`, in logarithms and float64.

    Results `[R + 1]` have one number a row; the last is of all contexts together, the root where a context is seen.
    `pseudo [A]`: the pseudo-counts of a leaf.

    Args:
        tree, counts: of `count_histories`.
        num_contexts: number of contexts counted apart, or None.
        num_actions: A.
        depth: the most actions of a history.
        beta: the probability that nothing further back matters.
    """

    def __init__(
        self, tree: Tree, counts: Counts, num_contexts: int | None, num_actions: int, depth: int, beta: float
    ) -> None:
        self.counts, self.depth, self.num_actions = counts, depth, num_actions
        self.sees, self.contexts, self.beta = num_contexts is not None, num_contexts or 1, beta
        self.num = len(counts.row_code)
        self.above = rows_above(tree, counts, self.contexts)
        self.ends = row_ends(tree, counts, self.contexts)
        self.blocks = list(row_blocks(tree, counts, self.contexts, num_actions))
        self.pooled = counts.pooled(self.contexts, num_actions, counts.count).double()
        self.total = torch.cat([counts.total().double(), self.pooled.sum()[None]])
        self.root = self.num if self.sees or self.num == 0 else 0

    def alone(self, pseudo: Tensor) -> Tensor:
        """`[R + 1]`: the log-probability of what followed each row if it is a leaf: Dirichlet-multinomial."""
        at, whole = pseudo.lgamma(), pseudo.sum()
        out = whole.lgamma() - (self.total + whole).lgamma()
        action = self.counts.action
        out[: self.num].index_add_(0, self.counts.row, (self.counts.count + pseudo[action]).lgamma_().sub_(at[action]))
        out[self.num] += ((self.pooled + pseudo).lgamma() - at).sum()
        return out

    def weigh(self, pseudo: Tensor, best: bool = False) -> tuple[Tensor, Tensor]:
        """The log-probabilities of each row with all that is further back.

        Returns:
            `[R + 1]`: of it as a leaf; and `[R + 1]`: summed over all trees (`best`: of the best tree).
        """
        leaf, never = self.alone(pseudo), self.never_seen()
        whole, parts = leaf.clone(), torch.zeros_like(leaf)
        missing = torch.full_like(leaf, self.num_actions)
        missing[self.num] = self.contexts
        for level in range(len(self.ends) - 2, -2, -1):
            here = slice(self.ends[level], self.ends[level + 1]) if level >= 0 else slice(self.num, self.num + 1)
            if level < self.depth:
                leaf[here] += math.log(self.beta)
                grown = parts[here] + math.log1p(-self.beta)
                if best:
                    grown += missing[here] * never[level + 1]
                whole[here] = torch.maximum(leaf[here], grown) if best else torch.logaddexp(leaf[here], grown)
            if level >= 0:
                parts.index_add_(0, self.above[here], whole[here])
                # What never follows a beginning needs no tree: it cannot have one.
                if best and level <= self.depth:
                    missing.index_add_(0, self.above[here], -torch.ones_like(whole[here]))
        return leaf, whole

    def evidence(self, pseudo: Tensor) -> float:
        """The log-probability of all that was counted."""
        return float(self.weigh(pseudo)[1][self.root])

    def predict(self, pseudo: Tensor) -> Tensor:
        """`[R + 1, A]`, float32: the log-probabilities of the next action where a row is the longest that occurred."""
        leaf, whole = self.weigh(pseudo)
        stop = (leaf - whole).exp()  # how probable it is that nothing further back matters
        base = pseudo / pseudo.sum()
        table = torch.zeros(self.num + 1, self.num_actions, device=base.device)
        rest = torch.ones_like(stop)  # how probable it is that something further back than the row matters
        if self.sees:
            table[-1] = stop[-1] * _mean(self.pooled, pseudo)
            rest[-1] -= stop[-1]
        for _, first, until in self.blocks:
            here, up = slice(first, until), self.above[first:until]
            mean = _mean(self.counts.dense(first, until, self.num_actions, self.counts.count), pseudo)
            table[here] = table[up] + mean.mul_((rest[up] * stop[here])[:, None])
            rest[here] = rest[up] * (1 - stop[here])
        # Further back than the longest history that occurred is one that never did, and leaves start from `base`.
        for first in range(0, self.num + 1, max(2**22 // self.num_actions, 1)):
            here = slice(first, first + max(2**22 // self.num_actions, 1))
            table[here] = (table[here] + rest[here, None] * base).log()
        return table

    def best_leaves(self, pseudo: Tensor) -> Tensor:
        """The rows, ascending, that are leaves of the best tree; of trees equally good, the smallest."""
        leaf, whole = self.weigh(pseudo, best=True)
        ends = leaf >= whole - 1e-12 * whole.abs()
        ends[-1] &= self.sees
        reached = torch.ones_like(ends)
        for _, first, until in self.blocks:
            up = self.above[first:until]
            reached[first:until] = reached[up] & ~ends[up]
        return (reached & ends).nonzero()[:, 0]

    def counts_of(self, rows: Tensor) -> Tensor:
        """`[n, A]`, float64: what followed `rows [n]`."""
        place = torch.full((self.num + 1,), -1, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        here = place[self.counts.row] >= 0
        n = torch.zeros(len(rows), self.num_actions, dtype=torch.double, device=rows.device)
        n[place[self.counts.row[here]], self.counts.action[here]] = self.counts.count[here].double()
        n[rows == self.num] = self.pooled
        return n

    def never_seen(self) -> list[float]:
        """The log-probability of the best tree below a history of 0, 1, ..., depth actions that never occurred."""
        out = [0.0]
        for _ in range(self.depth):
            out.append(max(math.log(self.beta), math.log1p(-self.beta) + self.num_actions * out[-1]))
        return out[::-1]


def _mean(n: Tensor, pseudo: Tensor) -> Tensor:
    """The probabilities `[..., A]` of actions after a leaf where they followed `n [..., A]` times."""
    return (n + pseudo).div_(n.sum(-1, keepdim=True) + pseudo.sum())


def histories_of(tree: Tree, nodes: Tensor, depth: int) -> list[tuple[int, ...]]:
    """The actions of each of `nodes [n]`, the oldest first."""
    before, last = torch.zeros_like(tree.parent), torch.full_like(tree.parent, -1)
    for level in range(1, len(tree.bounds) - 1):
        if level == depth + 1:
            continue  # the beginning of a plan, before any action
        first, until = tree.bounds[level - 1 : level + 1]
        to = tree.next_node[first:until].long()
        # A history is led to from its own past, one level up, and from nowhere else on that level.
        node, action = ((to >= until) & (to < tree.bounds[level + 1])).nonzero().unbind(1)
        before[to[node, action]], last[to[node, action]] = node + first, action
    actions: list[Tensor] = []
    while bool((last[nodes] >= 0).any()):
        actions.insert(0, last[nodes])
        nodes = before[nodes]
    rows = torch.stack(actions, 1).tolist() if actions else [[] for _ in nodes]
    return [tuple(action for action in row if action >= 0) for row in rows]
