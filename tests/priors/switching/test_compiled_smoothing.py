"""The compiled passes over sequences: equal to those in torch, and as good without numba."""

import pytest
import torch

from neuroprior.priors.switching import forward_backward
from neuroprior.priors.switching.forward_backward import smooth
from tests.support.sources import seeded


def inputs(num, length, modes, seed=0, least=1e-3):
    """Sequences of unequal lengths: beyond their ends the likelihoods are 1."""
    generator = seeded(seed)
    initial, steps = (
        torch.rand(shape, generator=generator).double() for shape in ((modes,), (num, length, modes, modes))
    )
    likelihood = torch.rand(num, length, modes, generator=generator).double() * (1 - least) + least
    steps = steps / steps.sum(-1, keepdim=True)
    steps[:, 0] = torch.eye(modes).double()
    likelihood[torch.arange(length) >= torch.randint(1, length + 1, (num, 1), generator=generator)] = 1.0
    return initial / initial.sum(), steps, likelihood


@pytest.mark.parametrize(("num", "length", "modes"), [(1, 1, 1), (3, 2, 4), (5, 300, 2), (40, 17, 3)])
def test_the_compiled_passes_are_those_in_torch(monkeypatch, num, length, modes):
    pytest.importorskip("numba")
    given = inputs(num, length, modes)
    monkeypatch.setattr(forward_backward, "COMPILE_FROM", 0)
    compiled = smooth(*given)
    monkeypatch.setattr(forward_backward, "COMPILE_FROM", 2**62)
    for one, other in zip(compiled, smooth(*given), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)


def test_likelihoods_that_leave_hardly_anything(monkeypatch):
    """Products of 1e-200 underflow unless each step is scaled."""
    pytest.importorskip("numba")
    initial, steps, likelihood = inputs(4, 50, 3)
    monkeypatch.setattr(forward_backward, "COMPILE_FROM", 0)
    plain, tiny = smooth(initial, steps, likelihood), smooth(initial, steps, likelihood * 1e-200)
    torch.testing.assert_close(plain.smoothed, tiny.smoothed)
    torch.testing.assert_close(plain.moved, tiny.moved)


def test_views_are_taken(monkeypatch):
    """Tensors that are not laid out row by row, as from an expanded or a permuted one."""
    pytest.importorskip("numba")
    initial, steps, likelihood = inputs(6, 20, 3)
    monkeypatch.setattr(forward_backward, "COMPILE_FROM", 0)
    turned = likelihood.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    for one, other in zip(smooth(initial, steps, turned), smooth(initial, steps, likelihood), strict=True):
        torch.testing.assert_close(one, other)


def test_without_numba(monkeypatch):
    monkeypatch.setattr(forward_backward, "COMPILE_FROM", 0)
    given = inputs(5, 30, 2)
    expected = smooth(*given)
    monkeypatch.setattr(forward_backward, "compiled", lambda name: None)
    for one, other in zip(smooth(*given), expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-12)
