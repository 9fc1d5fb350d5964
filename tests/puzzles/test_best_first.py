"""Best-first search: against a plain search with a heap, in puzzles also the compiled loop, and its bound."""

import heapq
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from neuroprior import GRUPrior, MarkovPrior, Plans, TabularWorld, TransformerPrior, UniformPrior, collect
from neuroprior.priors import MixturePrior
from neuroprior.puzzles import (
    AStarPlanner,
    BestFirstPlanner,
    LevinPlanner,
    LogLinearPrior,
    Search,
    format_sokoban,
    sliding_tiles,
    sokoban,
)
from neuroprior.worlds import World, cube, gridworld
from tests.puzzles.worlds.test_sokoban import LEVELS
from tests.support.sources import seeded


class Goal(TabularWorld):
    """A table whose last cell is the goal."""

    has_goal = True

    def solved(self, state: Tensor) -> Tensor:
        return state == self.num_states - 1

    def lower_bound(self, state: Tensor) -> Tensor:
        """Not a bound at all; a search for new minima on a path does not know."""
        return state * 5 % 13


STATES = 600
"""More than a search has room for at first."""


def random_table(seed: int, states: int = STATES) -> Goal:
    """Three actions, of which the first is always legal."""
    generator = seeded(seed)
    table = torch.randint(states, (states, 3), generator=generator)
    legal = (torch.rand(states, 3, generator=generator) < 0.7) | (torch.arange(3) == 0)
    return Goal(table, torch.rand(states, generator=generator), legal)


def far(state: Tensor) -> Tensor:
    """Some heuristic of cells."""
    return (state * 7 % 11).double()


def levin(depth: int, log_prob: float, left: float) -> float:
    return math.log(depth + 1 + left) - (1 + left / (depth + 1)) * log_prob


def plain(
    world: Any, planner: BestFirstPlanner, prior: Any, start: Tensor, cost: Callable[..., float]
) -> tuple[int, list[int] | None, float]:
    """Expansions, the plan that reaches the goal (None: none does) and its bound.

    Of each root on a path its nodes hold the actions since then and their log-probability: the lowest cost counts, with
    a heuristic that from the last root. The bound is the highest d / pi on the way times the number of roots.
    """
    if bool(world.solved(start[None])[0]):
        return 0, [], 0.0
    seen, queue, nodes, roots = {str(start.tolist())}, list[tuple[float, int]](), list[Any](), 0
    heuristic = planner.heuristic

    def expand(
        state: Tensor, logits: Tensor, hidden: Tensor, path: list[int], since: Any, least: float, c: float
    ) -> None:
        nonlocal roots
        bound = float(world.lower_bound(state)) if planner.reroot else 0.0
        if bound < least:
            since, least, roots = [*since, (0, 0.0)], bound, roots + 1
        own = torch.log_softmax(logits.double() / planner.temperature, -1)[0].tolist()
        after = [[(d + 1, log_prob + own[action]) for d, log_prob in since] for action in range(world.num_actions)]
        for action in range(world.num_actions):
            if bool(world.legal_actions(state)[0, action]):
                reached = world.step(state, torch.tensor([action]))[0]
                left = 0.0 if heuristic is None else float(heuristic(reached))
                key = min(cost(*one, left) for one in after[action][-1 if heuristic else 0 :])
                heapq.heappush(queue, (key, len(nodes) * world.num_actions + action))
        nodes.append((state, hidden, path, after, least, c))

    expand(start[None], *prior.start(1), [], [], math.inf, 0.0)
    while queue and len(nodes) < planner.max_nodes:
        number, action = divmod(heapq.heappop(queue)[1], world.num_actions)
        state, hidden, path, after, least, c = nodes[number]
        reached = world.step(state, torch.tensor([action]))[0]
        if str(reached[0].tolist()) in seen:
            continue
        seen.add(str(reached[0].tolist()))
        path, c = [*path, action], max(c, min(levin(*one, 0) for one in after[action]))
        if bool(world.solved(reached)[0]):
            return len(nodes), path, math.log(roots) + c
        expand(reached, *prior.step(torch.tensor([action]), hidden), path, after[action], least, c)
    return len(nodes), None, math.inf


