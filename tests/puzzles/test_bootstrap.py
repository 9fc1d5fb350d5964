"""Solve and learn: more gets solved, and an interrupted call goes on as if nothing had happened."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, Prior, World
from neuroprior.puzzles import (
    AStarPlanner,
    BestFirstPlanner,
    LevinPlanner,
    LogLinearPrior,
    SlidingTilesWorld,
    Steps,
    bootstrap,
    sliding_tiles,
    sokoban,
)
from neuroprior.puzzles.bootstrap import read_solutions, solution_plans, solution_steps, with_symmetries
from neuroprior.worlds import Categories, cube
from tests.puzzles.worlds.test_sokoban import LEVELS
from tests.support.sources import seeded


def tiles(number: int = 60) -> SlidingTilesWorld:
    return sliding_tiles(sliding_tiles(shape=(3, 3), scramble=40).reset(number, seeded(1)))


def prior_for(world: Any) -> LogLinearPrior:
    return LogLinearPrior(4, len(world.windows.windows))


def test_what_is_learned_solves_more_with_less() -> None:
    world, held_out = tiles(), sliding_tiles(shape=(3, 3), scramble=40).reset(60, seeded(2))
    prior = prior_for(world)
    before = LevinPlanner(prior, 500).search(world, held_out)
    sweeps = list(bootstrap(world, prior, world.boards, max_nodes=500, sweeps=4, generator=seeded(0)))
    after = LevinPlanner(prior, 500).search(world, held_out)
    assert [sweep.number for sweep in sweeps] == [1, 2, 3, 4]
    assert sweeps[-1].solved > sweeps[0].solved
    assert float(after.solved.double().mean()) > float(before.solved.double().mean()) + 0.2
    assert float(after.expansions.double().mean()) < 0.7 * float(before.expansions.double().mean())


def check_solution(world: World, start: Tensor, plan: Tensor) -> None:
    state = start[None]
    for action in plan.tolist():
        state, _ = world.step(state, torch.tensor([action]))
    assert world.solved(state).all()


def test_an_interrupted_call_goes_on(tmp_path: Path) -> None:
    world = tiles(40)
    how: dict[str, Any] = {"max_nodes": 300, "epochs": 2}
    whole, parts = prior_for(world), prior_for(world)
    once = list(bootstrap(world, whole, world.boards, sweeps=3, generator=seeded(0), **how))
    some = bootstrap(world, parts, world.boards, sweeps=3, generator=seeded(0), folder=tmp_path, **how)
    next(some), next(some)  # and then it is killed
    again = prior_for(world)
    resumed = list(bootstrap(world, again, world.boards, sweeps=3, generator=seeded(9), folder=tmp_path, **how))
    seconds = {"search_seconds": 0.0, "fit_seconds": 0.0}
    assert [sweep._replace(**seconds) for sweep in resumed] == [sweep._replace(**seconds) for sweep in once]
    assert again.weights.equal(whole.weights)
    solutions = read_solutions(tmp_path)
    assert len(solutions) == resumed[-1].solutions
    for number, plan in solutions.items():
        check_solution(world, world.boards[number], plan)
    one = prior_for(world)
    first = list(bootstrap(world, one, world.boards, sweeps=1, folder=tmp_path, **how))
    assert [sweep.solutions for sweep in first] == [once[0].solutions]
    alone = prior_for(world)
    list(bootstrap(world, alone, world.boards, sweeps=1, generator=seeded(0), **how))
    assert one.weights.equal(alone.weights)
    rarer = LogLinearPrior(4, len(world.windows.windows), min_count=3)
    for prior, problems, other, message in (
        (prior_for(world), world.boards[:10], {}, "the same call"),
        (prior_for(world), world.boards.flip(0), {}, "the same call"),
        (prior_for(world), world.boards, {"epochs": 3}, "the same call"),
        (prior_for(world), world.boards, {"max_actions": 10}, "the same call"),
        (prior_for(world), world.boards, {"teacher": AStarPlanner(world.lower_bound)}, "the same call"),
        (prior_for(world), world.boards, {"l2": 0.5}, "the same call"),
        (rarer, world.boards, {}, "`folder` must hold LogLinearPrior"),
    ):
        with pytest.raises(ValueError, match=message):
            list(bootstrap(world, prior, problems, folder=tmp_path, **how | other))


@pytest.mark.parametrize(
    "make",
    [
        lambda: GRUPrior(4),
        lambda: CombinedPrior(4, [MarkovPrior(4, 1)]),
        lambda: CombinedPrior(4, [MarkovPrior(4, 0), MarkovPrior(4, 1)]),
    ],
    ids=["network", "one expert", "several experts"],
)
def test_what_a_fit_chooses_does_not_keep_a_prior_from_going_on(make: Callable[[], Prior], tmp_path: Path) -> None:
    world = sliding_tiles(shape=(2, 2), scramble=6)
    problems, plans = world.reset(60, seeded(0)), torch.randint(4, (5, 6), generator=seeded(1))
    how: dict[str, Any] = {"max_steps": 2, "progress": False} if isinstance(make(), GRUPrior) else {}
    first, again = make(), make()
    for prior in (first, again):
        list(bootstrap(world, prior, problems, sweeps=1, generator=seeded(0), folder=tmp_path, **how))
    assert again.log_prob(plans).equal(first.log_prob(plans))


def test_other_validation_plans_are_another_call(tmp_path: Path) -> None:
    world = sliding_tiles(shape=(2, 2), scramble=6)
    problems = world.reset(60, seeded(0))
    how: dict[str, Any] = {"sweeps": 1, "max_steps": 2, "progress": False, "folder": tmp_path}
    validation = Plans(torch.zeros(6, 5, dtype=torch.long), 4)
    list(bootstrap(world, GRUPrior(4), problems, validation=validation, generator=seeded(0), **how))
    other = Plans(torch.ones(6, 5, dtype=torch.long), 4)
    with pytest.raises(ValueError, match="the same call"):
        list(bootstrap(world, GRUPrior(4), problems, validation=other, **how))


class Line(World):
    """A walk on a line to a place; all such worlds have the same states."""

    num_actions, has_goal, observation = 2, True, Categories(21)

    def observe(self, state: Tensor) -> Tensor:
        return state

    def __init__(self, goal: int) -> None:
        self.goal = goal

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.randint(10, (batch_size,), generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        after = torch.where(self.solved(state), state, (state + 2 * action - 1).clamp(0, 20))
        return after, (after == self.goal).float() * ~self.solved(state)

    def solved(self, state: Tensor) -> Tensor:
        return state == self.goal

    def terminated(self, state: Tensor) -> Tensor:
        return self.solved(state)


def test_another_world_or_teacher_is_another_call(tmp_path: Path) -> None:
    start = torch.arange(3, 9)

    def call(goal: int, teacher: BestFirstPlanner | None) -> list[Any]:
        how: dict[str, Any] = {"sweeps": 2, "first": 6, "max_nodes": 500, "folder": tmp_path, "teacher": teacher}
        return list(bootstrap(Line(goal), MarkovPrior(2, 1), start, generator=seeded(0), **how))

    def left(state: Tensor) -> Tensor:
        return state.double()

    done = call(0, AStarPlanner(left, max_nodes=50))
    assert call(0, AStarPlanner(left, max_nodes=50)) == done
    with pytest.raises(ValueError, match="solutions in this world"):
        call(12, AStarPlanner(left, max_nodes=50))
    for other in (
        None,
        AStarPlanner(left, max_nodes=50, weight=3.0),
        AStarPlanner(left, max_nodes=60),
        AStarPlanner(None, max_nodes=50),
        LevinPlanner(MarkovPrior(2, 1), max_nodes=50),
    ):
        with pytest.raises(ValueError, match="the same call"):
            call(0, other)


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"asked": {}, "sweeps": [], "generator": []}', '{"sweeps": [3]}'])
def test_damaged_folders_are_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / "sweeps.json").write_text(content)
    world = tiles(2)
    for read in (
        lambda: read_solutions(tmp_path),
        lambda: list(bootstrap(world, prior_for(world), world.boards, folder=tmp_path)),
    ):
        with pytest.raises(ValueError, match=r"sweeps\.json: (it must hold sweeps|not JSON)"):
            read()
    (tmp_path / "solutions-1.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match=r"solutions-1\.safetensors: it must hold solutions"):
        read_solutions(tmp_path, 1)


def test_problems_that_are_solved_at_the_start_teach_nothing() -> None:
    world, prior = tiles(4), prior_for(tiles(4))
    state = torch.cat([world.goal[None], world.boards])
    sweeps = list(bootstrap(world, prior, state, max_nodes=1, first=1, sweeps=2, generator=seeded(0)))
    assert [(sweep.solutions, sweep.actions) for sweep in sweeps] == [(1, 0), (1, 0)]
    assert not prior.after.any()


def test_the_budget_and_the_problems_grow() -> None:
    world = sliding_tiles(sliding_tiles(shape=(3, 3), scramble=8).reset(100, seeded(3)))
    sweeps = list(
        bootstrap(world, prior_for(world), world.boards, max_nodes=50, first=10, sweeps=5, generator=seeded(0))
    )
    assert [sweep.problems for sweep in sweeps[:2]] == [10, 40 if sweeps[0].solved >= 0.75 else 10]
    assert sweeps[-1].problems == 100
    for one, other in pairwise(sweeps):
        assert other.max_nodes in (one.max_nodes, 2 * one.max_nodes)
        assert other.max_nodes == 2 * one.max_nodes or other.problems == one.problems
    assert sweeps[-1].solutions > 90


def test_where_nothing_is_solved_the_budget_grows(tmp_path: Path) -> None:
    world = tiles(10)
    sweeps = list(
        bootstrap(world, prior_for(world), world.boards, max_nodes=2, sweeps=12, folder=tmp_path, generator=seeded(0))
    )
    assert sweeps[0].solutions == sweeps[0].actions == 0
    assert [sweep.max_nodes for sweep in sweeps[:3]] == [2, 4, 8]
    assert sweeps[-1].solutions > 0
    assert len(read_solutions(tmp_path)) == sweeps[-1].solutions


def test_a_teacher_and_a_heuristic_help() -> None:
    world = tiles(30)
    teacher = AStarPlanner(world.lower_bound, 3.0, 2000)
    prior = prior_for(world)
    sweeps = list(
        bootstrap(world, prior, world.boards, max_nodes=20, sweeps=2, teacher=teacher, guided=True, generator=seeded(0))
    )
    assert sweeps[0].solved == 1.0
    assert (sweeps[0].max_nodes, sweeps[1].max_nodes) == (2000, 20)


def test_symmetries_of_solutions_are_solutions() -> None:
    corner, side = ([[1, 2, 3], [4, 5, 6], [7, 8, 0]], [[1, 0, 2], [3, 4, 5], [6, 7, 8]])
    others = [sliding_tiles(goal=goal, scramble=30) for goal in (corner, side)]
    assert [world.symmetries() for world in others] == [2, 1]  # a blank beside the diagonal would go elsewhere
    for world in (tiles(), *others, sokoban(LEVELS)):
        state = world.reset(12, seeded(0)) if world.boards is None else world.boards[:12]
        found = AStarPlanner(world.lower_bound, 5.0, 3000).search(world, state)
        assert found.solved.sum() > 5
        kept = found.solved
        plans = [plan[:length] for plan, length in zip(found.plan[kept], found.lengths[kept], strict=True)]
        states, more = with_symmetries(world, state[kept], plans, 8, seeded(0))
        assert len(more) == world.symmetries() * len(plans)
        for start, plan in zip(states, more, strict=True):
            check_solution(world, start, plan)
        steps = solution_steps(world, states, more)
        same = Steps.of(solution_plans(world, states, more, "step"))
        assert all(one.equal(other) for one, other in zip(steps, same, strict=True))


def unused(state: Tensor) -> Tensor:
    raise AssertionError


@pytest.mark.parametrize(
    ("world", "prior", "how", "message"),
    [
        (tiles(4), None, {"sweeps": 0}, "sweeps"),
        (tiles(4), None, {"max_nodes": 0}, "max_nodes"),
        (tiles(4), None, {"epochs": 0}, "epochs"),
        (tiles(4), None, {"problems": tiles(4).boards[:0]}, "`problems` must hold at least one"),  # type: ignore[index]
        # All of these before the first search:
        (tiles(4), None, {"epoch": 2, "teacher": AStarPlanner(unused)}, "epoch: not a setting"),
        (tiles(4), LogLinearPrior(4, 3), {"teacher": AStarPlanner(unused)}, "3 patterns"),
        (tiles(4), LogLinearPrior(3, 3), {"teacher": AStarPlanner(unused)}, "must have 4 actions"),
        (cube(), MarkovPrior(9, 1), {"problems": torch.tensor([5]), "guided": True}, "`guided` must be False"),
        (
            sliding_tiles(sliding_tiles(shape=(4, 4), scramble=500).reset(3, seeded(0))),
            None,
            {"max_nodes": 5, "sweeps": 3},
            "enough to solve some of 3 problems, got none that 20 expansions solve",
        ),
    ],
)
def test_bad_input_is_refused(world: Any, prior: Any, how: dict[str, Any], message: str) -> None:
    how = {"problems": getattr(world, "boards", None)} | how
    with pytest.raises(ValueError, match=message):
        list(bootstrap(world, prior or prior_for(world), generator=seeded(0), **how))


def test_solutions_are_learned_from_themselves_before_any_symmetry_of_theirs() -> None:
    world = tiles(12)
    plans = [torch.randint(4, (5 + k % 3,), generator=seeded(k), dtype=torch.uint8) for k in range(12)]
    state, same = with_symmetries(world, world.boards, plans, 1, seeded(3))
    assert state.equal(world.boards)
    assert [plan.tolist() for plan in same] == [plan.tolist() for plan in plans]


@pytest.mark.parametrize("guided", [False, True])
def test_a_sweep_searches_with_the_heuristic_where_it_is_guided(guided: bool) -> None:
    """And with the prior as it is, within the budget: as many expansions as of that search."""
    world, state = tiles(20), tiles(20).boards
    heuristic = world.lower_bound if guided else None
    found = LevinPlanner(prior_for(world), 300, heuristic=heuristic).search(world, state)
    (sweep,) = bootstrap(world, prior_for(world), state, max_nodes=300, sweeps=1, guided=guided, epochs=1)
    assert sweep.mean_expansions == pytest.approx(float(found.expansions.double().mean()))
    assert sweep.solved == pytest.approx(float(found.solved.double().mean()))
    assert (sweep.problems, sweep.max_nodes, sweep.solutions) == (20, 300, int(found.solved.sum()))
