"""The interface of a world: a batched simulator in which a planner tries its plans."""

from abc import ABC, abstractmethod
from numbers import Integral
from typing import Literal, NamedTuple, Self, TypeVar

import torch
from torch import Tensor

from neuroprior._checks import check_range, describe, is_integer, is_number, kind_of
from neuroprior.worlds.observations import Observation, as_context


class Rollout(NamedTuple):
    """What plans led to: B starts, P plans for each start, L steps.

    Attributes:
        final_state: `[B, P]` (and the state's own dimensions, if it has any): where each plan ended.
        rewards: `[B, P, L]` floating point: the reward of each step.
        states: `[B, P, L]` (and the state's own dimensions): the state after each step; None where not asked for.
    """

    final_state: Tensor
    rewards: Tensor
    states: Tensor | None = None


Holder = TypeVar("Holder")


def moved(holder: Holder, device: torch.device | str) -> Holder:
    """`holder`, whose tensors, and other attributes that can be moved `to` a device, are moved to `device`.

    Tensors of its class are moved for it alone. What is in lists or other containers stays where it is.
    """
    device = torch.device(device)
    of_class = {name: value for kind in reversed(type(holder).__mro__) for name, value in vars(kind).items()}
    tensors = {name: value for name, value in of_class.items() if isinstance(value, Tensor)}
    for name, value in (tensors | vars(holder)).items():
        if hasattr(value, "to"):
            setattr(holder, name, value.to(device))
    return holder


def on_cpu(world: Holder, device: torch.device | str) -> Holder:
    """`world`, which simulates on the CPU alone; raises ValueError where `device` is another one."""
    if torch.device(device).type != "cpu":
        raise ValueError(f"device: {type(world).__name__} simulates on the CPU, and cannot be moved to {device}")
    return world


