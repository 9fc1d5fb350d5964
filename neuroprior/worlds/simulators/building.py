"""`from_simulator`: simulators of any kind as worlds."""

import copy
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import methodcaller
from typing import Any, Literal

from neuroprior._checks import check_sizes, kind_of, warn_caller
from neuroprior.worlds.observations import Categories, Features
from neuroprior.worlds.simulators.copies import (
    CloneCopier,
    Copier,
    DeepCopier,
    PickleCopier,
    ReplayCopier,
    StateCopier,
)
from neuroprior.worlds.simulators.driver import Driver, make_simulator
from neuroprior.worlds.simulators.fingerprints import fingerprint
from neuroprior.worlds.simulators.generators import keep_global_generators, seed_generators
from neuroprior.worlds.simulators.trials import Noise, require_as_original, require_same_starts, try_out
from neuroprior.worlds.simulators.world import SimulatorWorld, enter, make_start
from neuroprior.worlds.world import check_objective

NOISE_SHOWS = (
    "`stochastic` must be None or True where other random numbers change what happens, got False: every plan is tried"
    " under the same noise, which planners foresee"
)


def from_simulator(
    simulator: Any,
    num_actions: int | None = None,
    *,
    clone: Callable[[Any], Any] | None = None,
    legal_actions: Callable[[Any], Any] | None = None,
    observe: Callable[[Any], Any] | Literal["observation"] | None = None,
    observation: Categories | Features | None = None,
    objective: Literal["terminal", "return"] = "return",
    discount: float = 1.0,
    stochastic: bool | None = None,
    seeds: Sequence[int] | None = None,
    workers: int | None = None,
    action_names: Sequence[str] | None = None,
    seed: int = 0,
) -> SimulatorWorld:
    """A simulator of any kind as a world: planners try their plans in copies of it.

    A simulator has a method `step(action)`, which returns an observation, a reward and whether the episode has ended,
    or Gymnasium's five. It is copied by `clone`, else by its method `clone()`, else by `get_state()` and
    `set_state(state)`, else by pickle or `copy.deepcopy`. The simulator itself is never stepped, reset or changed.

    Planning begins at its present state, which `world.reset` returns. After each step of a running simulator,
    `world.state_of(simulator)` is the state to plan from.

    Copies are tried out: on random walks they must behave as the simulator does. Where other random numbers change
    what happens, the world is stochastic. Then each candidate plan meets noise of its own, drawn by the generator that
    a planner is given. Noise must come from generators that the simulator holds (of numpy, `random` or torch, however
    deep), or from the modules' own. Noise that no walk met is a ValueError when plans meet it.

    Args:
        simulator: an object, a list of them (several starts), or a function without arguments that makes one. Of a
            function each start is a new simulator; its `reset` is called, with `seed=` if it takes one. So it is with a
            Gymnasium environment that was never reset.
        num_actions: actions are numbered from 0; None: as many as the `action_space` has.
        clone: a function from a simulator to an independent copy.
        legal_actions: a function from a simulator to bool `[A]`. None: by its method `action_masks()` or
            `action_mask()`, or by `action_mask` in the info of the last step, or in its observation (which are not
            known before the first step: then all are legal). Where none is legal the episode is over.
        observe: a function from a simulator to what is observed, or "observation": what `step` returned last.
        observation: what `observe` returns, `Categories(number)` or `Features(size)`.
        objective, discount: what counts in this world; see `Planner`.
        stochastic: whether the same actions may lead to something else; None: this is tried out. False: every plan is
            tried under the same noise.
        seeds: of a function: starts are made by these, and drawn with equal probability; None: each is a new one.
        workers: so many processes share the plans of a start; worth it for steps of milliseconds. None: this process.
        action_names: A names.
        seed: of the walks on which the simulator is tried out.

    Raises:
        ValueError: the simulator cannot be copied, its copies share a state, its noise cannot be seeded, or an argument
            is wrong.

    Warns:
        UserWarning: `stochastic` is False, but other random numbers changed the walks.

    Example:
        >>> class Walk:
        ...     place = 0
        ...
        ...     def step(self, action):
        ...         self.place += 2 * action - 1
        ...         return None, float(self.place == 3), self.place == 3
        >>> world = from_simulator(Walk(), 2)
        >>> world.rollout(world.reset(1), torch.ones(1, 1, 4, dtype=torch.long)).rewards.tolist()
        [[[0.0, 0.0, 1.0, 0.0]]]
    """
    if workers is not None:
        check_sizes(workers=workers)
    check_objective(objective, discount)
    if (observe is None) != (observation is None):
        raise ValueError("`observe` and `observation` must be given together: what is observed, and what it is")
    with keep_global_generators():
        seed_generators([], seed)
        originals, factory = _sort(simulator, seed)
        example = originals[0] if originals else factory()
        number, first = _count_actions(example, num_actions)
        if action_names is not None and len(action_names) != number:
            raise ValueError(f"`action_names` must have {number} names, got {len(action_names)}")
        driver = Driver(number, first, legal_actions, observe, observation)
        make = None if originals else partial(make_simulator, factory)
        marks = [fingerprint(one) for one in originals]
        problem: Exception = ValueError("`simulator` must have copies")
        for copier in _copiers(example, clone, make, first):
            try:
                if make is None:
                    starts = [enter(driver, copier, one, None, None) for one in originals]
                else:
                    starts = [make_start(driver, copier, make, one) for one in seeds or (seed, seed + 1)]
                    require_same_starts(
                        driver, copier, starts[0], make_start(driver, copier, make, (seeds or (seed,))[0])
                    )
                noise = try_out(driver, copier, starts, seed, not stochastic)
                if make is not None and not noise.draws:
                    require_as_original(driver, copier, starts[0], make((seeds or (seed,))[0])[0])
            except Exception as error:  # a simulator may fail to be copied in any way of its own
                problem = error
                continue
            if [fingerprint(one) for one in originals] != marks:
                raise ValueError("`simulator` must have copies that share nothing with it: stepping one changed it")
            if noise.stochastic and stochastic is False:
                warn_caller(NOISE_SHOWS)
            noise = noise if stochastic is None else Noise(stochastic, True, declared=True)
            kept = starts if make is None or seeds is not None else []
            world = SimulatorWorld(driver, copier, noise, make, kept, workers)
            world.objective, world.discount = objective, discount
            world.kinds = tuple({type(getattr(one, "unwrapped", one)) for one in originals or [example]})
            world.action_names = None if action_names is None else tuple(action_names)
            return world
    if isinstance(problem, ValueError):
        raise problem
    raise ValueError(f"`simulator` must have copies; {type(problem).__name__}: {problem}".splitlines()[0]) from problem