def check_plain(world: Any, planner: BestFirstPlanner, prior: Any, state: Tensor, cost: Callable[..., float]) -> int:
    """A search finds what the plain one does, in no more expansions than its bound; how many problems are solved."""
    found = planner.search(world, state)
    check_found(world, state, found)
    for n, start in enumerate(state):
        expansions, plan, bound = plain(world, planner, prior, start, cost)
        assert int(found.expansions[n]) == expansions
        assert bool(found.solved[n]) == (plan is not None)
        assert float(found.log_bound[n]) == pytest.approx(bound, rel=1e-5)
        assert plan is None or found.plan[n, : int(found.lengths[n])].tolist() == plan
    if planner.heuristic is None and cost is levin:
        assert bool((found.expansions <= found.log_bound.exp() + 1e-6).all())
    return int(found.solved.sum())


def check_found(world: World, state: Tensor, found: Search) -> None:
    """Plans lead where the search says, and gain what it says."""
    now, score = state.clone(), torch.zeros(len(state), dtype=torch.float64)
    for t in range(found.plan.shape[1]):
        on = found.lengths > t
        now[on], reward = world.step(now[on], found.plan[on, t].long())
        score[on] += reward.double()
    assert now.equal(found.final_state)
    assert torch.allclose(score, found.score)
    assert world.solved(now).equal(found.solved)


@pytest.mark.parametrize("heuristic", [None, far], ids=["blind", "informed"])
@pytest.mark.parametrize("kind", ["levin", "heated", "rerooted", "additive"])
def test_searches_are_those_of_a_heap(kind: str, heuristic: Any) -> None:
    prior = MarkovPrior(3, 2).fit(torch.randint(3, (30, 5), generator=seeded(0)))
    how = {"heated": {"temperature": 3.0}, "rerooted": {"reroot": True}}.get(kind, {})
    for seed in range(2):
        state = torch.randint(STATES, (4,), generator=seeded(seed))
        state[0] = STATES - 1  # solved already
        for budget in (1, 30, 500):
            planner: BestFirstPlanner = LevinPlanner(prior, budget, heuristic=heuristic, **how)  # type: ignore[arg-type]
            cost: Callable[..., float] = levin
            if kind == "additive":
                planner, cost = AStarPlanner(heuristic, 2.0, budget), lambda depth, _, left: depth + 2 * left
            solved = check_plain(
                random_table(seed), planner, prior if kind != "additive" else UniformPrior(3), state, cost
            )
            assert solved > (budget == 500)


@pytest.mark.parametrize(
    "prior",
    [
        GRUPrior(3, hidden_size=8, window=3, seed=1),
        TransformerPrior(3, width=16, num_layers=1, num_heads=2, seed=1),
        MixturePrior(3, [GRUPrior(3, hidden_size=8, window=5, seed=2), MarkovPrior(3, 2)]),
    ],
    ids=["gru", "transformer", "mixture"],
)
def test_priors_whose_states_grow_search_as_others(prior: Any) -> None:
    state = torch.randint(200, (5,), generator=seeded(0))
    assert check_plain(random_table(0, 200), LevinPlanner(prior.eval(), 120), prior, state, levin) > 1


class Tree(Goal):
    """A binary tree whose goal is the last leaf: of the start 2n steps away on paper, and no nearer beside its path."""

    def __init__(self, height: int) -> None:
        states = torch.arange(2 ** (height + 1) - 1)
        inner = states < 2**height - 1
        children = torch.where(inner[:, None], 2 * states[:, None] + torch.tensor([1, 2]), states[:, None])
        super().__init__(children, torch.zeros(len(states)))
        self.bound = torch.full_like(states, height)
        levels = torch.arange(height + 1)
        self.bound[2 ** (levels + 1) - 2] = height - levels

    def lower_bound(self, state: Tensor) -> Tensor:
        return self.bound[state]


def test_rerooting_needs_as_many_expansions_as_there_are_siblings_on_the_way() -> None:
    for height in (1, 4, 6):
        world, start = Tree(height), torch.tensor([0])
        blind = LevinPlanner(UniformPrior(2), 10_000).search(world, start)
        assert blind.expansions.tolist() == [2 ** (height + 1) - 2]
        found = LevinPlanner(UniformPrior(2), 10_000, reroot=True).search(world, start)
        assert found.expansions.tolist() == [2 * height]
        assert found.plan.tolist() == [[1] * height]
        assert float(found.log_bound) == pytest.approx(math.log(height * 2 / 0.5))


def test_a_star_finds_shortest_plans() -> None:
    world = cube()
    state = world.reset(4, seeded(0))
    found = AStarPlanner(world.distance, 1.0, 2000).search(world, state)
    assert found.solved.all()
    assert found.lengths.equal(world.distance(state))
    # With an exact heuristic greedy search expands the nodes on its way and no others.
    greedy = AStarPlanner(world.distance, math.inf, 2000).search(world, state)
    assert greedy.expansions.equal(world.distance(state))
    breadth = AStarPlanner(None, 1.0, 300).search(world, state)
    assert bool((breadth.lengths[breadth.solved] == world.distance(state)[breadth.solved]).all())


