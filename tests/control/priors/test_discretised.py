"""Discretised vectors: one density however it is computed, with masses at the bounds."""

from pathlib import Path

import pytest
import torch

from neuroprior.control import DiscretisedPrior, VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.priors import GRUPrior, MarkovPrior, load, save
from neuroprior.testing.chi_square import chi_square

LOW, HIGH = torch.tensor([-1.0, 0.5]), torch.tensor([2.0, 3.0])


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plans(num: int = 40, length: int = 9) -> VectorPlans:
    """Vectors, a third of whose entries are clipped, in plans of unlike lengths."""
    actions = (torch.rand(num, length, 2, generator=rng(1)) * 1.5 - 0.25) * (HIGH - LOW) + LOW
    actions[..., 1] = actions[..., 0] + 0.5
    return VectorPlans(actions.clamp(LOW, HIGH), LOW, HIGH, lengths=torch.arange(num) % 3 + length - 2)


def fitted(tokens: str) -> DiscretisedPrior:
    made = {"markov": None, "order 1": MarkovPrior(6, 1), "gru": GRUPrior(6, 8, num_contexts=2)}[tokens]
    how = {"max_steps": 2, "progress": False} if tokens == "gru" else {}
    return DiscretisedPrior(LOW, HIGH, 4, made).fit(plans(), generator=rng(), **how)


@pytest.mark.parametrize("tokens", ["markov", "order 1", "gru"])
@torch.no_grad()
def test_scoring_stepping_saving_and_reordering_agree(tokens: str, tmp_path: Path):
    data = plans()
    with torch.enable_grad():
        prior = fitted(tokens)
    whole = prior.action_log_probs(data)
    assert whole.allclose(VectorPrior.action_log_probs(prior, data), atol=1e-4)
    again = load(save(prior, tmp_path), kind=VectorPrior)
    assert repr(again) == repr(prior)
    assert again.action_log_probs(data).equal(whole)
    order = torch.tensor([4, 0, 0, 2])
    _, state = prior.read(data.actions[:, :2])
    ahead, _ = prior.step(data.actions[order, 2], state[order])
    assert ahead.log_prob(data.actions[order, 3]).allclose(whole[order, 3], atol=1e-4)


@torch.no_grad()
def test_the_density_with_its_masses_at_the_bounds_integrates_to_one_and_samples_fit_it():
    prior = fitted("markov")
    forecast, _ = prior.read(torch.tensor([[[2.0, 2.5]]]))
    cells, axes, widths = 400, [], []
    for low, high in zip(LOW.tolist(), HIGH.tolist(), strict=True):
        width = (high - low) / cells
        axes.append(torch.cat([torch.tensor([low]), low + width * (torch.arange(cells) + 0.5), torch.tensor([high])]))
        widths.append(torch.cat([torch.ones(1), torch.full((cells,), width), torch.ones(1)]))
    grid = torch.cartesian_prod(*axes)
    mass = forecast.repeat_interleave(len(grid)).log_prob(grid).exp().view(cells + 2, -1)
    mass = mass * widths[0][:, None] * widths[1]
    assert mass.sum() == pytest.approx(1, abs=0.02)  # an edge may lie within a cell of the grid
    # Exact: one vector in each pair of bins, its density times the area of the bins.
    pairs = torch.cartesian_prod(torch.arange(6), torch.arange(6))
    inside = prior.vectors_of(pairs, rng(2))
    exact = (forecast.repeat_interleave(36).log_prob(inside) + prior.log_widths(pairs).sum(-1)).exp()
    assert exact.sum() == pytest.approx(1, abs=1e-5)
    assert bool((exact > 0).all())
    for draws in (
        forecast.repeat_interleave(50_000).sample(rng(3)),
        prior.sample(50_000, 1, past=torch.tensor([[[2.0, 2.5]]]), generator=rng(4))[0, :, 0],
    ):
        cell = prior.tokens_of(draws)
        counts = (cell[:, 0] * 6 + cell[:, 1]).bincount(minlength=36)
        assert chi_square(counts, exact * len(draws)) > 1e-6


@pytest.mark.parametrize("value", [0.7, 2.0])
def test_constant_vectors_are_predicted_with_a_finite_density(value: float):
    data = VectorPlans(torch.full((4, 6, 2), value), LOW, HIGH)
    prior = DiscretisedPrior(LOW, HIGH).fit(data)
    assert prior.log_prob(data).isfinite().all()
    assert prior.sample(3, 4, generator=rng()).isfinite().all()


def test_a_prior_over_other_tokens_is_refused():
    with pytest.raises(ValueError, match="num_bins"):
        DiscretisedPrior(LOW, HIGH, 4, MarkovPrior(5))
    with pytest.raises(ValueError, match="context indices"):
        DiscretisedPrior(LOW, HIGH, 4, MarkovPrior(6, num_contexts=3))
