"""The conformance suite of priors over vectors; `check_prior` runs it."""

import tempfile

import torch
from scipy.special import roots_legendre
from torch import Tensor

from neuroprior.control.priors.vector_prior import GaussianForecast, VectorPrior
from neuroprior.control.vector_plans import VectorPlans
from neuroprior.plans.sequences import constant_context, expand_context
from neuroprior.priors import load, save
from neuroprior.testing.chi_square import chi_square
from neuroprior.testing.rules import FALSE_ALARM, raises, require

NUM_CELLS = 10
"""Equally probable cells of a chi-square test."""

MAX_TOTAL_ERROR = 0.02
"""By how much an integral may differ from one: densities may jump, which quadrature resolves so far."""

GRID_POINTS = 500
"""Points at which a density is evaluated between the bounds."""

MAX_INTEGRATED_SIZE = 2
"""Dimensions up to which densities are integrated numerically."""


@torch.no_grad()
def check_vector_prior(prior: VectorPrior, length: int | None = None, num_plans: int = 20_000, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless `prior` does what a prior over vectors must.

    Stepping gives what `action_log_probs` does; with one or two dimensions, densities integrate to one, the masses at
    the bounds included, and samples fit them (chi-square tests, each with a false alarm of 1e-6); the same seed gives
    the same plans; saving and loading, and moving to a GPU where there is one, change nothing.
    `neuroprior.testing.check_prior` runs it.

    Args:
        prior: the prior to check, trained or not.
        length: of the plans; None for 5.
        num_plans: samples of a chi-square test, at most.
        seed: draws plans and contexts.

    Raises:
        AssertionError: the prior breaks a rule.

    Example:
        >>> check_vector_prior(AutoregressivePrior([-1.0], [1.0]))
    """
    length = length or 5
    generator = torch.Generator().manual_seed(seed)
    for kind in ("plan", "step") if prior.takes_context else (None,):
        for steps in sorted({1, length, (prior.memory or 0) + 3}):
            plans = random_plans(prior, kind, 7, steps, generator)
            _check_stepping(prior, plans)
            _check_reading(prior, plans)
    if prior.action_size <= MAX_INTEGRATED_SIZE:
        plans = random_plans(prior, "plan" if prior.takes_context else None, 3, length, generator)
        _check_total(prior, plans)
        _check_samples(prior, plans, num_plans, generator)
    _check_seeds(prior, length, generator)
    _check_copies(prior, length, generator)


def random_plans(
    prior: VectorPrior, kind: str | None, num: int, length: int, generator: torch.Generator
) -> VectorPlans:
    """Plans of random vectors, a third of whose numbers lie at the bounds, with features that the prior takes."""
    low, high = prior.action_low.cpu(), prior.action_high.cpu()
    share = 1.5 * torch.rand(num, length, prior.action_size, generator=generator) - 0.25
    actions = (low + share * (high - low)).clamp(low, high)
    shape = {None: None, "plan": (num, prior.context_size or 0), "step": (num, length, prior.context_size or 0)}[kind]
    context = None if shape is None else torch.randn(shape, generator=generator).to(prior.device)
    return VectorPlans(actions.to(prior.device), prior.action_low, prior.action_high, context=context)


def _step_through(prior: VectorPrior, plans: VectorPlans) -> list[tuple[GaussianForecast, Tensor]]:
    """What `start` and `step` return before each vector of plans."""
    context = plans.context
    outputs = [prior.start(len(plans), None if context is None else context[:, 0])]
    for t in range(1, plans.max_length):
        outputs.append(prior.step(plans.actions[:, t - 1], outputs[-1][1], None if context is None else context[:, t]))
    return outputs


def _check_stepping(prior: VectorPrior, plans: VectorPlans) -> None:
    """Stepping gives what `action_log_probs` gives; reordering the state reorders the forecasts."""
    whole = prior.action_log_probs(plans)
    num, length, _ = plans.actions.shape
    require(whole.shape == (num, length), f"action_log_probs: {list(whole.shape)}, not {[num, length]}")
    require(not whole.isnan().any(), "action_log_probs: NaN")
    require(prior.log_prob(plans).allclose(whole.sum(-1), atol=1e-3), "log_prob is not the sum of action_log_probs")
    order = torch.arange(num - 1, -1, -1, device=plans.actions.device)
    context = plans.context
    for t, (forecast, state) in enumerate(_step_through(prior, plans)):
        where = f"plans of length {length}, vector {t}"
        require(isinstance(state, Tensor) and len(state) == num, f"state must be one tensor of {num} rows ({where})")
        nats = forecast.log_prob(plans.actions[:, t])
        require(nats.shape == (num,), f"log_prob of a forecast: {list(nats.shape)}, not {[num]} ({where})")
        gap = float((nats - whole[:, t]).abs().max())
        require(gap < 1e-3 * (1 + float(nats.abs().max())), f"stepping differs by {gap:.2g} nats ({where})")
        if t + 1 < length:
            now = None if context is None else context[order, t + 1]
            backwards, _ = prior.step(plans.actions[order, t], state[order], now)
            gap = float((backwards.log_prob(plans.actions[order, t + 1]) - whole[order, t + 1]).abs().max())
            require(gap < 1e-3 * (1 + float(whole.abs().max())), f"reordering the state changes it by {gap:.2g} nats")


def _check_reading(prior: VectorPrior, plans: VectorPlans) -> None:
    """`read` of more vectors than `memory` is that of the last ones."""
    steps = plans.max_length
    if prior.memory is None or steps <= prior.memory + 1:
        return
    context = plans.context
    context = None if context is None else torch.cat([context, context[:, -1:]], 1)
    # One vector more than is read: a prior may know that a shorter past is the beginning of a plan.
    num_read = prior.memory + 1
    nats = [
        prior.read(plans.actions[:, -n:], None if context is None else context[:, -n - 1 :])[0].log_prob(
            plans.actions[:, 0]
        )
        for n in (steps, num_read)
    ]
    require(nats[0].allclose(nats[1], atol=1e-4), "read depends on more vectors than `memory` says")


def quadrature(prior: VectorPrior, points: int = 400) -> tuple[Tensor, Tensor]:
    """Values `[D, points + 2]` of each dimension and their weights: the two bounds, of mass 1, and points between."""
    nodes, weights = (torch.from_numpy(each).float().to(prior.device) for each in roots_legendre(points))
    low, half = prior.action_low[:, None], prior.half_range[:, None]
    values = torch.cat([low, low + half * (nodes + 1), low + 2 * half], 1)
    values[:, -1] = prior.action_high
    ones = torch.ones_like(low)
    return values, torch.cat([ones, half * weights, ones], 1)


def densities(forecast: GaussianForecast, rows: int, values: Tensor, weights: Tensor) -> Tensor:
    """Probabilities of the cells of a grid: `[rows, Q]` or `[rows, Q, Q]`, from `values` and `weights [D, Q]`."""
    if len(values) == 1:
        points, share = values[0][:, None], weights[0]
    else:
        points = torch.cartesian_prod(values[0], values[1])
        share = (weights[0][:, None] * weights[1]).flatten()
    nats = forecast.repeat_interleave(len(points)).log_prob(points.repeat(rows, 1)).view(rows, -1)
    return (nats.exp() * share).view(rows, *[values.shape[1]] * len(values))


def _check_total(prior: VectorPrior, plans: VectorPlans) -> None:
    """Densities integrate to one, the masses at the bounds included."""
    values, weights = quadrature(prior, 400 if prior.action_size == 1 else 120)
    for t, (forecast, _) in enumerate(_step_through(prior, plans)):
        total = densities(forecast, len(plans), values, weights).flatten(1).sum(1)
        worst = float((total - 1).abs().max())
        require(
            worst < MAX_TOTAL_ERROR,
            f"the density of vector {t} integrates to {1 + worst:.4f} or {1 - worst:.4f}, not 1",
        )


def _check_samples(prior: VectorPrior, plans: VectorPlans, num_plans: int, generator: torch.Generator) -> None:
    """Ranks of sampled vectors in the distributions that were forecast for them are uniform (chi-square tests).

    Of two dimensions the first vector is tested, of one dimension every vector.
    """
    rows = min(num_plans, 1000)
    context = None if plans.context is None else plans.context[:1, 0]
    length = min(plans.max_length, 3)
    past = plans.actions[:1, :2]
    for beginning in (past[:, :0], past):
        sampled = prior.sample(rows, length, context, past=beginning, generator=generator)
        require(sampled.shape == (1, rows, length, prior.action_size), f"sample: {list(sampled.shape)}")
        vectors = sampled[0]
        inside = (vectors >= prior.action_low) & (vectors <= prior.action_high)
        require(bool(inside.all()), "sample: vectors beyond the bounds")
        forecast, state = prior.read(
            beginning, None if context is None else expand_context(context, beginning.shape[1] + 1)
        )
        if prior.action_size == 2:
            ranks = _marginal_ranks(prior, forecast, vectors[:, 0, 0], generator)
            _check_uniform(ranks, "vector 0, dimension 0")
            forecast = forecast.repeat_interleave(rows)
            _check_uniform(_ranks(prior, forecast, vectors[:, 0], generator), "vector 0, dimension 1")
            continue
        forecast = forecast.repeat_interleave(rows)
        _check_uniform(_ranks(prior, forecast, vectors[:, 0], generator), "vector 0")
        state = state.repeat_interleave(rows, 0)
        for t in range(1, length):
            forecast, state = prior.step(vectors[:, t - 1], state)
            _check_uniform(_ranks(prior, forecast, vectors[:, t], generator), f"vector {t}")


def _check_uniform(ranks: Tensor, what: str) -> None:
    counts = (ranks * NUM_CELLS).long().clamp(0, NUM_CELLS - 1).bincount(minlength=NUM_CELLS).double()
    p = chi_square(counts, torch.full((NUM_CELLS,), len(ranks) / NUM_CELLS, dtype=torch.double))
    require(p > FALSE_ALARM, f"samples do not fit the density: {what}, chi-square p = {p:.2g}")


def _ranks(prior: VectorPrior, forecast: GaussianForecast, vectors: Tensor, generator: torch.Generator) -> Tensor:
    """`[N]`: the probability of less than the last number of `vectors [N, D]`, given those before it."""
    grid = _grid(prior, -1)
    before = vectors[:, :-1].cpu().repeat_interleave(len(grid), 0)
    points = torch.cat([before, grid.repeat(len(vectors))[:, None]], 1).to(vectors)
    density = forecast.repeat_interleave(len(grid)).log_prob(points).exp().view(len(vectors), -1).cpu()
    return _ranks_on(grid, density, vectors[:, -1].cpu(), generator)


def _marginal_ranks(
    prior: VectorPrior, forecast: GaussianForecast, first: Tensor, generator: torch.Generator
) -> Tensor:
    """`[N]`: the probability of less than `first [N]`, the first of two numbers, in a forecast of one row."""
    grid = _grid(prior, 0)
    values, weights = (each[1].cpu() for each in quadrature(prior, 200))
    points = torch.cartesian_prod(grid, values).to(first)
    joint = forecast.repeat_interleave(len(points)).log_prob(points).exp().view(len(grid), -1).cpu()
    return _ranks_on(grid, (joint * weights).sum(1).expand(len(first), -1), first.cpu(), generator)


def _grid(prior: VectorPrior, d: int) -> Tensor:
    """Evenly spaced values of a dimension from bound to bound."""
    low, high = prior.action_low.cpu()[d], prior.action_high.cpu()[d]
    return (low + (high - low) * torch.linspace(0, 1, GRID_POINTS)).clamp(low, high)


def _ranks_on(grid: Tensor, density: Tensor, values: Tensor, generator: torch.Generator) -> Tensor:
    """Ranks of `values [N]` where `density [N, Q]` is that at `grid [Q]`, a mass at its ends; at random in a mass."""
    density = density.double()
    inner = density.clone()
    # The ends of the grid are masses; the density beside them goes on to the bound.
    inner[:, 0], inner[:, -1] = density[:, 1], density[:, -2]
    slices = (inner[:, 1:] + inner[:, :-1]) / 2 * (grid[1] - grid[0])
    below = density[:, :1] + torch.nn.functional.pad(slices.cumsum(1), (1, 0))
    total = below[:, -1] + density[:, -1]
    place = ((values - grid[0]) / (grid[1] - grid[0])).clamp(0, len(grid) - 1)
    left = place.long().clamp(max=len(grid) - 2)
    ranks = torch.lerp(
        below.gather(1, left[:, None])[:, 0], below.gather(1, left[:, None] + 1)[:, 0], (place - left).double()
    )
    draw = torch.rand(len(values), generator=generator).double()
    ranks = torch.where(values <= grid[0], draw * density[:, 0], ranks)
    ranks = torch.where(values >= grid[-1], below[:, -1] + draw * density[:, -1], ranks)
    return ranks / total


def _check_seeds(prior: VectorPrior, length: int, generator: torch.Generator) -> None:
    """The same seed gives the same plans; torch's global generator is not used."""
    plans = random_plans(prior, "plan" if prior.takes_context else None, 2, length, generator)
    context = constant_context(plans)
    before = torch.get_rng_state()
    first, second = (
        prior.sample(16, length, context, past=plans.actions, generator=torch.Generator().manual_seed(1))
        for _ in range(2)
    )
    require(first.equal(second), "sample: the same seed gave other plans")
    require(torch.get_rng_state().equal(before), "sample used torch's global generator")
    distinct = len(first[0].flatten(1).unique(dim=0))
    require(distinct > 1, "sample: all plans after one past are the same")


def _check_copies(prior: VectorPrior, length: int, generator: torch.Generator) -> None:
    """A saved and loaded copy, and one on the GPU where there is one, say the same; wrong plans are refused."""
    plans = random_plans(prior, "plan" if prior.takes_context else None, 16, length, generator)
    want = prior.log_prob(plans).cpu()
    with tempfile.TemporaryDirectory() as folder:
        try:
            copy = load(save(prior, folder), kind=VectorPrior)
        except ValueError as error:
            raise AssertionError(f"the prior cannot be saved and loaded: {error}") from error
    for device in ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]:
        copy.to(device)
        context = None if plans.context is None else plans.context.to(device)
        got = copy.log_prob(VectorPlans(plans.actions.to(device), copy.action_low, copy.action_high, context=context))
        require(got.device.type == device, f"log_prob on {device} came back on {got.device}")
        gap = float((got.cpu() - want).abs().max())
        require(gap < 1e-3 * (1 + float(want.abs().max())), f"saved, loaded and moved to {device}: {gap:.2g} nats")
    below = prior.action_low - prior.half_range
    wider = VectorPlans(plans.actions, below, prior.action_high, context=plans.context)
    require(raises(lambda: prior.log_prob(wider)), "log_prob must raise ValueError for plans with other bounds")
    require(
        raises(lambda: prior.sample(2, 0, plans.context)), "sample must raise ValueError for plans without a vector"
    )
