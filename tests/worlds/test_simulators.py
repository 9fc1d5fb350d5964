"""Simulators as worlds: against bare loops, closed forms and fresh simulators; what is refused; what is left alone."""

import copy
import random
import warnings

import gymnasium
import numpy as np
import pytest
import torch

from neuroprior import FrontierPlanner, MCTSPlanner, SamplingPlanner, UniformPrior
from neuroprior.testing import check_world
from neuroprior.worlds import Categories, Features, SimulatorWorld, from_simulator
from neuroprior.worlds.simulators.copies import CloneCopier, DeepCopier, PickleCopier, ReplayCopier, StateCopier
from neuroprior.worlds.simulators.fingerprints import digest
from neuroprior.worlds.simulators.generators import state_of_generators
from tests.support import environments, simulators
from tests.support.simulators import SIGMAS
from tests.support.sources import every_plan, refuses, seeded


def bare_rewards(simulator, plan):
    """Rewards of a plan in a copy of a simulator."""
    simulator, rewards = copy.deepcopy(simulator), []
    for action in plan:
        _, reward, *ends = simulator.step(action)
        rewards.append(reward)
        if ends[0] or (len(ends) > 1 and ends[1]):
            break
    return rewards + [0.0] * (len(plan) - len(rewards))


def reach_probability(up, steps, goal=3):
    """With what probability a walk that goes up with probability `up` reaches the goal in so many steps."""
    chance, reached = {0: 1.0}, 0.0
    for _ in range(steps):
        after = {}
        for place, p in chance.items():
            for way, q in ((1, up), (-1, 1 - up)):
                after[place + way] = after.get(place + way, 0.0) + p * q
        reached += after.pop(goal, 0.0)
        chance = after
    return reached


def test_a_deterministic_rollout_is_a_bare_replay():
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=7)
    for _ in range(3):
        env.step(1)
    world = from_simulator(env)
    assert isinstance(world, SimulatorWorld)
    assert not world.stochastic
    plans = torch.randint(2, (1, 40, 30), generator=seeded(0))
    rewards = world.rollout(world.reset(1), plans).rewards
    assert rewards[0].tolist() == [bare_rewards(env, plan) for plan in plans[0].tolist()]
    assert 0 < (rewards == 0).sum() < rewards.numel()  # some plans fall


def test_all_plans_of_a_walk_are_exact():
    world = from_simulator(simulators.Walk(), 2)
    plans = every_plan(2, 6)
    rollout = world.rollout(world.reset(2), plans.expand(2, -1, -1), keep_states=True)
    places = (2 * plans - 1).cumsum(1)
    first = (places == 3).cumsum(1) == 1
    arrived = first & (places == 3)
    assert rollout.rewards[0].equal(arrived.double())
    assert rollout.rewards[1].equal(arrived.double())
    assert world.terminated(rollout.final_state[0]).equal(arrived.any(1))
    assert rollout.states[..., -1].equal(rollout.final_state)
    # The same place by the same actions is the same state, however it is reached.
    state = world.reset(1)
    for action in plans[5]:
        state, _ = world.step(state, action[None])
    assert state.equal(rollout.final_state[0, 5:6])


@pytest.mark.parametrize(
    "draw",
    [np.random.default_rng(0), np.random.RandomState(0), random.Random(0), random, np.random],
    ids=["generator", "random state", "random", "the module random", "the module numpy.random"],
)
def test_noise_of_each_kind_is_foreseen_as_it_is(draw):
    world = from_simulator(simulators.Slip(draw), 2)
    assert world.stochastic
    number = 20_000
    up = torch.ones(1, number, 7, dtype=torch.long)
    reached = world.rollout(world.reset(1), up, seeded(0)).rewards.sum(-1).mean()
    p = reach_probability(0.7, 7)
    assert abs(float(reached) - p) < SIGMAS * (p * (1 - p) / number) ** 0.5
    generator = seeded(1)
    state, total = world.reset(1).expand(number), torch.zeros(number, dtype=torch.double)
    for _ in range(3):
        state, reward = world.step(state, torch.ones(number, dtype=torch.long), generator)
        total += reward
    assert abs(float(total.mean()) - 0.343) < SIGMAS * (0.343 * 0.657 / number) ** 0.5