def puzzle_plans(world: Any, state: Tensor) -> Plans:
    """Random plans with the patterns on their way."""
    actions = torch.randint(4, (len(state), 12), generator=seeded(2))
    states = world.rollout(state, actions[:, None], keep_states=True).states
    seen = [world.observe(state), *(world.observe(states[:, 0, t]) for t in range(11))]
    return Plans(actions, 4, context=torch.stack(seen, 1))


EASY = "##########\n#@ $ .   #\n" + 8 * "##########\n"

PUZZLES: dict[str, Callable[[], Any]] = {
    "sokoban": lambda: sokoban([*map(format_sokoban, sokoban(LEVELS).boards[:3]), EASY]),
    "tiles": lambda: sliding_tiles(sliding_tiles(shape=(3, 4), scramble=14).reset(4, seeded(3))),
}


@pytest.mark.parametrize("puzzle", PUZZLES)
def test_the_compiled_search_finds_what_the_one_in_torch_does(puzzle: str) -> None:
    world = PUZZLES[puzzle]()
    learned = LogLinearPrior(4, len(world.windows.windows)).fit(puzzle_plans(world, world.boards), generator=seeded(0))
    budget = {"sokoban": 40, "tiles": 100}[puzzle]
    bound, uniform, solved = world.lower_bound, UniformPrior(4), 0
    after_last = LogLinearPrior(4, len(world.windows.windows))  # no pattern is known
    after_last.after[:, 0] = torch.arange(5.0)
    planners: dict[str, BestFirstPlanner] = {
        "uniform": LevinPlanner(uniform, budget),
        "learned": LevinPlanner(learned, budget),
        "last actions": LevinPlanner(after_last, budget),
        "heated": LevinPlanner(learned, budget, temperature=3.0),
        "informed": LevinPlanner(learned, budget, heuristic=bound),
        "uniform, rerooted": LevinPlanner(uniform, budget, reroot=True),
        "rerooted": LevinPlanner(learned, budget, reroot=True),
        "informed, rerooted": LevinPlanner(learned, budget, heuristic=bound, reroot=True),
        "breadth first": AStarPlanner(None, 1.0, budget),
        **{f"additive, {weight}": AStarPlanner(bound, weight, budget) for weight in (1.0, 3.0, math.inf)},
    }
    expansions = {}
    for name, planner in planners.items():
        compiled = planner.search(world, world.boards)
        check_found(world, world.boards, compiled)
        planner.order = None  # the compiled loop does not know it
        stepped = planner.search(world, world.boards)
        for field in ("solved", "expansions", "lengths", "plan", "final_state", "model_steps"):
            assert getattr(compiled, field).equal(getattr(stepped, field)), (name, field)
        assert torch.allclose(compiled.log_bound, stepped.log_bound)
        expansions[name] = tuple(compiled.expansions.tolist())
        solved += int(compiled.solved.sum())
    assert solved > 3
    if puzzle == "tiles":
        assert len({expansions[name] for name in ("uniform", "last actions", "learned", "heated")}) == 4


def test_an_order_of_ones_own_is_not_searched_by_the_compiled_loop() -> None:
    class LastFirst(BestFirstPlanner):
        def cost(self, depth: Tensor, log_prob: Tensor, left: Tensor) -> Tensor:
            return -depth.double()

    world = PUZZLES["tiles"]()
    deep = LastFirst(None, 30).search(world, world.boards)
    assert bool((deep.expansions[~deep.solved] == 30).all())
    assert not deep.expansions.equal(AStarPlanner(None, 1.0, 30).search(world, world.boards).expansions)


def test_an_unsolved_problem_gets_the_plan_to_its_best_node() -> None:
    world = sokoban(["########\n#@ $  .#\n########"])
    for planner in (
        LevinPlanner(UniformPrior(4), 4, heuristic=world.lower_bound),
        LevinPlanner(UniformPrior(4), 5, reroot=True),
    ):
        for order in (planner.order, None):
            planner.order = order  # type: ignore[assignment]
            found = planner.search(world, world.boards)
            assert not found.solved.any()
            assert found.plan.tolist() == [[3, 3, 3]]  # the box is one step from the goal
            assert world.lower_bound(found.final_state).tolist() == [1]
    decision = LevinPlanner(UniformPrior(4), 100).plan(world, world.boards)
    assert decision.plan.tolist() == [[3] * 4]
    assert decision.lengths is not None
    assert (decision.lengths.tolist(), decision.score.tolist()) == ([4], [1.0])
    assert decision.model_steps >= 4


