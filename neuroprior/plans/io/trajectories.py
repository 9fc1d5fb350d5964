"""Plans from trajectories in memory, as Gymnasium's environments return them, and back."""

from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neuroprior.plans.columns import LARGEST_INTEGER, Integers, check_names
from neuroprior.plans.io.assembly import assembled
from neuroprior.plans.io.npz import as_array
from neuroprior.plans.plans import Plans


def from_trajectories(trajectories: Iterable[Any], num_actions: int, *, observations: str | None = "context") -> Plans:
    """Plans of trajectories (episodes), one each.

    Args:
        trajectories: each a list of steps `(observation, action, reward, terminated, truncated, info)`, where the agent
            made the observation and then took the action (what follows the action is not used); or a dict or an object
            with `actions [T]` and perhaps `observations`, T of them or T + 1, of which the last is dropped (such are
            the episodes of Minari), or with `acts` and `obs` (such are the trajectories of imitation).
        num_actions: A; actions are integers from 0 to A - 1.
        observations: "context" to make the observations the context per step: integers become indices, arrays features
            (flattened, float32). None to leave them out.

    Returns:
        Plans, padded to the longest trajectory; without a context if no trajectory has observations.

    Raises:
        ValueError: actions that are not integers, observations that are neither integers nor arrays of one shape, or a
            trajectory with more or fewer of them; the message names the trajectory, counted from 0.

    Example:
        >>> episodes = [{"actions": [0, 1, 1], "observations": [4, 5, 5]}, {"actions": [2], "observations": [4]}]
        >>> plans = from_trajectories(episodes, num_actions=3)
        >>> plans.actions.tolist(), plans.context.tolist()
        ([[0, 1, 1], [2, 0, 0]], [[4, 5, 5], [4, 0, 0]])
    """
    check_names(num_actions, None)
    if observations not in ("context", None):
        raise ValueError(f"`observations` must be 'context' or None, got {observations!r}")
    check_are_several(trajectories)
    actions: list[Integers] = []
    observed: list[NDArray[Any] | None] = []
    for number, trajectory in enumerate(trajectories):
        place = f"trajectory {number}"
        taken, seen = parts_of(trajectory, place)
        actions.append(_actions(taken, num_actions, place))
        if observations is not None:
            observed.append(None if seen is None else observations_of(seen, len(actions[-1]), place))
    if not actions:
        raise ValueError("`trajectories` must have at least one trajectory, got an empty list")
    lengths = np.array([len(steps) for steps in actions])
    context = joined(observed)
    return assembled("trajectories", lengths, np.concatenate(actions), num_actions, context=context, per_step=True)


def to_trajectories(plans: Plans, kind: Literal["dicts", "imitation"] = "dicts") -> list[Any]:
    """Each plan as a trajectory.

    Args:
        plans: N of them.
        kind: "dicts" of `actions [T]`, int64, and, of a context, `observations [T]` or `[T, C]`; or those of
            the package "imitation", `imitation.data.types.Trajectory`, whose observations `[T + 1]` or `[T + 1, C]` are
            the context, the last one repeated, and each of which is terminal.

    Raises:
        ValueError: another kind; or, for imitation, plans without a context, or one without actions.
        ImportError: imitation is asked for, and not installed.

    Example:
        >>> to_trajectories(Plans(torch.tensor([[0, 1]]), 2, context=torch.tensor([[5, 3]])))
        [{'actions': array([0, 1]), 'observations': array([5, 3])}]
    """
    if kind not in ("dicts", "imitation"):
        raise ValueError(f"`kind` must be 'dicts' or 'imitation', got {kind!r}")
    actions, lengths = plans.actions.long().cpu().numpy(), plans.mask().sum(1).tolist()
    context = plans.context
    trajectories = [{"actions": row[:length].copy()} for row, length in zip(actions, lengths, strict=True)]
    if context is not None:
        for trajectory, row, length in zip(trajectories, context.detach().cpu().numpy(), lengths, strict=True):
            trajectory["observations"] = row[:length].copy()
    if kind == "dicts":
        return trajectories
    if context is None:
        raise ValueError("plans: no context; imitation's trajectories need an observation for each step")
    if lengths and not min(lengths):
        raise ValueError(f"plans: plan {lengths.index(0)} has no actions; imitation's trajectories need some")
    trajectory_class = import_module("imitation.data.types").Trajectory
    return [
        trajectory_class(
            obs=np.concatenate([one["observations"], one["observations"][-1:]]),
            acts=one["actions"],
            infos=None,
            terminal=True,
        )
        for one in trajectories
    ]


def check_are_several(trajectories: Any) -> None:
    """Raise ValueError for a dict, or a single trajectory that is not in a list."""
    if isinstance(trajectories, Mapping) and "actions" not in trajectories:
        raise ValueError("`trajectories` must be a list of trajectories, got a dict")
    if isinstance(trajectories, Mapping) or hasattr(trajectories, "actions") or hasattr(trajectories, "acts"):
        raise ValueError("`trajectories` must be a list of trajectories, got one; put it in a list")


