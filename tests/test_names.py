"""Where two things name their actions, they have to name them alike: numbers that mean other actions are refused."""

import json
from dataclasses import replace

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, Plans, Prior, SamplingPlanner, UniformPrior
from neuroprior.agents import Agent, Replay
from neuroprior.behaviour import RecordedPlans, SemiMarkovPrior
from neuroprior.control import (
    DoubleIntegrator,
    NoisePrior,
    ShootingPlanner,
    VectorGRU,
    VectorPlans,
    VectorPrior,
    control,
)
from neuroprior.priors import MixturePrior, StackedPrior, infer
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import gridworld

WORLD = gridworld(4, 4, edges="torus", seed=0)
NAMES, ENDS = WORLD.action_names, ([-1.0, -1.0], [1.0, 1.0])
assert NAMES is not None
PLANS = Plans(torch.randint(4, (20, 6), generator=torch.Generator().manual_seed(0)), 4, action_names=NAMES)
OTHERS = replace(PLANS, action_names=NAMES[::-1])
UNNAMED = replace(PLANS, action_names=None)
SHORT = {"max_steps": 2, "progress": False}


def learned(plans: Plans) -> MarkovPrior:
    return MarkovPrior(4, 0).fit(plans)


def timed(plans: Plans) -> Plans:
    return replace(RecordedPlans.of(plans), durations=1.0 + plans.actions)


def stored(plans: Plans) -> None:
    replay = Replay(1.0)
    for some in (PLANS, UNNAMED, plans):
        replay.add(some)


def mixture(plans: Plans) -> MixturePrior:
    return MixturePrior(4, [UniformPrior(4), learned(plans)])


def chains(*others: Prior) -> MixturePrior:
    return MixturePrior(4, [MarkovPrior(4, 0), MarkovPrior(4, 1), *others])


USES = {
    "scored": lambda plans: learned(PLANS).log_prob(plans),
    "in a world": lambda plans: sample_in_world(learned(plans), WORLD, torch.tensor([0]), 2, 3),
    "stored": stored,
    "mixed": lambda plans: MixturePrior(4, [learned(PLANS), UniformPrior(4), learned(plans)]),
    "mixed in a world": lambda plans: sample_in_world(mixture(plans), WORLD, torch.tensor([0]), 2, 3),
    "of a mixture": lambda plans: mixture(PLANS).log_prob(plans),
    "validating a mixture": lambda plans: chains().fit(PLANS, validation=plans),
    "inferred from numbers": lambda plans: infer([UniformPrior(4), learned(PLANS), learned(plans)], PLANS.actions),
    "of an agent": lambda plans: Agent(WORLD, SamplingPlanner(UniformPrior(4), 2, 2), learned(plans), replan_every=2),
    "learned and validated further": lambda plans: (
        GRUPrior(4, 4).fit(PLANS, **SHORT).fit(plans, **SHORT, validation=plans)
    ),
    "learned further without names": lambda plans: (
        GRUPrior(4, 4).fit(PLANS, **SHORT).fit(UNNAMED, **SHORT).fit(plans, **SHORT)
    ),
    "stacked further": lambda plans: StackedPrior(4, 4).fit(PLANS, **SHORT).fit(plans, **SHORT),
    "mixed further": lambda plans: chains(GRUPrior(4, 4)).fit(PLANS, **SHORT).fit(plans, **SHORT),
    "timed": lambda plans: SemiMarkovPrior(4).fit(timed(PLANS)).duration_log_prob(timed(plans)),
    "learned further": lambda plans: GRUPrior(4, 4).fit(PLANS, **SHORT).fit(plans, **SHORT),
}


@pytest.mark.parametrize("use", USES)
def test_other_names_are_refused(use):
    with pytest.raises(ValueError, match=r"^(validation: )?action_names: .+ in .+, .+ in .+; "):
        USES[use](OTHERS)


