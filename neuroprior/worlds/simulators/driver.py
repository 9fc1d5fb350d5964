"""Steps simulators of one kind, and reads what can be seen and done in them."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from neuroprior.worlds.observations import Categories, Features
from neuroprior.worlds.simulators.copies import Copier
from neuroprior.worlds.simulators.generators import (
    create_lazy_generators,
    find_generators,
    seed_generators,
    state_of_generators,
    state_of_held,
)

Array = np.ndarray[Any, Any]

RUNNING, TERMINATED, TRUNCATED = 0, 1, 2

MASK_METHODS = ("action_masks", "action_mask")


class View(NamedTuple):
    """What can be seen and done in a state: the observation, and which actions are legal, bool `[A]`; None: unknown."""

    observation: Any
    mask: Array | None


class Path(NamedTuple):
    """What a plan led to, up to the end of the episode.

    Attributes:
        taken: the actions that were taken: all but those that were not legal.
        rewards: of each action of the plan.
        counts: how many actions had been taken after each of the plan; empty where no views were wanted.
        views: after each action of the plan; empty where none were wanted.
        ended: whether the episode ended.
    """

    taken: list[int]
    rewards: list[float]
    counts: list[int]
    views: list[View]
    ended: bool

    def last_reward(self) -> float:
        """The reward of the last action that was taken."""
        if not self.taken:
            return 0.0
        return self.rewards[self.counts.index(len(self.taken)) if self.counts else -1]


class FromStep(NamedTuple):
    """Observations that are a function of what `step` returned last."""

    transform: Callable[[Any], Any]


def _same(observation: Any) -> Any:
    return observation


def _mask_in(*sources: Any) -> Any:
    """The `action_mask` of the first source that is a dict with one: infos, PettingZoo's observations; None: none."""
    return next((one["action_mask"] for one in sources if isinstance(one, dict) and "action_mask" in one), None)


def _outcome(result: Any) -> tuple[float, int]:
    """The reward that a simulator's `step` returned, and whether and how the episode ended.

    Raises:
        ValueError: it returned something else.
    """
    if not isinstance(result, tuple) or len(result) not in (3, 5):
        raise ValueError(
            "`step` must return (observation, reward, ended) or Gymnasium's five, got"
            f" {len(result) if isinstance(result, tuple) else type(result).__name__}"
        )
    try:
        ended = TERMINATED if result[2] else TRUNCATED if len(result) == 5 and result[3] else RUNNING
        return float(result[1]), ended  # now: a simulator may return the same array again
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`step` must return (observation, reward, ended) with a number as reward and True or False as end: {error}"
        ) from error


