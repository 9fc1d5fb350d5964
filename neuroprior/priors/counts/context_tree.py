"""Variable-order Markov priors: context tree weighting, the average over all trees of histories that may matter."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes, is_number
from neuroprior.priors.counts.histories import Counts, Tree, level_bounds, parent_rows, row_blocks
from neuroprior.priors.counts.history_prior import HistoryPrior, check_depth

_PAIRS = ("pair_row", "pair_action", "pair_count")


@dataclass(frozen=True, eq=False)
class Leaf:
    """A leaf of the tree of `ContextTreePrior.map_tree`: given this history, nothing further back matters."""

    history: tuple[int, ...]
    """The last actions, the oldest first."""
    opening: bool
    """True where these are all the actions since the plan began."""
    context: int | None
    """That of the next action; None where it does not matter."""
    count: int
    """How many actions followed it in the training plans."""
    probs: Tensor
    """`[A]`, float64: of the next action."""


class ContextTreePrior(HistoryPrior):
    """A Markov chain whose order depends on the history: context tree weighting.

    (Willems, Shtarkov and Tjalkens 1995, "The context-tree weighting method: basic properties"; with more than two
    actions, and as Bayesian inference, Kontoyiannis et al. 2022, "Bayesian context trees: modelling and exact inference
    for discrete time series".)

    The histories that matter are the leaves of a tree that is not known. Of a history s either nothing further back
    matters, with probability beta, and actions follow it as they were drawn from a Dirichlet distribution; or the
    action before s matters too. At `depth` actions nothing further back does. A plan's beginning is one more symbol,
    before the first action, that a history may reach; nothing is further back than it. So

        P(s) = beta * Pe(s) + (1 - beta) * (product of P(as) over the A actions a and the beginning),

    with Pe the Dirichlet-multinomial probability of all that followed s in the training plans, and P(s) = Pe(s) where s
    is of `depth` actions or is a plan's whole past. The probability of the next action is exactly the average over all
    trees and all their parameters after training (float32); it does not change as a plan goes on.

    With a context index the present context comes before the last action: either it does not matter, with probability
    beta, and then no action does; or each context has a tree of its own.

    Args:
        num_actions: A.
        depth: >= 0, the most past actions that may matter. Deeper trees cost memory and time, not accuracy.
        beta: between 0 and 1. None: 1 - 1 / A (1 / 2 for one action), so that a history's tree is expected to branch
            at one history of each length. (The papers' 1 / 2 for two actions; for more, theirs, 1 - 2 ** (1 - A), soon
            rounds to 1.)
        alpha: > 0, the pseudo-count of an action in a leaf, averaged over actions. None: of A * alpha = 1/4, 1/2, 1, 2,
            ..., 64 the one under which the training plans are most probable (climbing from 2).
        base: how these pseudo-counts are distributed over the actions. "frequencies": as in all training plans, with
            Witten-Bell smoothing for actions that were never taken; "uniform": evenly. "uniform" and alpha = 1 / 2 give
            the papers' Krichevsky-Trofimov estimator; where actions are very unevenly frequent, "frequencies" predicts
            far better.
        num_contexts: number of context indices, for a prior that takes an index.

    Attributes:
        pseudo_counts: `[A]`, float64: of each action in a leaf, as given by `alpha` and `base` or found by `fit`.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = ContextTreePrior(2, depth=2).fit(torch.tensor([[0, 0, 1, 0, 0, 1, 0, 0, 1]]))
        >>> prior.action_log_probs(torch.tensor([[0, 0, 1]])).exp() > 0.5
        tensor([[True, True, True]])
    """

    bounds: Tensor
    pair_row: Tensor
    pair_action: Tensor
    pair_count: Tensor
    pseudo_counts: Tensor

    tables = (*HistoryPrior.tables, "bounds", *_PAIRS, "pseudo_counts")

    def __init__(
        self,
        num_actions: int,
        depth: int = 10,
        beta: float | None = None,
        alpha: float | None = None,
        base: Literal["frequencies", "uniform"] = "frequencies",
        num_contexts: int | None = None,
    ) -> None:
        check_depth("depth", depth)
        if beta is not None and (not is_number(beta) or not 0 < beta < 1):
            raise ValueError(f"`beta` must be a number between 0 and 1, got {beta!r}")
        if alpha is not None and (not is_number(alpha) or not 0 < alpha < float("inf")):
            raise ValueError(f"`alpha` must be a positive finite number, got {alpha!r}")
        if base not in ("frequencies", "uniform"):
            raise ValueError(f'`base` must be "frequencies" or "uniform", got {base!r}')
        check_sizes(num_actions=num_actions)
        self.depth, self.alpha, self.base = depth, alpha, base
        self.beta = 1 - 1 / max(num_actions, 2) if beta is None else float(beta)
        super().__init__(num_actions, depth, num_contexts)

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"depth": self.depth, "beta": self.beta, "alpha": self.alpha, "base": self.base}

    def log_evidence(self) -> float:
        """The log-probability, in nats, of all actions of the training plans, averaged over all trees and parameters.

        The higher, the better the depth, beta and alpha describe the plans. 0 before `fit`.
        """
        return self._weighting(*self._tree_and_counts()).evidence(self.pseudo_counts)

    def map_tree(self) -> list[Leaf]:
        """The most probable tree after training: its leaves that occurred in the plans, the shortest first.

        This is the BCT algorithm of Kontoyiannis et al. 2022. Of equally probable trees it is the smallest. Empty
        before `fit`.
        """
        tree, counts = self._tree_and_counts()
        num, contexts = len(counts.row_code), self.num_contexts or 1
        if num == 0:
            return []
        weighting = self._weighting(tree, counts)
        rows = weighting.best_leaves(self.pseudo_counts)
        n = weighting.counts_of(rows)
        code = torch.cat([counts.row_code, counts.row_code.new_zeros(1)])[rows]
        node, index = code.div(contexts, rounding_mode="floor"), (code % contexts).tolist()
        context = [None if self.num_contexts is None or row == num else c for row, c in zip(rows, index, strict=True)]
        probs = (n + self.pseudo_counts) / (n.sum(1, keepdim=True) + self.pseudo_counts.sum())
        opening = (node >= tree.bounds[self.depth + 1]).tolist()
        columns = (_histories_of(tree, node, self.depth), opening, context, n.sum(1).long().tolist(), probs.cpu())
        leaves = [Leaf(*leaf) for leaf in zip(*columns, strict=True)]
        return sorted(leaves, key=lambda leaf: (len(leaf.history), leaf.opening, leaf.history, leaf.context or 0))

    def learn(self, tree: Tree, counts: Counts) -> None:
        weighting = self._weighting(tree, counts)
        self.register_buffer("pseudo_counts", self._choose(weighting).to(self.device))
        self.register_buffer("bounds", torch.tensor(tree.bounds, device=self.device))
        for name, value in zip(_PAIRS, (counts.row.int(), counts.action.int(), counts.count), strict=True):
            self.register_buffer(name, value.to(self.device))
        super().learn(tree, counts)

    def estimate(self, tree: Tree, counts: Counts) -> Tensor:
        return self._weighting(tree, counts).predict(self.pseudo_counts)

    def _choose(self, weighting: "Weighting") -> Tensor:
        """The pseudo-counts of a leaf."""
        counts, actions = weighting.pooled, self.num_actions
        base = torch.full_like(counts, 1 / actions)
        if self.base == "frequencies" and bool(counts.any()):
            kinds = (counts > 0).sum()
            base = (counts + kinds * base) / (counts.sum() + kinds)
        if self.alpha is not None or weighting.num == 0:
            return base * actions * (0.5 if self.alpha is None else self.alpha)
        evidence = {size: weighting.evidence(base * size) for size in (1.0, 2.0, 4.0)}
        while (best := max(evidence, key=lambda size: evidence[size])) in (min(evidence), max(evidence)):
            further = best / 2 if best == min(evidence) else best * 2
            if not 1 / 4 <= further <= 64:
                break
            evidence[further] = weighting.evidence(base * further)
        return base * best

    def tables_fit(self) -> bool:
        rows, pairs, bounds = self.row_code.numel(), self.pair_row.numel(), self.bounds.flatten()
        whole = (self.bounds, self.pair_row, self.pair_action, self.pair_count)
        limits = (rows, self.num_actions, 2**63 - 1)
        return (
            super().tables_fit()
            and all(t.dim() == 1 for t in whole)
            and self.pair_action.numel() == self.pair_count.numel() == pairs
            and all(0 <= t < limit for v, limit in zip(whole[1:], limits, strict=True) for t in _extremes(v))
            and len(bounds) == (2 * self.depth + 2 if rows else 2)
            and (int(bounds[0]), int(bounds[-1])) == (0, len(self.next_node))
            and bool((bounds.diff() >= 0).all())
            and self.pseudo_counts.shape == (self.num_actions,)
            and bool((self.pseudo_counts > 0).all() & self.pseudo_counts.isfinite().all())
        )

    def _weighting(self, tree: Tree, counts: Counts) -> "Weighting":
        return Weighting(tree, counts, self.num_contexts, self.num_actions, self.depth, self.beta)

    def _tree_and_counts(self) -> tuple[Tree, Counts]:
        tree = Tree(self.next_node, self.parent, int(self.start_node), self.bounds.tolist())
        row, action = self.pair_row.long(), self.pair_action.long()
        return tree, Counts(self.row_code, row, action, self.pair_count, self.pair_count)


def _extremes(values: Tensor) -> list[int]:
    return [int(values.min()), int(values.max())] if len(values) else []


class Weighting:
    """The recursion of `ContextTreePrior` over the rows of `counts`, in logarithms and float64.

    Results `[R + 1]` have one number a row; the last is that of all contexts together, the root of a tree with
    contexts. `pseudo [A]`: the pseudo-counts of a leaf.

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
        self.takes_context, self.contexts, self.beta = num_contexts is not None, num_contexts or 1, beta
        self.num = len(counts.row_code)
        self.parent = parent_rows(tree, counts, self.contexts)
        self.ends = level_bounds(tree, counts, self.contexts)
        self.blocks = list(row_blocks(tree, counts, self.contexts, num_actions))
        self.pooled = counts.pooled(self.contexts, num_actions, counts.count).double()
        self.total = torch.cat([counts.total().double(), self.pooled.sum()[None]])
        self.root = self.num if self.takes_context or self.num == 0 else 0

    def leaf_evidence(self, pseudo: Tensor) -> Tensor:
        """`[R + 1]`: the log-probability of all that followed each row if it is a leaf (Dirichlet-multinomial)."""
        at, whole = pseudo.lgamma(), pseudo.sum()
        out = whole.lgamma() - (self.total + whole).lgamma()
        action = self.counts.action
        out[: self.num].index_add_(0, self.counts.row, (self.counts.count + pseudo[action]).lgamma_().sub_(at[action]))
        out[self.num] += ((self.pooled + pseudo).lgamma() - at).sum()
        return out

    def weigh(self, pseudo: Tensor, best: bool = False) -> tuple[Tensor, Tensor]:
        """The log-probabilities of what followed each row, with the prior probabilities of trees.

        Returns:
            `[R + 1]`: with the row as a leaf; and `[R + 1]`: summed over all trees below it (`best`: for the best one).
        """
        leaf, absent = self.leaf_evidence(pseudo), self.absent()
        whole, parts = leaf.clone(), torch.zeros_like(leaf)
        missing = torch.full_like(leaf, self.num_actions)
        missing[self.num] = self.contexts
        for level in range(len(self.ends) - 2, -2, -1):
            rows = slice(self.ends[level], self.ends[level + 1]) if level >= 0 else slice(self.num, self.num + 1)
            if level < self.depth:
                leaf[rows] += math.log(self.beta)
                branch = parts[rows] + math.log1p(-self.beta)
                if best:
                    branch += missing[rows] * absent[level + 1]
                whole[rows] = torch.maximum(leaf[rows], branch) if best else torch.logaddexp(leaf[rows], branch)
            if level >= 0:
                parts.index_add_(0, self.parent[rows], whole[rows])
                # A beginning has no tree below it, so only missing actions cost something.
                if best and level <= self.depth:
                    missing.index_add_(0, self.parent[rows], -torch.ones_like(whole[rows]))
        return leaf, whole

    def evidence(self, pseudo: Tensor) -> float:
        """The log-probability of all that was counted."""
        return float(self.weigh(pseudo)[1][self.root])

    def predict(self, pseudo: Tensor) -> Tensor:
        """`[R + 1, A]`, float32: log-probabilities of the next action after the history of each row.

        The row is the longest history that occurred.
        """
        leaf, whole = self.weigh(pseudo)
        stop = (leaf - whole).exp()  # the posterior probability that nothing further back matters
        base = pseudo / pseudo.sum()
        table = torch.zeros(self.num + 1, self.num_actions, device=base.device)
        rest = torch.ones_like(stop)  # the posterior probability that something further back than the row matters
        if self.takes_context:
            table[-1] = stop[-1] * _mean(self.pooled, pseudo)
            rest[-1] -= stop[-1]
        for _, first, until in self.blocks:
            rows, up = slice(first, until), self.parent[first:until]
            mean = _mean(self.counts.dense(first, until, self.num_actions, self.counts.count), pseudo)
            table[rows] = table[up] + mean.mul_((rest[up] * stop[rows])[:, None])
            rest[rows] = rest[up] * (1 - stop[rows])
        # Histories further back than the longest that occurred have no counts: their leaves have the mean `base`.
        for first in range(0, self.num + 1, max(2**22 // self.num_actions, 1)):
            rows = slice(first, first + max(2**22 // self.num_actions, 1))
            table[rows] = (table[rows] + rest[rows, None] * base).log()
        return table

    def best_leaves(self, pseudo: Tensor) -> Tensor:
        """The rows, ascending, that are leaves of the best tree; of equally good trees, of the smallest."""
        leaf, whole = self.weigh(pseudo, best=True)
        ends = leaf >= whole - 1e-12 * whole.abs()
        ends[-1] &= self.takes_context
        reached = torch.ones_like(ends)
        for _, first, until in self.blocks:
            up = self.parent[first:until]
            reached[first:until] = reached[up] & ~ends[up]
        return (reached & ends).nonzero()[:, 0]

    def counts_of(self, rows: Tensor) -> Tensor:
        """`[n, A]`, float64: what followed `rows [n]`."""
        place = torch.full((self.num + 1,), -1, device=rows.device)
        place[rows] = torch.arange(len(rows), device=rows.device)
        inside = place[self.counts.row] >= 0
        n = torch.zeros(len(rows), self.num_actions, dtype=torch.double, device=rows.device)
        n[place[self.counts.row[inside]], self.counts.action[inside]] = self.counts.count[inside].double()
        n[rows == self.num] = self.pooled
        return n

    def absent(self) -> list[float]:
        """The log-probability of the best tree below a history of 0, 1, ..., depth actions that did not occur."""
        out = [0.0]
        for _ in range(self.depth):
            out.append(max(math.log(self.beta), math.log1p(-self.beta) + self.num_actions * out[-1]))
        return out[::-1]


def _mean(n: Tensor, pseudo: Tensor) -> Tensor:
    """The posterior mean `[..., A]` of a leaf's distribution after counts `n [..., A]`."""
    return (n + pseudo).div_(n.sum(-1, keepdim=True) + pseudo.sum())


def _histories_of(tree: Tree, nodes: Tensor, depth: int) -> list[tuple[int, ...]]:
    """The actions of each of `nodes [n]`, the oldest first."""
    before, last = torch.zeros_like(tree.parent), torch.full_like(tree.parent, -1)
    for level in range(1, len(tree.bounds) - 1):
        if level == depth + 1:
            continue  # the beginning of a plan, before any action
        first, until = tree.bounds[level - 1 : level + 1]
        to = tree.next_node[first:until].long()
        # On the level above, only the history without its last action leads to a history.
        node, action = ((to >= until) & (to < tree.bounds[level + 1])).nonzero().unbind(1)
        before[to[node, action]], last[to[node, action]] = node + first, action
    actions: list[Tensor] = []
    while bool((last[nodes] >= 0).any()):
        actions.insert(0, last[nodes])
        nodes = before[nodes]
    rows = torch.stack(actions, 1).tolist() if actions else [[] for _ in nodes]
    return [tuple(action for action in row if action >= 0) for row in rows]
