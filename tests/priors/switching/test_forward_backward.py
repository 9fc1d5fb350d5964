"""Filtering, smoothing and the most probable path, against the sums over all sequences of modes."""

from itertools import product

import pytest
import torch

from neuroprior.priors.switching.forward_backward import most_probable_path, predict, smooth
from tests.support.sources import seeded


def inputs(num, length, modes, seed=0, least=1e-3):
    """Sequences of unequal lengths: beyond their ends likelihoods are 1 and steps the identity."""
    generator = seeded(seed)
    initial, steps = (
        torch.rand(shape, generator=generator).double() for shape in ((modes,), (num, length, modes, modes))
    )
    likelihood = torch.rand(num, length, modes, generator=generator).double() * (1 - least) + least
    steps = steps / steps.sum(-1, keepdim=True)
    lengths = torch.randint(1, length + 1, (num,), generator=generator)
    beyond = torch.arange(length) >= lengths[:, None]
    steps[:, 0] = torch.eye(modes).double()
    steps[beyond] = torch.eye(modes).double()
    likelihood[beyond] = 1.0
    return initial / initial.sum(), steps, likelihood


def weights_of_paths(initial, steps, likelihood):
    """All paths of one sequence, and the joint probability of each and the actions up to every step."""
    length, modes = likelihood.shape
    paths = torch.tensor(list(product(range(modes), repeat=length)))
    weight, partial = initial[paths[:, 0]] * likelihood[0, paths[:, 0]], []
    for t in range(length):
        if t:
            weight = weight * steps[t, paths[:, t - 1], paths[:, t]] * likelihood[t, paths[:, t]]
        partial.append(weight)
    return paths, torch.stack(partial, 1)


@pytest.mark.parametrize(("num", "length", "modes"), [(1, 1, 1), (3, 2, 4), (4, 6, 3), (2, 9, 2)])
def test_the_passes_are_the_sums_over_all_paths(num, length, modes):
    initial, steps, likelihood = inputs(num, length, modes)
    found, (predicted, filtered, _) = smooth(initial, steps, likelihood), predict(initial, steps, likelihood)
    best = most_probable_path(initial, steps, likelihood)
    for n in range(num):
        paths, partial = weights_of_paths(initial, steps[n], likelihood[n])
        total = partial[:, -1].sum()
        assert found.log_likelihood[n].sum() == pytest.approx(float(total.log()), rel=1e-12)
        assert paths[partial[:, -1].argmax()].tolist() == best[n].tolist()
        for t in range(length):
            at = torch.nn.functional.one_hot(paths[:, t], modes).double()
            whole = (partial[:, -1, None] * at).sum(0) / total
            torch.testing.assert_close(found.smoothed[n, t], whole, rtol=1e-10, atol=1e-12)
            so_far = (partial[:, t, None] * at / modes ** (length - 1 - t)).sum(0)
            torch.testing.assert_close(filtered[n, t], so_far / so_far.sum(), rtol=1e-10, atol=1e-12)
            before = initial if t == 0 else filtered[n, t - 1] @ steps[n, t]
            torch.testing.assert_close(predicted[n, t], before, rtol=1e-10, atol=1e-12)
            if t + 1 < length:
                pair = torch.nn.functional.one_hot(paths[:, t] * modes + paths[:, t + 1], modes**2).double()
                moved = (partial[:, -1, None] * pair).sum(0).view(modes, modes) / total
                torch.testing.assert_close(found.moved[n, t], moved, rtol=1e-10, atol=1e-12)


def test_likelihoods_that_leave_hardly_anything():
    """Products of 1e-200 underflow unless each step is scaled."""
    initial, steps, likelihood = inputs(4, 50, 3)
    plain, tiny = smooth(initial, steps, likelihood), smooth(initial, steps, likelihood * 1e-200)
    torch.testing.assert_close(plain.smoothed, tiny.smoothed)
    torch.testing.assert_close(plain.moved, tiny.moved)


def test_views_are_taken():
    """Tensors that are not laid out row by row, as from an expanded or a permuted one."""
    initial, steps, likelihood = inputs(6, 20, 3)
    turned = likelihood.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    for one, other in zip(smooth(initial, steps, turned), smooth(initial, steps, likelihood), strict=True):
        torch.testing.assert_close(one, other)
