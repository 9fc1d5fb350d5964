"""Tails of many hypergeometric distributions at once: Fisher's exact test for each of a great many 2 x 2 tables."""

import torch
from torch import Tensor

TERMS = 64
"""Terms of a tail that are summed together."""

AT_ONCE = 2**15
"""Tails that are summed together; memory is bounded by it."""

PRECISION = 1e-17
"""A tail is summed until its terms are below this share of the sum."""


def two_sided(count: Tensor, total: Tensor, successes: Tensor, draws: Tensor) -> Tensor:
    """Twice the tail beyond each count, on the side of the mean where it lies, or 1 where that is more.

    Args:
        count: integers `[K]`: successes among the draws; possible ones.
        total: `[K]`: what is drawn from, without replacement.
        successes: `[K]`: successes among those.
        draws: `[K]`: how many are drawn.

    Returns:
        float64 `[K]`: the two-sided p-values of Fisher's exact test, by doubling the one-sided one.
    """
    x, n, s, d = (values.double() for values in (count, total, successes, draws))
    # The lower tail is the upper one of what the draws leave behind: count successes as failures.
    below = x * n <= s * d
    x, s = torch.where(below, d - x, x), torch.where(below, n - s, s)
    tails = [_upper_tail(*part) for part in zip(*(values.split(AT_ONCE) for values in (x, n, s, d)), strict=True)]
    return (2 * torch.cat(tails)).clamp(max=1)


def _upper_tail(x: Tensor, n: Tensor, s: Tensor, d: Tensor) -> Tensor:
    """P(X >= x) for x at or beyond the mean, where the terms fall."""
    sums, term = torch.ones_like(x), torch.ones_like(x)
    steps = torch.arange(TERMS, dtype=x.dtype, device=x.device)
    open_, first = torch.arange(len(x), device=x.device), 0
    while len(open_):
        at = x[open_, None] + first + steps
        ratio = (s[open_, None] - at) * (d[open_, None] - at)
        ratio = ratio.clamp_(min=0).div_((at + 1) * (n[open_, None] - s[open_, None] - d[open_, None] + at + 1))
        ratio[:, 0] *= term[open_]
        terms = ratio.cumprod(1)
        sums[open_] += terms.sum(1)
        term[open_] = terms[:, -1]
        open_, first = open_[terms[:, -1] > PRECISION * sums[open_]], first + TERMS
    return (_log_probability(x, n, s, d) + sums.log()).exp()


def _log_probability(x: Tensor, n: Tensor, s: Tensor, d: Tensor) -> Tensor:
    return _log_choose(s, x) + _log_choose(n - s, d - x) - _log_choose(n, d)


def _log_choose(n: Tensor, k: Tensor) -> Tensor:
    return torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)
