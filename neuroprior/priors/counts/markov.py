"""Markov priors of any order: counts of what followed the last k actions, with back-off to shorter histories."""

from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from neuroprior._checks import is_number
from neuroprior.plans import Plans
from neuroprior.priors.counts.histories import Counts, Tree, level_bounds, parent_rows, row_blocks
from neuroprior.priors.counts.history_prior import HistoryPrior, check_depth
from neuroprior.priors.learning import plans_for, training_plans

Backoff = Literal["dirichlet", "witten-bell", "kneser-ney"]

BACKOFFS: tuple[Backoff, ...] = get_args(Backoff)

FALLBACK_DISCOUNTS = (0.5, 1.0, 1.5)
"""Discounts of Kneser-Ney where the counts give none: those of KenLM's option `--discount_fallback`."""

BACKOFFS_TRIED: list[tuple[Backoff, float]] = [
    ("kneser-ney", 1),
    ("kneser-ney", 0.5),
    ("witten-bell", 1),
    ("witten-bell", 4),
    ("dirichlet", 1),
    ("dirichlet", 8),
]
"""Back-offs and their smoothing; for each order the best of them is chosen on validation plans."""


class MarkovPrior(HistoryPrior):
    """A Markov chain of order k over actions (Hyvärinen, the section on Markov models).

    The probability of action a after the history h of the last k actions is interpolated with that after h', the
    history without its oldest action: the less often h occurred, the more weight h' has. The empty history is
    interpolated with the uniform distribution. So a history that did not occur in training has the probabilities of the
    longest one that did, and every action stays possible. Sampling continues past the training length with the same
    probabilities. With n the counts of training and k(h) the number of different actions that followed h, the three
    methods (`backoff`) are

    - "kneser-ney": p(a | h) = (n(h, a) - D + (sum of all D after h) * p(a | h')) / n(h). There are three discounts D,
      for counts of 1, of 2 and of more, estimated for each length of history from how many counts are 1, 2, 3 and 4. In
      histories shorter than k, n(h, a) is not how often a followed h but after how many different older actions (the
      plan's beginning is one): interpolated modified Kneser-Ney smoothing (Chen and Goodman 1999, section 3).
    - "witten-bell": p(a | h) = (n(h, a) + s * k(h) * p(a | h')) / (n(h) + s * k(h)), with s = `smoothing` (Witten and
      Bell 1991; method C).
    - "dirichlet": p(a | h) = (n(h, a) + s * p(a | h')) / (n(h) + s): s pseudo-counts distributed as p(a | h') (MacKay
      and Peto 1995).

    On held-out sequences "kneser-ney" was the best or close to it without tuning, above all at orders for which there
    are few data; the other two come close with the right `smoothing`.

    With a context index the histories are counted apart in each context; the empty history in a context is interpolated
    with all contexts together.

    Args:
        num_actions: A.
        order: k >= 0, the number of past actions that count.
        smoothing: > 0, the weight of the shorter history: s above; for "kneser-ney", a factor on D (which stays at most
            n(h, a)). 1 is the published formula of each method.
        initial: the first k actions. "joint": from the distribution of the openings of the plans (interpolated with
            "lower"). "lower": action t < k from the chain of order t, wherever in a plan those t actions stood (the
            paper's footnote 2).
        num_contexts: number of context indices, for a prior that takes an index.
        backoff: "kneser-ney", "witten-bell" or "dirichlet".

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = MarkovPrior(3, order=1).fit(torch.tensor([[0, 1, 2, 0, 1, 2], [1, 2, 0, 1, 2, 0]]))
        >>> prior.log_prob(torch.tensor([[0, 1, 2], [0, 2, 1]])).double().exp().round(decimals=2).tolist()
        [0.21, 0.01]
        >>> prior.sample(2, 4, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([2, 4])
    """

    def __init__(
        self,
        num_actions: int,
        order: int = 1,
        smoothing: float = 1.0,
        initial: Literal["joint", "lower"] = "joint",
        num_contexts: int | None = None,
        backoff: Backoff = "kneser-ney",
    ) -> None:
        check_depth("order", order)
        if not is_number(smoothing) or not 0 < smoothing < float("inf"):
            raise ValueError(f"`smoothing` must be a positive finite number, got {smoothing!r}")
        if initial not in ("joint", "lower"):
            raise ValueError(f'`initial` must be "joint" or "lower", got {initial!r}')
        if backoff not in BACKOFFS:
            raise ValueError(f"`backoff` must be one of {', '.join(map(repr, BACKOFFS))}, got {backoff!r}")
        self.order, self.smoothing, self.initial, self.backoff = order, float(smoothing), initial, backoff
        self.openings = initial == "joint"
        super().__init__(num_actions, order, num_contexts)

    @property
    def config(self) -> dict[str, Any]:
        settings = {"order": self.order, "smoothing": self.smoothing, "initial": self.initial, "backoff": self.backoff}
        return super().config | settings

    def estimate(self, tree: Tree, counts: Counts) -> Tensor:
        smoothing = torch.tensor([self.smoothing], dtype=torch.double, device=counts.row.device)
        return back_off_log_probs(tree, counts, self.num_contexts, self.num_actions, self.backoff, smoothing)[0]

    def transition_matrix(self) -> Tensor:
        """`[A, A]`: the probability of each action (column) after each action (row), wherever in a plan.

        Raises:
            ValueError: the order is 0, or the prior takes a context.
        """
        if self.order == 0 or self.takes_context:
            raise ValueError("`transition_matrix` must be a prior of order 1 or more without context")
        return self.log_probs[self.next_node[0].long()].exp()