class World(ABC):
    """A batched simulator with a finite set of actions, numbered from 0.

    A state is one tensor whose first dimension is the batch; what its other dimensions mean is up to the world.
    A subclass sets `num_actions` and writes `reset` and `step`; the rest has defaults.

    Attributes:
        num_actions: the number of actions, A.
        all_legal: True where every action is legal in every state, so that `legal_actions` need not be called. A class
            that writes `legal_actions`, and says nothing of this, has False.
        stochastic: True where the outcome of an action is random, so that one rollout of a plan is not enough.
        shares_steps: True where steps from different states may be taken on several threads at once.
        observation: what `observe` gives: `Categories(number)`, `Features(size)`, or None where nothing is observed.
        has_goal: True where `solved` says in which states a goal is reached.
        objective: what counts in this world: "return", the sum of a plan's rewards, or "terminal", its last reward.
            Planners without an objective of their own follow it.
        discount: above 0, at most 1: the reward of step t (from 0) counts `discount ** t` in a return.
        action_names: names of the actions, where there are any.
        max_snapshots: how many states can be stepped from at once; others are first reached again. None: all.
    """

    num_actions: int
    all_legal: bool = True
    stochastic: bool = False
    shares_steps: bool = False
    observation: Observation | None = None
    has_goal: bool = False
    objective: Literal["terminal", "return"] = "return"
    discount: float = 1.0
    action_names: tuple[str, ...] | None = None
    max_snapshots: int | None = None

    def __init_subclass__(cls, **settings: object) -> None:
        super().__init_subclass__(**settings)
        definer = next(kind for kind in cls.__mro__ if {"legal_actions", "all_legal"} & vars(kind).keys())
        if "all_legal" not in vars(definer):
            cls.all_legal = False
        if isinstance(number := vars(cls).get("num_actions"), Integral):
            cls.num_actions = int(number)

    def __setattr__(self, name: str, value: object) -> None:
        # Gymnasium's spaces count in numpy's integers, which torch takes in few places.
        super().__setattr__(name, int(value) if name == "num_actions" and isinstance(value, Integral) else value)

    def to(self, device: torch.device | str) -> Self:
        """Move the tensors of this world, and of worlds that it holds, to `device`; returns self."""
        return moved(self, device)

    @abstractmethod
    def reset(self, batch_size: int, generator: torch.Generator | None = None) -> Tensor:
        """Random states to plan from, `[batch_size, ...]`."""

    @abstractmethod
    def step(self, state: Tensor, action: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """One step.

        It is also given actions that are not legal, since some planners try plans of all actions and leave out those
        with an illegal one afterwards: it must not raise an error then, and what it returns does not count.

        Args:
            state: `[N, ...]`.
            action: int64 `[N]` between 0 and A - 1.
            generator: draws what is random.

        Returns:
            The next state `[N, ...]` and the reward of the step, `[N]` floating point.
        """

    def rollout(
        self, state: Tensor, plans: Tensor, generator: torch.Generator | None = None, keep_states: bool = False
    ) -> Rollout:
        """Try P plans from each of B starts. Shapes, dtypes and ranges are checked once, here, not at every step.

        In a stochastic world this default draws for each plan independently. A world may use common random numbers for
        all plans of a start instead (as `TabularWorld` does); starts are always independent.

        Args:
            state: `[B, ...]`.
            plans: integers `[B, P, L]` between 0 and A - 1.
            generator: draws what is random.
            keep_states: also return the state after each step.

        Raises:
            ValueError: a shape, dtype or value is wrong; the message says which.
        """
        self.check_state(state)
        check_plans(plans, state.shape[0], self.num_actions)
        batch, num_plans, length = plans.shape
        now = state.repeat_interleave(num_plans, 0)
        rewards, states = [torch.zeros(batch, num_plans, 0, device=state.device)], []
        for t in range(length):
            now, reward = step_alive(self, now, plans[:, :, t].reshape(-1).long(), generator)
            rewards.append(reward.view(batch, num_plans, 1))
            if keep_states:
                states.append(now)
        shape = (batch, num_plans, *state.shape[1:])
        kept = join_states(states, state, shape) if keep_states else None
        return Rollout(now.view(shape), torch.cat(rewards, -1), kept)

    def observe(self, state: Tensor) -> Tensor:
        """The observation in `state [N, ...]`, as `observation` declares it: `[N]` categories, `[N, C]` features.

        Default: there is none.

        Raises:
            ValueError: the world observes nothing.
        """
        raise ValueError(f"observe: {type(self).__name__} observes nothing; write `observe`, and declare `observation`")

    def context(self, state: Tensor) -> Tensor:
        """Returns what is observed in `state [N, ...]` as a context for priors: `[N]`, `[N, C]` or `[N, F]`.

        Features that are integers or truth values become floating point.

        Raises:
            ValueError: nothing is declared in `observation`, or `observe` gives something else.
        """
        observed = self.observe(state)
        if self.observation is None:
            raise ValueError(
                f"observation: {type(self).__name__} must declare what `observe` gives,"
                " such as Categories(number) or Features(size)"
            )
        return as_context(self.observation, observed, len(state))

    def legal_actions(self, state: Tensor) -> Tensor:
        """Which actions are legal in `state [N, ...]`: `[N, A]` bool; where none is, the episode is over.

        Default: all.
        """
        return torch.ones(state.shape[0], self.num_actions, dtype=torch.bool, device=state.device)

    def terminated(self, state: Tensor) -> Tensor:
        """In which of `state [N, ...]` the episode is over: `[N]` bool. Default: none.

        Planners go on with plans that end such episodes: `step` has to leave these states as they are, and give a
        reward of 0 there. What is executed there is not learned from.
        """
        return torch.zeros(state.shape[0], dtype=torch.bool, device=state.device)

    def solved(self, state: Tensor) -> Tensor:
        """In which of `state [N, ...]` a goal is reached: `[N]` bool. Default: none."""
        return torch.zeros(state.shape[0], dtype=torch.bool, device=state.device)

    def group(self, state: Tensor) -> Tensor | None:
        """The number of the independent world that each state is in, int64 `[N]`; None (the default): there is one."""
        return None

    def check_state(self, state: Tensor) -> None:
        """Raise ValueError where `state` cannot be a batch of this world's states. Default: it must have a batch."""
        if not isinstance(state, Tensor) or state.dim() == 0:
            raise ValueError("`state` must be a tensor of shape [B, ...], got a single number or another type")


def join_states(states: list[Tensor], start: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The states of L >= 0 steps from `start`, each of `shape` `[B, P, ...]` in some view, as `[B, P, L, ...]`."""
    if not states:
        return start.new_zeros(*shape[:2], 0, *shape[2:])
    return torch.stack([state.view(shape) for state in states], 2)


def step_alive(
    world: World, state: Tensor, action: Tensor, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """As `world.step`, but a state `[N, ...]` in which no action is legal stays as it is, without reward.

    Raises:
        ValueError: the world changes the states that it is given, which planners plan from once more.
    """
    version = None if state.is_inference() else state._version
    after, reward = world.step(state, action, generator)
    if version is not None and state._version != version:
        raise ValueError(f"step: {type(world).__name__} must not change the states that it is given; change a clone")
    if world.all_legal:
        return after, reward
    alive = world.legal_actions(state).any(1)
    if alive.all():
        return after, reward
    return torch.where(alive.view(-1, *[1] * (state.dim() - 1)), after, state), reward * alive


def allowed_actions(world: World, state: Tensor) -> Tensor:
    """Which actions a plan may take in `state [N, ...]`, `[N, A]` bool: legal ones; any where the episode is over."""
    legal = world.legal_actions(state)
    return legal | ~legal.any(1, keepdim=True)


def is_over(world: World, state: Tensor) -> Tensor:
    """In which of `state [N, ...]` the episode is over, `[N]` bool: terminated, or no action is legal."""
    over = world.terminated(state)
    return over if world.all_legal else over | ~world.legal_actions(state).any(1)


def check_is_world(world: object) -> None:
    """Raise ValueError unless it is a `World`."""
    if not isinstance(world, World):
        raise ValueError(f"`world` must be a World, whose actions are numbered, got {kind_of(world)}")
    if not hasattr(world, "num_actions"):
        raise ValueError(f"num_actions: {type(world).__name__} does not say how many actions it has")


def check_plans(plans: Tensor, batch_size: int, num_actions: int) -> None:
    """Raise ValueError unless `plans` is an integer tensor `[batch_size, P, L]` of actions below `num_actions`."""
    if plans.dim() != 3 or plans.shape[0] != batch_size:
        raise ValueError(
            f"`plans` must have shape [B, P, L] with B = {batch_size} starts, got {list(plans.shape)}"
            " (for one plan per start, use plans[:, None])"
        )
    check_range("plans", plans, num_actions, "actions")


def check_action(action: Tensor, num: int, num_actions: int) -> Tensor:
    """Returns `action [N]` as int64; raises ValueError unless it is `num` integers below `num_actions`.

    Values are not looked at on a GPU, where that waits for the device.
    """
    if not isinstance(action, Tensor) or list(action.shape) != [num] or not is_integer(action):
        raise ValueError(f"`action` must be integers [{num}], one a state, got {describe(action)}")
    if action.device.type == "cpu":
        check_range("action", action, num_actions, "actions")
    return action.long()


def check_objective(objective: str | None, discount: float | None) -> None:
    """Raise ValueError for an unknown `objective`, or a `discount` that is out of range or has no effect."""
    if objective not in (None, "terminal", "return"):
        raise ValueError(f'`objective` must be "terminal" or "return", got {objective!r}')
    if discount is not None and (not is_number(discount) or not 0 < discount <= 1):
        raise ValueError(f"`discount` must be a number above 0 and at most 1, got {discount!r}")
    if objective == "terminal" and discount not in (None, 1):
        raise ValueError('discount: it has no effect with objective="terminal"; use objective="return"')
