"""The conformance suite of continuous worlds."""

from functools import partial

import torch
from torch import Tensor

from neuroprior.control.vector_plans import VectorPlans
from neuroprior.control.worlds.continuous_world import ContinuousWorld
from neuroprior.testing.rules import raises, require
from neuroprior.testing.worlds import check_batch, check_dynamics, check_reset


def check_continuous_world(
    world: ContinuousWorld, length: int | None = None, num_states: int = 50, seed: int = 0
) -> None:
    """Raise AssertionError, with a message that says how, unless `world` does what a continuous world must.

    What `neuroprior.testing.check_world` asks of every world, which runs this suite; and: the bounds are finite and in
    order, there is one name a dimension, observations are features; `rollout` refuses vectors beyond the bounds, NaN
    in plans and NaN in states.

    Args:
        world: the world to check.
        length: of the plans; None for 6.
        num_states: how many random states.
        seed: draws states and plans.

    Raises:
        AssertionError: the world breaks a rule.

    Example:
        >>> check_continuous_world(DoubleIntegrator())
    """
    generator = torch.Generator().manual_seed(seed)
    state = check_reset(world, num_states, seed)
    plans, wrong_plans = _plans(world, state, length or 6, generator)
    if state.is_floating_point():
        wrong = torch.full_like(state, torch.nan)
        require(raises(partial(world.rollout, wrong, plans)), "rollout must raise ValueError for states of NaN")
    check_dynamics(world, state, plans, wrong_plans, _check_features, generator, seed)


def _check_features(world: ContinuousWorld, state: Tensor) -> None:
    """`observe`: floating point features of each state."""
    observed = world.observe(state)
    require(isinstance(observed, torch.Tensor), f"observe must return a tensor, not {type(observed).__name__}")
    fits = observed.is_floating_point() and observed.dim() == 2 and len(observed) == len(state)
    require(fits, f"observe must give floating point features [N, C], not {observed.dtype} {list(observed.shape)}")
    require(not observed.isnan().any(), "observe: NaN in the observations")
    check_batch("observe", world.observe, state, observed)


def _plans(
    world: ContinuousWorld, state: Tensor, length: int, generator: torch.Generator
) -> tuple[Tensor, dict[str, Tensor]]:
    """Random plans of vectors `[N, 3, L, D]`, and wrong ones; bounds and names are checked."""
    low, high = world.action_low, world.action_high
    try:
        world.check_bounds()
        world.check_state(state)
        VectorPlans(torch.zeros(0, length, len(low)), low.cpu(), high.cpu(), action_names=world.action_names)
    except ValueError as error:
        raise AssertionError(str(error)) from error
    plans = low + (high - low) * torch.rand(len(state), 3, length, len(low), generator=generator).to(low.device)
    plans = plans.to(state.device)
    return plans, {
        "plans of integers": plans.long(),
        "vectors above action_high": plans + (high - low),
        "vectors below action_low": plans - (high - low),
        "vectors of NaN": torch.full_like(plans, torch.nan),
        "vectors of too few dimensions": plans[..., 1:],
    }
