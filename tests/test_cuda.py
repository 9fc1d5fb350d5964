"""On a CUDA device everything does what it does on a CPU; skipped where there is none."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    MCTSPlanner,
    Planner,
    Plans,
    Prior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    collect,
    fit,
    gridworld,
    load,
    save,
)
from neuroprior.control import (
    AutoregressivePrior,
    DoubleIntegrator,
    ICEMPlanner,
    MPPIPlanner,
    NoisePrior,
    PlanarArm,
    ShootingPlanner,
    StoredWindows,
    VectorGRU,
    VectorPlans,
    VectorPrior,
    control,
)
from neuroprior.planners import FrontierPlanner, execute, oracle
from neuroprior.priors import AdaptivePrior, CombinedPrior, MixturePrior, StackedPrior, SwitchingPrior, adapt
from neuroprior.puzzles import AStarPlanner, LevinPlanner, sliding_tiles, sokoban
from neuroprior.sampling import sample_in_world
from neuroprior.testing import check_prior, check_world
from neuroprior.worlds import cube, maze
from tests.support.sources import seeded

DEVICE = torch.device("cuda")
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")

A, QUICK = 3, {"max_steps": 20, "progress": False}


def plans(number: int = 60, length: int = 6, context: Tensor | None = None) -> Plans:
    return Plans(torch.randint(A, (number, length), generator=seeded(0)), A, context=context)


def index(number: int = 60, length: int = 6) -> Tensor:
    return torch.randint(4, (number, length), generator=seeded(1))


PRIORS: dict[str, Callable[[], Prior]] = {
    "uniform": lambda: UniformPrior(A),
    "markov": lambda: MarkovPrior(A, 2).fit(plans()),
    "markov, context": lambda: MarkovPrior(A, 1, num_contexts=4).fit(plans(context=index())),
    "gru": lambda: GRUPrior(A, 16, 2).fit(plans(), **QUICK),
    "gru, context": lambda: GRUPrior(A, 16, num_contexts=4).fit(plans(context=index()), **QUICK),
    "gru, features": lambda: GRUPrior(A, 16, context_size=2, lags=3),
    "transformer": lambda: TransformerPrior(A, 16).fit(plans(), **QUICK),
    "transformer, features": lambda: TransformerPrior(A, 16, window=3, context_size=2),
    "stacked": lambda: StackedPrior(A, 8, depth=2, orders=(1,)).fit(plans(), **QUICK),
    "mixture": lambda: MixturePrior(A, [MarkovPrior(A, 1), GRUPrior(A, 8)]).fit(plans(), **QUICK),
    "adaptive": lambda: adapt(AdaptivePrior(MarkovPrior(A, 1).fit(plans()), [3.0, 1.0], 0.9), plans()),
    "combined": lambda: CombinedPrior(A, [MarkovPrior(A, 1), GRUPrior(A, 8)]).fit(plans(), **QUICK),
    "switching": lambda: SwitchingPrior(A, 2).fit(plans()),
}


@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_conforms(name: str) -> None:
    check_prior(PRIORS[name]().to(DEVICE), num_plans=4_000)


@pytest.mark.parametrize("name", ["markov", "gru", "transformer", "combined", "switching"])
def test_plans_of_a_prior(name: str) -> None:
    prior = PRIORS[name]().to(DEVICE)
    for method in ("auto", "tree", "ancestral"):
        drawn = prior.sample(3000, 7, method=method, generator=seeded(2))
        assert drawn.device.type == DEVICE.type
        assert drawn.equal(prior.sample(3000, 7, method=method, generator=seeded(2)))


NETWORKS: dict[str, Callable[[], Any]] = {
    "gru": lambda: GRUPrior(A, 16, 2),
    "gru, context": lambda: GRUPrior(A, 16, num_contexts=4),
    "transformer": lambda: TransformerPrior(A, 16),
    "transformer, features": lambda: TransformerPrior(A, 16, context_size=2),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_half_precision(name: str) -> None:
    """Under autocast the log-probability of an action differs by less than .03 nats from that in single precision."""
    prior = NETWORKS[name]().to(DEVICE)
    context = None
    if prior.takes_context:
        context = index(500, 1)[:, 0] if prior.num_contexts else torch.randn(500, 2, generator=seeded(4))
        context = context.to(DEVICE)
    drawn = prior.sample(500, 40, context, generator=seeded(2))
    given = Plans(drawn, A, context=context)
    single = prior.action_log_probs(given)
    with torch.autocast("cuda", torch.bfloat16):
        half = prior.action_log_probs(given)
        again = prior.sample(500, 40, context, generator=seeded(2))
    assert float((half - single).detach().abs().max()) < 0.03
    assert again.shape == drawn.shape


@pytest.mark.parametrize("name", ["markov", "gru", "transformer", "stacked", "combined", "switching"])
@pytest.mark.parametrize("where", ["cpu", "cuda"])
def test_learning_on_the_device(name: str, where: str) -> None:
    """A prior that is on the device stays there, wherever its plans are, and learns about the same."""
    there, here = PRIORS[name]().to(DEVICE), PRIORS[name]()
    data = plans(200)
    settings = {} if name in ("markov", "switching") else QUICK
    given = Plans(data.actions.to(where), A)
    there.fit(given, generator=seeded(0), **settings)
    here.fit(data, generator=seeded(0), **settings)
    assert there.device.type == DEVICE.type
    mine, theirs = there.log_prob(given), here.log_prob(data)
    assert mine.mean().item() == pytest.approx(theirs.mean().item(), abs=0.05)


def test_plans_move_with_all_that_belongs_to_them() -> None:
    here = Plans(plans().actions, A, torch.full((60,), 4), context=index(), group=torch.arange(60))
    for moved in (here.to(DEVICE), vectors(2).to(DEVICE)):
        tensors = [value for value in vars(moved).values() if isinstance(value, Tensor)]
        assert len(tensors) == 4
        assert all(value.device.type == DEVICE.type for value in tensors)
    assert here.to(DEVICE).to("cpu").actions.equal(here.actions)


def test_one_call(tmp_path: Any) -> None:
    prior = fit(plans(300), effort="fast").to(DEVICE)
    there = Plans(plans().actions.to(DEVICE), A)
    assert math.isclose(load(save(prior, tmp_path)).log_prob(plans()).sum(), prior.log_prob(there).sum(), rel_tol=1e-3)


WORLDS: dict[str, Callable[[], Any]] = {
    "grid": lambda: gridworld(8, 8, "torus", num_worlds=3),
    "maze": lambda: maze(7, 9, num_layouts=3, num_worlds=2),
    "cube": cube,
    "sokoban": lambda: sokoban(["#######\n#@ $ .#\n#######"]),
    "tiles": lambda: sliding_tiles(shape=(3, 3)),
}


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_conforms(name: str) -> None:
    check_world(WORLDS[name]().to(DEVICE))


PLANNERS: dict[str, Callable[[Prior], Planner]] = {
    "sampling": lambda prior: SamplingPlanner(prior, 6, 64),
    "frontier": lambda prior: FrontierPlanner(prior, 6, 64),
    "trees": lambda prior: MCTSPlanner(prior, 6, 64),
    "exhaustive": lambda prior: ExhaustivePlanner(4),
}


@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("prior", [UniformPrior(4), GRUPrior(4, 8, num_contexts=64)], ids=["uniform", "gru"])
def test_a_planner_on_the_device(name: str, prior: Prior) -> None:
    world = gridworld(8, 8, "wall", num_worlds=2).to(DEVICE)
    planner, state = PLANNERS[name](prior.to(DEVICE)), world.reset(20, seeded(0))
    decision = planner.plan(world, state, seeded(1))
    assert decision.plan.device.type == decision.score.device.type == DEVICE.type
    assert decision.score.equal(planner.plan(world, state, seeded(1)).score)
    best = oracle(world, state, decision.plan.shape[1], any_prefix=planner.any_prefix)
    assert (decision.score <= best + 1e-5).all()
    prior.to("cpu")


def test_plans_beside_a_world_and_what_is_collected() -> None:
    world = gridworld(8, 8, "wall", num_worlds=2).to(DEVICE)
    prior = GRUPrior(4, 8, num_contexts=64).to(DEVICE)
    drawn, rollout = sample_in_world(prior, world, world.reset(5, seeded(0)), 300, 6, generator=seeded(1))
    assert drawn.shape == (5, 300, 6)
    assert rollout.rewards.device.type == DEVICE.type
    learned = collect(SamplingPlanner(prior, 6, 16), world, 100, context="plan", generator=seeded(2))
    prior.fit(learned, generator=seeded(3), **QUICK)
    execute(SamplingPlanner(prior, 6, 16), world, world.reset(5, seeded(0)), 8, generator=seeded(4))


def test_searches_of_puzzles() -> None:
    world = sliding_tiles(shape=(3, 3), scramble=20).to(DEVICE)
    state = world.reset(5, seeded(0))
    for planner in (AStarPlanner(world.lower_bound), LevinPlanner(UniformPrior(4).to(DEVICE))):
        found = planner.search(world, state)
        assert found.solved.any()


def test_a_prior_elsewhere_than_the_states_is_refused() -> None:
    world = gridworld(8, 8).to(DEVICE)
    with pytest.raises(ValueError, match="it is on cpu, and the states on cuda"):
        SamplingPlanner(GRUPrior(4, 8), 6, 64).plan(world, world.reset(5, seeded(0)), seeded(1))


LOW, HIGH = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 1.5])


def vectors(context_size: int | None = None) -> VectorPlans:
    noise = torch.randn(20, 30, 2, generator=seeded(0)).cumsum(1).mul(0.3)
    context = None if context_size is None else torch.randn(20, 30, context_size, generator=seeded(1))
    return VectorPlans((noise.sin() * 0.9 + 0.25).clamp(LOW, HIGH), LOW, HIGH, context=context)


VECTORS: dict[str, Callable[..., VectorPrior]] = {
    "noise": NoisePrior,
    "coloured": partial(NoisePrior, exponent=None, memory=4),
    "autoregressive": AutoregressivePrior,
    "stored": partial(StoredWindows, match=2, horizon=4, max_windows=10),
    "gru": partial(VectorGRU, width=8),
}


@pytest.mark.parametrize("name", VECTORS)
@pytest.mark.parametrize("first", ["cpu", "cuda"])
def test_a_prior_over_vectors(name: str, first: str) -> None:
    """It conforms, whether it learned here or there, and predicts the same in both."""
    settings = QUICK if name == "gru" else {}
    prior = VECTORS[name](LOW, HIGH).to(first).fit(vectors(), generator=seeded(0), **settings)
    assert prior.device.type == first
    here = prior.to("cpu").log_prob(vectors())
    prior.to(DEVICE)
    there = prior.log_prob(vectors())
    torch.testing.assert_close(there.cpu(), here, rtol=1e-3, atol=1e-2)
    check_prior(prior, num_plans=4_000)


@pytest.mark.parametrize("make", [ShootingPlanner, ICEMPlanner, MPPIPlanner])
@pytest.mark.parametrize("kind", [DoubleIntegrator, PlanarArm])
@pytest.mark.parametrize("name", ["none", "autoregressive", "stored", "gru"])
def test_a_planner_of_vectors(make: Any, kind: Any, name: str) -> None:
    world = kind().to(DEVICE)
    low, high, prior = world.action_low, world.action_high, None
    if name != "none":
        noise = torch.randn(20, 30, len(low), generator=seeded(0)).to(DEVICE).mul(0.3).clamp(low, high)
        settings = QUICK if name == "gru" else {}
        prior = VECTORS[name](low, high).to(DEVICE).fit(VectorPlans(noise, low, high), **settings)
    planner = make(8, 32, prior=prior, prior_share=0.0 if prior is None else 0.5)
    result = control(planner, world, world.reset(3, seeded(0)), 4, generator=seeded(1))
    assert result.plans.actions.device.type == DEVICE.type
    check_world(world)