def back_off_log_probs(
    tree: Tree, counts: Counts, num_contexts: int | None, num_actions: int, rule: Backoff, smoothing: Tensor
) -> Tensor:
    """The log-probabilities of each action after each row of `counts`, with one or more smoothings.

    Each row is interpolated with that of its parent in the tree in the same context; the empty history in a context
    with all contexts together; and these (without contexts, the empty history) with the uniform distribution.

    Args:
        tree, counts: of `count_histories`.
        num_contexts: number of contexts counted apart, or None.
        num_actions: A.
        rule: the `backoff` of `MarkovPrior`.
        smoothing: `[S]`, float64, each as in `MarkovPrior`.

    Returns:
        `[S, R + 1, A]`, float32; the last row is that of all contexts together.
    """
    contexts, each = num_contexts or 1, smoothing[:, None, None]
    values = counts.kinds if rule == "kneser-ney" else counts.count
    root = torch.full((len(smoothing), 1, num_actions), 1 / num_actions, dtype=torch.double, device=smoothing.device)
    if num_contexts is not None:
        root = _pool_contexts(counts, contexts, root, rule, each)
    table = torch.empty(len(smoothing), len(counts.row_code) + 1, num_actions, device=root.device)
    table[:, -1:] = root.clamp(min=1e-300).log()
    if not len(counts.row_code):  # of a prior that has not learned yet
        return table
    parent = parent_rows(tree, counts, contexts)
    discounts, discount_level, ends = torch.zeros(3), -1, level_bounds(tree, counts, contexts)
    for level, first, until in row_blocks(tree, counts, contexts, num_actions):
        if rule == "kneser-ney" and level != discount_level:
            span = torch.searchsorted(counts.row, torch.tensor(ends[level : level + 2], device=root.device))
            discounts, discount_level = kneser_ney_discounts(values[span[0] : span[1]]), level
        # The table holds logarithms, as a probability may be too small for float32.
        lower = table[:, parent[first:until]].double().exp()
        n = counts.dense(first, until, num_actions, values)
        table[:, first:until] = blend(n, lower, rule, each, discounts).clamp(min=1e-300).log()
    return table


