"""Stepped environments against the environments themselves: by copies, by replaying, and what is refused."""

import warnings

import gymnasium
import pytest
import torch

from neuroprior import SamplingPlanner, UniformPrior, from_gymnasium
from neuroprior.testing import check_world
from neuroprior.worlds import SteppedWorld
from tests.support import environments
from tests.support.sources import every_plan, refuses, seeded

NAMES = ("CartPole-v1", "MountainCar-v0")


def real_trajectory(env, seed, actions, first=0):
    """Observations and rewards of a trajectory, and how many of the actions were taken."""
    first_observed, _ = env.reset(seed=seed)
    observations, rewards = [first_observed], []
    for action in actions:
        first_observed, reward, terminated, truncated, _ = env.step(action + first)
        observations.append(first_observed)
        rewards.append(reward)
        if terminated or truncated:
            break
    return observations, rewards


@pytest.mark.parametrize("name", NAMES)
def test_rollouts_are_the_environments(name):
    world = from_gymnasium(name, seeds=[4, 9], horizon=30)
    assert isinstance(world, SteppedWorld)
    assert world.copies
    state = torch.zeros(2, 33, dtype=torch.long)
    state[1, 0] = 1
    plans = torch.randint(world.num_actions, (2, 6, 25), generator=seeded(0))
    rollout = world.rollout(state, plans, keep_states=True)
    env = gymnasium.make(name).unwrapped
    for b, seed in enumerate(world.seeds):
        for p in range(6):
            observations, rewards = real_trajectory(env, seed, plans[b, p].tolist())
            taken = len(rewards)
            assert rollout.rewards[b, p].tolist() == pytest.approx(rewards + [0.0] * (25 - taken))
            assert rollout.states[b, p, :, 1].tolist() == [min(t + 1, taken) for t in range(25)]
            shown = world.observe(rollout.states[b, p])
            assert shown[:taken].tolist() == [
                pytest.approx(first_observed.tolist()) for first_observed in observations[1:]
            ]
            assert rollout.final_state[b, p].equal(rollout.states[b, p, -1])
    assert world.num_layouts == 2
    assert world.layout(rollout.final_state).tolist() == [[0] * 6, [1] * 6]


def test_steps_continue_from_any_state():
    world = from_gymnasium("CartPole-v1", seeds=[0], horizon=40)
    plan = torch.randint(2, (1, 1, 16), generator=seeded(1))
    whole = world.rollout(world.reset(1), plan)
    half = world.rollout(world.reset(1), plan[:, :, :8]).final_state[:, 0]
    rest = world.rollout(half, plan[:, :, 8:])
    assert rest.final_state.equal(whole.final_state)
    assert rest.rewards[0, 0].equal(whole.rewards[0, 0, 8:])
    # Another world that never met these states knows them, too.
    other = from_gymnasium("CartPole-v1", seeds=[0], horizon=40)
    assert other.observe(whole.final_state[0]).equal(world.observe(whole.final_state[0]))


def test_the_last_observation_is_that_after_the_last_action():
    """Of histories as long as the horizon, which differ in their last action alone."""
    world = from_gymnasium("CartPole-v1", seeds=[0], horizon=3)
    final = world.rollout(world.reset(1), torch.tensor([[[0, 1, 0], [0, 1, 1]]])).final_state[0]
    env = gymnasium.make("CartPole-v1").unwrapped
    for row, plan in zip(world.observe(final), ([0, 1, 0], [0, 1, 1]), strict=True):
        assert row.tolist() == pytest.approx(real_trajectory(env, 0, plan)[0][-1].tolist())


def test_an_end_is_kept():
    world = from_gymnasium("CartPole-v1", seeds=[0], horizon=20)
    fallen = world.rollout(world.reset(1), torch.ones(1, 1, 15, dtype=torch.long)).final_state[:, 0]
    assert fallen[0, 1] < 15
    assert fallen[0, 2] == 1
    after = world.rollout(fallen, every_plan(2, 6)[None])
    assert (after.final_state[0] == fallen).all()
    assert after.rewards.sum() == 0


@pytest.mark.parametrize("kept", [1, 5])
def test_what_is_not_kept_is_found_again(kept):
    plans = every_plan(2, 6)[None]
    first, second = (from_gymnasium("CartPole-v1", seeds=[0], horizon=12) for _ in range(2))
    one = first.rollout(first.reset(1), plans, keep_states=True)
    shown = first.observe(one.final_state[0])
    second.max_kept = kept
    other = second.rollout(second.reset(1), plans, keep_states=True)
    assert one.states.equal(other.states)
    assert one.rewards.equal(other.rewards)
    assert second.observe(one.final_state[0]).equal(shown)
    assert len(second._kept) <= kept < len(first._kept)


@pytest.mark.parametrize("env", [environments.Forgetful, environments.Slippery, environments.Corridor])
def test_replayed_and_copied_environments_go_the_same_way(env):
    world = from_gymnasium(env(), method="step", seed=2, horizon=10)
    assert world.copies == (env is not environments.Forgetful)
    plans = torch.randint(2, (1, 20, 8), generator=seeded(3))
    rollout = world.rollout(world.reset(1), plans, keep_states=True)
    real = env()
    for p in range(20):
        observations, rewards = real_trajectory(real, 2, plans[0, p].tolist(), first=5)
        shown = world.observe(rollout.states[0, p]).argmax(1).tolist()
        assert shown[: len(rewards)] == observations[1:]
        assert rollout.rewards[0, p, : len(rewards)].tolist() == pytest.approx(rewards)
    check_world(world)


