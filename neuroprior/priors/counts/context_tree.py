"""Variable-order Markov priors: context tree weighting, the average over all trees of histories that may matter."""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.priors.counts.histories import Counts, Tree
from neuroprior.priors.counts.history_prior import HistoryPrior
from neuroprior.priors.counts.weighting import Weighting, histories_of

_PAIRS = ("pair_row", "pair_action", "pair_count")


@dataclass(frozen=True, eq=False)
class Leaf:
    """A history that tells all about the next action, in the tree of `ContextTreePrior.map_tree`."""

    history: tuple[int, ...]
    """The last actions, the oldest first."""
    opening: bool
    """True: these are all the actions since the plan began."""
    context: int | None
    """Seen now; None where it does not matter."""
    count: int
    """How many actions of the training plans followed it."""
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

    With a context index the context seen now is nearer than the last action: either it does not matter, with
    probability beta, and no action does; or each context has a tree of its own.

    Args:
        num_actions: A.
        depth: >= 0, the most past actions that may matter. Deeper trees cost memory and time, but no accuracy.
        beta: between 0 and 1. None: 1 - 1 / A (1 / 2 for one action), so that a history's tree is expected to branch
            at one history of each length. (The papers' 1 / 2 for two actions; for more, theirs, 1 - 2 ** (1 - A), soon
            rounds to 1.)
        alpha: > 0, the pseudo-count of an action in a leaf, averaged over actions. None: of A * alpha = 1/4, 1/2, 1, 2,
            ..., 64 the one under which the training plans are most probable (climbing from 2).
        base: how these pseudo-counts are spread. "frequencies": as the actions of all training plans are, those never
            taken by the Witten-Bell rule; "uniform": evenly. "uniform" and alpha = 1 / 2 give the papers'
            Krichevsky-Trofimov estimator; where many actions are taken unevenly, "frequencies" predicts far better.
        num_contexts: number of context indices, where the prior sees one.

    Attributes:
        pseudo_counts: `[A]`, float64: of each action in a leaf, as `alpha` and `base` say or `fit` found.

    Raises:
        ValueError: an argument is out of range.
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
        if not isinstance(depth, int) or isinstance(depth, bool) or depth < 0:
            raise ValueError(f"depth: an integer of at least 0 is expected, not {depth!r}")
        if beta is not None and not 0 < beta < 1:
            raise ValueError(f"beta: a number between 0 and 1 is expected, not {beta!r}")
        if alpha is not None and not 0 < alpha < float("inf"):
            raise ValueError(f"alpha: a positive finite number is expected, not {alpha!r}")
        if base not in ("frequencies", "uniform"):
            raise ValueError(f'base: "frequencies" or "uniform" is expected, not {base!r}')
        check_sizes(num_actions=num_actions)
        self.depth, self.alpha, self.base = depth, alpha, base
        self.beta = 1 - 1 / max(num_actions, 2) if beta is None else float(beta)
        super().__init__(num_actions, depth, num_contexts)

    @property
    def config(self) -> dict[str, Any]:
        own = {"depth": self.depth, "beta": self.beta, "alpha": self.alpha, "base": self.base}
        return super().config | own

    def log_evidence(self) -> float:
        """The log-probability, in nats, of all actions of the training plans, averaged over all trees and parameters.

        Of two depths, betas or alphas the better one makes it higher. 0 before `fit`.
        """
        return self._weighting(*self._learned()).evidence(self.pseudo_counts)

    def map_tree(self) -> list[Leaf]:
        """The most probable tree after training: those of its leaves that occurred, the shortest first.

        (The BCT algorithm of Kontoyiannis et al. 2022.) Of equally probable trees the smallest. Empty before
        `fit`.
        """
        tree, counts = self._learned()
        num, contexts = len(counts.row_code), self.num_contexts or 1
        if num == 0:
            return []
        weighting = self._weighting(tree, counts)
        rows = weighting.best_leaves(self.pseudo_counts)
        n = weighting.counts_of(rows)
        code = torch.cat([counts.row_code, counts.row_code.new_zeros(1)])[rows]
        node, seen = code.div(contexts, rounding_mode="floor"), (code % contexts).tolist()
        context = [None if self.num_contexts is None or row == num else c for row, c in zip(rows, seen, strict=True)]
        probs = (n + self.pseudo_counts) / (n.sum(1, keepdim=True) + self.pseudo_counts.sum())
        opening = (node >= tree.bounds[self.depth + 1]).tolist()
        columns = (histories_of(tree, node, self.depth), opening, context, n.sum(1).long().tolist(), probs.cpu())
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

    def _choose(self, weighting: Weighting) -> Tensor:
        """The pseudo-counts of a leaf."""
        counts, actions = weighting.pooled, self.num_actions
        base = torch.full_like(counts, 1 / actions)
        if self.base == "frequencies" and bool(counts.any()):
            kinds = (counts > 0).sum()
            base = (counts + kinds * base) / (counts.sum() + kinds)
        if self.alpha is not None or weighting.num == 0:
            return base * actions * (0.5 if self.alpha is None else self.alpha)
        found = {size: weighting.evidence(base * size) for size in (1.0, 2.0, 4.0)}
        while (best := max(found, key=lambda size: found[size])) in (min(found), max(found)):
            further = best / 2 if best == min(found) else best * 2
            if not 1 / 4 <= further <= 64:
                break
            found[further] = weighting.evidence(base * further)
        return base * best

    def tables_fit(self) -> bool:
        rows, pairs, bounds = self.row_code.numel(), self.pair_row.numel(), self.bounds.flatten()
        whole = (self.bounds, self.pair_row, self.pair_action, self.pair_count)
        limits = (rows, self.num_actions, 2**63 - 1)
        return (
            super().tables_fit()
            and all(not t.is_floating_point() and t.dim() == 1 for t in whole)
            and self.pair_action.numel() == self.pair_count.numel() == pairs
            and all(0 <= t < limit for v, limit in zip(whole[1:], limits, strict=True) for t in _extremes(v))
            and len(bounds) == (2 * self.depth + 2 if rows else 2)
            and (int(bounds[0]), int(bounds[-1])) == (0, len(self.next_node))
            and bool((bounds.diff() >= 0).all())
            and self.pseudo_counts.shape == (self.num_actions,)
            and bool((self.pseudo_counts > 0).all() & self.pseudo_counts.isfinite().all())
        )

    def _weighting(self, tree: Tree, counts: Counts) -> Weighting:
        return Weighting(tree, counts, self.num_contexts, self.num_actions, self.depth, self.beta)

    def _learned(self) -> tuple[Tree, Counts]:
        tree = Tree(self.next_node, self.parent, int(self.start_node), self.bounds.tolist())
        row, action = self.pair_row.long(), self.pair_action.long()
        return tree, Counts(self.row_code, row, action, self.pair_count, self.pair_count)


def _extremes(values: Tensor) -> list[int]:
    return [int(values.min()), int(values.max())] if len(values) else []