def blend(n: Tensor, lower: Tensor, rule: Backoff, smoothing: Tensor | float, discounts: Tensor) -> Tensor:
    """Probabilities `[S, R, A]` from counts `n [R, A]` and those after the shorter history, `lower [S, R, A]`: float64.

    `smoothing` is `[S, 1, 1]`, or a number for all.
    """
    if rule == "kneser-ney":
        off = discounted(n, discounts, smoothing)
        return interpolate(n - off, off.sum(-1, keepdim=True), n.sum(-1, keepdim=True), lower)
    kinds = (n > 0).sum(-1, keepdim=True) if rule == "witten-bell" else torch.ones_like(n[..., :1])
    weight = kinds.double() * smoothing
    return interpolate(n, weight, n.sum(-1, keepdim=True) + weight, lower)


def discounted(n: Tensor, discounts: Tensor, smoothing: Tensor | float) -> Tensor:
    """What Kneser-Ney smoothing takes off counts `n` of one, of two and of more, for those after the shorter history.

    `discounts [3]` are times `smoothing`.
    """
    return (torch.cat([discounts.new_zeros(1), discounts])[n.clamp(max=3).long()] * smoothing).minimum(n)


def interpolate(kept: Tensor, mass: Tensor, total: Tensor, lower: Tensor) -> Tensor:
    """Probabilities from counts that are `kept`, and the `mass` that goes to `lower`, of a `total` of both."""
    return torch.where(total > 0, (kept + mass * lower) / total.clamp(min=1e-300), lower)


def entry_log_probs(
    tree: Tree,
    counts: Counts,
    num_contexts: int | None,
    num_actions: int,
    rule: Backoff,
    smoothing: Tensor,
    entry: Tensor,
) -> Tensor:
    """Of `back_off_log_probs`, flattened after its first dimension, those at `entry [E]` alone: `[S, E]`, float64.

    Where actions are many, most of the table is of those that never followed.
    """
    contexts, row, action = num_contexts or 1, entry.div(num_actions, rounding_mode="floor"), entry % num_actions
    number, values = len(counts.row_code), (counts.kinds if rule == "kneser-ney" else counts.count).double()
    root = torch.full((len(smoothing), 1, num_actions), 1 / num_actions, dtype=torch.double, device=entry.device)
    if num_contexts is not None:
        root = _pool_contexts(counts, contexts, root, rule, smoothing[:, None, None])
    probs = root[:, 0, action]
    if rule == "kneser-ney":
        ends = torch.tensor(level_bounds(tree, counts, contexts), device=entry.device)
        off = torch.cat(
            [
                discounted(values[first:until], kneser_ney_discounts(counts.kinds[first:until]), smoothing[:, None])
                for first, until in pairwise(torch.searchsorted(counts.row, ends).tolist())
            ],
            1,
        )
        kept, mass = values - off, _row_sums(counts, off)
        total = _row_sums(counts, values[None])
    else:
        kinds = _row_sums(counts, torch.ones_like(values)[None]) if rule == "witten-bell" else torch.ones(1, number)
        kept, mass = values.expand(len(smoothing), -1), kinds.double() * smoothing[:, None]
        total = _row_sums(counts, values[None]) + mass
    code, parent = counts.row * num_actions + counts.action, parent_rows(tree, counts, contexts)
    above = [row]
    while bool((above[-1] < number).any()):
        above.append(torch.cat([parent, parent.new_tensor([number])])[above[-1]])
    for ancestor in reversed(above):
        inside = (ancestor < number).nonzero()[:, 0]
        rows, wanted = ancestor[inside], ancestor[inside] * num_actions + action[inside]
        place = torch.searchsorted(code, wanted).clamp(max=len(code) - 1)
        there = kept[:, place] * (code[place] == wanted)
        probs[:, inside] = interpolate(there, mass[:, rows], total[:, rows], probs[:, inside])
    return probs.clamp(min=1e-300).log()


def _row_sums(counts: Counts, values: Tensor) -> Tensor:
    """The sums `[S, R]` over each row of `values [S, P]`."""
    return values.new_zeros(len(values), len(counts.row_code)).index_add_(1, counts.row, values)


