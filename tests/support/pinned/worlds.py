"""Worlds: their starts, what steps lead to and pay, what is observed and legal, where episodes end; state values."""

from typing import Any

import torch

from neuroprior.values import can_reach, network_approximation, q_learning, tile_approximation, value_iteration
from neuroprior.worlds import (
    DoubleIntegrator,
    EpisodicWorld,
    ForagingWorld,
    PlanarArm,
    World,
    cube,
    egocentric,
    format_sokoban,
    four_rooms,
    from_gymnasium,
    goal_direction,
    gridworld,
    labyrinth,
    local_view,
    maze,
    patches,
    sliding_tiles,
    sokoban,
    windows_within,
)
from tests.support.sources import random_world, seeded, stochastic_world
from tests.support.unchanged import case

LEVELS = ["#######\n#@ $ .#\n#######", "######\n#.$  #\n# +$ #\n#    #\n######"]


def walk(world: Any, number: int = 6, length: int = 5) -> dict[str, Any]:
    """Some steps from some starts, by actions that are legal."""
    generator = seeded(0)
    state, found = world.reset(number, generator), {}
    found["start"] = state
    for t in range(length):
        if isinstance(world, World):
            legal = world.legal_actions(state)
            action = torch.multinomial(legal.float(), 1, generator=generator)[:, 0]
        else:
            share = torch.rand(number, len(world.action_low), generator=generator)
            action, legal = world.action_low + share * (world.action_high - world.action_low), torch.zeros(0)
        state, reward = world.step(state, action, generator)
        found[f"step {t}"] = [state.double(), reward, legal, world.terminated(state)]
    found["observed"] = observed if torch.is_tensor(observed := world.observe(state)) else str(observed)
    if isinstance(world, World):
        plans = torch.randint(world.num_actions, (number, 3, 4), generator=generator)
        rolled = world.rollout(world.reset(number, seeded(1)), plans, seeded(2), keep_states=True)
        found |= rolled._asdict() | {"names": world.action_names, "stochastic": world.stochastic}
        if hasattr(world, "solved"):
            found["solved"] = world.solved(state)
    return found


@case
def grids_and_mazes():
    table = gridworld(4, 5, "torus", num_worlds=2, reward_power=3.0)
    walled = maze(7, 9, loops=0.3, num_layouts=2, num_worlds=2, seed=3)
    rooms = four_rooms(9, 9, reward="goal", egocentric=True, view=2, num_layouts=2)
    found = {
        "torus": walk(table),
        "walls": walk(gridworld(5, 4, seed=2)),
        "maze": walk(walled),
        "goal maze": walk(maze(7, 7, reward="goal", view=1)),
        "rooms": walk(rooms),
        "turning": walk(egocentric(gridworld(4, 4))),
        "labyrinth": walk(labyrinth(absorbing=True)),
        "random": walk(random_world(0, legal=True)),
        "stochastic": walk(stochastic_world(0)),
        "foraging": walk(ForagingWorld(table := gridworld(4, 4, "torus"), patches(table, 2, 1, seeded(0)), 3, 3)),
    }
    state = rooms.reset(5, seeded(3))
    found["places"] = [rooms.square(state), rooms.coordinates(state), rooms.heading(state), rooms.layout(state)]
    goals = four_rooms(9, 9, reward="goal")
    state = goals.reset(5, seeded(3))
    found["views"] = [local_view(walled, 1)(walled.reset(5, seeded(3))), goal_direction(goals)(state)]
    ended = torch.tensor([False, False, True])
    line = EpisodicWorld(
        torch.tensor([[0, 1], [0, 2], [2, 2]]), torch.tensor([0.0, 0, 1]), None, torch.tensor([1.0, 0, 0]), ended
    )
    found["episodes"] = [walk(line), line.start_anywhere().reset(9, seeded(0))]
    foraging = ForagingWorld(table, patches(table, 2, 1, seeded(0)), 3, 3)
    state = foraging.reset(4, seeded(0))
    state[:, 1] = torch.tensor([0, 2, 3, 7])
    found["regrown"] = [foraging.regrow(state, seeded(1)), foraging.season(state)]
    world = stochastic_world(1)
    found["means"] = [world.mean_reward(), world.mean_after(torch.arange(5).double()[None])]
    return found


@case
def puzzles():
    found = {
        "cube": walk(cube(scramble=3)),
        "cube, quarter turns": walk(cube("quarter", scramble=2, reward="distance", absorbing=True), 3, 3),
        "sokoban": walk(sokoban(LEVELS)),
        "sokoban, board": walk(sokoban(LEVELS, observation="board")),
        "tiles": walk(sliding_tiles(shape=(3, 3))),
        "tiles, board": walk(sliding_tiles(shape=(2, 3), observation="board", scramble=4)),
        "windows": windows_within(2, 2, 1),
    }
    for name, world in {"of tiles": sliding_tiles(shape=(3, 3)), "of boxes": sokoban(LEVELS)}.items():
        state = world.reset(4, seeded(0))
        found[name] = [world.lower_bound(state), world.mover(state), world.kinds(state), world.planes(state).float()]
        found[name] += (
            [[world.transformed(state, n), world.transformed_actions(n)] for n in range(min(3, world.symmetries))]
            if isinstance(world.symmetries, int)
            else []
        )
    world = cube()
    found["distance"] = world.distance(world.reset(5, seeded(1)))
    found["written"] = format_sokoban(sokoban(LEVELS).boards[0].numpy()) if hasattr(sokoban(LEVELS), "boards") else ""
    return found


@case
def gymnasium_environments():
    return {
        "taxi": walk(from_gymnasium("Taxi-v4")),
        "ice": walk(from_gymnasium("FrozenLake-v1", starts="any")),
        "cart and pole": walk(from_gymnasium("CartPole-v1", seeds=range(3), horizon=6), 3),
    }


@case
def continuous_worlds():
    arm = PlanarArm(2, masses=1.3)
    state = arm.reset(4, seeded(0))
    return {
        "integrator": walk(DoubleIntegrator(2, goal=(0.5, -0.2), mass=2.0)),
        "arm": walk(arm),
        "joints": arm.joints(state),
        "bounds": [arm.action_low, arm.action_high],
    }


@case
def values():
    world, maps = random_world(1, legal=True), gridworld(3, 4, num_worlds=2)
    cells = torch.arange(12)
    true = value_iteration(maps, goal=5, discount=0.8)
    place = maps.coordinates(cells).double()
    return {
        "learned": q_learning(maps, 5, num_agents=2, steps=200, generator=seeded(0)),
        "explored": q_learning(world, 3, steps=100, epsilon=0.3, step_size=0.2, discount=0.7, generator=seeded(0)),
        "true": true,
        "rewards": value_iteration(world, discount=0.9),
        "swept": value_iteration(maps, goal=5, sweeps=2),
        "reach": [can_reach(maps, cells, 5, 3), can_reach(maps, cells, 5, 3, within=True)],
        "tiles": tile_approximation(true, place, 2.0, 2),
        "network": network_approximation(true, place, generator=seeded(0), steps=20),
    }