class Driver:
    """Steps simulators of one kind, and reads what can be seen and done in them.

    Args:
        num_actions: A.
        first_action: the number of the first action in the simulator.
        legal_actions: a function from a simulator to its legal actions, bool `[A]`; None: a method of the simulator or
            the `action_mask` in its info, or in its observation, says so, or all are legal.
        observe: a function from a simulator to its observation; "observation": what `step` returned last; a `FromStep`:
            a function of that; None: nothing is observed.
        observation: what `observe` returns.

    Attributes:
        reads_mask: whether a function or a method says which actions are legal.
        has_masks: whether not all actions are legal everywhere.
    """

    def __init__(
        self,
        num_actions: int,
        first_action: int,
        legal_actions: Callable[[Any], Any] | None,
        observe: Any,
        observation: Categories | Features | None,
    ) -> None:
        self.num_actions, self.first_action = num_actions, first_action
        self.observe = FromStep(_same) if observe == "observation" else observe
        self.observation = observation
        self.legal_actions, self.reads_mask = legal_actions, legal_actions is not None
        self.has_masks = self.reads_mask

    def find_masks(self, simulator: Any, observation: Any, info: Any) -> None:
        """Find out where masks come from: a method of `simulator`, its `info`, or its observation."""
        if self.legal_actions is None:
            self.legal_actions = next(
                (_Method(name) for name in MASK_METHODS if _Method(name).of(simulator) is not None), None
            )
            self.reads_mask = self.legal_actions is not None
        self.has_masks = self.has_masks or self.reads_mask or _mask_in(info, observation) is not None

    def take(self, simulator: Any, action: int) -> tuple[Any, float, int, Any]:
        """Take an action: the observation, the reward, whether and how the episode ended, and the info.

        Raises:
            ValueError: `step` returns something else.
        """
        result = simulator.step(action + self.first_action)
        reward, ended = _outcome(result)
        return result[0], reward, ended, result[4] if len(result) == 5 else None

    def view(self, simulator: Any, observation: Any, info: Any) -> View:
        """What can be seen and done in the state of a simulator, of which the last step told `observation` and `info`.

        Raises:
            ValueError: the observation is not as declared, or the mask has a wrong shape.
        """
        mask = None
        if self.reads_mask:
            assert self.legal_actions is not None
            mask = self.legal_actions(simulator)
        else:
            mask = _mask_in(info, observation)
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_actions,):
                raise ValueError(f"`legal_actions` must be bool [{self.num_actions}], got {list(mask.shape)}")
            if not np.isin(mask, (0, 1)).all():
                raise ValueError(f"`legal_actions` must be True or False for each action, got {mask.tolist()}")
            mask = mask.astype(bool)
        if self.observe is None:
            return View(None, mask)
        if isinstance(self.observe, FromStep):
            return View(None if observation is None else self.as_declared(observation), mask)
        return View(self._check(self.observe(simulator)), mask)

    def legal_numbers(self, view: View) -> Array:
        """The numbers of the actions that are legal, all where that is not known."""
        return np.arange(self.num_actions) if view.mask is None else np.flatnonzero(view.mask)

    def end(self, view: View) -> int:
        """Whether an episode ends where nothing is legal."""
        return TERMINATED if view.mask is not None and not view.mask.any() else RUNNING

    def as_declared(self, observation: Any) -> Any:
        """What `step` returned as an observation of this world."""
        return self._check(self.observe.transform(observation))

    def _check(self, value: Any) -> Any:
        """An observation as declared: an integer, or float32 `[C]`."""
        if isinstance(self.observation, Categories):
            number = self.observation.number
            if np.ndim(value) or not 0 <= int(value) < number or int(value) != value:
                raise ValueError(f"`observe` must return an integer from 0 to {number - 1}, got {value!r}")
            return int(value)
        assert self.observation is not None
        features, size = np.atleast_1d(np.array(value, dtype=np.float32)), self.observation.size
        if features.shape != (size,):
            raise ValueError(f"`observe` must return {size} numbers, got the shape {list(features.shape)}")
        return features

    def follow(self, simulator: Any, actions: Sequence[int], view: View | None) -> Path:
        """Step a simulator, in place, through actions, up to the end of the episode.

        Args:
            simulator: where to begin.
            actions: of a plan.
            view: of the state to begin in; None: no views are wanted, and all actions are legal. Actions that are not
                legal change nothing, with a reward of 0.
        """
        if view is None:
            return self._hurry(simulator, actions)
        path = Path([], [], [], [], False)
        for action in actions:
            reward, ended = 0.0, RUNNING
            if view.mask is None or view.mask[action]:
                observation, reward, ended, info = self.take(simulator, action)
                view = self.view(simulator, observation, info)
                ended = ended or self.end(view)
                path.taken.append(action)
            path.rewards.append(reward)
            path.counts.append(len(path.taken))
            path.views.append(view)
            if ended:
                return path._replace(ended=True)
        return path

    def _hurry(self, simulator: Any, actions: Sequence[int]) -> Path:
        """`follow` without views, and with as little beside the simulator's steps as possible."""
        step, first, rewards, ended = simulator.step, self.first_action, list[float](), RUNNING
        for action in actions:
            reward, ended = _outcome(step(action + first))
            rewards.append(reward)
            if ended:
                break
        return Path(list(actions[: len(rewards)]), rewards, [], [], bool(ended))


class _Method:
    """Calls a method, or reads an attribute, of simulators and of what Gymnasium's wrappers hold."""

    def __init__(self, name: str) -> None:
        self.name = name

    def of(self, simulator: Any) -> Any:
        """The method, or None where there is none that needs no arguments."""
        inner = getattr(simulator, "unwrapped", simulator)
        value = getattr(simulator, self.name, getattr(inner, self.name, None))
        return None if callable(value) and needs_arguments(value) else value

    def __call__(self, simulator: Any) -> Any:
        value = self.of(simulator)
        return value() if callable(value) else value


def needs_arguments(function: Any) -> bool:
    """Whether a function cannot be called without arguments."""
    parameters = inspect.signature(function).parameters.values()
    return any(p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD) for p in parameters)


def make_simulator(factory: Callable[[], Any], seed: int) -> tuple[Any, Any, Any]:
    """A new simulator at the start of an episode, and its first observation and info, where it tells them.

    Args:
        factory: makes it.
        seed: of all that is random in making and resetting it.
    """
    seed_generators([], seed)
    simulator = factory()
    create_lazy_generators(simulator)
    seed_generators(find_generators(simulator).values(), seed)
    reset = getattr(simulator, "reset", None)
    if not callable(reset):
        return simulator, None, None
    parameters = inspect.signature(reset).parameters.values()
    seeded = any(p.name == "seed" or p.kind is p.VAR_KEYWORD for p in parameters)
    if not seeded and needs_arguments(reset):
        return simulator, None, None
    result = reset(seed=seed % 2**31) if seeded else reset()
    if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict):
        return simulator, *result
    return simulator, result, None


def follow_plans(
    driver: Driver, copier: Copier, saved: Any, view: View | None, plans: list[list[int]], seeds: list[int | None]
) -> tuple[list[Path], bool]:
    """The paths of plans from one state, each under the noise of its seed, and whether one without a seed drew."""
    paths, held, draws = list[Path](), None, False
    shared = state_of_generators(copier.shared_generators()) if None in seeds else None
    for plan, seed in zip(plans, seeds, strict=True):
        simulator = copier.load(saved)
        if seed is not None:
            seed_generators(copier.generators(simulator), seed)
        elif held is None:  # the same in all copies
            held = state_of_held(copier.separate_generators(simulator))
        paths.append(driver.follow(simulator, plan, view))
        draws = draws or (seed is None and held != state_of_held(copier.separate_generators(simulator)))
    return paths, draws or (shared is not None and shared != state_of_generators(copier.shared_generators()))
