"""Best-first search: against a plain search with a heap, in puzzles against the compiled loop, and its bound."""

import heapq
import math
from collections.abc import Callable
from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor

from neuroprior import (
    GRUPrior,
    MarkovPrior,
    MixturePrior,
    Plans,
    TabularWorld,
    TransformerPrior,
    UniformPrior,
    collect,
)
from neuroprior.priors import Prior
from neuroprior.puzzles import (
    AStarPlanner,
    BestFirstPlanner,
    LevinPlanner,
    LogLinearPrior,
    PatternCounts,
    PatternNetwork,
    Search,
    format_sokoban,
    sliding_tiles,
    sokoban,
)
from neuroprior.worlds import World, cube, gridworld
from tests.puzzles.worlds.test_sokoban import LEVELS


class Goal(TabularWorld):
    """A table whose last cell is the goal."""

    has_goal = True

    def solved(self, state: Tensor) -> Tensor:
        return state == self.num_states - 1

    def lower_bound(self, state: Tensor) -> Tensor:
        """Not a bound at all; a search for new minima on a path does not know."""
        return state * 5 % 13


def random_table(seed: int, states: int = 200) -> Goal:
    """Three actions, of which the first is always legal."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randint(states, (states, 3), generator=generator)
    legal = (torch.rand(states, 3, generator=generator) < 0.7) | (torch.arange(3) == 0)
    return Goal(table, torch.rand(states, generator=generator), legal)


def far(state: Tensor) -> Tensor:
    """Some heuristic of cells."""
    return (state * 7 % 11).double()


def levin(depth: int, log_prob: float, left: float) -> float:
    return math.log(depth + 1 + left) - (1 + left / (depth + 1)) * log_prob


def plain(
    world: Any, prior: Prior, start: Tensor, budget: int, cost: Callable[..., float], heuristic: Any, reroot: bool
) -> tuple[int, list[int] | None, float]:
    """Expansions, the plan that reaches the goal (None: none does) and its bound.

    Of each root on a path its nodes hold the actions since then and their log-probability: the lowest cost counts, with
    a heuristic that from the last root. The bound is the highest d / pi on the way times the number of roots.
    """
    if bool(world.solved(start[None])[0]):
        return 0, [], 0.0
    seen, queue, nodes, roots = {int(start)}, list[tuple[float, int]](), list[Any](), 0

    def expand(
        state: Tensor, logits: Tensor, hidden: Tensor, path: list[int], since: Any, least: float, c: float
    ) -> None:
        nonlocal roots
        bound = float(world.lower_bound(state)) if reroot else 0.0
        if bound < least:
            since, least, roots = [*since, (0, 0.0)], bound, roots + 1
        own = torch.log_softmax(logits.double(), -1)[0].tolist()
        after = [[(d + 1, log_prob + own[action]) for d, log_prob in since] for action in range(world.num_actions)]
        for action in range(world.num_actions):
            if bool(world.legal_actions(state)[0, action]):
                reached = world.step(state, torch.tensor([action]))[0]
                left = 0.0 if heuristic is None else float(heuristic(reached))
                key = min(cost(*one, left) for one in after[action][-1 if heuristic else 0 :])
                heapq.heappush(queue, (key, len(nodes) * world.num_actions + action))
        nodes.append((state, hidden, path, after, least, c))

    expand(start[None], *prior.start(1), [], [], math.inf, 0.0)
    while queue and len(nodes) < budget:
        number, action = divmod(heapq.heappop(queue)[1], world.num_actions)
        state, hidden, path, after, least, c = nodes[number]
        reached = world.step(state, torch.tensor([action]))[0]
        if int(reached) in seen:
            continue
        seen.add(int(reached))
        path, c = [*path, action], max(c, min(levin(*one, 0) for one in after[action]))
        if bool(world.solved(reached)[0]):
            return len(nodes), path, math.log(roots) + c
        expand(reached, *prior.step(torch.tensor([action]), hidden), path, after[action], least, c)
    return len(nodes), None, math.inf


@pytest.mark.parametrize("heuristic", [None, far], ids=["blind", "informed"])
@pytest.mark.parametrize("kind", ["levin", "rerooted", "additive"])
def test_searches_are_those_of_a_heap(kind: str, heuristic: Any) -> None:
    prior: Prior = MarkovPrior(3, 2).fit(torch.randint(3, (30, 5), generator=torch.Generator().manual_seed(0)))
    if kind == "additive":
        prior = UniformPrior(3)
    for seed in range(2):
        world = random_table(seed)
        state = torch.randint(200, (4,), generator=torch.Generator().manual_seed(seed))
        state[0] = 199  # solved already
        for budget in (1, 30, 400):
            planner: BestFirstPlanner = LevinPlanner(prior, budget, heuristic=heuristic, reroot=kind == "rerooted")
            cost: Callable[..., float] = levin
            if kind == "additive":
                planner, cost = AStarPlanner(heuristic, 2.0, budget), lambda depth, _, left: depth + 2 * left
            found = planner.search(world, state)
            for n, start in enumerate(state):
                expansions, plan, bound = plain(world, prior, start, budget, cost, heuristic, planner.reroot)
                assert int(found.expansions[n]) == expansions
                assert bool(found.solved[n]) == (plan is not None)
                assert float(found.log_bound[n]) == pytest.approx(bound)
                if plan is not None:
                    assert found.plan[n, : int(found.lengths[n])].tolist() == plan


GROWING: dict[str, Callable[[], Prior]] = {
    "gru": lambda: GRUPrior(3, hidden_size=8, window=3, seed=1),
    "transformer": lambda: TransformerPrior(3, width=16, num_layers=1, num_heads=2, seed=1),
    "mixture": lambda: MixturePrior(3, [GRUPrior(3, hidden_size=8, window=5, seed=2), MarkovPrior(3, 2)]),
}


@pytest.mark.parametrize("name", GROWING)
def test_priors_whose_states_grow_search_as_others(name: str) -> None:
    prior, world = GROWING[name]().eval(), random_table(0)
    state = torch.randint(200, (5,), generator=torch.Generator().manual_seed(0))
    state[0] = 199  # solved already
    for at_once in (1, 4):
        found = LevinPlanner(prior, 120, nodes_at_once=at_once).search(world, state)
        check_found(world, state, found)
        assert bool((found.expansions <= at_once * found.log_bound.exp() + 1e-6).all())
        for n, start in enumerate(state if at_once == 1 else ()):
            expansions, plan, bound = plain(world, prior, start, 120, levin, None, False)
            assert int(found.expansions[n]) == expansions
            assert float(found.log_bound[n]) == pytest.approx(bound, rel=1e-5)
            if plan is not None:
                assert found.plan[n, : int(found.lengths[n])].tolist() == plan
    assert found.solved.sum() > 2


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


@pytest.mark.slow
def test_no_solution_takes_more_expansions_than_its_bound() -> None:
    generator = torch.Generator().manual_seed(1)
    prior = MarkovPrior(3, 1).fit(torch.randint(3, (30, 5), generator=generator))
    solved = 0
    for seed in range(5):
        world = random_table(seed)
        state = torch.randint(200, (40,), generator=generator)
        for at_once, reroot in ((1, False), (8, False), (1, True), (8, True)):
            found = LevinPlanner(prior, 300, nodes_at_once=at_once, reroot=reroot).search(world, state)
            check_found(world, state, found)
            assert bool((found.expansions <= at_once * found.log_bound.exp() + 1e-6).all())
            solved += int(found.solved.sum())
    assert solved > 200


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
    state = world.reset(4, torch.Generator().manual_seed(0))
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
    actions = torch.randint(4, (len(state), 12), generator=torch.Generator().manual_seed(2))
    seen = []
    for t in range(12):
        seen.append(world.observe(state))
        state, _ = world.step(state, actions[:, t])
    return Plans(actions, 4, context=torch.stack(seen, 1))


EASY = "##########\n#@ $ .   #\n" + 8 * "##########\n"

PUZZLES = {
    "sokoban": lambda: sokoban([*map(format_sokoban, sokoban(LEVELS).boards[:3]), EASY]),
    "tiles": lambda: sliding_tiles(sliding_tiles(shape=(3, 4), scramble=14).reset(4, torch.Generator().manual_seed(3))),
}


@pytest.mark.parametrize("puzzle", PUZZLES)
def test_the_compiled_search_finds_the_same(puzzle: str) -> None:
    world = PUZZLES[puzzle]()
    state, patterns = world.boards, len(world.windows.windows)
    plans = puzzle_plans(world, state)
    generator = torch.Generator().manual_seed(0)
    learned = [LogLinearPrior(4, patterns), PatternCounts(4, patterns), PatternNetwork(4, patterns, size=4)]
    learned.append(LogLinearPrior(4, patterns, use_last=False))
    planners: list[BestFirstPlanner] = [
        LevinPlanner(prior, 40)
        for prior in (UniformPrior(4), *(prior.fit(plans, generator=generator) for prior in learned))
    ]
    planners += [LevinPlanner(learned[0], 40, heuristic=world.lower_bound)]
    planners += [LevinPlanner(prior, 40, reroot=True) for prior in (UniformPrior(4), learned[0])]
    planners += [LevinPlanner(learned[0], 40, heuristic=world.lower_bound, reroot=True)]
    planners += [AStarPlanner(world.lower_bound, weight, 40) for weight in (1.0, 3.0, math.inf)]
    planners += [AStarPlanner(None, 1.0, 40)]
    solved = 0
    for planner in planners:
        compiled = planner.search(world, state)
        check_found(world, state, compiled)
        planner.compile = False
        stepped = planner.search(world, state)
        for name in ("solved", "expansions", "lengths", "plan", "final_state", "model_steps"):
            assert getattr(compiled, name).equal(getattr(stepped, name)), (planner, name)
        assert torch.allclose(compiled.log_bound, stepped.log_bound)
        solved += int(compiled.solved.sum())
    assert solved > 3


def test_an_unsolved_problem_gets_the_plan_to_its_best_node() -> None:
    world = sokoban(["########\n#@ $  .#\n########"])
    state = world.boards
    planners = (
        LevinPlanner(UniformPrior(4), 4, heuristic=world.lower_bound),
        LevinPlanner(UniformPrior(4), 5, reroot=True),
    )
    for planner, compiled in product(planners, (True, False)):
        planner.compile = compiled
        found = planner.search(world, state)
        assert not found.solved.any()
        assert found.plan.tolist() == [[3, 3, 3]]  # the box is one step from the goal
        assert world.lower_bound(found.final_state).tolist() == [1]
    decision = LevinPlanner(UniformPrior(4), 100).plan(world, state)
    assert decision.plan.tolist() == [[3] * 4]
    assert decision.lengths is not None
    assert (decision.lengths.tolist(), decision.score.tolist()) == ([4], [1.0])
    assert decision.model_steps >= 4


def test_any_prior_searches_any_world_with_goals() -> None:
    level = ["#######\n#@ $ .#\n#######", "#######\n#.$  @#\n#######"]
    for prior in (GRUPrior(4), MarkovPrior(4, 1)):
        found = LevinPlanner(prior, 100).search(sokoban(level), sokoban(level).boards)
        assert found.solved.all()
        assert found.lengths.tolist() == [3, 3]
    for compile in (True, False):
        planner = LevinPlanner(UniformPrior(4), 10, compile=compile)
        assert planner.search(sokoban(level), sokoban(level).boards[:0]).plan.shape == (0, 0)
    assert LevinPlanner(UniformPrior(9), 10).plan(cube(), torch.tensor([0])).lengths.tolist() == [0]  # type: ignore[union-attr]


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="with goals"):
        LevinPlanner(UniformPrior(4)).search(gridworld(3, 3), torch.tensor([0]))
    with pytest.raises(ValueError, match="lower_bound"):
        LevinPlanner(UniformPrior(9), reroot=True).search(cube(), torch.tensor([1]))
    with pytest.raises(ValueError, match="max_nodes"):
        LevinPlanner(UniformPrior(4), 0)
    with pytest.raises(ValueError, match="weight"):
        AStarPlanner(weight=-1.0)
    with pytest.raises(ValueError, match="actions"):
        LevinPlanner(UniformPrior(3)).search(cube(), torch.tensor([1]))
    with pytest.raises(ValueError, match="max_nodes: 1000000000000 would need"):
        LevinPlanner(UniformPrior(4), 10**12)
    with pytest.raises(ValueError, match="heuristic: a function"):
        AStarPlanner("manhattan")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="heuristic: one number for each"):
        LevinPlanner(UniformPrior(9), heuristic=lambda state: state.double() * math.nan).search(
            cube(), torch.tensor([5])
        )


def test_heuristics_of_other_worlds_are_refused() -> None:
    small, large, levels = sliding_tiles(shape=(3, 3)), sliding_tiles(shape=(4, 4)), sokoban(["####\n#@.#\n#$ #\n####"])
    pairs = [(small, large.lower_bound), (large, small.lower_bound), (large, levels.lower_bound)]
    for world, heuristic in (*pairs, (levels, large.lower_bound), (small, cube().distance)):
        for planner in (AStarPlanner(heuristic), LevinPlanner(UniformPrior(4), heuristic=heuristic)):
            with pytest.raises(ValueError, match=r"heuristic: it is that of another world \(state"):
                planner.search(world, world.reset(2))
    # Another world with the same states may help.
    assert AStarPlanner(sliding_tiles(shape=(3, 3)).lower_bound).search(small, small.goal[None]).solved.all()


def test_plans_of_no_actions_are_collected() -> None:
    world = sliding_tiles(shape=(2, 2))
    start = world.goal[None].repeat(3, 1, 1)
    for context in (None, "step"):
        plans = collect(LevinPlanner(UniformPrior(4)), world, state=start, context=context)  # type: ignore[arg-type]
        assert plans.actions.shape == (3, 0)
    turned = cube()
    plans = collect(LevinPlanner(UniformPrior(9)), turned, state=torch.zeros(2, dtype=torch.long), context="plan")
    assert plans.actions.shape == (2, 0)
    assert plans.context is not None
    assert plans.context.equal(turned.observe(torch.zeros(2, dtype=torch.long)))


def test_numbers_that_order_nothing_are_refused() -> None:
    world = sliding_tiles(sliding_tiles(shape=(3, 3), scramble=9).reset(3, torch.Generator().manual_seed(0)))
    prior = LogLinearPrior(4, len(world.windows.windows))
    with pytest.raises(ValueError, match="heuristic: numbers of at least 0"):
        LevinPlanner(prior, heuristic=lambda state: -world.lower_bound(state)).search(world, world.boards)
    prior.after[:] = math.nan
    for compile in (True, False):
        with pytest.raises(ValueError, match=r"prior: .* are NaN"):
            LevinPlanner(prior, compile=compile).search(world, world.boards)


def test_last_actions_count_where_no_pattern_is_known() -> None:
    """The compiled search leaves out what makes no difference, and nothing else."""
    world = sliding_tiles(sliding_tiles(shape=(3, 3), scramble=6).reset(8, torch.Generator().manual_seed(0)))
    prior = LogLinearPrior(4, len(world.windows.windows))
    prior.after[:, 0] = 1.0
    planner = LevinPlanner(prior, 100)
    compiled = planner.search(world, world.boards)
    planner.compile = False
    assert compiled.expansions.equal(planner.search(world, world.boards).expansions)
    assert not compiled.expansions.equal(LevinPlanner(UniformPrior(4), 100).search(world, world.boards).expansions)


class Heated:
    """A prior whose logits are divided by a temperature."""

    def __init__(self, prior: Prior, temperature: float) -> None:
        self.prior, self.temperature = prior, temperature
        self.num_actions, self.context_per, self.device = prior.num_actions, prior.context_per, prior.device

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.start(batch_size, context)
        return logits / self.temperature, state

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits, state = self.prior.step(action, state, context)
        return logits / self.temperature, state

    def check_context_of(self, context: Tensor | None, num_plans: int = 0, length: int = 0) -> None:
        self.prior.check_context_of(context, num_plans, length)


@pytest.mark.parametrize("temperature", [0.3, 3.0])
@pytest.mark.parametrize("kind", ["table", "puzzle"])
def test_the_temperature_divides_the_logits(kind: str, temperature: float) -> None:
    """In tables, and in puzzles with a prior of patterns, which the compiled loop could search with."""
    if kind == "table":
        world: Any = random_table(0)
        state = torch.arange(6)
        prior: Any = MarkovPrior(3, 2).fit(torch.randint(3, (30, 5), generator=torch.Generator().manual_seed(0)))
        same = LevinPlanner(Heated(prior, temperature), 80).search(world, state)
    else:
        world = sliding_tiles(sliding_tiles(shape=(3, 3), scramble=12).reset(3, torch.Generator().manual_seed(1)))
        state = world.boards
        prior = LogLinearPrior(4, len(world.windows.windows))
        prior.fit(puzzle_plans(world, state), generator=torch.Generator().manual_seed(0))
        same = LevinPlanner(prior, 80, temperature=temperature, compile=False).search(world, state)
    warm = LevinPlanner(prior, 80, temperature=temperature).search(world, state)
    cold = LevinPlanner(prior, 80).search(world, state)
    assert warm.expansions.equal(same.expansions)
    assert warm.plan.equal(same.plan)
    assert not warm.expansions.equal(cold.expansions)


def test_of_nodes_with_equal_rewards_the_one_nearest_to_the_goal_is_best() -> None:
    """And one with a higher sum of rewards is better, however far: the goal is not reached within the budget."""
    table = torch.tensor([[1, 2], [3, 3], [4, 4], [3, 3], [4, 4], [5, 5]])

    left = torch.tensor([9.0, 1.0, 5.0, 4.0, 3.0, 0.0])
    for reward, end in (([0.0, 0, 0, 0, 0, 0], 1), ([0.0, 1, 1, 0, 0, 0], 1), ([0.0, 0, 2, 0, 0, 0], 4)):
        world = Goal(table, torch.tensor([reward]))
        found = AStarPlanner(lambda state: left[state].double(), 1.0, 50).search(world, torch.tensor([0]))
        assert not found.solved.any()
        assert found.final_state.tolist() == [end]