def parts_of(trajectory: Any, place: str) -> tuple[Any, Any]:
    """Actions and observations (or None) of a trajectory."""
    if isinstance(trajectory, Mapping):
        if "actions" not in trajectory:
            raise ValueError(f"{place}: no 'actions'; it has {', '.join(map(str, trajectory)) or 'nothing'}")
        return trajectory["actions"], trajectory.get("observations")
    if hasattr(trajectory, "actions"):
        return trajectory.actions, getattr(trajectory, "observations", None)
    if hasattr(trajectory, "acts"):
        return trajectory.acts, getattr(trajectory, "obs", None)
    if not isinstance(trajectory, list | tuple):
        raise ValueError(f"`{place}` must be a list of steps or a dict with 'actions', got {type(trajectory).__name__}")
    for number, step in enumerate(trajectory):
        if not isinstance(step, list | tuple) or len(step) != 6:
            raise ValueError(
                f"`{place}` must be step {number}: (observation, action, reward, terminated, truncated, info)"
            )
    return [step[1] for step in trajectory], [step[0] for step in trajectory]


def _actions(values: Any, num_actions: int, place: str) -> Integers:
    actions = array_of(values, f"{place}: actions")
    if not actions.size and actions.ndim == 1:
        return np.zeros(0, np.int64)
    if actions.dtype.kind not in "iu" or actions.ndim != 1:
        raise ValueError(
            f"`{place}` must have one integer per step as actions, got {actions.dtype} of shape {list(actions.shape)}"
            " (discrete actions); of vectors see vector_plans_from_trajectories"
        )
    wrong = np.flatnonzero((actions < 0) | (actions >= num_actions))
    if wrong.size:
        raise ValueError(
            f"{place}: action {actions[wrong[0]]} of step {wrong[0]} is out of range; there are {num_actions}, "
            f"0 to {num_actions - 1}"
        )
    return actions.astype(np.int64)


def observations_of(values: Any, length: int, place: str) -> NDArray[Any]:
    """Indices `[T]` or features `[T, C]`, of a precision that holds the values."""
    if isinstance(values, Mapping | tuple) or (isinstance(values, list) and values and isinstance(values[0], Mapping)):
        raise ValueError(
            f"{place}: observations are of a Dict or Tuple space; flatten them first (gymnasium.spaces.flatten)"
        )
    observed = array_of(values, f"{place}: observations")
    if observed.ndim == 0 or len(observed) not in (length, length + 1):
        shown = list(observed.shape)[:1] or "one"
        raise ValueError(f"`{place}` must have {length} or {length + 1} observations for {length} actions, got {shown}")
    observed = observed[:length]
    if observed.ndim == 1 and observed.dtype.kind in "iu":
        if observed.size and not 0 <= int(observed.min()) <= int(observed.max()) < LARGEST_INTEGER:
            raise ValueError(f"`{place}` must have observations from 0, got {observed.min()}")
        return observed.astype(np.int64)
    if observed.dtype.kind not in "iufb":
        raise ValueError(f"`{place}` must have integers or arrays of numbers as observations, got {observed.dtype}")
    width = int(np.prod(observed.shape[1:]))
    wide = np.result_type(observed, np.float32).itemsize > 4
    features = observed.reshape(length, width).astype(np.float64 if wide else np.float32)
    with np.errstate(over="ignore"):
        wrong = np.flatnonzero(~np.isfinite(features.astype(np.float32, copy=False)).all(1))
    if wrong.size:
        raise ValueError(f"{place}: the observation of step {wrong[0]} is not finite, or too large for float32")
    return features


def joined(observed: list[NDArray[Any] | None]) -> NDArray[Any] | None:
    """All observations end to end: `[S]` or `[S, C]`, or None where there are none."""
    parts = [(i, values) for i, values in enumerate(observed) if values is not None]
    if not parts:
        return None
    if len(parts) < len(observed):
        missing = next(i for i, values in enumerate(observed) if values is None)
        raise ValueError(f"trajectory {missing}: no observations, which trajectory {parts[0][0]} has")
    # Of a trajectory without steps the kind of its observations is not known.
    parts = [(i, values) for i, values in parts if len(values)] or parts[:1]
    number, first = parts[0]
    for i, values in parts:
        if values.shape[1:] != first.shape[1:] or values.dtype.kind != first.dtype.kind:
            raise ValueError(
                f"trajectory {i}: observations of another kind than trajectory {number}: {_kind(values)}, not"
                f" {_kind(first)}"
            )
    return np.concatenate([values for _, values in parts])


def _kind(observations: NDArray[Any]) -> str:
    return "integers" if observations.ndim == 1 else f"{observations.shape[1]} features"


def array_of(values: Any, place: str) -> NDArray[Any]:
    if isinstance(values, torch.Tensor):
        return as_array(values)
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, OverflowError, RuntimeError) as error:
        raise ValueError(f"`{place}` must be one number or one array of a fixed shape per step") from error
    if array.dtype.kind == "O":
        raise ValueError(f"`{place}` must be numbers, got {array.dtype} values")
    return array