def test_of_nodes_with_equal_rewards_the_one_nearest_to_the_goal_is_best() -> None:
    """And one with a higher sum of rewards is better, however far: the goal is not reached within the budget."""
    table = torch.tensor([[1, 2], [3, 3], [4, 4], [3, 3], [4, 4], [5, 5]])
    left = torch.tensor([9.0, 1.0, 5.0, 4.0, 3.0, 0.0])
    for reward, end in (([0.0, 0, 0, 0, 0, 0], 1), ([0.0, 1, 1, 0, 0, 0], 1), ([0.0, 0, 2, 0, 0, 0], 4)):
        world = Goal(table, torch.tensor([reward]))
        found = AStarPlanner(lambda state: left[state].double(), 1.0, 50).search(world, torch.tensor([0]))
        assert not found.solved.any()
        assert found.final_state.tolist() == [end]


def test_any_prior_searches_any_world_with_goals() -> None:
    world = sokoban(["#######\n#@ $ .#\n#######", "#######\n#.$  @#\n#######"])
    for prior in (GRUPrior(4), MarkovPrior(4, 1)):
        found = LevinPlanner(prior, 100).search(world, world.boards)
        assert found.solved.all()
        assert found.lengths.tolist() == [3, 3]
        assert LevinPlanner(prior, 10).search(world, world.boards[:0]).plan.shape == (0, 0)
    assert LevinPlanner(UniformPrior(4), 10).search(world, world.boards[:0]).plan.shape == (0, 0)


def test_plans_of_no_actions_are_collected() -> None:
    tiles, turned = sliding_tiles(shape=(2, 2)), cube()
    plans = collect(LevinPlanner(UniformPrior(4)), tiles, state=tiles.goal[None].repeat(3, 1, 1), context="step")
    assert plans.actions.shape == (3, 0)
    start = torch.zeros(2, dtype=torch.long)
    plans = collect(LevinPlanner(UniformPrior(9)), turned, state=start, context="plan")
    assert plans.actions.shape == (2, 0)
    assert plans.context is not None
    assert plans.context.shape == (2, 0, turned.observe(start).shape[1])


def search_tiles(prior: Any = None, **settings: Any) -> Search:
    """Search boards of 3 x 3; a `bias` is what the first action of the prior gets."""
    world = sliding_tiles(shape=(3, 3), scramble=9)
    if isinstance(prior, float):
        bias, prior = prior, LogLinearPrior(4, len(world.windows.windows))
        prior.after[:, 0] = bias
    return LevinPlanner(prior, **settings).search(world, world.reset(3, seeded(0)))


LARGER = sliding_tiles(shape=(4, 4)).lower_bound


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LevinPlanner(UniformPrior(4)).search(gridworld(3, 3), torch.tensor([0])), "`world` must have goals"),
        (lambda: LevinPlanner(None, reroot=True).search(cube(), torch.tensor([1])), "`reroot` must be False"),  # type: ignore[arg-type]
        (lambda: LevinPlanner(UniformPrior(3)).search(cube(), torch.tensor([1])), "actions"),
        (lambda: LevinPlanner(3), "`prior` must have num_actions"),  # type: ignore[arg-type]
        (lambda: LevinPlanner(UniformPrior(4), 0), "max_nodes"),
        (lambda: LevinPlanner(UniformPrior(4), 10**12), "max_nodes: 1000000000000 would need"),
        (lambda: AStarPlanner(weight=-1.0), "`weight` must be at least 0, got -1.0"),
        (lambda: search_tiles(heuristic=lambda state: state.flatten(1).sum(1) * math.nan), "heuristic"),
        (
            lambda: search_tiles(heuristic=lambda state: -state.flatten(1).sum(1)),
            "`heuristic` must be at least 0, got -36",
        ),
        (lambda: search_tiles(heuristic=LARGER), "`heuristic` must know the states of this world"),
        (lambda: search_tiles(heuristic=cube().distance), "`heuristic` must know the states of this world"),
        (lambda: search_tiles(math.nan), "its logits are NaN"),
        (lambda: search_tiles(math.nan, heuristic=lambda state: state.flatten(1).sum(1)), "its logits are NaN"),
    ],
)
def test_bad_input_is_refused(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_another_world_with_the_same_states_may_help() -> None:
    assert search_tiles(heuristic=sliding_tiles(shape=(3, 3)).lower_bound).solved.all()
