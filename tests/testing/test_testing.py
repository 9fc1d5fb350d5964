"""The conformance suites: every prior and world of the library passes, and broken ones fail with a message."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from inspect import isabstract

import numpy as np
import pytest
import torch
from torch import Tensor

from neuroprior import (
    ContextTreePrior,
    GRUPrior,
    MarkovPrior,
    Plans,
    Prior,
    TabularWorld,
    TransformerPrior,
    UniformPrior,
    World,
    from_gymnasium,
    gridworld,
    puzzles,
    worlds,
)
from neuroprior.behaviour import RecordedPlans, SemiMarkovPrior
from neuroprior.control import NoisePrior
from neuroprior.priors import AdaptivePrior, adapt
from neuroprior.puzzles import LogLinearPrior, sliding_tiles, sokoban
from neuroprior.sampling.states import tensors_in
from neuroprior.testing import check_prior, check_world
from neuroprior.testing.chi_square import alike, chi_square
from neuroprior.worlds import Features, Rollout, cube, egocentric, four_rooms, labyrinth, maze
from tests.support.sources import stochastic_world

SOKOBAN = ["#######\n#@ $ .#\n#######", "######\n#.$  #\n# +$ #\n#    #\n######"]


def random_plans(num_actions: int, context: Tensor | None = None, length: int = 5) -> Plans:
    generator = torch.Generator().manual_seed(3)
    return Plans(torch.randint(num_actions, (60, length), generator=generator), num_actions, context=context)


def index_context(*shape: int) -> Tensor:
    return torch.randint(3, shape, generator=torch.Generator().manual_seed(4))


def random_context(prior: Prior, num: int, length: int, generator: torch.Generator) -> Tensor | None:
    """A context of each step, of the kind that the prior takes."""
    if prior.context_size is not None:
        return torch.randn(num, length, prior.context_size, generator=generator)
    if prior.num_patterns is not None:
        return torch.randint(6, (num, length, prior.num_patterns), generator=generator)
    if prior.num_contexts is None:
        return None
    return torch.randint(prior.num_contexts, (num, length), generator=generator)


def pattern_context(*shape: int) -> Tensor:
    return torch.randint(6, (*shape, 2), generator=torch.Generator().manual_seed(5), dtype=torch.int32)


PRIORS = {
    "uniform": lambda: UniformPrior(4),
    "uniform, one action": lambda: UniformPrior(1),
    "uniform, 300 actions": lambda: UniformPrior(300),
    "markov-0": lambda: MarkovPrior(4, 0).fit(random_plans(4)),
    "markov-2": lambda: MarkovPrior(4, 2).fit(random_plans(4)),
    "markov-3, lower": lambda: MarkovPrior(3, 3, initial="lower").fit(random_plans(3)),
    "markov-2 untrained": lambda: MarkovPrior(4, 2),
    "markov-2, context a plan": lambda: MarkovPrior(3, 2, num_contexts=4).fit(random_plans(3, index_context(60))),
    "markov-2, context a step": lambda: MarkovPrior(3, 2, num_contexts=4).fit(random_plans(3, index_context(60, 5))),
    "markov-3, witten-bell": lambda: MarkovPrior(4, 3, backoff="witten-bell").fit(random_plans(4)),
    "markov-3, dirichlet, context a step": lambda: MarkovPrior(
        3, 3, num_contexts=4, backoff="dirichlet", initial="lower"
    ).fit(random_plans(3, index_context(60, 5))),
    "semi-markov": lambda: SemiMarkovPrior(4).fit(
        replace(RecordedPlans.of(random_plans(4)), durations=torch.ones(60, 5))
    ),
    "context tree untrained": lambda: ContextTreePrior(4),
    "context tree": lambda: ContextTreePrior(4, 3).fit(random_plans(4)),
    "context tree, one action": lambda: ContextTreePrior(1, 2).fit(random_plans(1)),
    "context tree, 300 actions": lambda: ContextTreePrior(300, 4).fit(random_plans(300)),
    "context tree, context a plan": lambda: ContextTreePrior(3, num_contexts=4).fit(random_plans(3, index_context(60))),
    "context tree, context a step": lambda: ContextTreePrior(3, 0, num_contexts=4).fit(
        random_plans(3, index_context(60, 5))
    ),
    "adaptive": lambda: AdaptivePrior(MarkovPrior(3, 1), [4.0, 2.0, 0.5], 0.8).fit(random_plans(3)),
    "adaptive, of an individual": lambda: adapt(
        AdaptivePrior(ContextTreePrior(3, 2, num_contexts=4).fit(random_plans(3, index_context(60, 5))), [3.0, 1.0]),
        random_plans(3, index_context(60, 5)),
    ),
    "log-linear untrained": lambda: LogLinearPrior(4, 2),
    "log-linear": lambda: LogLinearPrior(3, 2).fit(random_plans(3, pattern_context(60, 5))),
    "gru untrained": lambda: GRUPrior(4),
    "gru": lambda: GRUPrior(4).fit(random_plans(4, length=3), progress=False, max_steps=20),
    "gru, two layers, index": lambda: GRUPrior(3, 16, 2, window=2, num_contexts=3),
    "gru, features": lambda: GRUPrior(3, 16, window=1, context_size=2),
    "transformer untrained": lambda: TransformerPrior(4),
    "transformer": lambda: TransformerPrior(4).fit(random_plans(4, length=3), progress=False, max_steps=20),
    "transformer, no window": lambda: TransformerPrior(3, 16, window=0),
    "transformer, index": lambda: TransformerPrior(3, 16, window=2, num_contexts=3),
    "transformer, features": lambda: TransformerPrior(3, 16, window=2, context_size=2),
}


@pytest.mark.parametrize("name", PRIORS)
def test_every_prior_conforms(name: str) -> None:
    prior = PRIORS[name]()
    check_prior(prior, num_plans=4_000 if isinstance(prior, GRUPrior | TransformerPrior) else 20_000)


def legal_world() -> TabularWorld:
    legal = torch.tensor([[True, True], [True, False], [False, True]])
    return TabularWorld(torch.tensor([[1, 2], [0, 0], [2, 0]]), torch.rand(2, 3, 2), legal)


WORLDS = {
    "walls": gridworld(5, 4, "wall", num_worlds=3),
    "torus": gridworld(20, 20, "torus"),
    "one cell": gridworld(1, 1),
    "legal": legal_world(),
    "cube": cube(),
    "cube, quarter turns": cube("quarter", scramble=3),
    "chance": stochastic_world(0),
    "maze": maze(7, 9, num_layouts=3, num_worlds=2),
    "four rooms": four_rooms(egocentric=True, view=2, reward="goal"),
    "egocentric": egocentric(gridworld(5, 5, "torus")),
    "labyrinth": labyrinth(absorbing=True),
    "taxi": from_gymnasium("Taxi-v4"),
    "ice": from_gymnasium("FrozenLake-v1", starts="any"),
    "cart and pole": from_gymnasium("CartPole-v1", seeds=range(3)),
    "sokoban": sokoban(SOKOBAN),
    "sliding tiles": sliding_tiles(shape=(3, 3)),
    "sliding tiles, no square": sliding_tiles(shape=(2, 4), scramble=5),
}


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
def test_every_world_conforms(world: World) -> None:
    check_world(world)


def test_no_world_is_left_out() -> None:
    exported = {getattr(room, name) for room in (worlds, puzzles) for name in room.__all__}
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, World) and not isabstract(kind)}
    assert kinds == {type(world) for world in WORLDS.values()}


INTEGERS = [
    torch.int8, torch.uint8, torch.int16, torch.int32, torch.int64, torch.uint16, torch.uint32, torch.uint64
]  # fmt: skip
LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "strided": lambda values: torch.stack([values, values], -1)[..., 0],
    "transposed": lambda values: values.transpose(0, -1).contiguous().transpose(0, -1),
}


def outcomes(prior: Prior, plans: Tensor, context: Tensor | None) -> list[Tensor]:
    """All logits and log-probabilities of some plans."""
    first, *rest = [None] * plans.shape[1] if context is None else context.unbind(1)
    logits, state = prior.start(len(plans), first)
    found = [logits]
    for action, given in zip(plans.unbind(1), rest, strict=False):
        logits, state = prior.step(action, state, given)
        found.append(logits)
    return [*found, prior(plans, context), prior.log_prob(Plans(plans, prior.num_actions, context=context))]


@torch.no_grad()
@pytest.mark.parametrize("name", PRIORS)
def test_integers_of_every_kind_and_layout_mean_the_same_to_a_prior(name: str) -> None:
    prior = PRIORS[name]()
    generator = torch.Generator().manual_seed(0)
    plans = torch.randint(min(prior.num_actions, 100), (5, 4), generator=generator)
    context = random_context(prior, 5, 4, generator)
    due = outcomes(prior, plans, context)
    for kind in INTEGERS:
        for layout in LAYOUTS.values():
            now = context if context is None or context.is_floating_point() else context.to(kind)
            found = outcomes(prior, layout(plans.to(kind)), None if now is None else layout(now))
            assert all(map(torch.allclose, found, due))


@pytest.mark.parametrize("name", PRIORS)
def test_integers_out_of_range_are_refused_by_a_prior(name: str) -> None:
    prior = PRIORS[name]()
    generator = torch.Generator().manual_seed(0)
    context = random_context(prior, 3, 2, generator)
    _, state = prior.start(3, None if context is None else context[:, 0])
    plans = torch.zeros(3, 2, dtype=torch.long)
    for kind in INTEGERS:
        values = [-1] if kind.is_signed else []
        for wrong in [*values, *([prior.num_actions] if prior.num_actions < 128 else [])]:
            action = torch.tensor([0, 0, wrong]).to(kind)
            for call in (
                lambda action=action: prior.step(action, state),
                lambda action=action: prior(torch.stack([plans[:, 0].to(action.dtype), action], 1), context),
                lambda action=action: prior.log_prob(Plans(torch.stack([action, action], 1), prior.num_actions)),
            ):
                with pytest.raises(ValueError, match="is out of range"):
                    call()
    for wrong in (plans[:, :1], plans[:, 0].double(), plans[:, 0] > 0):
        with pytest.raises(ValueError, match="`action` must be integers"):
            prior.step(wrong, state)


@torch.no_grad()
@pytest.mark.parametrize("name", PRIORS)
def test_a_prior_that_is_called_reads_plans_as_log_prob_does(name: str) -> None:
    prior = PRIORS[name]()
    generator = torch.Generator().manual_seed(0)
    plans = torch.randint(min(prior.num_actions, 100), (5, 4), generator=generator)
    context = random_context(prior, 5, 4, generator)
    with pytest.raises(ValueError, match="`plans` must be integers"):
        prior(plans[0], context)
    with pytest.raises(ValueError, match="`plans` must be integers"):
        prior(plans.double(), context)
    with pytest.raises(ValueError, match="context"):
        prior(plans, plans if context is None else None)
    if context is not None:
        with pytest.raises(ValueError, match="context"):
            prior(plans, context[:4])
        with pytest.raises(ValueError, match="context"):
            prior(plans, context[:, :3])
    if context is not None and prior.num_patterns is None:
        each = context[:, :1].expand(context.shape)
        assert prior(plans, context[:, 0]).equal(prior(plans, each))


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("name", [name for name in PRIORS if name.endswith("features")])
def test_features_of_every_kind_are_read_in_single_precision(name: str, kind: torch.dtype) -> None:
    """Eighths, which half precision holds; they may require gradients, which nothing that is kept does."""
    prior = PRIORS[name]()
    generator = torch.Generator().manual_seed(0)
    plans = torch.randint(prior.num_actions, (5, 4), generator=generator)
    context = torch.randint(-16, 16, (5, 4, prior.context_size), generator=generator) / 8
    given = context.to(kind).requires_grad_()
    stored = Plans(plans, prior.num_actions, context=given).context
    assert stored is not None
    assert stored.equal(context.to(stored))
    logits, state = prior.start(5, given[:, 0])
    kept = tensors_in((logits, state, prior.step(plans[:, 0], state, given[:, 1])))
    for values in (stored, *kept):
        assert not values.requires_grad
        assert values.dtype.itemsize >= 4
    found, due = (outcomes(prior, plans, values) for values in (given, context))
    assert all(torch.allclose(one.float(), other, atol=1e-6) for one, other in zip(found, due, strict=True))
    drawn = [prior.sample(5, 4, values, generator=generator.manual_seed(1)) for values in (given, context)]
    assert drawn[0].equal(drawn[1])


@pytest.mark.parametrize("make", [*PRIORS.values(), lambda: NoisePrior([-1.0], [1.0])], ids=[*PRIORS, "vectors"])
def test_another_precision_is_refused(make: Callable[[], Prior]) -> None:
    """And leaves the prior as it was."""
    prior = make()
    before = {name: values.clone() for name, values in prior.state_dict().items()}
    for change in (prior.half, prior.bfloat16, prior.double, partial(prior.to, "cpu", torch.double)):
        with pytest.raises(ValueError, match="must compute in single precision"):
            change()
    after = prior.to("cpu").float().state_dict()
    assert all(after[name].dtype == values.dtype and after[name].equal(values) for name, values in before.items())


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
def test_integers_of_every_kind_and_layout_mean_the_same_to_a_world(world: World) -> None:
    def seeded() -> torch.Generator:
        return torch.Generator().manual_seed(1)

    state, num = world.reset(6, seeded()), world.num_actions
    plans = torch.randint(num, (6, 4, 3), generator=seeded())
    due = [*world.step(state, plans[:, 0, 0], seeded()), *world.rollout(state, plans, seeded())[:2]]
    for kind in INTEGERS:
        for layout in LAYOUTS.values():
            given = layout(plans.to(kind))
            found = world.step(layout(state), given[:, 0, 0], seeded()), world.rollout(layout(state), given, seeded())
            assert all(map(torch.equal, [*found[0], *found[1][:2]], due))
        for wrong in [num, *([-1] if kind.is_signed else [])]:
            given = plans.clone()
            given[2, 0] = wrong
            for call in (
                partial(world.step, state, given[:, 0, 0].to(kind)),
                partial(world.rollout, state, given.to(kind)),
            ):
                with pytest.raises(ValueError, match=f"{wrong} is out of range"):
                    call()
    for none in (plans[:2, 0, 0], plans[:, 0], plans[:, 0, 0].double()):
        with pytest.raises(ValueError, match="`action` must be integers"):
            world.step(state, none)


def with_parts(kind, **parts):
    """A class with other attributes and methods."""
    return type("Changed", (kind,), parts)


class Broken(MarkovPrior):
    """A right prior, to be broken in one place."""

    def __init__(self, num_actions=3, order=2, num_contexts=None, **settings):
        super().__init__(num_actions, order, num_contexts=num_contexts)
        self.fit(random_plans(num_actions, None if num_contexts is None else index_context(60) % num_contexts))


def starting(change):
    """`Broken`, whose `start` returns `change(logits, state)`."""

    class Changed(Broken):
        def start(self, batch_size, context=None):
            return change(*super().start(batch_size, context))

    return Changed


def stepping(change):
    """`Broken`, whose `step` returns `change(logits, state)`."""

    class Changed(Broken):
        def step(self, action, state, context=None):
            return change(*super().step(action, state, context))

    return Changed


def reading(change):
    """`Broken`, whose `forward` returns `change(logits)`."""
    return with_parts(Broken, forward=lambda self, plans, context=None: change(Broken.forward(self, plans, context)))


def scoring(log_prob):
    """`Broken` with another `log_prob`, of the actions of plans."""
    return with_parts(Broken, log_prob=lambda self, plans: log_prob(self, getattr(plans, "actions", plans)))


def mean_of_all(logits, state):
    """The mean of the logits of all plans that it is asked for together."""
    return logits.mean(0).expand_as(logits), state


class Forgetful(Broken):
    """Saves too little to be made again."""

    def __init__(self, num_actions=3, bonus=0.0, **settings):
        super().__init__(num_actions)
        self.log_probs[:, 0] += bonus
        self.log_probs.sub_(self.log_probs.logsumexp(1, keepdim=True))

    def state_dict(self, *args, **settings):
        return {}

    def load_state_dict(self, *args, **settings):
        pass


class ReadsContext(Prior):
    """Reads a context in each step, also where there is one for the whole plan."""

    def __init__(self):
        super().__init__(3, context_size=3)

    def start(self, batch_size, context=None):
        return context, torch.zeros(batch_size, 1)

    def step(self, action, state, context=None):
        return context * 2, state

    def fit(self, plans, **settings):
        return self


class Overwrites(Broken):
    """Changes the state that it is given."""

    def step(self, action, state, context=None):
        logits, after = super().step(action, state)
        return logits, state.copy_(after)


class FitsToNothing(Broken):
    def fit(self, plans, **settings):
        super().fit(plans)


class Unsavable(Broken):
    """Its `config` is not what its constructor takes."""

    def __init__(self):
        super().__init__()


class ReadsFirstContext(MarkovPrior):
    """Computes all steps of a plan at once from the context of its first."""

    def forward(self, plans, context=None):
        return super().forward(plans, None if context is None else context[:, :1].expand_as(context))


def changing(prior):
    """The prior, fitted to plans in which what is done depends on a context that changes along them."""
    context = torch.arange(40).view(8, 5) // 3 % 2
    return prior.fit(Plans(context + torch.arange(40).view(8, 5) % 2, 3, context=context))


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            with_parts(
                stepping(lambda logits, state: (logits.roll(1, -1), state)),
                forward=lambda self, plans, context=None: torch.zeros(*plans.shape, 3),
            ),
            "stepping differs from forward",
        ),
        # It keeps what it knows of a row in itself, so that reordering the state does not reorder it.
        (
            stepping(lambda logits, state: (logits + torch.arange(len(logits))[:, None] * torch.arange(3) / 10, state)),
            "stepping differs from forward|with the plans beside it",
        ),
        *(
            (
                partial(with_parts(together(mean_of_all), forward=Prior.forward), num_contexts=2),
                "^forward: the logits of a plan change by .* nats with the plans beside it",
            )
            for together in (starting, stepping)
        ),
        (
            reading(lambda logits: logits.mean(0).expand_as(logits)),
            "^forward: the logits of a plan change by .* nats with the plans beside it",
        ),
        (scoring(lambda prior, actions: Broken.log_prob(prior, actions) + 0.1), "sum to 1.1"),
        (scoring(lambda prior, actions: Broken.log_prob(prior, (actions.long() + 1) % 3)), "do not fit log_prob"),
        (
            with_parts(Broken, sample=lambda self, num, length, *args, **settings: torch.randint(3, (num, length))),
            "same seed gave other plans|global generator",
        ),
        (partial(Forgetful, bonus=1.0), "saved, loaded"),
        (lambda: changing(ReadsFirstContext(3, 1, num_contexts=2)), "stepping differs from forward"),
        (ReadsContext, "step: .* `step` is given None where the last context goes on"),
        (Unsavable, "cannot be saved and loaded"),
        (
            starting(lambda logits, state: (torch.nn.functional.pad(logits, (0, 1)), state)),
            r"^`start` must return floating point logits \[7, 3\], got torch.float32 \[7, 4\]$",
        ),
        (
            stepping(lambda logits, state: (logits.long(), state)),
            r"^`step` must return floating point logits \[7, 3\], got torch.int64 \[7, 3\]$",
        ),
        (
            reading(lambda logits: logits.long()),
            r"^`forward` must return floating point logits \[7, 1, 3\], got torch.int64 \[7, 1, 3\]$",
        ),
        (
            starting(lambda logits, state: (logits.numpy(), state)),
            r"^`start` must return floating point logits \[7, 3\], got ndarray$",
        ),
        (
            starting(lambda logits, state: logits),
            r"^`start` must return logits and a state, got torch.float32 \[7, 3\]$",
        ),
        (Overwrites, "^step must leave the state that it is given as it is, and return another$"),
        (FitsToNothing, "^fit must return the prior itself, got NoneType$"),
    ],
)
def test_a_broken_prior_fails_with_a_message(broken, message):
    with pytest.raises(AssertionError, match=message):
        check_prior(broken())


@pytest.mark.parametrize(("given", "message"), [(None, "got NoneType"), (Forgetful, "the class Forgetful")])
def test_what_is_no_prior_fails_with_a_message(given, message):
    with pytest.raises(AssertionError, match=f"`fit` has to return it.*{message}"):
        check_prior(given)


class Line(World):
    """A right world without a table: a point on a line, to be broken in one place."""

    num_actions, observation = 2, Features(1)

    def reset(self, batch_size, generator=None):
        return torch.rand(batch_size, 1, generator=generator)

    def step(self, state, action, generator=None):
        after = state + (2.0 * action[:, None] - 1)
        return after, -after[:, 0].abs()

    def observe(self, state):
        return state


def moving(change, kind=Line, **parts):
    """A world whose `step` returns `change(after, reward)`."""

    class Changed(kind):
        def step(self, state, action, generator=None):
            return change(*super().step(state, action, generator))

    return with_parts(Changed, **parts)


def rolling(change, kind=Line):
    """A world whose `rollout` returns `change(found, state)`."""

    class Changed(kind):
        def rollout(self, state, plans, generator=None, keep_states=False):
            return change(super().rollout(state, plans, generator, keep_states), state)

    return Changed


class Noisy(Line):
    """Stochastic, which is allowed."""

    stochastic = True

    def step(self, state, action, generator=None):
        after, reward = super().step(state, action)
        return after + torch.randn(after.shape, generator=generator), reward


class InPlace(Line):
    def step(self, state, action, generator=None):
        state += 2.0 * action[:, None] - 1
        return state, -state[:, 0].abs()


class Careless(Line):
    def rollout(self, state, plans, generator=None):
        total = (2.0 * plans - 1).cumsum(-1)
        return Rollout(state[:, None] + total.sum(-1, keepdim=True), -(state[:, None] + total).abs())


class Unchecked(Line):
    def rollout(self, state, plans, generator=None):
        places = state[:, None] + (2.0 * plans - 1).cumsum(-1)
        final = places[..., -1:] if plans.shape[-1] else state[:, None].expand(-1, plans.shape[1], -1)
        return Rollout(final, -places.abs())


class Lucky(TabularWorld):
    """Each plan has random numbers of its own."""

    def __init__(self):
        world = stochastic_world(0)
        super().__init__(world.next_state, world.reward, probability=world.probability)

    def rollout(self, state, plans, generator=None, keep_states=False):
        return World.rollout(self, state, plans, generator, keep_states)


class Biased(Lucky):
    """In its rollouts an action that fails is tried again, one time in two."""

    def rollout(self, state, plans, generator=None, keep_states=False):
        worse, better = (TabularWorld.rollout(self, state, plans, generator, keep_states) for _ in range(2))
        again = torch.rand(len(state), generator=generator) < 0.5
        pick = again[:, None] & (better.rewards[..., -1:] > worse.rewards[..., -1:]).any(-1)
        final = torch.where(pick, better.final_state, worse.final_state)
        return Rollout(final, torch.where(pick[..., None], better.rewards, worse.rewards))


class Ending(Line):
    """Over beyond 2: a right world, where nothing happens after the end."""

    def terminated(self, state):
        return state[:, 0].abs() > 2

    def step(self, state, action, generator=None):
        after, reward = super().step(state, action)
        over = self.terminated(state)
        return torch.where(over[:, None], state, after), reward.masked_fill(over, 0)


class GoesOn(Ending):
    def step(self, state, action, generator=None):
        after, reward = Line.step(self, state, action)
        return after, reward.masked_fill(self.terminated(state), 0)


class PaysOn(Ending):
    def step(self, state, action, generator=None):
        return super().step(state, action)[0], Line.step(self, state, action)[1]


def first_legal(self, state):
    return torch.tensor([True, False]).expand(len(state), 2)


def legal_by_place(self, state):
    """It depends on the place of a state in its batch."""
    legal = torch.ones(len(state), 2, dtype=torch.bool)
    legal[::2, 0] = False
    return legal


class Strict(Line):
    """A simulator that stops at actions that are not legal."""

    all_legal, legal_actions = False, first_legal

    def step(self, state, action, generator=None):
        if (action == 1).any():
            raise RuntimeError("illegal move")
        return super().step(state, action)


def starts_for_states(found, state):
    if found.states is None:
        return found
    return found._replace(states=state[:, None, None].expand_as(found.states))


def ends_for_states(found, state):
    if found.states is None:
        return found
    return found._replace(states=found.states[:, :, -1:].expand_as(found.states))


@pytest.mark.parametrize("world", [Line, Noisy, Ending])
def test_worlds_of_ones_own_conform(world):
    check_world(world())
    check_world(world(), length=1)


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (InPlace, "changed the state"),
        (with_parts(Line, step=lambda self, state, action, generator=None: (state, action)), "reward of torch.int64"),
        (moving(lambda after, reward: (after - after.mean(), reward)), "depends on its batch"),
        (Careless, "rollout ends in other states"),
        (Unchecked, "must raise ValueError"),
        (with_parts(Noisy, stochastic=False), "`stochastic` is False"),
        # Its rollouts have a smaller variance than its steps.
        (rolling(lambda found, _: found._replace(rewards=0.9 * found.rewards), Noisy), "rewards of rollout do not fit"),
        (Lucky, "different random numbers"),
        (Biased, "do not fit those of steps"),
        (with_parts(Line, all_legal=True, legal_actions=first_legal), "all_legal is True"),
        (with_parts(Line, observation=None), "what it gives is not declared"),
        (
            with_parts(Line, observation=Features(3)),
            r"`observe` must give .*Features\(size=3\), got torch.float32 \[\d+, 1\]",
        ),
        (GoesOn, "terminated states must stay"),
        (PaysOn, "reward from terminated states must be 0"),
        # It says where its goal is, which `reset` never draws, but not that it has one.
        (with_parts(Line, solved=lambda self, state: state[:, 0] > 2), "has_goal is False"),
        (rolling(starts_for_states), "last of the states is not the final one"),
        (
            with_parts(Line, all_legal=False, legal_actions=legal_by_place),
            "legal_actions: what is found in a state depends on its batch",
        ),
        (
            with_parts(Line, has_goal=True, solved=lambda self, state: torch.arange(len(state)) % 2 == 0),
            "solved: what is found in a state depends on its batch",
        ),
        (with_parts(Line, group=lambda self, state: torch.zeros(1, dtype=torch.long)), "group must return int64"),
        (
            moving(lambda after, reward: (after, torch.rand(len(after))), stochastic=True),
            "the same seed gave other rewards",
        ),
        (Strict, "stops at actions that are not legal .illegal move."),
        (rolling(ends_for_states), "states on the way are not those of shorter plans"),
    ],
)
def test_a_broken_world_fails_with_a_message(broken, message):
    with pytest.raises(AssertionError, match=message):
        check_world(broken())


def test_chi_square_is_scipys() -> None:
    from scipy import stats

    expected = torch.tensor([50.0, 30.0, 20.0, 100.0])
    counts = torch.tensor([60.0, 25.0, 15.0, 100.0])
    assert chi_square(counts, expected) == pytest.approx(stats.chisquare(counts, expected).pvalue)
    # Two cells below five are taken together: 3 + 4 expected.
    pooled = stats.chisquare([5.0, 60.0, 42.0], [7.0, 60.0, 40.0]).pvalue
    assert chi_square(torch.tensor([1.0, 4, 60, 42]), torch.tensor([3.0, 4, 60, 40])) == pytest.approx(pooled)


def test_alike_is_scipys_test_of_each_group() -> None:
    from scipy import stats

    generator = torch.Generator().manual_seed(0)
    group = torch.arange(3).repeat_interleave(1000)
    weights = torch.tensor([[5.0, 3, 2], [1, 1, 8], [0, 1, 0]])  # each number's middle rank is in a bin of its own
    first, second = (weights[group].multinomial(1, generator=generator)[:, 0] for _ in range(2))
    statistic = 0.0
    for g in range(2):
        table = torch.stack([part[group == g].bincount(minlength=3) for part in (first, second)])
        statistic += stats.chi2_contingency(table, correction=False).statistic
    assert alike(first, second, group) == pytest.approx(stats.chi2.sf(statistic, 4))
    assert alike(first, torch.where(group == 2, 0, second), group) < 1e-50
    assert alike(first[group == 2], first[group == 2], group[group == 2] - 2) == 1.0


@pytest.mark.parametrize("continuous", [True, False])
def test_alike_raises_false_alarms_as_often_as_it_says(continuous: bool) -> None:
    from scipy import stats

    generator = torch.Generator().manual_seed(1)
    group = torch.arange(5).repeat_interleave(100)
    p = []
    for _ in range(300):
        draws = torch.rand(2, 500, generator=generator)
        draws = draws if continuous else (draws**3 * 6).floor()
        p.append(alike(draws[0], draws[1], group))
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-6  # small p-values are no more frequent
    assert sum(p) / 300 < 0.62  # and it is not blind


def test_a_world_without_actions_and_what_is_no_world_are_refused() -> None:
    world = gridworld(3, 3, seed=0)
    world.num_actions = np.int64(4)  # type: ignore[assignment]
    check_world(world)
    world.num_actions = 0
    with pytest.raises(AssertionError, match="`num_actions` must be an integer above 0, got 0"):
        check_world(world)
    with pytest.raises(AssertionError, match="`world` must be a World, got int"):
        check_world(3)  # type: ignore[arg-type]
