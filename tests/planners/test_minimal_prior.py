"""Three things are all that samplers and planners need of a prior: `num_actions`, `start` and `step`."""

import math
from collections.abc import Callable

import pytest
import torch

from neuroprior import CombinedPrior, MarkovPrior, MCTSPlanner, Prior, SamplingPlanner, UniformPrior
from neuroprior.agents import Agent
from neuroprior.behaviour import SemiMarkovPrior
from neuroprior.planners import FrontierPlanner
from neuroprior.priors import AdaptivePrior, MixturePrior, infer
from neuroprior.puzzles import LevinPlanner, sliding_tiles
from neuroprior.sampling import Steppable, sample, sample_in_world
from tests.support.sources import random_world, refuses, seeded, stochastic_world


class Minimal:
    """A Markov chain that is no `Prior` and has nothing else."""

    def __init__(self, log_probs):
        self.num_actions = log_probs.shape[1]
        self.log_probs = log_probs  # [A + 1, A]: of the first action, and after each action

    def start(self, batch_size):
        return self.log_probs[:1].expand(batch_size, -1), torch.zeros(batch_size, 0)

    def step(self, action, state):
        return self.log_probs[action + 1], state


FITTED = MarkovPrior(3, 1).fit(torch.randint(3, (40, 6), generator=seeded(0)))
_first, _state = FITTED.start(1)
CHAIN: Steppable = Minimal(torch.cat([_first, FITTED.step(torch.arange(3), _state.expand(3, *_state.shape[1:]))[0]]))
WORLDS = {
    "all legal": random_world(0),
    "some legal": random_world(1, "WSA", legal=True),
    "stochastic": stochastic_world(0),
}


def same(first, second):
    """Whether two nested tuples have the same tensors and numbers."""
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, tuple):
        return len(first) == len(second) and all(map(same, first, second))
    return first == second


@pytest.mark.parametrize("method", ["auto", "ancestral", "tree"])
def test_sampling(method):
    plans = [sample(prior, 500, 5, generator=seeded(1), method=method) for prior in (CHAIN, FITTED)]
    assert same(*plans)


@pytest.mark.parametrize("kind", WORLDS)
def test_sampling_in_a_world(kind):
    world = WORLDS[kind]
    state = world.reset(20, seeded(0))
    found = [sample_in_world(prior, world, state, 30, 4, generator=seeded(1)) for prior in (CHAIN, FITTED)]
    assert same(*found)


@pytest.mark.parametrize("kind", WORLDS)
@pytest.mark.parametrize(
    "kind_of_planner",
    [SamplingPlanner, FrontierPlanner, MCTSPlanner],
)
def test_planning(kind_of_planner, kind):
    world = WORLDS[kind]
    state = world.reset(20, seeded(0))
    if world.stochastic and kind_of_planner in (FrontierPlanner, MCTSPlanner):
        with refuses("deterministic"):
            kind_of_planner(CHAIN, 4, 12).plan(world, state)
        return
    planners = [kind_of_planner(prior, 4, 12, objective="return") for prior in (CHAIN, FITTED)]
    assert same(*(planner.plan(world, state, seeded(1)) for planner in planners))


class Counting(Minimal):
    """It counts how often it is asked for a step."""

    steps = 0

    def step(self, action, state):
        self.steps += 1
        return super().step(action, state)


@pytest.mark.parametrize("kind", [None, *WORLDS])
@pytest.mark.parametrize("num_plans", [30, 2000])
def test_nothing_is_asked_after_the_last_action(kind, num_plans):
    prior, world = Counting(CHAIN.log_probs), WORLDS.get(kind)
    if world is None:
        sample(prior, num_plans, 4, generator=seeded(1))
    else:
        sample_in_world(prior, world, world.reset(7, seeded(0)), num_plans, 4, generator=seeded(1))
    assert prior.steps == 3


def test_what_does_not_fit_is_refused():
    with refuses("context", "none"):
        sample(CHAIN, 10, 4, torch.zeros(10, dtype=torch.long))
    with refuses("must have 3 actions", "got 4"):
        SamplingPlanner(Minimal(torch.zeros(5, 4)), 3, 2).plan(random_world(0), torch.tensor([0]))


def test_a_prior_on_another_device_than_the_states_is_named():
    prior = Minimal(CHAIN.log_probs)
    prior.device = torch.device("cuda")
    world = WORLDS["all legal"]
    with refuses("it is on cuda", "the states on cpu"):
        SamplingPlanner(prior, 4, 8).plan(world, world.reset(3, seeded(0)))


class Spoiled(Prior):
    """The uniform prior on four actions, but for what one of its methods returns."""

    def __init__(self, method: str, spoil: Callable) -> None:
        super().__init__(4)
        self.method, self.spoil = method, spoil

    def start(self, batch_size, context=None):
        return self._outputs("start", batch_size)

    def step(self, action, state, context=None):
        return self._outputs("step", len(action))

    def _outputs(self, method, num):
        outputs = torch.zeros(num, 4), torch.zeros(num, 1)
        return self.spoil(*outputs) if method == self.method else outputs

    def fit(self, plans, **settings):
        return self