def _sort(simulator: Any, seed: int) -> tuple[list[Any], Callable[[], Any]]:
    """The simulators whose present states are starts; or none, and the function that makes them."""
    several = list(simulator) if isinstance(simulator, list | tuple) else [simulator]
    if not several:
        raise ValueError("`simulator` must be one or more simulators, got none")
    single = several[0]
    if not isinstance(single, type) and callable(getattr(single, "step", None)):
        if len(several) == 1 and not _was_reset(single):
            return [], partial(copy.deepcopy, single)
        return several, lambda: None
    if len(several) > 1 or not callable(single):
        raise ValueError(
            f"`simulator` must be an object with a method `step`, or a function that makes one, got {kind_of(single)}"
        )
    return [], single


def _was_reset(simulator: Any) -> bool:
    """Whether a simulator can be stepped; a Gymnasium environment only after its reset."""
    if not hasattr(simulator, "unwrapped") or not hasattr(simulator, "action_space"):
        return True
    layer = simulator
    while layer is not None:
        if getattr(layer, "_has_reset", True) is False:
            return False
        layer = vars(layer).get("env")
    try:
        copied = copy.deepcopy(simulator)
        copied.step(int(getattr(simulator.action_space, "start", 0)))
    except Exception:
        return False
    return True


def _count_actions(simulator: Any, num_actions: int | None) -> tuple[int, int]:
    """The number of actions, and the number of the first in the simulator."""
    space = getattr(simulator, "action_space", None)
    if num_actions is None and space is not None:
        if type(space).__name__ != "Discrete":
            raise ValueError(f"`simulator` must have discrete actions, got those of the space {space}")
        return int(space.n), int(space.start)
    check_sizes(num_actions=num_actions)
    assert num_actions is not None
    return num_actions, int(getattr(space, "start", 0))


def _copiers(simulator: Any, clone: Any, make: Any, first_action: int) -> Iterator[Copier]:
    """The ways in which a simulator may be copied, those of its own alone where it has any."""
    if clone is not None or callable(getattr(simulator, "clone", None)):
        yield CloneCopier(clone if clone is not None else methodcaller("clone"))
    elif callable(getattr(simulator, "get_state", None)) and callable(getattr(simulator, "set_state", None)):
        yield StateCopier(copy.deepcopy(simulator), deep=False)
        yield StateCopier(copy.deepcopy(simulator), deep=True)
    else:
        if not hasattr(simulator, "__deepcopy__"):
            yield PickleCopier()
        yield DeepCopier()
        if make is not None:
            yield ReplayCopier(lambda seed: make(seed)[0], first_action)
