"""Every planner passes `check_planner`, and planners that break a rule do not."""

from inspect import isabstract

import pytest
import torch

from neuroprior import (
    ExhaustivePlanner,
    MCTSPlanner,
    Planner,
    SamplingPlanner,
    TabularWorld,
    UniformPrior,
    planners,
)
from neuroprior.planners import Decision, FrontierPlanner
from neuroprior.testing import check_planner
from tests.support.sources import TablePrior, refuses, seeded

HOW = {
    "terminal": {},
    "return": {"objective": "return", "discount": 0.7},
    "prefix": {"any_prefix": True},
    "value": {"objective": "return", "any_prefix": True, "value": lambda state: (state % 7).double()},
}
PLANNERS = {
    "sampling": SamplingPlanner,
    "frontier": FrontierPlanner,
    "mcts": MCTSPlanner,
    "exhaustive": lambda prior, length, number, **how: ExhaustivePlanner(length, **how),
}


@pytest.mark.parametrize("how", HOW.values(), ids=HOW)
@pytest.mark.parametrize("make", PLANNERS.values(), ids=PLANNERS)
def test_planners_conform(make, how):
    check_planner(lambda prior, length, number: make(prior, length, number, **how))


def test_no_planner_is_left_out():
    exported = {getattr(planners, name) for name in planners.__all__}
    kinds = {one for one in exported if isinstance(one, type) and issubclass(one, Planner) and not isabstract(one)}
    assert kinds == {type(make(UniformPrior(2), 2, 3)) for make in PLANNERS.values()}


@pytest.mark.parametrize("make", [MCTSPlanner])
def test_priors_that_hold_all_that_exists_impossible_are_named(make):
    """Where action 0 alone exists, a prior that never takes it."""
    world = TabularWorld(torch.zeros(1, 2, dtype=torch.long), torch.ones(1), torch.tensor([[True, False]]))
    never = torch.tensor([-torch.inf, 0.0])
    prior = TablePrior([never.expand(1, 1, 2), never.expand(1, 2, 2)])
    with refuses("prior"):
        make(prior, 2, 3).plan(world, torch.zeros(2, dtype=torch.long), seeded(0))


class Broken(Planner):
    """Decides as a planner does, and then spoils it."""

    def __init__(self, inner, spoil):
        super().__init__(inner.objective, inner.discount, inner.value, inner.any_prefix)
        self.inner, self.spoil = inner, spoil

    def plan(self, world, state, generator=None):
        return self.spoil(self.inner.plan(world, state, generator))


class Careless(SamplingPlanner):
    """Reads the global generator."""

    def plan(self, world, state, generator=None):
        return super().plan(world, state, generator or torch.Generator().manual_seed(int(torch.rand(()) * 1e6)))


class FirstOfEquals(ExhaustivePlanner):
    """Takes the first of equally good plans."""

    def plan(self, world, state, generator=None):
        found = super().plan(world, state, generator)
        if getattr(world, "num_states", 0) != 13:
            return found
        plan = torch.zeros_like(found.plan)
        now = world.step(world.step(state, plan[:, 0].long())[0], plan[:, 1].long())[0]
        return found._replace(plan=plan, final_state=now)


def spoiled(**changes):
    """`make` for planners whose decisions are changed."""

    def spoil(found: Decision) -> Decision:
        return found._replace(**{name: change(getattr(found, name)) for name, change in changes.items()})

    return lambda prior, length, number: Broken(ExhaustivePlanner(length), spoil)


def totals(prior, length, number):
    """Gives the steps of all starts together."""
    return Broken(
        ExhaustivePlanner(length), lambda found: found._replace(model_steps=found.model_steps * len(found.plan))
    )


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (spoiled(score=lambda score: score + 0.5), "score"),
        (spoiled(score=lambda score: score[:, None]), "shapes"),
        (spoiled(final_state=lambda state: (state + 1) % 12), "final_state"),
        (spoiled(model_steps=lambda steps: steps - 1), "model_steps"),
        (totals, "of one start, at most"),
        (spoiled(plan=lambda plan: 1 - plan), "score|not legal"),
        (spoiled(plan=lambda plan: plan.float()), "`plan` must be integers"),
        (lambda prior, length, number: SamplingPlanner, "`make` must be a Planner"),
        (lambda prior, length, number: Broken(ExhaustivePlanner(length), tuple), "`plan` must be a Decision"),
        (spoiled(lengths=lambda lengths: torch.zeros(20, dtype=torch.long)), "lengths"),
        (lambda prior, length, number: SamplingPlanner(prior, length, 1), "below the best"),
        (Careless, "global generator"),
        (lambda prior, length, number: FirstOfEquals(length), "equally good"),
    ],
    ids=[
        *("score", "shape", "state", "steps", "totals", "plan", "float", "class", "tuple", "lengths"),
        *("bad", "global", "ties"),
    ],
)
def test_planners_that_break_a_rule_fail(make, word):
    with pytest.raises(AssertionError, match=word):
        check_planner(make)
