"""Growing the horizon: what is planned, what is learned from, and that it reaches what short plans do not."""

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Plans,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    collect,
)
from neuroprior.planners import extend_horizon
from neuroprior.worlds import EpisodicWorld, four_rooms, gridworld, labyrinth, maze
from neuroprior.worlds.labyrinth import WATER
from tests.support.sources import refuses, seeded

LENGTH = 40


def line(maps: int = 1) -> TabularWorld:
    """A line of cells and the moves left and right; the further from the middle, the better."""
    cell = torch.arange(2 * LENGTH + 1)
    moves = torch.stack([(cell - 1).clamp(min=0), (cell + 1).clamp(max=2 * LENGTH)], 1)
    return TabularWorld(moves, (cell - LENGTH).abs().float().expand(maps, -1))


class FromTheMiddle(TabularWorld):
    """The line, in which all plans start in the middle."""

    def __init__(self):
        known = line()
        super().__init__(known.next_state, known.reward)

    def reset(self, batch_size, generator=None):
        return torch.full((batch_size,), LENGTH)


def test_what_short_plans_teach_reaches_far():
    """The best three moves are equal. Repeating goes straight on for 20 moves, which random plans never do."""
    world, generator = FromTheMiddle(), seeded(0)
    plans = collect(ExhaustivePlanner(3), world, 200, generator=generator)
    prior = MarkovPrior(2, 1)
    rounds = list(extend_horizon(prior, plans, world, (6, 12, 20), num_starts=200, num_plans=64, generator=generator))
    assert [one.length for one in rounds] == [3, 6, 12, 20]
    assert rounds[0].plans is plans
    for one in rounds[1:]:
        assert one.plans.actions.shape == (200, one.length)
    repeats = rounds[-1].plans.actions
    assert float((repeats[:, 1:] == repeats[:, :-1]).float().mean()) > 0.99
    start = torch.full((100,), LENGTH)
    found = SamplingPlanner(prior, 20, 16).plan(world, start, seeded(1)).score
    by_chance = SamplingPlanner(UniformPrior(2), 20, 16).plan(world, start, seeded(1)).score
    assert float(found.mean()) > 19.5
    assert float(by_chance.max()) < 19


def test_the_prior_is_as_it_was_after_each_round():
    world, generator = FromTheMiddle(), seeded(0)
    plans, prior = collect(ExhaustivePlanner(3), world, 50, generator=generator), MarkovPrior(2, 1)
    rounds = extend_horizon(prior, plans, world, (6,), num_starts=50, generator=generator)
    next(rounds)
    first = MarkovPrior(2, 1).fit(plans)
    every = torch.cartesian_prod(*[torch.arange(2)] * 4)
    assert torch.allclose(prior.log_prob(every), first.log_prob(every))
    first = next(rounds)
    assert torch.allclose(prior.log_prob(every), MarkovPrior(2, 1).fit(first.plans).log_prob(every))
    assert next(rounds, None) is None


def test_the_temperature_of_a_round_is_that_which_finds_most():
    """Nine in ten plans that were learned from lead the wrong way; the hotter, the more go the other way."""

    class OneWay(FromTheMiddle):
        """The line, in which only what lies to the right counts."""

        def __init__(self):
            super().__init__()
            self._set_maps((torch.arange(2 * LENGTH + 1) - LENGTH).clamp(min=0).float()[None])

    world, lefts = OneWay(), torch.zeros(30, 6, dtype=torch.long)
    lefts[:3] = 1
    found = {}
    for heat in ((1.0,), (1.0, 3.0), (3.0,)):
        plans = Plans(lefts, 2)
        how = {"num_starts": 200, "num_plans": 4, "temperatures": heat, "generator": seeded(0)}
        *_, last = extend_horizon(MarkovPrior(2, 0), plans, world, (6,), **how)
        found[heat] = float(last.plans.actions.float().mean())
    assert found[(1.0, 3.0)] == pytest.approx(found[(3.0,)], abs=0.05)
    assert found[(1.0, 3.0)] > found[(1.0,)] + 0.1
    with refuses("`temperatures` must have at least one"):
        next(extend_horizon(MarkovPrior(2, 0), Plans(lefts, 2), world, (6,), num_starts=5, temperatures=()))


