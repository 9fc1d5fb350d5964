"""Foraging: food is eaten once and grows where it may; its oracle against all plans."""

import pytest
import torch

from eval.live.foraging import ForagingWorld, patches
from eval.live.oracle import ForagingOracle
from neuroprior import ExhaustivePlanner, gridworld
from neuroprior.testing import check_world
from neuroprior.worlds import egocentric, labyrinth, maze
from tests.support.sources import (
    FALSE_ALARM,
    corridor,
    every_plan,
    p_value,
    random_world,
    refuses,
    seeded,
    stochastic_world,
)


def forage(table, period=50, num_items=3, num_seasons=2, radius=2, seed=0):
    return ForagingWorld(table, patches(table, num_seasons, radius, seeded(seed)), period, num_items)


TABLES = {
    "grid": lambda: gridworld(5, 5, edges="torus"),
    "labyrinth": labyrinth,
    "egocentric": lambda: egocentric(maze(7, 7)),
}


@pytest.mark.parametrize("table", TABLES)
def test_it_is_a_world(table):
    check_world(forage(TABLES[table]()))


def test_food_is_eaten_once():
    world = ForagingWorld(corridor(), torch.ones(1, 4), 100, 3)
    state = torch.tensor([[0, 0, 1, 1, 3]])
    rollout = world.rollout(state, torch.tensor([[[1, 0, 1, 1, 1, 1]]]))
    assert rollout.rewards.tolist() == [[[2, 0, 0, 0, 1, 0]]]
    assert rollout.final_state.tolist() == [[[3, 6, 4, 4, 4]]]


def test_an_agent_that_turns_eats_in_its_square():
    world = forage(egocentric(maze(7, 7)))
    square = int(world.place[world.reset(1, seeded(0))[0, 0]])
    state = torch.tensor([[4 * square, 0, square, world.num_places, world.num_places]])
    after, reward = world.step(state, torch.tensor([0]))
    assert reward.tolist() == [1]
    assert after[0, 2] == world.num_places


def test_food_regrows_at_the_places_of_the_season():
    """Chi-square test of 20,000 items."""
    growth = torch.tensor([[0.0, 1.0, 3.0, 0.0], [2.0, 0.0, 0.0, 1.0]])
    world = ForagingWorld(corridor(), growth, 10, 2)
    for time, season in ((3, 0), (13, 1), (20, 0), (30, 1)):
        state = torch.tensor([[0, time, 4, 4]]).repeat(10_000, 1)
        renewed = world.regrow(state, seeded(time))
        assert torch.equal(renewed[:, :2], state[:, :2])
        assert p_value(renewed[:, 2:], growth[season].double()) > FALSE_ALARM
        assert (world.season(state) == season).all()


def test_what_is_not_eaten_stays_until_the_season_ends():
    world = ForagingWorld(corridor(), torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 1.0]]), 10, 3)
    state = torch.tensor([[1, 9, 2, 4, 2]])
    assert world.regrow(state, seeded(0)).tolist() == [[1, 9, 2, 0, 2]]
    assert world.regrow(state + torch.tensor([[0, 1, 0, 0, 0]]), seeded(0)).tolist() == [[1, 10, 3, 3, 3]]


@pytest.mark.parametrize("table", [*TABLES, "partly legal"])
def test_a_patch_is_what_can_be_reached(table):
    table = random_world(2, "S", legal=True, states=12) if table == "partly legal" else TABLES[table]()
    growth = patches(table, 4, 3, seeded(1))
    plans, place = every_plan(table.num_actions, 3), forage(table).place
    for season, middle in enumerate(table.reset(4, seeded(1))):
        reached = {int(place[middle])}
        for plan in plans:
            now = middle[None]
            for action in plan:
                if not table.legal_actions(now)[0, action]:
                    break
                now, _ = table.step(now, action[None])
                reached.add(int(place[now]))
        assert growth[season].nonzero()[:, 0].tolist() == sorted(reached)


