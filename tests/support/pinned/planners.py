"""Planners, searches, agents and curricula: what they decide from some seeded starts, and at what cost."""

from tempfile import TemporaryDirectory
from typing import Any

import torch

from neuroprior.agents import Agent, restore_agent, save_agent
from neuroprior.control import DoubleIntegrator, ICEMPlanner, MPPIPlanner, ShootingPlanner, coloured_noise, control
from neuroprior.planners import (
    ExhaustivePlanner,
    FrontierPlanner,
    MCTSPlanner,
    SamplingPlanner,
    best_sampling,
    collect,
    expected_score,
    extend_horizon,
    oracle,
    search_weights,
)
from neuroprior.priors import GRUPrior, MarkovPrior, UniformPrior
from neuroprior.puzzles import AStarPlanner, LevinPlanner, LogLinearPrior, bootstrap, sliding_tiles, sokoban
from neuroprior.sampling import sample, sample_in_world
from neuroprior.worlds import cube, four_rooms, gridworld, maze
from tests.support.pinned.data import behaviour
from tests.support.sources import TablePrior, random_world, seeded, stochastic_world
from tests.support.unchanged import case
from tests.support.vectors import Cart, drift

LEVELS = ["#######\n#@ $ .#\n#######", "######\n#.$  #\n# +$ #\n#    #\n######"]


def chain(num_actions: int = 3, **more: Any) -> MarkovPrior:
    return MarkovPrior(num_actions, 2, **more).fit(behaviour(num_actions=num_actions))


MAKERS = {
    "sampling": lambda prior, **how: SamplingPlanner(prior, 4, 12, temperature=1.3, uniform_share=0.25, **how),
    "halving": lambda prior, **how: SamplingPlanner(prior, 4, 12, num_rollouts=6, halving=True, **how),
    "exhaustive": lambda prior, **how: ExhaustivePlanner(3, num_rollouts=2, **how),
    "frontier": lambda prior, **how: FrontierPlanner(prior, 4, 12, **how),
    "mcts": lambda prior, **how: MCTSPlanner(prior, 4, 16, **how),
}
ONLY_SURE = ("distinct", "frontier", "mcts", "horizon")


@case(slow=True)
def searches():
    found: dict[str, Any] = {}
    tiles, boxes = sliding_tiles(shape=(3, 3), scramble=9), sokoban(LEVELS)
    for name, world in {"tiles": tiles, "boxes": boxes}.items():
        state = world.reset(4, seeded(3))
        moves = MarkovPrior(4, 1).fit(torch.randint(4, (30, 5), generator=seeded(0)))
        for kind, planner in {
            "levin": LevinPlanner(moves, 300),
            "rerooted": LevinPlanner(moves, 300, reroot=True),
            "informed": LevinPlanner(moves, 300, heuristic=world.lower_bound, temperature=1.5),
            "a star": AStarPlanner(world.lower_bound, 1.0, 300),
            "weighted": AStarPlanner(world.lower_bound, 2.0, 300),
            "blind": AStarPlanner(None, 1.0, 200),
        }.items():
            found[f"{kind}, {name}"] = planner.search(world, state)
    table = cube("half", scramble=3)
    found["cube"] = MCTSPlanner(UniformPrior(table.num_actions), 3, 20).plan(
        table, table.reset(4, seeded(0)), seeded(1)
    )
    return found


@case
def planners_of_vectors():
    found: dict[str, Any] = {}
    for name, world in {"cart": Cart(last=8), "integrator": DoubleIntegrator(2)}.items():
        prior, state = drift(world), world.reset(3, seeded(0))
        for kind, planner in {
            "shooting": ShootingPlanner(6, 24, prior=prior, prior_share=0.25, noise_beta=1.0, discount=0.9),
            "shooting, fixed": ShootingPlanner(6, 24, prior=prior, prior_share=0.25, adapt_share=False),
            "icem": ICEMPlanner(6, 32, iterations=3, elites=4, prior=prior, std=0.4),
            "icem, noise": ICEMPlanner(6, 24, prior=prior, prior_as="noise", prior_iterations=None),
            "icem, plain": ICEMPlanner(5, 30),
            "mppi": MPPIPlanner(6, 24, prior=prior),
            "mppi, costly": MPPIPlanner(5, 24, control_cost=True, normalise=False, temperature=1.0),
        }.items():
            done = control(planner, world, state, 5, seeded(1), replan_every=2)
            found[f"{kind}, {name}"] = [done.plans.actions, done.plans.lengths, done.rewards, done.model_steps]
            found[f"{kind}, {name}"].append(planner.plan(world, state, seeded(2))._replace(memory=None))
    found["noise"] = [coloured_noise((2, 9, 1), beta, seeded(0)) for beta in (0.0, 1.0, 2.5)]
    return found


