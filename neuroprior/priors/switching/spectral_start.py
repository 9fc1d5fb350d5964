"""Modes to start EM from, found in what deviations from the average behaviour go together."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior.plans import Plans

RARE = 3.0
"""Added to the standard deviations of a row, in actions: so histories that occurred a few times weigh little."""

MOST_POINTS, TRIES = 20_000, 10
"""Actions whose directions are clustered, and beginnings that clustering tries."""


def spectral_modes(plans: Plans, num_modes: int, length: float, generator: torch.Generator) -> Tensor | None:
    """Modes of actions, `[N, L]` int64, from 0 to K - 1; None where the average policy leaves nothing to explain.

    A mode is a habit of deviating from the average policy: an animal that turns right at one fork since it seeks water
    turns left at the next for the same reason. The deviations (an indicator of the action less the share of the action
    in its context, after the last action) of a chain of order 1 are not correlated over time; those of modes that
    persist are. The K - 1 directions in which nearby deviations are most correlated span what distinguishes the modes
    (cross-moments as in Hsu, Kakade and Zhang 2012); there, the actions are divided into K clusters. Other plans of the
    same source give nearly the same directions, and so the same modes.

    Args:
        plans: N plans of up to L actions.
        num_modes: K >= 2.
        length: actions after which nearness has fallen to 1 / e.
        generator: draws the beginnings of clusters.
    """
    from scipy.cluster.vq import kmeans2, vq
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    mask, size, taken = plans.mask().cpu(), plans.num_actions, plans.actions.cpu().long()
    rows = torch.nn.functional.pad(taken, (1, 0), value=size)[:, :-1]
    if plans.context is not None:
        context = plans.context.cpu().long()
        rows = rows + (size + 1) * context
    rows, actions = rows[mask].unique(return_inverse=True)[1], taken[mask]
    number = int(rows.max()) + 1 if len(rows) else 0
    counts = torch.zeros(number * size, dtype=torch.double)
    counts = counts.index_add_(0, rows * size + actions, torch.ones(len(rows)).double()).view(number, size)
    shares = counts / counts.sum(1, keepdim=True)
    deviations = torch.nn.functional.one_hot(actions, size) - shares[rows]
    # The sum of a row's deviations has this standard deviation, were they independent.
    weights = 1 / ((counts.sum(1, keepdim=True) * shares * (1 - shares)).sqrt() + RARE)
    deviations = deviations * weights[rows]
    if number * size <= num_modes or not bool(deviations.any()):
        return None

    def near(values: Tensor) -> Tensor:
        """The sums of `values [T, D]` over the nearby actions of the same plan, without the action itself."""
        whole = values.new_zeros(*mask.shape, values.shape[1])
        whole[mask] = values
        sums = _decaying_sums(whole.numpy(), length) + _decaying_sums(whole.numpy()[:, ::-1], length)[:, ::-1]
        return torch.from_numpy(np.ascontiguousarray(sums))[mask]

    def project(directions: Tensor) -> Tensor:
        """`[T, D]` of directions `[number * A, D]`."""
        return (deviations[:, :, None] * directions.view(number, size, -1)[rows]).sum(1)

    def moments(direction: Any) -> Any:
        """The matrix of cross-moments times a direction."""
        nearby = near(project(torch.from_numpy(np.ascontiguousarray(direction)).view(-1, 1)))
        product = torch.zeros(number, size, dtype=torch.double).index_add_(0, rows, deviations * nearby)
        return product.flatten().numpy()

    operator = LinearOperator((number * size,) * 2, matvec=moments, dtype=np.float64)
    first = torch.rand(number * size, generator=generator, device=generator.device).double().cpu().numpy()
    try:
        _, directions = eigsh(operator, k=num_modes - 1, which="LA", v0=first, tol=1e-3)
    except ArpackError:
        return None
    projected = project(torch.from_numpy(np.ascontiguousarray(directions)))
    points = (projected + near(projected)).numpy()
    points = points / points.std(0).clip(1e-12)
    sample = points[:: -(-len(points) // MOST_POINTS)]
    draw = np.random.default_rng(int(torch.randint(2**31, (), generator=generator, device=generator.device)))
    clusterings = [kmeans2(sample, num_modes, minit="++", seed=draw) for _ in range(TRIES)]
    centres = min(
        (centre for centre, _ in clusterings), key=lambda centre: float(np.square(vq(sample, centre)[1]).sum())
    )
    modes = torch.zeros(mask.shape, dtype=torch.int64)
    modes[mask] = torch.from_numpy(vq(points, centres)[0]).long()
    return modes


def _decaying_sums(values: Any, length: float) -> Any:
    """Sums of `values [N, L, D]` over what came before, decaying over `length` steps."""
    from scipy.signal import lfilter

    share = np.exp(-1 / length)
    return lfilter([0.0, share], [1.0, -share], values, axis=1)
