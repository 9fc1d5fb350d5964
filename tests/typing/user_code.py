"""Typical code of a user, as `mypy --strict` reads it (`make check`); a test runs it.

`assert_type` says what a type checker has to find. A comment `type: ignore[...]` says that a mistake has to be found:
one that is not found makes the comment superfluous, which is an error, too.
"""

from functools import partial
from pathlib import Path
from typing import Any, Self, assert_type

import torch
from torch import Tensor

import neuroprior
from neuroprior import (
    ContextTreePrior,
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Planner,
    Plans,
    Prior,
    SamplingPlanner,
    TabularWorld,
    World,
    collect,
    compare,
    fit,
    gridworld,
    load,
    read_plans,
    save,
    write_plans,
)
from neuroprior.behaviour import DurationModel, mean_interval
from neuroprior.comparison import Comparison
from neuroprior.control import DoubleIntegrator, ICEMPlanner, NoisePrior, VectorDecision, VectorPlans, VectorPrior
from neuroprior.planners import Decision, Execution, execute
from neuroprior.priors.learning import training_plans
from neuroprior.testing import check_planner, check_prior, check_world
from neuroprior.worlds import GridWorld, Rollout


def behaviour(folder: Path) -> MarkovPrior:
    """Plans from a tensor and from a file; fitting, scoring, sampling, saving."""
    plans = Plans(
        torch.tensor([[0, 1, 1], [0, 1, 2]]), 3, action_names=["eat", "rest", "walk"], group=torch.tensor([0, 1])
    )
    write_plans(plans, folder / "plans.jsonl")
    again = read_plans(folder / "plans.jsonl")
    assert_type(again, Plans)
    assert_type(again[:1], Plans)
    assert_type(again.group, Tensor | None)
    prior = MarkovPrior(3, order=1).fit(again)
    assert_type(prior, MarkovPrior)  # fit returns what it was called on
    assert_type(prior.log_prob(again), Tensor)
    assert_type(prior.sample(4, 5, generator=torch.Generator()), Tensor)
    assert_type(load(save(prior, folder / "prior")), Prior)
    assert_type(fit(again, ContextTreePrior), Prior)
    assert_type(fit(again, partial(GRUPrior, hidden_size=8), max_steps=1), Prior)
    assert mean_interval([1.0, 2.0, 4.0]).low < 7 / 3
    return prior


class Cart(World):
    """A world of one's own: a cart that should stand at 0."""

    num_actions = 3

    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        return torch.rand(batch_size, 2, generator=generator)

    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        speed = state[:, 1] + 0.1 * (action - 1)
        position = state[:, 0] + 0.1 * speed
        return torch.stack([position, speed], 1), -(position**2)


class Inertia(Prior):
    """A prior of one's own: repeats the last action with a probability that it learns."""

    repeat: Tensor

    def __init__(self, num_actions: int) -> None:
        super().__init__(num_actions)
        self.register_buffer("repeat", torch.tensor(0.5))

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        return self.repeat.new_zeros(batch_size, self.num_actions), self.repeat.new_empty(batch_size, 0)

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        probs = ((1 - self.repeat) / (self.num_actions - 1)).repeat(len(action), self.num_actions)
        probs[torch.arange(len(action)), action.long()] = self.repeat
        return probs.log(), state

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        self.check_settings(settings)
        actions = training_plans(self, plans).actions
        self.repeat = (actions[:, 1:] == actions[:, :-1]).float().mean()
        return self


class Wrapped(Planner):
    """A planner of one's own, around one of the library."""

    def __init__(self, prior: Prior, length: int, num_plans: int) -> None:
        super().__init__()
        self.inner = SamplingPlanner(prior, length, num_plans)

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        return self.inner.plan(world, state, generator)


def planning(prior: Prior) -> None:
    """A prior in a planner, in a world of the library."""
    world = gridworld(5, 5, edges="torus", seed=0)
    assert_type(world, GridWorld)
    table: TabularWorld = world
    starts = table.reset(3)
    plans = collect(ExhaustivePlanner(depth=2), world, 8, generator=torch.Generator())
    assert_type(plans, Plans)
    learned = MarkovPrior(4, 1).fit(plans)
    decision = SamplingPlanner(learned, length=3, num_plans=4).plan(world, starts)
    assert_type(decision, Decision)
    assert_type(decision.score, Tensor)
    assert_type(decision.model_steps, int)
    assert_type(execute(SamplingPlanner(learned, 3, 4), world, starts, 2), Execution)
    own: dict[str, Any] = {"length": 3, "starts": 4, "training_starts": 20, "seeds": 1, "progress": False}
    comparison = compare(world, {"mine": learned, "gru": partial(MarkovPrior, order=2)}, [SamplingPlanner], [4], **own)
    assert_type(comparison, Comparison)
    assert_type(comparison.rows[0].score, float)
    assert_type(Cart().rollout(Cart().reset(1), torch.zeros(1, 1, 2, dtype=torch.long)), Rollout)
    assert prior.num_actions == 3


def vectors(folder: Path) -> None:
    """Plans of vectors, a prior over them, and a planner that takes it."""
    world = DoubleIntegrator()
    given = VectorPlans(torch.zeros(4, 6, 1).uniform_(-1, 1), -torch.ones(1), torch.ones(1))
    prior = NoisePrior([-1.0], [1.0], exponent=None).fit(given)
    assert_type(prior, NoisePrior)
    assert_type(load(save(prior, folder / "noise"), kind=VectorPrior), VectorPrior)
    assert_type(load(save(DurationModel(3), folder / "durations"), kind=DurationModel), DurationModel)
    decision = ICEMPlanner(length=3, num_plans=4).plan(world, world.reset(2))
    assert_type(decision, VectorDecision)


def mistakes(prior: Prior) -> None:
    """What a type checker finds before it is run."""
    prior.sample("many", 3)  # type: ignore[arg-type]
    prior.sample(1, 3, method="beam")  # type: ignore[arg-type]
    gridworld(5, 5, edges="sphere")  # type: ignore[arg-type]
    Plans([[0, 1]], 2)  # type: ignore[arg-type]
    SamplingPlanner(prior, lenght=3, num_plans=4)  # type: ignore[call-arg]
    print(neuroprior.nothing)  # type: ignore[attr-defined]


def main(folder: Path) -> None:
    prior = behaviour(folder)
    planning(prior)
    vectors(folder)
    check_world(Cart())
    check_prior(Inertia(4).fit(torch.tensor([[0, 0, 1, 1, 1], [3, 3, 3, 2, 2]])))
    check_planner(Wrapped, enough=512)