def test_rare_noise_is_noticed_by_what_is_drawn():
    class Rare(simulators.Walk):
        def __init__(self):
            super().__init__()
            self.draw = random.Random(3)

        def step(self, action):
            return super().step(1 - action if self.draw.random() < 0.01 else action)

    assert from_simulator(Rare(), 2).stochastic

    # Noise in vain is none; and what is known need not be tried out.
    class Vain(simulators.Walk):
        def step(self, action):
            random.random()
            return super().step(action)

    assert not from_simulator(Vain(), 2).stochastic
    assert from_simulator(Vain(), 2, stochastic=True).stochastic


class Late(simulators.Walk):
    """Counts its steps, and from 150 on draws a number; `effect` says whether it counts."""

    def __init__(self, draw, effect=True):
        self.draw, self.effect, self.time = draw, effect, 0

    def step(self, action):
        self.time += 1
        number = self.draw.random() if self.time > 150 else 0.0
        return None, action + (number if self.effect else 0.0), False


class LateClone(Late):
    def clone(self):
        other = copy.copy(self)
        other.draw = self.draw if self.draw is random else copy.deepcopy(self.draw)
        return other


class LateDraws(Late):
    """Draws at each step, but only late ones count."""

    def step(self, action):
        self.draw.random()
        return super().step(action)


def draw_of(name):
    """What draws numbers below 1."""
    return {
        "generator": np.random.default_rng(3),
        "random": random.Random(3),
        "module random": random,
        "module numpy.random": np.random,
    }[name]


NOISY = [(Late, "generator"), (Late, "module random"), (Late, "module numpy.random"), (LateClone, "random")]
NOISY += [(LateClone, "module random"), (LateDraws, "generator"), (LateDraws, "module numpy.random")]


@pytest.mark.parametrize("planner", [SamplingPlanner, FrontierPlanner, MCTSPlanner])
@pytest.mark.parametrize(("kind", "name"), NOISY)
def test_noise_that_no_walk_met_is_refused_when_plans_meet_it(kind, name, planner):
    world = from_simulator(kind(draw_of(name)), 2)
    assert not world.stochastic
    near = planner(UniformPrior(2), 140, 4).plan(world, world.reset(1), seeded(0))
    assert float(near.score) > 0
    for _ in range(2):
        with refuses("plans met noise that no trial walk had met; give `stochastic=True`"):
            planner(UniformPrior(2), 160, 4).plan(world, world.reset(1), seeded(0))
    allowed = from_simulator(kind(draw_of(name)), 2, stochastic=True)
    assert allowed.stochastic


@pytest.mark.parametrize("kind", [Late, LateClone, LateDraws])
@pytest.mark.parametrize("name", ["generator", "module random"])
def test_numbers_that_are_drawn_late_to_no_effect_are_no_noise(kind, name):
    world = from_simulator(kind(draw_of(name), effect=False), 2)
    plans = torch.randint(2, (1, 20, 160), generator=seeded(0))
    for _ in range(3):
        assert world.rollout(world.reset(1), plans).rewards.equal(plans.double())
        _, reward = world.step(world.rollout(world.reset(1), plans).final_state[0], plans[0, :, 0].long())
        assert reward.equal(plans[0, :, 0].double())
    assert not world.stochastic


def test_noise_that_no_walk_met_is_noticed_in_other_processes():
    pytest.importorskip("joblib")
    world = from_simulator(Late(draw_of("module random")), 2, workers=2)
    with refuses("give `stochastic=True`"):
        world.rollout(world.reset(1), torch.ones(1, 4, 160, dtype=torch.long))


def test_noise_that_is_declared_away_is_a_warning():
    with pytest.warns(UserWarning, match="`stochastic` must be None or True") as caught:
        world = from_simulator(simulators.Slip(random.Random(0)), 2, stochastic=False)
    assert caught[0].filename == __file__
    plans = torch.ones(1, 4, 6, dtype=torch.long)
    first, second = (world.rollout(world.reset(1), plans, seeded(seed)).rewards for seed in (0, 1))
    assert first.equal(second)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from_simulator(simulators.Walk(), 2, stochastic=False)