@pytest.mark.parametrize("kept", [1, 4096])
def test_replays_go_on_only_from_their_own_history(kept):
    world, other = (from_gymnasium(environments.Forgetful(), method="step", horizon=10) for _ in range(2))
    world.max_kept = other.max_kept = kept
    plans = torch.randint(2, (1, 12, 8), generator=seeded(6))
    whole = world.rollout(world.reset(1), plans, keep_states=True)
    first_observed = world.observe(whole.states[0].flatten(0, 1)).view(12, 8, -1)
    state = other.reset(12)
    for t in range(8):  # step by step, the last row's environment is there when the first row's is needed
        state, reward = other.step(state, plans[0, :, t])
        assert other.observe(state).equal(first_observed[:, t])
        assert reward.equal(whole.rewards[0, :, t])


def test_a_plan_takes_as_many_steps_as_it_has_actions(monkeypatch):
    taken = []
    step = environments.Corridor.step
    monkeypatch.setattr(environments.Corridor, "step", lambda env, action: taken.append(action) or step(env, action))
    left = torch.zeros(1, 1, 8, dtype=torch.long)
    for env in (environments.Forgetful, environments.Corridor):
        world = from_gymnasium(env(), method="step", horizon=10)
        taken.clear()
        world.rollout(world.reset(1), left)
        assert len(taken) == 8
        world.rollout(world.reset(1), left)
        assert len(taken) == 8
    # Copies go on from the seven steps that two plans share.
    world.rollout(world.reset(1), left.index_fill(2, torch.tensor([7]), 1))
    assert len(taken) == 9
    # Of few copies the latest are kept.
    world = from_gymnasium(environments.Corridor(), method="step", horizon=10)
    world.max_kept = 2
    taken.clear()
    state = world.reset(1)
    states = [state := world.step(state, torch.zeros(1, dtype=torch.long))[0] for _ in range(8)]
    world.step(states[-2], torch.ones(1, dtype=torch.long))
    assert len(taken) == 9


def test_a_stepped_minigrid_conforms():
    check_world(from_gymnasium("MiniGrid-DoorKey-5x5-v0", method="step", seeds=[0]), num_states=10)


def test_a_planner_finds_the_end_of_the_corridor():
    world = from_gymnasium(environments.Corridor(), method="step", horizon=8)
    planner = SamplingPlanner(UniformPrior(2), 5, 300, any_prefix=True)
    # Only right, right, right, right arrives at once; a sixteenth of the plans begin so.
    decision = planner.plan(world, world.reset(3), seeded(4))
    assert decision.plan[:, :4].eq(1).all()
    assert decision.score.tolist() == pytest.approx([1 - 0.9 * 4 / 100] * 3)


def test_reset_draws_seeds():
    world = from_gymnasium("CartPole-v1", seeds=[5, 6])
    state = world.reset(100, seeded(5))
    assert state[:, 0].unique().tolist() == [0, 1]
    assert state[:, 1:].sum() == 0
    assert len(world.observe(state).unique(dim=0)) == 2


def test_refusals():
    with refuses("differs between two trajectories of the same actions from seed 0", "cannot be replayed"):
        from_gymnasium(environments.Unseeded(), method="step")
    world = from_gymnasium(environments.Corridor(), method="step", horizon=3)
    state = world.rollout(world.reset(1), torch.zeros(1, 1, 3, dtype=torch.long)).final_state[:, 0]
    with refuses("it holds 3 actions", "longer horizon"):
        world.step(state, torch.tensor([0]))
    for wrong, words in (
        (torch.zeros(1, 5, dtype=torch.long), "shape [B, 6]"),
        (torch.zeros(1, 6), "shape [B, 6]"),
        (torch.tensor([[1, 0, 0, 0, 0, 0]]), "state (seed)[0]: 1 is out of range"),
        (torch.tensor([[0, 4, 0, 0, 0, 0]]), "state (length)[0]: 4 is out of range"),
        (torch.tensor([[0, 0, 2, 0, 0, 0]]), "state (ended)[0]: 2 is out of range"),
        (torch.tensor([[0, 1, 0, 5, 0, 0]]), "state (actions)[0, 0]: 5 is out of range"),
    ):
        with refuses(words):
            world.check_state(wrong)


def test_one_start_for_all_resets_is_said():
    """CartPole draws its start: with one seed all resets are one state, and with more there are as many starts."""
    with pytest.warns(UserWarning, match="seed 0 alone.*seeds=range"):
        world = from_gymnasium("CartPole-v1", method="step")
    assert len(world.reset(20, seeded(0)).unique(dim=0)) == 1
    first = world.observe(world.reset(1, seeded(0)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        several = from_gymnasium("CartPole-v1", method="step", seeds=range(5))
        from_gymnasium(environments.Corridor(), method="step")
    starts = several.reset(60, seeded(0))
    assert len(several.observe(starts).unique(dim=0)) == 5
    zero = several.observe(starts[several.layout(starts) == 0][:1])
    torch.testing.assert_close(zero, first)


def test_environments_are_stepped_on_the_cpu():
    world = from_gymnasium("CartPole-v1", seeds=[4])
    assert world.to("cpu") is world
    with refuses("SteppedWorld simulates on the CPU", "cuda"):
        world.to("cuda")
