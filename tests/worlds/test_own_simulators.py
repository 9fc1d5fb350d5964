"""Worlds of vectors of one's own with a mistake in them: `check_world` and `control` say what is wrong, in one line."""

import pytest
import torch

from neuroprior.control import ContinuousWorld, ICEMPlanner, control, from_mujoco
from neuroprior.testing import check_world


class Push(ContinuousWorld):
    """A right world, to be broken in one place: two numbers that vectors push."""

    action_low, action_high = -torch.ones(2), torch.ones(2)

    def reset(self, batch_size, generator=None):
        return torch.randn(batch_size, 2, generator=generator)

    def step(self, state, action, generator=None):
        after = state + action
        return after, -after.square().sum(1)


def stepping(change):
    """`Push`, whose `step` returns `change(after, reward)`."""

    class Changed(Push):
        def step(self, state, action, generator=None):
            return change(*super().step(state, action))

    return Changed


def with_parts(**parts):
    """`Push` with other attributes and methods."""
    return type("Changed", (Push,), parts)


TWO = torch.ones(2)

WRONG = {
    "reward of shape [N, 1]": (stepping(lambda after, reward: (after, reward[:, None])), r"reward \[", "float"),
    "a single reward": (stepping(lambda after, reward: (after, reward.mean())), r"reward \[\]", "reward"),
    "reward against reward": (stepping(lambda after, reward: (after, reward[:, None] - reward)), "reward", "reward"),
    "integer reward": (stepping(lambda after, reward: (after, reward.long())), "reward of torch.int64", "int64"),
    "a number as reward": (stepping(lambda after, reward: (after, 0.0)), "two tensors", "two tensors.*float"),
    "no reward": (stepping(lambda after, reward: after), "two tensors", "two tensors.*Tensor"),
    "as Gymnasium": (stepping(lambda after, reward: (after, reward, False, False, {})), "two tensors", "bool.*dict"),
    "nothing": (stepping(lambda after, reward: None), "two tensors", "NoneType"),
    "numpy": (stepping(lambda after, reward: (after.numpy(), reward)), "two tensors", "ndarray"),
    "state of another dtype": (stepping(lambda after, reward: (after.double(), reward)), "float64", "float64"),
    "state of another shape": (stepping(lambda after, reward: (after[:, :1], reward)), "step: state", "next state"),
    "NaN in the state": (stepping(lambda after, reward: (after * torch.nan, reward)), "NaN in the next", "NaN"),
    "NaN in the reward": (stepping(lambda after, reward: (after, reward * torch.nan)), "NaN in the reward", "NaN"),
    "infinite bounds": (
        with_parts(action_high=TWO * torch.inf),
        "`action_low` must be below `action_high` .* inf",
        "got -1 and inf in dimension 0",
    ),
    "equal bounds": (with_parts(action_low=TWO), "`action_low` must be below", "got 1 and 1 in dimension 0"),
    "bounds that are lists": (
        with_parts(action_low=[-1.0, -1.0]),
        "`action_low` must be a float32",
        "`action_low` must",
    ),
    "a number as bound": (
        with_parts(action_low=-1.0, action_high=1.0),
        "`action_low` must be a float32",
        "`action_low` must",
    ),
    "bounds of float64": (
        with_parts(action_high=TWO.double()),
        "`action_high` must be a float32",
        "`action_high` must .*float64",
    ),
    "bounds of unequal number": (
        with_parts(action_high=torch.ones(3)),
        "must have shape",
        r"must have shape \[D\], got \[2\] and \[3\]",
    ),
    "bounds too near": (with_parts(action_low=TWO - 1e-7), "must be below", "got 1 and 1"),
    "too few names": (with_parts(action_names=("knee",)), "action_names", "action_names"),
    "ends that are numbers": (
        with_parts(terminated=lambda self, state: (state[:, 0] > 9).long()),
        "terminated must be bool",
        "`terminated` must return bool .*int64",
    ),
    "ends [N, 1]": (
        with_parts(terminated=lambda self, state: state[:, :1] > 9),
        "terminated must be bool",
        r"`terminated` must return bool \[3\], got torch.bool \[3, 1\]",
    ),
    "one end for all": (
        with_parts(terminated=lambda self, state: False),
        "terminated must",
        "`terminated` must .* got bool",
    ),
    "observations [N]": (with_parts(observe=lambda self, state: state[:, 0]), "observe must", "`observe` must .*C]"),
    "integer observations": (
        with_parts(observe=lambda self, state: state.long()),
        "observe must",
        "`observe` must .*int64",
    ),
    "observations of NaN": (with_parts(observe=lambda self, state: state * torch.nan), "observe: NaN", "nan"),
}


@pytest.mark.parametrize("name", WRONG)
def test_mistakes_are_named(name):
    make, by_check, by_control = WRONG[name]
    with pytest.raises(AssertionError, match=by_check) as found:
        check_world(make())
    assert "\n" not in str(found.value)
    state, generator = torch.zeros(3, 2), torch.Generator().manual_seed(0)
    with pytest.raises(ValueError, match=by_control) as raised:
        control(ICEMPlanner(2, 4), make(), state, 2, generator)
    assert "\n" not in str(raised.value)


def in_place(self, state, action, generator=None):
    action.mul_(0.5)
    return state + action, -state.square().sum(1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            with_parts(reset=lambda self, number, generator=None: torch.zeros(number, 2).numpy()),
            "reset must return",
        ),
        (with_parts(reset=lambda self, number, generator=None: torch.full((number, 2), torch.nan)), "reset: NaN"),
        (with_parts(step=in_place), "changed the action"),
        (stepping(lambda after, reward: (after, reward - reward.mean())), "depends on its batch"),
        (with_parts(observe=lambda self, state: state - state.mean(0)), "observe: .*depends on its batch"),
    ],
)
def test_check_world_finds_more(make, message):
    with pytest.raises(AssertionError, match=message):
        check_world(make())


class Gamble(Push):
    """Where its steps lead is certain; its rewards are random."""

    stochastic = True

    def step(self, state, action, generator=None):
        after, reward = super().step(state, action)
        return after, reward + torch.randn(reward.shape, generator=generator)


def test_rewards_alone_may_be_random():
    check_world(Gamble())


def test_random_rewards_are_to_be_announced():
    with pytest.raises(AssertionError, match="`stochastic` is False"):
        check_world(type("Quiet", (Gamble,), {"stochastic": False})())


def test_a_state_may_be_a_single_number():
    class Count(Push):
        def reset(self, batch_size, generator=None):
            return torch.randn(batch_size, generator=generator)

        def step(self, state, action, generator=None):
            after = state + action.sum(1)
            return after, -after.square()

    check_world(Count())
    done = control(ICEMPlanner(2, 4), Count(), torch.zeros(3), 2, torch.Generator().manual_seed(0))
    assert done.states.shape == (3, 3)
    assert done.plans.context is not None
    assert done.plans.context.equal(done.states[:, :-1, None])


def test_a_state_of_another_precision_is_named():
    """A simulator of MuJoCo answers in float64."""
    pytest.importorskip("mujoco")
    pytest.importorskip("gymnasium")
    world = from_mujoco("Reacher-v5", num_threads=1)
    with pytest.raises(ValueError, match=r"next state of torch.float32.*float64"):
        control(ICEMPlanner(2, 4), world, world.reset(1).float(), 2)