def test_the_simulator_and_the_callers_generators_stay_as_they_were():
    env = gymnasium.make("FrozenLake-v1")
    env.reset(seed=3)
    env.step(1)
    for one in (env, simulators.Slip(np.random.default_rng(4)), simulators.Slip(random)):
        held = [one.unwrapped.np_random] if one is env else [one.draw] if one.draw is not random else []
        before = digest(vars(getattr(one, "unwrapped", one))), state_of_generators(held)
        world = from_simulator(one, 4 if one is env else 2)
        state = world.state_of([one, one])
        rollout = world.rollout(state, torch.ones(2, 3, 4, dtype=torch.long), seeded(0), keep_states=True)
        world.step(rollout.final_state.flatten(), torch.zeros(6, dtype=torch.long), seeded(0))
        world.terminated(rollout.states.flatten())
        assert (digest(vars(getattr(one, "unwrapped", one))), state_of_generators(held)) == before


def test_one_seed_has_one_result():
    world = from_simulator(simulators.Slip(np.random.default_rng(0)), 2)
    plans = torch.randint(2, (3, 20, 8), generator=seeded(0))
    first, second = (world.rollout(world.reset(3), plans, seeded(5)) for _ in range(2))
    assert first.final_state.equal(second.final_state)
    assert first.rewards.equal(second.rewards)
    other = from_simulator(simulators.Slip(np.random.default_rng(9)), 2)
    assert other.rollout(other.reset(3), plans, seeded(5)).rewards.equal(first.rewards)
    assert not world.rollout(world.reset(3), plans, seeded(6)).rewards.equal(first.rewards)
    made = from_simulator(simulators.NoisyStart)
    assert made.reset(9, seeded(1)).equal(made.reset(9, seeded(1)))


def local_simulator():
    """Of a class that pickle does not find."""

    class Local(simulators.Walk):
        pass

    return Local()


COPIED = {
    "pickle": (simulators.Walk(), PickleCopier),
    "deepcopy": (local_simulator(), DeepCopier),
    "clone": (simulators.Clone(), CloneCopier),
    "states": (simulators.States(), StateCopier),
    "made anew": (environments.Forgetful, ReplayCopier),
}


