"""Back-off: from counts of what followed histories, probabilities that lean on shorter histories."""

from typing import Literal, get_args

import torch
from torch import Tensor

from neuroprior.priors.counts.histories import Counts, Tree, row_blocks, row_ends, rows_above

Backoff = Literal["dirichlet", "witten-bell", "kneser-ney"]

BACKOFFS: tuple[Backoff, ...] = get_args(Backoff)

FALLBACK_DISCOUNTS = (0.5, 1.0, 1.5)
"""Of Kneser-Ney, where the counts give none: those of KenLM's option `--discount_fallback`."""


def back_off_probs(
    tree: Tree, counts: Counts, num_contexts: int | None, num_actions: int, rule: Backoff, smoothing: float
) -> Tensor:
    """The log-probabilities of each action after each row of `counts`.

    Each row leans on that of its parent in the tree in the same context; (context, empty history) on all contexts
    together; and that, or where no context is seen the empty history, on the uniform distribution.

    Args:
        tree, counts: of `count_histories`.
        num_contexts: number of contexts counted apart, or None.
        num_actions: A.
        rule: how; see `MarkovPrior`.
        smoothing: how much; see there.

    Returns:
        `[R + 1, A]`, float32; the last row is what (context, empty history) leans on.
    """
    contexts = num_contexts or 1
    values = counts.kinds if rule == "kneser-ney" else counts.count
    lean = torch.full((1, num_actions), 1 / num_actions, dtype=torch.double, device=counts.row.device)
    if num_contexts is not None:
        lean = _pooled(counts, contexts, lean, rule, smoothing)
    table = torch.empty(len(counts.row_code) + 1, num_actions, device=lean.device)
    table[-1:] = lean.clamp(min=1e-300).log()
    above = rows_above(tree, counts, contexts)
    discounts, known, ends = torch.zeros(3), -1, row_ends(tree, counts, contexts)
    for level, first, until in row_blocks(tree, counts, contexts, num_actions):
        if rule == "kneser-ney" and level != known:
            here = torch.searchsorted(counts.row, torch.tensor(ends[level : level + 2], device=lean.device))
            discounts, known = kneser_ney_discounts(values[here[0] : here[1]]), level
        # Logarithms, as a probability may be too small for float32.
        lower = table[above[first:until]].double().exp()
        n = counts.dense(first, until, num_actions, values)
        table[first:until] = blend(n, lower, rule, smoothing, discounts).clamp(min=1e-300).log()
    return table


def blend(n: Tensor, lower: Tensor, rule: Backoff, smoothing: float, discounts: Tensor) -> Tensor:
    """Probabilities `[..., A]` from counts `n` and the probabilities `lower` to lean on, both `[..., A]` float64."""
    if rule == "kneser-ney":
        # Counts of one, of two and of more are lowered, each by its discount; what this frees goes to `lower`.
        off = torch.cat([discounts.new_zeros(1), discounts * smoothing])[n.clamp(max=3).long()].minimum(n)
        total = n.sum(-1, keepdim=True)
        share = torch.where(total > 0, off.sum(-1, keepdim=True) / total.clamp(min=1), 1.0)
        return (n - off) / total.clamp(min=1) + share * lower
    kinds = (n > 0).sum(-1, keepdim=True) if rule == "witten-bell" else torch.ones_like(n[..., :1])
    weight = kinds.double() * smoothing
    total = n.sum(-1, keepdim=True) + weight
    return torch.where(total > 0, (n + weight * lower) / total, lower)


def kneser_ney_discounts(counts: Tensor) -> Tensor:
    """The discounts `[3]` (float64) of counts of 1, 2 and more, from how many of `counts [P]` are 1, 2, 3 and 4.

    Chen and Goodman (1999), "An empirical study of smoothing techniques for language modeling", section 3 ("modified
    Kneser-Ney smoothing"). Where no count is 1, 2 or 3, or a discount is not between 0 and its count:
    `FALLBACK_DISCOUNTS`.
    """
    met = [int((counts == k).sum()) for k in range(1, 5)]
    if 0 in met[:3]:
        return torch.tensor(FALLBACK_DISCOUNTS, dtype=torch.double, device=counts.device)
    common = met[0] / (met[0] + 2 * met[1])
    found = [k - (k + 1) * common * met[k] / met[k - 1] for k in (1, 2, 3)]
    if not all(0 < d <= k for k, d in enumerate(found, 1)):
        found = list(FALLBACK_DISCOUNTS)
    return torch.tensor(found, dtype=torch.double, device=counts.device)


def _pooled(counts: Counts, contexts: int, lean: Tensor, rule: Backoff, smoothing: float) -> Tensor:
    """The probabilities `[1, A]` in all contexts together."""
    if rule != "kneser-ney":
        return blend(counts.pooled(contexts, lean.shape[1], counts.count).double()[None], lean, rule, smoothing, lean)
    # The histories one longer than none at all are here the contexts.
    n = counts.pooled(contexts, lean.shape[1], torch.ones_like(counts.count))
    return blend(n.double()[None], lean, rule, smoothing, kneser_ney_discounts(n))