def kneser_ney_discounts(counts: Tensor) -> Tensor:
    """The discounts `[3]` (float64) of counts of 1, 2 and more, from how many of `counts [P]` are 1, 2, 3 and 4.

    Chen and Goodman (1999), "An empirical study of smoothing techniques for language modeling", section 3 ("modified
    Kneser-Ney smoothing"). Where no count is 1, 2 or 3, or a discount is not between 0 and its count:
    `FALLBACK_DISCOUNTS`.
    """
    number = counts.clamp(max=5).bincount(minlength=6)[1:5].tolist()
    if 0 in number[:3]:
        return torch.tensor(FALLBACK_DISCOUNTS, dtype=torch.double, device=counts.device)
    common = number[0] / (number[0] + 2 * number[1])
    discounts = [k - (k + 1) * common * number[k] / number[k - 1] for k in (1, 2, 3)]
    if not all(0 < d <= k for k, d in enumerate(discounts, 1)):
        discounts = list(FALLBACK_DISCOUNTS)
    return torch.tensor(discounts, dtype=torch.double, device=counts.device)


class Chains:
    """Markov chains of an order, one for each of `BACKOFFS_TRIED`; what they count is counted once.

    Args:
        plans: to count.
        order: of all chains.
        num_contexts: of priors that take an index as context; None: of priors without.

    Raises:
        TooLargeError: their tables would be too large.
        ValueError: plans that a Markov chain cannot learn from.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2, 0, 1, 2]]).repeat(20, 1), 3)
        >>> chains = Chains(plans, 1)
        >>> chains.chain(int(chains.log_likelihood(plans).argmax())).backoff
        'kneser-ney'
    """

    def __init__(self, plans: Plans, order: int, num_contexts: int | None = None) -> None:
        self.order, self.num_contexts = order, num_contexts
        self._first = MarkovPrior(plans.num_actions, order, num_contexts=num_contexts)
        self.plans = plans_for(self._first, plans)
        self._counted = self._first.count(self.plans)
        self._first.hold(*self._counted, torch.empty(0, plans.num_actions))

    def log_likelihood(self, plans: Plans) -> Tensor:
        """That of all `plans` together under each chain, in nats, float64 on the CPU; they share where each action is.

        Args:
            plans: the context is only used by chains that take one.

        Raises:
            ValueError: other actions or another context than those of the chains.
        """
        entry = self._first.entries(plans if self.num_contexts is not None else plans.without_context())
        entry, times = entry.unique(return_counts=True)
        sums = []
        for rule, pairs in groupby(BACKOFFS_TRIED, key=itemgetter(0)):
            smoothing = torch.tensor([each for _, each in pairs], dtype=torch.double, device=entry.device)
            log_probs = entry_log_probs(*self._counted, self.num_contexts, plans.num_actions, rule, smoothing, entry)
            sums.append(log_probs @ times.double())
        return torch.cat(sums).cpu()

    def chain(self, number: int) -> MarkovPrior:
        """The chain with the back-off of that number."""
        backoff, smoothing = BACKOFFS_TRIED[number]
        prior = MarkovPrior(
            self.plans.num_actions, self.order, smoothing, num_contexts=self.num_contexts, backoff=backoff
        )
        training_plans(prior, self.plans)
        prior.learn(*self._counted)
        return prior


def _pool_contexts(counts: Counts, contexts: int, lower: Tensor, rule: Backoff, smoothing: Tensor) -> Tensor:
    """The probabilities `[S, 1, A]` in all contexts together."""
    if rule != "kneser-ney":
        n = counts.pooled(contexts, lower.shape[-1], counts.count)
        return blend(n.double()[None], lower, rule, smoothing, lower)
    # The histories longer by one symbol are here the contexts.
    n = counts.pooled(contexts, lower.shape[-1], torch.ones_like(counts.count))
    return blend(n.double()[None], lower, rule, smoothing, kneser_ney_discounts(n))
