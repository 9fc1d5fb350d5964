"""Messages about bad input that no other test reads, and what happens at the edges: no plans, plans without actions."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import neuroprior
from neuroprior import CombinedPrior, MarkovPrior, Plans, TabularWorld, UniformPrior
from neuroprior.__main__ import main
from neuroprior.behaviour import DurationModel, SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.control import (
    DoubleIntegrator,
    VectorPlans,
    read_vector_plans,
    vector_plans_from_trajectories,
    write_vector_plans,
)
from neuroprior.priors import MixturePrior, StackedPrior, SwitchingPrior, infer, load, save
from neuroprior.puzzles import LogLinearPrior, SokobanWorld, Steps, read_sokoban, sliding_tiles, sokoban
from neuroprior.worlds import cube, gridworld
from tests.support.sources import refuses, seeded

ZEROS = torch.zeros(2, 3, dtype=torch.long)
VECTORS = torch.zeros(2, 3, 1)
LEVEL = "#####\n#@$.#\n#####"


def vectors(**fields: object) -> VectorPlans:
    return VectorPlans(**({"actions": VECTORS, "action_low": [-1.0], "action_high": [1.0]} | fields))


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "vectors of two dimensions": (lambda: vectors(actions=torch.zeros(2, 3)), "[N, L, D]"),
    "bounds the wrong way": (lambda: vectors(action_low=[1.0], action_high=[-1.0]), "action_low"),
    "lengths of others": (lambda: vectors(lengths=torch.tensor([3])), "`lengths` must be integers of shape [2]"),
    "groups of others": (lambda: vectors(group=torch.tensor([1])), "group"),
    "a name for names": (lambda: vectors(action_names="torque"), "`action_names` must be a list"),
    "context of others": (lambda: vectors(context=torch.zeros(5, 2)), "context"),
    "steps before the first": (lambda: vectors().steps(-1), "`first` must be an integer of at least 0, got -1"),
    "lengths that are words": (lambda: vectors(lengths=["long", "short"]), "`lengths` must be numbers"),
    "plans that are none": (lambda: write_vector_plans(Plans(ZEROS, 1), "x.npz"), "VectorPlans"),
    "vectors in CSV": (lambda: write_vector_plans(vectors(), "x.csv"), ".npz"),
    "no name of a file": (lambda: read_vector_plans(3), "path"),
    "observations of another kind": (
        lambda: vector_plans_from_trajectories([], [-1.0], [1.0], observations="all"),
        "observations",
    ),
    "integers observed": (
        lambda: vector_plans_from_trajectories([{"actions": VECTORS[0], "observations": [1, 2, 3]}], [-1.0], [1.0]),
        "must be arrays of features",
    ),
    "one plan by its number": (lambda: Plans(ZEROS, 1)[0], "plans[0 : 1]"),
    "one plan of vectors by its number": (lambda: vectors()[torch.tensor(0)], "plans[0 : 1]"),
    "the last plan by its number": (lambda: Plans(ZEROS, 1)[-1], "plans[-1 : ] is"),
    "patterns of others": (lambda: Plans(ZEROS, 1, context=torch.zeros(2, 4, 5, dtype=torch.int32)), "[2, 3, F]"),
    "no patterns": (lambda: LogLinearPrior(2, 2).start(1), "context"),
    "patterns of other steps": (
        lambda: LogLinearPrior(2, 2).fit_steps(Steps(ZEROS[:, :1], ZEROS[0], ZEROS[0], ZEROS[0])),
        "shape",
    ),
    "levels of no width": (lambda: SokobanWorld(torch.zeros(0, 3, 3), ()), "levels"),
    "a prior that is none": (lambda: infer({"a": 3}, ZEROS), "priors['a']"),
    "a state that is no tensor": (lambda: DoubleIntegrator().rollout(3, VECTORS), "state"),
    "a state of other shape": (lambda: DoubleIntegrator().rollout(torch.zeros(2, 3), torch.zeros(2, 1, 3, 2)), "state"),
    "a table that is too large": (
        lambda: TabularWorld(torch.zeros(2**16, 2**8, dtype=torch.long), torch.zeros(2**8, 1).expand(2**8, 2**16)),
        "2**31",
    ),
}


@pytest.mark.parametrize(("call", "says"), REFUSED.values(), ids=REFUSED)
def test_refused(call: Callable[[], object], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with refuses(says, error=IndexError if says.startswith("plans[") else ValueError):
        call()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("plans", [Plans(ZEROS, 1), vectors()], ids=["numbers", "vectors"])
def test_a_loop_over_plans_has_plans_of_one(plans: Plans | VectorPlans) -> None:
    each = list(plans)
    assert [len(one) for one in each] == [1, 1]
    assert torch.cat([one.actions for one in each]).equal(plans.actions)
    with refuses("reversible", error=TypeError):
        reversed(plans)  # type: ignore[call-overload]


def test_a_sample_needs_the_context_that_the_prior_takes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    plain = str(save(MarkovPrior(2, 0), tmp_path / "plain"))
    index = str(save(MarkovPrior(2, 0, num_contexts=3), tmp_path / "index"))
    for words, says in (
        ([plain, "--context", "day"], "takes none"),
        ([index], "give --context"),
        ([index, "--context", "7"], "not known"),
    ):
        assert main(["sample", *words]) == 2
        assert says in capsys.readouterr().err
    assert main(["sample", index, "--context", "2", "--num-plans", "2", "--length", "3"]) == 0


def test_a_device_that_is_not_there(tmp_path: Path) -> None:
    folder = save(MarkovPrior(2, 0), tmp_path)
    with refuses("device", "nowhere"):
        load(folder, "nowhere")


@pytest.mark.parametrize(
    "prior",
    [
        CombinedPrior(2, [UniformPrior(2), MarkovPrior(2, 1)]),
        MixturePrior(2, [UniformPrior(2), MarkovPrior(2, 1)]),
        StackedPrior(2, hidden_size=4),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_no_plans_and_plans_without_actions(prior) -> None:
    prior.fit(
        Plans(torch.randint(2, (4, 60), generator=seeded(0)), 2),
        generator=seeded(0),
        **({"max_steps": 1} if isinstance(prior, StackedPrior) else {}),
    )
    logits, state = prior.start(0)
    assert prior.step(torch.zeros(0, dtype=torch.long), state)[0].shape == logits.shape == (0, 2)
    assert prior(torch.zeros(3, 0, dtype=torch.long)).shape == (3, 0, 2)


@pytest.mark.parametrize(
    "world",
    [cube(), gridworld(3, 3), sliding_tiles(shape=(2, 2)), sokoban(read_sokoban(LEVEL))],
    ids=lambda w: type(w).__name__,
)
def test_worlds_move_to_a_device(world) -> None:
    assert world.to(torch.device("cpu")) is world
    state = world.reset(2, seeded(0))
    assert world.step(state, torch.zeros(2, dtype=torch.long))[0].device.type == "cpu"


def test_durations_are_counted_anew() -> None:
    durations = torch.tensor([[1.0, 4.0, 1.2, 3.5]]).repeat(20, 1) * torch.linspace(0.5, 2, 20)[:, None]
    plans = RecordedPlans(torch.tensor([[0, 1, 0, 1]]).repeat(20, 1), 2, durations=durations)
    prior = SemiMarkovPrior(2).fit(plans[:4])
    fewer = prior.log_prob(plans)
    assert not torch.allclose(prior.recount(plans).log_prob(plans), fewer)
    assert repr(DurationModel(2, laws=("gamma",))) == "DurationModel(2, laws=['gamma'], transitions=True)"


def named(order: str = "abc", contexts: str = "LR", per: str = "plan", end: bool = False) -> Plans:
    """Plans in which each action but the last is followed by the next, named in an order; with a context of its own."""
    actions = (torch.arange(12) + torch.randint(3, (30, 1), generator=seeded(0))) % 3
    number = torch.tensor(["abc".index(name) for name in order]).argsort()
    context = torch.arange(30) % 2 if per == "plan" else (torch.arange(30) % 2)[:, None].expand(30, 12)
    how = {"action_names": tuple(order), "context": context, "context_names": tuple(contexts)}
    plans = RecordedPlans(number[actions], 3, durations=torch.ones(30, 12), **how)
    return plans.with_end() if end else plans


COUNTS_AGAIN = {
    "combined": lambda: CombinedPrior(3, [UniformPrior(3), MarkovPrior(3, 1, num_contexts=2)], num_contexts=2),
    "mixture": lambda: MixturePrior(3, [UniformPrior(3), MarkovPrior(3, 1, num_contexts=2)], num_contexts=2),
    "stacked": lambda: StackedPrior(3, hidden_size=4, num_contexts=2),
    "switching": lambda: SwitchingPrior(3, 2, num_contexts=2, restarts=1, max_iterations=2),
    "semi-Markov": lambda: SemiMarkovPrior(3, num_contexts=2),
}


@pytest.mark.parametrize("make", COUNTS_AGAIN.values(), ids=COUNTS_AGAIN)
def test_plans_that_are_numbered_otherwise_are_not_counted_in_again(make) -> None:
    prior = make()
    settings = {"max_steps": 1, "progress": False} if "max_steps" in prior.fit_settings else {}
    prior.fit(named(), generator=seeded(0), **settings)
    before = prior.log_prob(named())
    with refuses("action_names", "c, b, a", "a, b, c"):
        prior.recount(named("cba"))
    with refuses("context_names", "R, L", "L, R"):
        prior.recount(named(contexts="RL"))
    with refuses("3 actions", "got 4"):
        prior.recount(named(end=True))
    with refuses("at least one plan with an action"):
        prior.recount(named().steps(0, 0))
    assert prior.log_prob(named()).equal(before)
    assert prior.recount(named()).log_prob(named()).isfinite().all()


@pytest.mark.parametrize("plans", [named(), named(per="step"), named(end=True)], ids=["plan", "step", "end"])
@pytest.mark.parametrize("kind", [CombinedPrior, MixturePrior])
def test_what_fitted_experts_know_need_not_be_learned_again(kind, plans) -> None:
    """A mixture that was never fitted itself is for plans like those of its experts, or else learns what they are."""
    size = plans.num_actions
    fitted = [UniformPrior(size).fit(plans), MarkovPrior(size, 1, num_contexts=2).fit(plans)]
    prior = kind(size, fitted, num_contexts=2)
    assert (prior.end, prior.context_per, prior.context_names) == (plans.end, fitted[1].context_per, ("L", "R"))
    prior.learn_weights(plans)
    assert prior.recount(plans).log_prob(plans).isfinite().all()
    with refuses("context_names", "R, L", "L, R"):
        prior.learn_weights(replace(plans, context_names=("R", "L")))
    alone = kind(size, [UniformPrior(size), MarkovPrior(size, 1, num_contexts=2)], num_contexts=2)
    assert alone.recount(plans).log_prob(plans).isfinite().all()
    assert (alone.end, alone.context_per) == (plans.end, fitted[1].context_per)


def test_experts_that_know_other_contexts_are_refused() -> None:
    experts = [
        MarkovPrior(3, order, num_contexts=2).fit(named(contexts=names)) for order, names in enumerate(["LR", "RL"])
    ]
    with refuses("context_names", "R, L", "experts[1]", "fit them to plans that are numbered alike"):
        MixturePrior(3, experts)


@pytest.mark.parametrize("kind", [CombinedPrior, MixturePrior])
def test_validation_plans_are_refused_before_anything_is_learned(kind) -> None:
    plans, prior = named(), kind(3, [MarkovPrior(3, 1, num_contexts=2)], num_contexts=2)
    with refuses("validation: context_names", "R, L"):
        prior.fit(plans, validation=named(contexts="RL"))
    with refuses("`validation` must have at least one plan with an action"):
        prior.fit(plans, validation=plans.steps(0, 0))


def test_an_end_is_that_of_the_plans_that_were_learned_from() -> None:
    plans = Plans(torch.randint(2, (20, 4), generator=seeded(0)), 3)
    prior = MixturePrior(3, [UniformPrior(3), MarkovPrior(3, 1)]).fit(plans, generator=seeded(0))
    with refuses("end=None", "got 2"):
        prior.recount(replace(plans, end=2))


@pytest.mark.parametrize("kind", [CombinedPrior, MixturePrior])
def test_weights_are_learned_from_plans_that_are_known(kind) -> None:
    prior = kind(2, [UniformPrior(2), MarkovPrior(2, 1)])
    plans = Plans(torch.randint(2, (30, 6), generator=seeded(0)), 2, action_names=("a", "b"))
    prior.fit(plans, generator=seeded(0))
    with refuses("action_names", "b, a"):
        prior.learn_weights(replace(plans, action_names=("b", "a")))
    for none in (plans[:0], plans.steps(0, 0)):
        with refuses("at least one plan with an action"):
            prior.learn_weights(none)
    with refuses("must have 2 actions", "5"):
        prior.learn_weights(Plans(torch.zeros(3, 4, dtype=torch.long), 5))


def test_plans_of_vectors_are_fitted_by_priors_over_vectors() -> None:
    plans = VectorPlans(torch.rand(6, 5, 1), [0.0], [1.0])
    with refuses("Plans of numbered actions", "VectorPlans"):
        neuroprior.fit(plans)  # type: ignore[arg-type]
    prior = neuroprior.control.VectorGRU(plans.action_low, plans.action_high, width=4)
    assert prior.fit(plans, max_steps=1, progress=False).log_prob(plans).isfinite().all()


def test_a_fit_that_does_not_return_the_prior_is_named() -> None:
    class ReturnsNothing(UniformPrior):
        def fit(self, plans, *, generator=None):  # type: ignore[override]
            pass

    with refuses("ReturnsNothing.fit returned NoneType"):
        neuroprior.fit(torch.tensor([[0, 1]]), ReturnsNothing)
