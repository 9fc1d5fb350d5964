"""Plans in Minari's local datasets of episodes, where actions are discrete."""

import json
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

import numpy as np
import torch

from neuroprior.plans.io.trajectories import from_trajectories, to_trajectories
from neuroprior.plans.plans import Plans, check_are_plans, check_plain_plans

OURS = "neuroprior"
"""Key of a dataset's metadata under which stands what Minari has no place for."""


def read_minari(dataset_id: str, *, observations: bool = True) -> Plans:
    """Plans of a local Minari dataset, one for each episode. Nothing is downloaded.

    Observations of a Discrete space become a context index per step, those of a Box, MultiDiscrete or MultiBinary space
    features per step (flattened, float32). The values of Discrete spaces are renumbered from 0. What `write_minari`
    wrote comes back as it was.

    Args:
        dataset_id: such as "minigrid/BabyAI-Pickup/optimal-v0", in `MINARI_DATASETS_PATH` or `~/.minari/datasets`.
        observations: whether the observations become the context.

    Raises:
        FileNotFoundError: there is no such local dataset; the message says how to get it.
        ImportError: Minari is not installed.
        ValueError: actions that are not discrete, observations of a Dict, Tuple or Text space, or a damaged dataset.
    """
    dataset = local_dataset(dataset_id)
    spaces = _module("gymnasium.spaces")
    with one_line(dataset_id):
        space, observed = dataset.action_space, dataset.observation_space
        if not isinstance(space, spaces.Discrete):
            raise ValueError(
                f"actions of the space {_text(space)}; discrete actions are expected; of a Box see read_vector_plans"
            )
        readable = (spaces.Discrete, spaces.Box, spaces.MultiDiscrete, spaces.MultiBinary)
        if observations and not isinstance(observed, readable):
            raise ValueError(f"observations of the space {_text(observed)}; leave them out with observations=False")
        first = int(observed.start) if isinstance(observed, spaces.Discrete) else 0
        episodes = [
            {
                "actions": episode.actions - int(space.start),
                "observations": episode.observations - first if observations else None,
            }
            for episode in dataset.iterate_episodes()
        ]
        plans = from_trajectories(episodes, int(space.n))
        groups = [about.get("group") for about in dataset.storage.get_episode_metadata(dataset.episode_indices)]
        ours = json.loads(dataset.storage.metadata.get(OURS, "{}"))
        return _restore(plans, groups, ours, observations)


def local_dataset(dataset_id: str) -> Any:
    """The local Minari dataset of this name.

    Raises:
        FileNotFoundError: there is none; the message says how to get it.
        ImportError: Minari is not installed.
    """
    minari = _module("minari")
    try:
        return minari.load_dataset(dataset_id)
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{dataset_id}: not among the local Minari datasets; `minari download {dataset_id}` gets a public one"
        ) from None


def write_minari(plans: Plans, dataset_id: str) -> None:
    """Write plans as a new local Minari dataset, one episode each; for thousands of plans rather than millions.

    The context becomes the observation (0 where there is none), the last one repeated after the last action. As plans
    have no rewards or terminations, rewards are 0 and each episode terminates at its end. Groups become metadata of the
    episodes ("group").

    Args:
        plans: at least one, each with at least one action.
        dataset_id: such as "mice/open-field-v0", not there yet.

    Raises:
        ImportError: Minari is not installed.
        ValueError: plans of vectors; no plans, or one without actions; patterns, or fields of a subclass of `Plans`,
            which Minari cannot hold; or a dataset of this name is there already.
    """
    check_are_plans(plans)
    minari = _module("minari")
    lengths = plans.mask().sum(1).tolist()
    if not lengths or min(lengths) == 0:
        raise ValueError(f"{dataset_id}: Minari cannot hold {'a plan without actions' if lengths else 'no plans'}")
    check_plain_plans(plans, dataset_id)
    context, space = _context_of_steps(plans)
    shown = Plans(plans.actions, plans.num_actions, plans.lengths, context=context)
    buffers = [
        minari.data_collector.EpisodeBuffer(
            observations=np.concatenate([episode["observations"], episode["observations"][-1:]]),
            actions=episode["actions"],
            rewards=np.zeros(length, np.float32),
            terminations=np.arange(1, length + 1) == length,
            truncations=np.zeros(length, bool),
        )
        for episode, length in zip(to_trajectories(shown), lengths, strict=True)
    ]
    with one_line(dataset_id), warnings.catch_warnings(), _whole(dataset_id):
        warnings.simplefilter("ignore", UserWarning)  # of missing authors, code and environment
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            action_space=_module("gymnasium.spaces").Discrete(plans.num_actions),
            observation_space=space,
            description="plans written by neuroprior",
        )
        if plans.group is not None:
            dataset.storage.update_episode_metadata([{"group": group} for group in plans.group.tolist()])
        names = {key: getattr(plans, key) for key in ("action_names", "context_names", "group_names", "end")}
        ours = {key: value for key, value in names.items() if value is not None} | {
            "context": plans.context is not None
        }
        dataset.storage.update_metadata({OURS: json.dumps(ours)})


def _context_of_steps(plans: Plans) -> tuple[torch.Tensor, Any]:
    """The context of each step, and Gymnasium's space of it."""
    spaces = _module("gymnasium.spaces")
    context = torch.zeros(plans.actions.shape, dtype=torch.long) if plans.context is None else plans.context
    if context.is_floating_point():
        context = context.float()
        return context, spaces.Box(-np.inf, np.inf, (context.shape[-1],), np.float32)
    if context.dim() == 3:
        raise ValueError(f"context: patterns {list(context.shape)} are written to .npz files only")
    count = len(plans.context_names) if plans.context_names is not None else int(context.max()) + 1
    return context, spaces.Discrete(count)


def _restore(plans: Plans, groups: list[Any], ours: dict[str, Any], observations: bool) -> Plans:
    """Plans as they were written: with names, groups and `end`, and without a context where they had none."""
    context = plans.context if ours.get("context", True) else None
    grouped = bool(groups) and all(group is not None for group in groups)
    lengths = plans.mask().sum(1) if ours.get("end") is not None else plans.lengths
    return Plans(
        plans.actions,
        plans.num_actions,
        lengths,
        ours.get("action_names"),
        context,
        torch.tensor([int(group) for group in groups]) if grouped else None,
        ours.get("context_names") if context is not None else None,
        ours.get("group_names") if grouped else None,
        ours.get("end"),
    )


@contextmanager
def one_line(dataset_id: str) -> Iterator[None]:
    """Turn what Minari, h5py and pyarrow raise over a dataset into one line."""
    try:
        yield
    except (ValueError, KeyError, OSError, AssertionError, TypeError, AttributeError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0][:300]
        raise ValueError(f"{dataset_id}: {reason or type(error).__name__}") from error


@contextmanager
def _whole(dataset_id: str) -> Iterator[None]:
    """Remove what was written of a dataset if writing fails."""
    path = import_module("minari.storage.datasets_root_dir").get_dataset_path(dataset_id)
    was_there = path.exists()
    try:
        yield
    except BaseException:
        if not was_there:
            shutil.rmtree(path, ignore_errors=True)
        raise


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ImportError(f"Minari cannot be used ({error}); pip install 'neuroprior[gym]'") from error


def _text(space: Any) -> str:
    return " ".join(str(space).split())[:100]