@pytest.mark.parametrize("per", [None, "plan", "step"])
def test_neural_priors_see_what_their_plans_recorded(per):
    world, generator = gridworld(5, 5, num_worlds=2), seeded(0)
    plans = collect(ExhaustivePlanner(2), world, 40, context=per, generator=generator)
    prior = GRUPrior(4, 8, num_contexts=None if per is None else 25)
    *_, last = extend_horizon(
        prior, plans, world, (4, 6), num_starts=30, num_plans=8, generator=generator, max_steps=3, progress=False
    )
    assert prior.context_per == per
    assert last.plans.actions.shape == (30, 6)
    shape = None if last.plans.context is None else last.plans.context.shape
    assert shape == (None if per is None else (30, 6))


def test_same_seed_same_plans():
    def extended(seed: int) -> torch.Tensor:
        world, generator = gridworld(6, 6), seeded(seed)
        plans = collect(ExhaustivePlanner(2), world, 40, generator=generator)
        how = {"num_starts": 20, "num_plans": 8, "generator": generator, "max_steps": 2, "progress": False}
        *_, last = extend_horizon(GRUPrior(4, 8), plans, world, (4, 5), **how)
        return last.plans.actions

    assert torch.equal(extended(3), extended(3))
    assert not torch.equal(extended(3), extended(4))


def test_only_plans_that_led_somewhere():
    """A goal is seldom in reach of three moves; those that found it end in it."""
    world = four_rooms(7, 7, reward="goal", num_worlds=4, num_layouts=3)
    state = world.reset(500, seeded(0))
    planner = ExhaustivePlanner(3, any_prefix=True)
    reached = planner.plan(world, state, seeded(1)).score > 0
    plans = collect(planner, world, state=state, min_score=0.0, generator=seeded(1))
    assert 0 < int(reached.sum()) == len(plans) < 500
    assert plans.group is not None
    assert torch.equal(plans.group, world.reward_map(state[reached]) * 3 + world.layout(state[reached]))
    ends = world.rollout(state[reached], plans.actions[:, None], keep_states=True).rewards[:, 0]
    assert plans.lengths is not None
    assert bool((ends.gather(1, plans.lengths[:, None] - 1) == 1).all())


def test_of_plans_that_go_on_after_the_end_only_the_beginning_is_kept():
    """A prefix that goes on beyond the end of the world is as good as the one that ends there."""
    world = TabularWorld(torch.tensor([[1], [2], [2]]), torch.zeros(3))
    planner = ExhaustivePlanner(6, any_prefix=True, value=lambda state: (state == 2).float())
    plans = collect(planner, world, state=torch.zeros(50, dtype=torch.long), generator=seeded(0))
    assert plans.lengths.tolist() == [2] * 50


def test_only_plans_that_score_more_are_kept():
    """Cell 1 pays, cell 0 does not, and none leads to the other; in every round of a curriculum, too."""
    world = TabularWorld(torch.tensor([[0], [1]]), torch.tensor([0.0, 1.0]))
    state = torch.tensor([0, 1, 0, 1, 1])
    assert len(collect(ExhaustivePlanner(2), world, state=state, min_score=0.0)) == 3
    with refuses("min_score"):
        collect(ExhaustivePlanner(2), world, state=state, min_score=1.0)
    plans = Plans(torch.zeros(4, 2, dtype=torch.long), 1)
    how = {"num_starts": 40, "num_plans": 2, "generator": seeded(0)}
    *_, every = extend_horizon(MarkovPrior(1, 0), plans, world, (3,), **how)
    *_, best = extend_horizon(MarkovPrior(1, 0), plans, world, (3,), min_score=0.0, **how)
    assert 0 < len(best.plans) < len(every.plans) == 40


def test_plans_end_where_it_is_over():
    """Chosen for their reward at the water or the solved cube, wherever they would have led on from there."""
    world = labyrinth(absorbing=True)
    assert world.terminated(torch.arange(127)).nonzero()[:, 0].tolist() == [WATER]
    assert not labyrinth().terminated(torch.arange(127)).any()
    plans = collect(
        ExhaustivePlanner(6, objective="return"), world, 400, context="step", min_score=0.0, generator=seeded(0)
    )
    assert plans.context is not None
    after = world.next_state[plans.context, plans.actions.long()]
    lengths = plans.mask().sum(1)
    assert bool((after.gather(1, lengths[:, None] - 1) == WATER).all())
    assert not bool((plans.mask() & (plans.context == WATER)).any())
    assert 1 <= int(lengths.min()) < int(lengths.max()) == 6