SPOILED: dict[str, tuple[Callable, str]] = {
    "one action more": (lambda logits, state: (torch.cat([logits, logits[:, :1]], 1), state), "4], got torch.float32"),
    "without rows": (lambda logits, state: (logits[0], state), "4], got torch.float32 [4]"),
    "one row": (lambda logits, state: (logits[: len(logits) > 1], state), "4], got torch.float32 ["),
    "a row more": (lambda logits, state: (torch.cat([logits, logits[:1]]), state), "4], got torch.float32 ["),
    "one dimension more": (lambda logits, state: (logits[:, None], state), ", 1, 4]"),
    "transposed": (lambda logits, state: (logits.T, state), "4], got torch.float32 [4, "),
    "integers": (lambda logits, state: (logits.long(), state), "got torch.int64"),
    "an array": (lambda logits, state: (logits.numpy(), state), "got ndarray"),
    "no state": (lambda logits, state: logits, "must return logits and a state, got torch.float32"),
    "a state of one row": (lambda logits, state: (logits, (state, state[: len(state) > 1])), "must return a state of"),
    "a state of nothing": (lambda logits, state: (logits, ()), "must return a state of"),
    "a state that is none": (
        lambda logits, state: (logits, None),
        "rows, a tensor or a tuple of such tensors, got None",
    ),
    "NaN": (lambda logits, state: (logits * torch.nan, state), "its logits are NaN"),
    "one NaN": (lambda logits, state: (logits.index_fill(1, torch.tensor(3), torch.nan), state), "its logits are NaN"),
    "infinite": (lambda logits, state: (logits.index_fill(1, torch.tensor(0), torch.inf), state), "NaN or infinite"),
    "nothing possible": (lambda logits, state: (logits - torch.inf, state), "-inf for all legal actions"),
}
WIDE = random_world(1, "WSA", actions=4, legal=True)
TILES = sliding_tiles(shape=(2, 3))
STARTS = WIDE.reset(20, seeded(0))
TRIED = torch.randint(4, (7, 5), generator=seeded(2))
DOORS: dict[str, Callable[[Prior], object]] = {
    "sample": lambda prior: sample(prior, 5, 3, method="ancestral"),
    "tree": lambda prior: sample(prior, 500, 3, method="tree"),
    "mask": lambda prior: sample(prior, 20, 3, mask=torch.ones(4).bool()),
    "in a world": lambda prior: sample_in_world(prior, WIDE, STARTS, 30, 3),
    "sampling": lambda prior: SamplingPlanner(prior, 3, 12).plan(WIDE, STARTS),
    "frontier": lambda prior: FrontierPlanner(prior, 3, 12).plan(WIDE, STARTS),
    "tree search": lambda prior: MCTSPlanner(prior, 3, 12).plan(WIDE, STARTS),
    "Levin": lambda prior: LevinPlanner(prior, 50).search(TILES, TILES.reset(5, seeded(0))),
    "agent": lambda prior: Agent(WIDE, SamplingPlanner(prior, 3, 12), prior, STARTS[:1]).run(3),
    "log_prob": lambda prior: prior.log_prob(TRIED),
    "infer": lambda prior: infer([prior, UniformPrior(4)], TRIED),
    "mixture": lambda prior: MixturePrior(4, [prior, UniformPrior(4)]).sample(5, 3),
    "combined": lambda prior: CombinedPrior(4, [prior, UniformPrior(4)]).sample(5, 3),
    "adaptive": lambda prior: AdaptivePrior(prior, [2.0]).sample(5, 3),
    "semi-Markov": lambda prior: SemiMarkovPrior(4, prior).sample(5, 3),
    "a mixture's log_prob": lambda prior: MixturePrior(4, [prior, UniformPrior(4)]).log_prob(TRIED),
    "an adaptive log_prob": lambda prior: AdaptivePrior(prior, [2.0]).log_prob(TRIED),
}


@pytest.mark.parametrize("method", ["start", "step"])
@pytest.mark.parametrize("what", SPOILED)
@pytest.mark.parametrize("door", DOORS)
def test_what_a_prior_must_not_return_is_refused(door, what, method):
    spoil, words = SPOILED[what]
    with refuses(words):
        DOORS[door](Spoiled(method, spoil))


def test_half_precision_is_drawn_from_as_single_precision():
    """In bfloat16 the probabilities of many actions would not sum to one."""
    half, single = (Minimal(torch.linspace(-2, 2, 300 * 301).view(301, 300).to(torch.bfloat16)) for _ in range(2))
    single.log_probs = single.log_probs.float()
    for method in ("ancestral", "tree"):
        drawn = [sample(prior, 4000, 3, generator=seeded(1), method=method) for prior in (half, single)]
        assert drawn[0].equal(drawn[1])


def test_log_prob_after_an_impossible_action():
    """What comes after it does not count, so that a prior may give anything there."""

    def impossible(logits, state):
        return logits.index_fill(1, torch.tensor(2), -torch.inf), state

    class Lost(Spoiled):
        def step(self, action, state, context=None):
            logits, state = super().step(action, state)
            return logits.masked_fill((action == 2)[:, None], torch.nan), state

    plans = torch.tensor([[2, 0, 1], [0, 2, 1], [0, 1, 3]])
    expected = torch.tensor([-math.inf, math.log(1 / 3) - 2 * math.log(4)])
    assert torch.allclose(Lost("start", impossible).log_prob(plans[[0, 2]]), expected)
    with refuses("its logits are NaN"):
        Lost("start", impossible).log_prob(plans)
