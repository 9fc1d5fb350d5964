"""Tries out a simulator on random walks: whether copies of it behave alike, and whether it is stochastic."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from neuroprior.worlds.simulators.copies import Copier
from neuroprior.worlds.simulators.driver import Driver, View
from neuroprior.worlds.simulators.fingerprints import fingerprint
from neuroprior.worlds.simulators.generators import seed_generators, state_of_generators

NUM_WALKS, WALK_LENGTH = 6, 32
"""Random walks, and actions in each."""

EXTRA_STEPS = 1000
"""Steps of more walks, where generators are drawn from but no walk was changed by it."""

SEEDED = "draw its noise from generators that it holds, or from the modules'"


class Start(NamedTuple):
    """A saved simulator to walk from, and what can be seen and done there."""

    saved: Any
    view: View


class Noise(NamedTuple):
    """Whether a simulator is stochastic, whether it draws from any generator, and whether a user declared it."""

    stochastic: bool
    draws: bool
    declared: bool = False


class Moment(NamedTuple):
    """What one step gave, as far as it can be compared."""

    action: int
    observation: bytes
    reward: str
    ended: int
    mask: bytes


def try_out(driver: Driver, copier: Copier, starts: Sequence[Start], seed: int, look_for_noise: bool) -> Noise:
    """Compare walks of copies under the same and under other random numbers.

    Args:
        driver: steps the simulators; it is told where masks come from.
        copier: copies them.
        starts: where walks begin.
        seed: of the walks and of the noise.
        look_for_noise: whether it is not known already if the simulator is stochastic.

    Raises:
        ValueError: copies share a state, lose a part of it, or have noise that cannot be seeded.
    """
    draw = np.random.default_rng(seed)
    stochastic = draws = False
    for walk in range(NUM_WALKS):
        start = starts[walk % len(starts)]
        first_seed, second_seed, other_seed = (int(value) for value in draw.integers(2**62, size=3))
        before = fingerprint(copier.load(start.saved))
        simulator = load_seeded(copier, start.saved, first_seed)
        states = state_of_generators(copier.generators(simulator))
        moments, view = random_walk(driver, simulator, start.view, walk * WALK_LENGTH // (2 * NUM_WALKS), draw)
        saved = copier.save(simulator, (start.saved, _actions(moments), first_seed))
        draws = draws or states != state_of_generators(copier.generators(simulator))
        if moments and moments[-1].ended:
            continue
        simulator = load_seeded(copier, saved, second_seed)
        states = state_of_generators(copier.generators(simulator))
        after, _ = random_walk(driver, simulator, view, WALK_LENGTH - len(moments), draw)
        draws = draws or states != state_of_generators(copier.generators(simulator))
        if fingerprint(copier.load(start.saved)) != before:
            raise ValueError("`simulator` must have copies that share nothing with it: stepping one changed another")
        again = _follow(driver, copier, saved, view, _actions(after), second_seed)
        _require_equal(after, again, SEEDED)
        simulator = load_seeded(copier, start.saved, first_seed)
        whole, _ = follow_on(driver, simulator, start.view, _actions(moments))
        _require_equal(moments, whole, SEEDED)
        seed_generators(copier.generators(simulator), second_seed)
        rest, _ = follow_on(driver, simulator, view, _actions(after))
        _require_equal(after, rest, "have copies that behave as it does")
        if look_for_noise and not stochastic:
            stochastic = _follow(driver, copier, saved, view, _actions(after), other_seed) != after
    steps = 0
    while look_for_noise and draws and not stochastic and steps < EXTRA_STEPS:
        start = starts[steps % len(starts)]
        first_seed, other_seed = (int(value) for value in draw.integers(2**62, size=2))
        simulator = load_seeded(copier, start.saved, first_seed)
        moments, _ = random_walk(driver, simulator, start.view, 4 * WALK_LENGTH, draw)
        stochastic = _follow(driver, copier, start.saved, start.view, _actions(moments), other_seed) != moments
        steps += len(moments) + 1
    return Noise(stochastic, draws)


def require_same_starts(driver: Driver, copier: Copier, first: Start, second: Start) -> None:
    """Raise ValueError unless two simulators that were made by the same seed behave alike."""
    simulator = load_seeded(copier, first.saved, 0)
    moments, _ = random_walk(driver, simulator, first.view, WALK_LENGTH, np.random.default_rng(0))
    again = _follow(driver, copier, second.saved, second.view, _actions(moments), 0)
    _require_equal(moments, again, SEEDED)


def require_as_original(driver: Driver, copier: Copier, start: Start, original: Any) -> None:
    """Raise ValueError unless a simulator, which is stepped itself, behaves as copies of one that was made alike."""
    moments, _ = random_walk(driver, copier.load(start.saved), start.view, WALK_LENGTH, np.random.default_rng(0))
    whole, _ = follow_on(driver, original, start.view, _actions(moments))
    _require_equal(moments, whole, "have copies that behave as it does")


def changes_by_noise(driver: Driver, copier: Copier, start: Start, actions: Sequence[int], seed: int) -> bool:
    """Whether actions give something else under the noise of `seed` than under that of 0."""
    first, second = (_follow(driver, copier, *start, actions, one) for one in (0, seed))
    return first != second


def _actions(moments: Sequence[Moment]) -> list[int]:
    return [moment.action for moment in moments]


def load_seeded(copier: Copier, saved: Any, seed: int) -> Any:
    """A copy whose generators are seeded."""
    simulator = copier.load(saved)
    seed_generators(copier.generators(simulator), seed)
    return simulator


def _follow(driver: Driver, copier: Copier, saved: Any, view: View, actions: Sequence[int], seed: int) -> list[Moment]:
    """What a copy gives for these actions under the noise of a seed."""
    simulator = load_seeded(copier, saved, seed)
    return follow_on(driver, simulator, view, actions)[0]


def follow_on(driver: Driver, simulator: Any, view: View, actions: Sequence[int]) -> tuple[list[Moment], View]:
    """What a simulator gives for these actions, without those that are not legal, and the last view."""
    moments: list[Moment] = []
    for action in actions:
        if view.mask is None or view.mask[action]:
            moment, view = _moment(driver, simulator, action)
            moments.append(moment)
            if moment.ended:
                break
    return moments, view


def random_walk(
    driver: Driver, simulator: Any, view: View, length: int, draw: np.random.Generator
) -> tuple[list[Moment], View]:
    """What a simulator gives for random legal actions, and the last view."""
    moments: list[Moment] = []
    for _ in range(length):
        legal = driver.legal_numbers(view)
        if not len(legal) or (moments and moments[-1].ended):
            break
        moment, view = _moment(driver, simulator, int(draw.choice(legal)))
        moments.append(moment)
    return moments, view


def _moment(driver: Driver, simulator: Any, action: int) -> tuple[Moment, View]:
    """What a step gives, and the view after it."""
    try:
        observation, reward, ended, info = driver.take(simulator, action)
    except ValueError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise ValueError(
            f"`simulator` must step by each action, or say which are legal; action {action} raised {reason}"
        ) from error
    driver.find_masks(simulator, observation, info)
    view = driver.view(simulator, observation, info)
    seen = fingerprint([observation, view.observation])
    return Moment(
        action, seen, repr(reward), ended or driver.end(view), b"" if view.mask is None else view.mask.tobytes()
    ), view


def _require_equal(first: list[Moment], second: list[Moment], rule: str) -> None:
    """Raise ValueError, with what differs, unless two walks gave the same."""
    for t, (one, other) in enumerate(zip(first, second, strict=False), start=1):
        for name in ("observation", "reward", "ended", "mask"):
            if getattr(one, name) != getattr(other, name):
                raise ValueError(f"`simulator` must {rule}; under the same seeds the {name} of action {t} differed")
    if len(first) != len(second):
        raise ValueError(
            f"`simulator` must {rule}; under the same seeds walks had {len(first)} and {len(second)} steps"
        )