def slippery() -> TabularWorld:
    """A line of six cells that ends at 5; each step goes on or stays, at random."""
    cell = torch.arange(6)
    after = torch.stack([cell, (cell + 1).clamp(max=5)], 1)[:, None]
    reward = torch.zeros(6, 1, 2)
    reward[4, 0, 1] = 1.0
    return TabularWorld(after, reward, probability=torch.full((6, 1, 2), 0.5))


def test_in_a_stochastic_world_a_plan_is_executed_once():
    """What is observed before the last executed action is not the end."""
    world, planner = slippery(), SamplingPlanner(UniformPrior(1), 12, 2, objective="return")
    plans = collect(planner, world, state=torch.zeros(400, dtype=torch.long), context="step", generator=seeded(0))
    assert plans.context is not None
    assert not bool((plans.mask() & (plans.context == 5)).any())
    shorter = plans.mask().sum(1) < 12
    assert 0 < int(shorter.sum()) < 400


def test_in_a_stochastic_world_plans_are_scored_by_several_rollouts():
    """Two actions gain 1: one with probability 0.5, one always. A single rollout often takes the former for as good."""
    next_state = torch.zeros(1, 2, 2, dtype=torch.long)
    outcomes, chances = torch.tensor([[[0.0, 1.0], [1.0, 1.0]]]), torch.full((1, 2, 2), 0.5)
    world = TabularWorld(next_state, outcomes[None], probability=chances)
    plans = collect(ExhaustivePlanner(1, objective="return", num_rollouts=16), world, 300, generator=seeded(0))
    assert bool((plans.actions == 1).all())
    how = {"num_starts": 300, "num_plans": 40, "objective": "return", "generator": seeded(1)}
    even = collect(SamplingPlanner(UniformPrior(2), 1, 1), world, 300, generator=seeded(2))
    for rollouts, sure in ((1, False), (16, True)):
        *_, last = extend_horizon(MarkovPrior(2, 0), even, world, (1,), num_rollouts=rollouts, **how)
        assert bool((last.plans.actions == 1).all()) == sure


def test_each_layout_and_reward_map_is_a_group():
    assert maze(5, 5).group(torch.arange(4)) is None
    made = [torch.tensor([[1], [1], [3], [3]]), torch.tensor([0.0, 1, 0, 1]), ["on"], torch.ones(4)]
    ends = torch.tensor([False, True, False, True])
    episodes = EpisodicWorld(*made, ends, layouts=torch.tensor([0, 0, 1, 1]))
    assert episodes.group(torch.arange(4)).tolist() == [0, 0, 1, 1]
    assert EpisodicWorld(*made, ends).group(torch.arange(4)) is None
    assert four_rooms(num_worlds=2).group(torch.tensor([4, 13 * 13])).tolist() == [0, 1]


def test_settings_are_tried_as_they_are_planned_with(monkeypatch):
    """What tells temperatures apart has the goal, the candidates and the rollouts of the rounds themselves."""
    from neuroprior.planners import horizon_curriculum

    seen, real = [], horizon_curriculum.best_sampling

    def recorded(prior, world, state, length, num_plans, **how):
        seen.append((len(state), length, num_plans, how))
        return real(prior, world, state, length, num_plans, **how)

    monkeypatch.setattr(horizon_curriculum, "best_sampling", recorded)
    world, generator = FromTheMiddle(), seeded(0)
    plans = collect(ExhaustivePlanner(2), world, 20, generator=generator)
    goal = {"objective": "return", "discount": 0.9, "any_prefix": True}
    how = {"temperatures": [1.0, 2.0], "uniform_shares": [0.0, 0.5], "num_rollouts": 3, "generator": generator}
    list(extend_horizon(MarkovPrior(2, 1), plans, world, (4, 6), num_starts=30, num_plans=8, **how, **goal))
    assert seen == [(30, length, 8, how | goal) for length in (4, 6)]