@pytest.mark.parametrize("name", COPIED)
@pytest.mark.parametrize("size", [1, 3, 2048])
def test_what_is_not_kept_is_reached_again(name, size):
    simulator, copier = COPIED[name]
    how = {"observe": "observation", "observation": Features(1)}
    if name != "made anew":
        how["observe"] = lambda held: [held.place if hasattr(held, "place") else held.cells[0]]
    worlds = [from_simulator(simulator, 2, **how) for _ in range(2)]
    assert isinstance(worlds[0].copier, copier)
    worlds[1].max_snapshots = size
    seen = []
    for world in worlds:
        plans = torch.randint(2, (2, 5, 6), generator=seeded(2))
        rollout = world.rollout(world.reset(2, seeded(1)), plans, seeded(3), keep_states=True)
        state = rollout.final_state.flatten()
        for t in range(4):
            state, reward = world.step(state, plans[0, :, t].repeat(2), seeded(t))
            seen.append(reward)
        world._views.clear()
        seen += [rollout.rewards, world.observe(rollout.states.flatten()), world.observe(state)]
        seen += [world.terminated(state), state]
    for first, second in zip(seen[: len(seen) // 2], seen[len(seen) // 2 :], strict=True):
        assert first.equal(second)
    assert len(worlds[1]._snapshots) <= size


def test_a_running_simulator_is_planned_in_step_by_step():
    real = simulators.Walk()
    world = from_simulator(real, 2)
    planner = SamplingPlanner(UniformPrior(2), 3, 64, objective="return")
    total = 0.0
    for _ in range(3):
        decision = planner.plan(world, world.state_of(real), seeded(0))
        assert decision.score.tolist() == [1.0]
        _, reward, _ = real.step(int(decision.plan[0, 0]))
        total += reward
    assert total == 1
    several = from_simulator([simulators.Walk(), real], 2)
    assert several.reset(100, seeded(0)).unique().tolist() == [0, 1]


def test_states_are_forgotten_on_demand():
    world, real = from_simulator(simulators.Walk(), 2), simulators.Walk()
    real.step(1)
    old, up = world.state_of(real), torch.ones(1, 1, 4, dtype=torch.long)
    final = world.rollout(old, up).final_state[:, 0]
    world.forget()
    assert world.rollout(world.reset(1), up).rewards.sum() == 1
    assert world.rollout(world.state_of(real), up).rewards[0, 0].tolist() == [0, 1, 0, 0]
    for state in (old, final):
        with refuses("from before `forget` was called"):
            world._snapshot(int(state))
    made = from_simulator(simulators.NoisyStart)
    state = made.reset(4, seeded(0))
    first = made.rollout(state, up.expand(4, -1, -1)).rewards
    made.forget()
    assert made.rollout(state, up.expand(4, -1, -1)).rewards.equal(first)


MASKED = {
    "method": (simulators.DoorsWithMethod(), {}),
    "argument": (simulators.Doors(), {"legal_actions": simulators.Doors.legal}),
}


@pytest.mark.parametrize("name", MASKED)
def test_masks_are_respected(name):
    simulator, how = MASKED[name]
    world = from_simulator(simulator, 3, **how)
    assert not world.all_legal
    start = world.reset(2)
    assert world.legal_actions(start).tolist() == [[True, False, False]] * 2
    planner = SamplingPlanner(UniformPrior(3), 6, 4, objective="return")
    decision = planner.plan(world, start, seeded(0))
    assert decision.plan[:, :4].tolist() == [[0, 1, 2, 0]] * 2
    assert decision.score.tolist() == [1, 1]
    assert world.terminated(decision.final_state).all()  # nothing is legal there
    # What is not legal changes nothing.
    plan = torch.tensor([[[0, 0, 2, 1, 2]]])
    rollout = world.rollout(start[:1], plan, keep_states=True)
    short = world.rollout(start[:1], torch.tensor([[[0, 1, 2]]]))
    assert rollout.final_state.equal(short.final_state)
    assert world.observation is None
    check_world(world)


def test_masks_of_info_are_seen_after_a_reset():
    class Env(gymnasium.Env):
        observation_space, action_space = gymnasium.spaces.Discrete(9), gymnasium.spaces.Discrete(3, start=4)

        def reset(self, seed=None, options=None):
            self.doors = simulators.Doors()
            return 0, {"action_mask": self.doors.legal()}

        def step(self, action):
            return *self.doors.step(action - 4), False, {"action_mask": self.doors.legal()}

    world = from_simulator(Env)
    assert world.legal_actions(world.reset(1)).tolist() == [[True, False, False]]
    decision = SamplingPlanner(UniformPrior(3), 4, 3, objective="return").plan(world, world.reset(2), seeded(0))
    assert decision.plan.tolist() == [[0, 1, 2, 0]] * 2
    env = Env()
    env.reset()
    _, _, _, _, info = env.step(4)
    assert world.legal_actions(world.state_of(env, info=info)).tolist() == [[False, True, False]]


def test_numbers_of_states_survive_what_planners_do_with_them():
    world = from_simulator(
        simulators.Slip(random.Random(0)), 2, observe=lambda s: s.place + 20, observation=Categories(41)
    )
    states = world.rollout(world.reset(4), torch.ones(4, 3, 5, dtype=torch.long), seeded(0), True).states
    shown = world.observe(states.reshape(-1)).view(4, 3, 5)
    assert shown.dtype == torch.long
    assert world.observe(states[1, 2]).equal(shown[1, 2])
    assert world.observe(states[:, 0, 0].repeat_interleave(3, 0)).equal(shown[:, 0, 0].repeat_interleave(3))
    assert world.observe(states[:0, 0, 0]).shape == (0,)
    for wrong in (states, torch.zeros(3), torch.tensor([10_000]), torch.tensor([-1])):
        with refuses("state"):
            world.check_state(wrong)
    check_world(world)


def test_workers_give_the_same():
    pytest.importorskip("joblib")
    worlds = [from_simulator(simulators.Slip(random.Random(0)), 2, workers=workers) for workers in (None, 2)]
    plans = torch.randint(2, (1, 9, 6), generator=seeded(0))
    one, two = (world.rollout(world.reset(1), plans, seeded(1)) for world in worlds)
    assert one.rewards.equal(two.rewards)
    assert one.final_state.equal(two.final_state)


@pytest.mark.parametrize(
    "make",
    [
        lambda: from_simulator(simulators.Walk(), 2),
        lambda: from_simulator(
            simulators.Slip(np.random.default_rng(0)), 2, observe=lambda s: [s.place], observation=Features(1)
        ),
        lambda: from_simulator(lambda: gymnasium.make("CartPole-v1"), observe="observation", observation=Features(4)),
        lambda: from_simulator(simulators.NoisyByModule()),
        lambda: from_simulator(environments.Forgetful, observe="observation", observation=Categories(10)),
    ],
    ids=["walk", "slip", "cart", "never reset", "made anew"],
)
def test_simulators_conform(make):
    check_world(make(), num_states=5)


def test_observations_of_running_simulators_are_read_from_them():
    env = gymnasium.make("CartPole-v1")
    env.reset(seed=1)
    observation = env.step(1)[0]
    world = from_simulator(env, observe="observation", observation=Features(4))
    assert world.observe(world.reset(1))[0].tolist() == observation.tolist()

    class Blurred(simulators.Walk):
        def step(self, action):
            _, *rest = super().step(action)
            return [self.place / 7 + 1], *rest

    world = from_simulator(Blurred(), 2, observe="observation", observation=Features(1))
    with refuses("`state_of` must be given what a running simulator's last step observed"):
        world.observe(world.reset(1))
    assert world.observe(world.state_of(Blurred(), observation=[1.0])).tolist() == [[1.0]]
    state, _ = world.step(world.reset(1), torch.tensor([1]))
    assert world.observe(state)[0].tolist() == pytest.approx([8 / 7])


class Wrong:
    def __init__(self, returned):
        self.returned = returned

    def step(self, action):
        return self.returned


REFUSED = {
    "shallow clone": (lambda: from_simulator(simulators.ShallowClone(), 2), "share nothing"),
    "held by the class": (lambda: from_simulator(simulators.ClassHeld(), 2), "share nothing"),
    "clone with its generator": (
        lambda: from_simulator(simulators.Slip(random.Random(0)), 2, clone=copy.copy),
        "they share draw",
    ),
    "unseedable": (lambda: from_simulator(simulators.Unseedable(), 2), "draw its noise from generators"),
    "made unseedably": (lambda: from_simulator(local_noise, 2), "draw its noise from generators"),
    "forgetful": (lambda: from_simulator(environments.Forgetful()), "copies that behave as it does"),
    "not copied": (lambda: from_simulator(Wrong(n for n in ()), 2), "cannot pickle 'generator'"),
    "no simulator": (lambda: from_simulator(3, 2), "a method `step`, or a function that makes one, got int"),
    "none": (lambda: from_simulator([], 2), "one or more simulators, got none"),
    "no number": (lambda: from_simulator(simulators.Walk()), "`num_actions` must be an integer"),
    "vectors": (lambda: from_simulator(gymnasium.make("Pendulum-v1")), "discrete actions"),
    "too many actions": (
        lambda: from_simulator(simulators.Doors(), 4, legal_actions=simulators.Doors.legal),
        "[4], got [3]",
    ),
    "illegal": (lambda: from_simulator(simulators.Doors(), 3), "say which are legal"),
    "illegal, as is said too late": (lambda: from_simulator(simulators.DoorsWithInfo(), 3), "say which are legal"),
    "two values": (
        lambda: from_simulator(Wrong((0, 1.0)), 2),
        "(observation, reward, ended) or Gymnasium's five, got 2",
    ),
    "a number": (lambda: from_simulator(Wrong(1.0), 2), "got float"),
    "reward": (lambda: from_simulator(Wrong((0, "x", False)), 2), "a number as reward"),
    "undeclared": (lambda: from_simulator(simulators.Walk(), 2, observe=lambda s: s.place), "must be given together"),
    "other category": (
        lambda: from_simulator(simulators.Walk(), 2, observe=lambda s: s.place, observation=Categories(3)),
        "an integer from 0 to 2, got",
    ),
    "other size": (
        lambda: from_simulator(simulators.Walk(), 2, observe=lambda s: [1, 2], observation=Features(3)),
        "must return 3 numbers, got the shape [2]",
    ),
    "names": (lambda: from_simulator(simulators.Walk(), 2, action_names=["up"]), "`action_names` must have 2 names"),
    "workers": (lambda: from_simulator(simulators.Walk(), 2, workers=0), "`workers` must be"),
    "no step": (lambda: from_simulator(simulators.Walk(), 2).state_of(3), "must be of the world's class Walk, got int"),
    "another class": (
        lambda: from_simulator(simulators.Walk(), 2).state_of([simulators.Walk(), simulators.Cells()]),
        "must be of the world's class Walk, got Cells",
    ),
    "another environment": (
        lambda: from_simulator(simulators.NoisyStart).state_of(gymnasium.make("CartPole-v1")),
        "must be of the world's class NoisyStart",
    ),
}


def local_noise():
    """A simulator that is made by noise that cannot be seeded."""
    simulator = simulators.Walk()
    simulator.place = int(np.random.default_rng().integers(-1000, 1000))
    return simulator


@pytest.mark.parametrize("name", REFUSED)
def test_refusals(name):
    call, words = REFUSED[name]
    with refuses(words):
        call()


def test_simulators_are_stepped_on_the_cpu():
    world = from_simulator(simulators.Walk(), 2)
    assert world.to("cpu") is world
    with refuses("SimulatorWorld simulates on the CPU", "cuda"):
        world.to("cuda")
    with refuses("`observe` must be given to from_simulator"):
        world.observe(world.reset(1))


def test_arrays_that_a_simulator_reuses_are_read_at_once():
    plan = torch.tensor([[[1, 1, 1, 0, 0]]])
    world = from_simulator(simulators.ReusedReward(), 2)
    assert world.rollout(world.reset(1), plan).rewards.flatten().tolist() == [1, 2, 3, 2, 1]
    for observe in ("observation", lambda simulator: simulator.seen):
        world = from_simulator(simulators.ReusedObservation(), 2, observe=observe, observation=Features(1))
        states = world.rollout(world.state_of(simulators.ReusedObservation(), np.zeros(1)), plan, None, True).states
        assert world.observe(states[0, 0]).flatten().tolist() == [1, 2, 3, 2, 1]


def test_what_a_state_leaves_out_is_each_simulator_s_own():
    world = from_simulator([simulators.GoalOutsideState(2), simulators.GoalOutsideState(-2)], 2)
    other = world.state_of(simulators.GoalOutsideState(-2))
    plans = torch.tensor([[[0, 0], [1, 1]]])
    rewards = world.rollout(torch.cat([torch.tensor([0, 1]), other]), plans.expand(3, 2, 2)).rewards.sum(-1)
    assert rewards.tolist() == [[0, 1], [1, 0], [1, 0]]


def test_copies_that_lose_what_a_simulator_is_are_not_used():
    world = from_simulator(simulators.Views, 2)
    rewards = world.rollout(world.reset(1), torch.tensor([[[1, 1, 1, 0]]])).rewards
    assert rewards.flatten().tolist() == [0.5, 0.5, 0.5, 7.0]


def test_the_frontier_planner_reaches_no_state_twice(monkeypatch):
    """The states of three steps of 4 starts would be more than three times as many as are kept."""
    world, reached = from_simulator(simulators.Walk, 2), []
    world.max_snapshots = 150
    reach = SimulatorWorld._reach
    monkeypatch.setattr(SimulatorWorld, "_reach", lambda self, handle: reached.append(handle) or reach(self, handle))
    state = world.reset(4, seeded(0))
    decision = FrontierPlanner(UniformPrior(2), 12, 32).plan(world, state, seeded(1))
    assert decision.score.tolist() == [1, 1, 1, 1]
    assert sorted(reached) == state.tolist()


def test_simulators_that_hold_the_same_are_found():
    world = from_simulator(simulators.Walk, 2)
    state = world.reset(5, seeded(0))
    assert state.unique().numel() == 5
    assert world.are_same(state)
    assert not world.are_same(torch.cat([state, world.step(state, torch.ones(5, dtype=torch.long))[0]]))
    noisy = from_simulator(simulators.NoisyStart)
    assert not noisy.are_same(noisy.reset(40, seeded(0)))


class Forgetful:
    """It counts its steps, and misbehaves from the third one on once `returns` is set."""

    returns = ()

    def __init__(self):
        self.t = 0

    def step(self, action):
        self.t += 1
        return (None, float(action), False) if self.t < 3 or not Forgetful.returns else Forgetful.returns[0]


@pytest.mark.parametrize("returned", [None, (None, None, False), (None, 1.0)])
def test_what_a_step_returns_late_is_refused_in_a_line(returned, monkeypatch):
    world = from_simulator(Forgetful(), num_actions=2)
    monkeypatch.setattr(Forgetful, "returns", (returned,))
    assert world.rollout(world.reset(1), torch.tensor([[[1, 0]]])).rewards.tolist() == [[[1, 0]]]
    with refuses("`step` must return (observation, reward, ended)"):
        world.rollout(world.reset(1), torch.tensor([[[1, 0, 1, 1]]]))