@pytest.mark.parametrize("use", USES)
@pytest.mark.parametrize("plans", [PLANS, UNNAMED], ids=["the same", "none"])
def test_the_same_names_and_none_are_taken(use, plans):
    USES[use](plans)


HIP, KNEE = ("hip", "knee"), ("knee", "hip")
MOVES = VectorPlans(torch.rand(6, 20, 2, generator=torch.Generator().manual_seed(0)), *ENDS, action_names=HIP)
SWAPPED = replace(MOVES, action_names=KNEE)


class Arm(DoubleIntegrator):
    """Both of whose actions have names."""

    action_names = KNEE


def moved(prior: VectorPrior) -> None:
    world = Arm()
    control(ShootingPlanner(3, 4, prior=prior), world, world.reset(1, torch.Generator().manual_seed(0)), 2)


VECTOR_USES = {
    "scored": lambda plans: NoisePrior(*ENDS).fit(MOVES).log_prob(plans),
    "read back": lambda plans: again(NoisePrior(*ENDS).fit(MOVES)).log_prob(plans),
    "learned further": lambda plans: VectorGRU(*ENDS, width=4).fit(MOVES, **SHORT).fit(plans, **SHORT),
    "validated": lambda plans: VectorGRU(*ENDS, width=4).fit(MOVES, validation=plans, **SHORT),
}


def again(prior: VectorPrior) -> VectorPrior:
    made = type(prior)(**prior.config)
    made.load_state_dict(prior.state_dict())
    made.restore(json.loads(json.dumps(prior.learned)))
    return made


@pytest.mark.parametrize("use", VECTOR_USES)
def test_other_names_of_dimensions_are_refused(use):
    where = "validation: " if use == "validated" else ""
    with pytest.raises(ValueError, match=rf"^{where}action_names: knee, hip in the plans, hip, knee in this prior; "):
        VECTOR_USES[use](SWAPPED)
    for plans in (MOVES, replace(MOVES, action_names=None)):
        VECTOR_USES[use](plans)


def test_priors_of_vectors_learn_anew_from_other_names_and_move_only_their_own_world():
    prior = NoisePrior(*ENDS).fit(MOVES)
    with pytest.raises(ValueError, match=r"^action_names: knee, hip in the world, hip, knee in the prior; "):
        moved(prior)
    moved(prior.fit(SWAPPED))


def test_a_refused_fit_keeps_what_was_learned():
    stacked, noise = StackedPrior(4, 4).fit(PLANS, **SHORT), NoisePrior(*ENDS).fit(MOVES)
    with pytest.raises(ValueError, match=r"^action_names: "):
        stacked.fit(OTHERS, **SHORT)
    with pytest.raises(ValueError, match=r"^`action_high` of the plans "):
        noise.fit(replace(SWAPPED, action_high=torch.full((2,), 2.0)))
    assert stacked.action_names == tuple(NAMES)
    assert noise.action_names == HIP
    first = GRUPrior(4, 4)
    with pytest.raises(ValueError, match=r"^validation: action_names: .+ in these plans, .+ in those that are"):
        first.fit(PLANS, validation=OTHERS, **SHORT)


def test_named_plans_are_matched_to_each_intention():
    """As if both had learned from the same numbers."""
    one, other = learned(PLANS), learned(replace(PLANS, actions=3 - PLANS.actions, action_names=NAMES[::-1]))
    found = infer([one, other], PLANS)
    assert found.log_probs[:, -1].exp().allclose(torch.full((20, 2), 0.5, dtype=torch.double))


def test_a_fit_that_is_refused_leaves_a_network_free_to_learn_other_plans():
    wrong = Plans(torch.zeros(3, 4, dtype=torch.long), 5)
    prior = GRUPrior(4)
    for plans, how in ((PLANS, {"validation": wrong}), (PLANS[:0], {})):
        with pytest.raises(ValueError, match=r"plans|actions"):
            prior.fit(plans, **SHORT, **how)
    assert prior.fit(OTHERS, **SHORT).action_names == OTHERS.action_names