def test_bad_worlds():
    table, growth = corridor(), torch.ones(2, 4)
    for word, make in {
        "period": lambda: ForagingWorld(table, growth, 0),
        "num_items": lambda: ForagingWorld(table, growth, 5, 0),
        "[E, 4]": lambda: ForagingWorld(table, torch.ones(2, 5), 5),
        "at least 0": lambda: ForagingWorld(table, -growth, 5),
        "above it": lambda: ForagingWorld(table, growth * 0, 5),
        "one layout": lambda: ForagingWorld(maze(7, 7, num_layouts=2), growth, 5),
        "radius": lambda: patches(table, 1, 0),
        "deterministic": lambda: patches(stochastic_world(0), 1, 1),
    }.items():
        with refuses(word):
            make()
    world = ForagingWorld(table, growth, 5, 2)
    for word, state in {
        "[B, 4]": torch.zeros(3, 3, dtype=torch.long),
        "cells": torch.tensor([[4, 0, 0, 0]]),
        "places": torch.tensor([[0, 0, 5, 0]]),
        "time": torch.tensor([[0, -1, 0, 0]]),
        "int64": torch.zeros(3, 4),
    }.items():
        with refuses(word):
            world.rollout(state, torch.zeros(len(state), 1, 1, dtype=torch.long))


@pytest.mark.parametrize(("table", "length"), [("grid", 5), ("labyrinth", 5), ("egocentric", 6)])
@pytest.mark.parametrize("discount", [1.0, 0.9])
def test_the_oracle_is_the_best_of_all_plans(table, length, discount):
    world = forage(TABLES[table](), num_items=4, radius=3)
    state = world.reset(30, seeded(0))
    state[:10, 2] = world.num_places  # some is eaten already
    best = ExhaustivePlanner(length, objective="return", discount=discount).plan(world, state, seeded(1))
    found = ForagingOracle(length, discount).plan(world, state, seeded(2))
    assert torch.allclose(found.score, best.score)
    assert float(best.score.max()) > 1
    rollout = world.rollout(state, found.plan[:, None].long())
    assert torch.equal(rollout.final_state[:, 0], found.final_state)
    now = state
    for action in found.plan.long().T:
        assert world.legal_actions(now).gather(1, action[:, None]).all()
        now, _ = world.step(now, action)
    again = ForagingOracle(length, discount).plan(world, state, seeded(2))
    assert torch.equal(found.plan, again.plan)


def test_the_oracle_breaks_ties_at_random():
    """Two of four plans of a corridor without food in reach: all are equally good. Chi-square over 4,000 decisions."""
    world = ForagingWorld(corridor(), torch.ones(1, 4), 100, 1)
    state = torch.tensor([[1, 0, 4]]).repeat(4000, 1)
    plan = ForagingOracle(2).plan(world, state, seeded(0)).plan.long()
    assert p_value(2 * plan[:, 0] + plan[:, 1], torch.ones(4)) > FALSE_ALARM


def test_many_starts_are_planned_for_in_parts():
    world = forage(gridworld(4, 4))
    state = world.reset(20, seeded(0))
    whole = ForagingOracle(6).plan(world, state, seeded(0))
    planner = ForagingOracle(6)
    planner.steps_at_once = 2000
    parts = planner.plan(world, state, seeded(0))
    assert torch.equal(whole.score, parts.score)
    assert whole.model_steps == parts.model_steps == 6 * 2**3 * 16 * 4


def test_where_the_oracle_cannot_be_asked():
    many = ForagingWorld(corridor(), torch.ones(1, 4), 5, 13)
    for world in (random_world(0), many):
        with refuses("deterministic ForagingWorld of at most 12 items"):
            ForagingOracle(3).plan(world, world.reset(2, seeded(0)))


def test_priors_see_what_they_would_in_the_table():
    world = forage(gridworld(5, 5))
    state = world.reset(6, seeded(0))
    assert torch.equal(world.observe(state), state[:, 0])
    seeing = ForagingWorld(maze(5, 5, view=1), torch.ones(1, 25), 10, 2)
    there = seeing.reset(20, seeded(0))
    assert torch.equal(seeing.observe(there), seeing.table.observe(there[:, 0]))
    assert seeing.observe(there).shape == (20, 8)