@case
def samples():
    found: dict[str, Any] = {}
    prior, table, world = chain(), TablePrior.random(3, 5), random_world(2, legal=True, states=8)
    for name, one in {"chain": prior, "table": table}.items():
        for temperature in (1.0, 1.7):
            how: dict[str, Any] = {"temperature": temperature}
            found[f"{name} {temperature}"] = {
                "tree": sample(one, 200, 4, generator=seeded(0), method="tree", **how),
                "ancestral": sample(one, 40, 4, generator=seeded(0), method="ancestral", batch_size=16, **how),
                "in a world": sample_in_world(one, world, world.reset(3, seeded(0)), 5, 4, generator=seeded(1), **how),
            }
    rooms = four_rooms(9, 9)
    network = GRUPrior(4, 8, num_contexts=rooms.num_states, seed=2)
    network.context_per = "step"
    found["network"] = sample_in_world(network, rooms, rooms.reset(3, seeded(0)), 5, 4, generator=seeded(1))[0]
    return found


@case
def decisions():
    """Of every planner: in tables with maps and illegal actions, for each goal, and in a stochastic one."""
    found: dict[str, Any] = {}
    sure, unsure = random_world(3, legal=True, states=12), stochastic_world(2)
    goals: dict[str, dict[str, Any]] = {
        "terminal": {},
        "return": {"objective": "return", "discount": 0.8},
        "prefix": {"any_prefix": True},
        "value": {"objective": "return", "discount": 0.9, "value": lambda state: (state % 5).double()},
    }
    for name, make in MAKERS.items():
        for goal, how in goals.items():
            if name == "halving" or (name == "exhaustive" and goal == "value"):
                continue
            state = sure.reset(6, seeded(0))
            found[f"{name}, {goal}"] = make(chain(), **how).plan(sure, state, seeded(1))
        if name not in ("frontier", "mcts"):  # which refuse stochastic worlds
            planner = make(chain(), **goals["return"])
            found[f"{name}, stochastic"] = planner.plan(unsure, unsure.reset(5, seeded(0)), seeded(1))
    state = sure.reset(6, seeded(0))
    found["best"] = [oracle(sure, state, 4, **how) for how in goals.values()]
    plans = torch.randint(3, (5, 2, 3), generator=seeded(0))
    state = unsure.reset(5, seeded(0))
    found["expected"] = expected_score(unsure, state, plans, objective="return", discount=0.9)
    return found


@case
def curricula():
    """The horizon curriculum, problems that are solved again and again, and how candidates are best drawn."""
    found: dict[str, Any] = {}
    world = maze(7, 7, num_layouts=2, num_worlds=2)
    plans = collect(ExhaustivePlanner(3), world, 30, generator=seeded(0))
    found["collected"] = [plans.actions, plans.group]
    better = collect(
        ExhaustivePlanner(2),
        world,
        context="step",
        state=world.reset(12, seeded(1)),
        min_score=0.6,
        generator=seeded(0),
    )
    found["with a least score"] = [better.actions, better.context, better.group]
    prior = MarkovPrior(4, 2)
    rounds = extend_horizon(
        prior, plans, world, (5, 7), num_starts=20, num_plans=16, temperatures=(1.0, 2.0),
        uniform_shares=(0.0, 0.2), min_score=0.3, generator=seeded(2),
    )  # fmt: skip
    found["rounds"] = [[one.length, one.plans.actions] for one in rounds]
    found["learned"] = prior.transition_matrix()
    tuned = best_sampling(prior, world, world.reset(20, seeded(3)), 6, 16, generator=seeded(4))
    found["tuned"] = [tuned.temperature, tuned.uniform_share, {str(key): one for key, one in tuned.scores.items()}]
    found["weights"] = search_weights(torch.tensor([-1.0, -3.0, -9.0]), 8)
    tiles = sliding_tiles(sliding_tiles(shape=(3, 3), scramble=8).reset(20, seeded(3)))
    learner = LogLinearPrior(4, len(tiles.windows.windows))
    found["bootstrap"] = [
        sweep._replace(search_seconds=0, fit_seconds=0)
        for sweep in bootstrap(
            tiles, learner, tiles.boards, max_nodes=60, sweeps=2, first=15, generator=seeded(0), epochs=1
        )
    ]
    found["weights of patterns"] = learner.weights.double()
    return found


@case(relative=2e-3)
def agents():
    world, found = gridworld(5, 5, "torus"), {}
    for name, make, more in (
        ("counts", lambda: MarkovPrior(4, 2), {}),
        ("network", lambda: GRUPrior(4, 8, window=4, seed=1), {"training": {"max_steps": 3, "progress": False}}),
        ("cold", lambda: MarkovPrior(4, 1), {"warm_start": False, "retention": 0.5, "min_score": 0.5}),
    ):

        def agent(generator=0, make=make, more=more):
            prior = make()
            planner = SamplingPlanner(prior, 6, 8, objective="return", discount=0.9)
            return Agent(
                world, planner, prior, world.reset(4, seeded(7)), replan_every=2,
                learn_every=12, plan_length=6, generator=seeded(generator), **more,
            )  # fmt: skip

        one = agent()
        done = one.run(24)
        with TemporaryDirectory() as folder:
            save_agent(one, folder)
            again = restore_agent(agent(1), folder)
        found[name] = [done.actions, done.rewards, done.model_steps, one.time, again.time, again.run(4).actions]
        found[name] += [one.replay.plans.actions, one.prior.log_prob(behaviour(4, 6, 4).actions)]
    return found
