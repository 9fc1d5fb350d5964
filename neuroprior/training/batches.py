"""Batches of plans for training; long plans window by window; in an order that depends on the seed alone."""

from collections.abc import Iterator
from math import nan
from typing import NamedTuple

import lightning
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from neuroprior.plans import Plans
from neuroprior.plans.sequences import Sequences
from neuroprior.training.settings import Settings

MAX_DISTINCT = 1024
"""Distinct plans that one training step takes together, each weighted by its number."""

VALIDATION_ACTIONS, VALIDATION_PLANS, MAX_VALIDATION_ACTIONS = 2**14, 256, 2**16
"""Each validation scores plans with about so many actions in all, if there are so many plans among them; else more
plans, with about `MAX_VALIDATION_ACTIONS` actions at most.
"""

MIN_WINDOWS = 8
"""Windows through which the hidden state is carried in training, for plans as long; twice as many in validation."""


class Batch(NamedTuple):
    """A window of some plans.

    Attributes:
        actions: `[N, T]`; vectors `[N, T, D]`.
        weight: `[N, T]`, of each action in the loss; 0 beyond a plan's end.
        context: `[N, T]`, `[N, T, C]` or None.
        previous: `[N]` or `[N, D]`, the action before the window, `num_actions` or NaN for none; None where all are
            whole plans.
        continues: whether the rows continue those of the batch before, so that the hidden state is carried over.
    """

    actions: Tensor
    weight: Tensor
    context: Tensor | None
    previous: Tensor | None
    continues: bool


class Step(NamedTuple):
    """The windows that make up a batch.

    Attributes:
        pieces: `[N]`, numbers of pieces of plans.
        number: of the window in each of these pieces.
        continues: whether it continues the batch before.
    """

    pieces: Tensor
    number: int
    continues: bool


class PlansModule(lightning.LightningDataModule):
    """Plans for training and for validation, in batches.

    Where at most `MAX_DISTINCT` plans are distinct, and few enough of them, each step takes them all, each weighted by
    its number: the exact gradient. Otherwise steps take batches of plans.

    An epoch is what lies between two validations. Its batches depend on the seed and on its number alone, so that a
    training that is resumed after an epoch goes on as if it had never stopped.

    Args:
        training: plans to learn from.
        validation: plans for early stopping; of many, some are drawn (`VALIDATION_ACTIONS`).
        settings: size of batches and windows, and how often to validate.
        seed: draws the order.

    Attributes:
        settings: with what was not given chosen for these plans.
        epochs: how many there are at most.
        steps: steps in each.

    Raises:
        ValueError: no validation plan has an action.
    """

    def __init__(self, training: Sequences, validation: Sequences, settings: Settings, seed: int) -> None:
        super().__init__()
        batch_size = settings.batches_of(training.max_length)
        self.training = Windows(training, settings.window, batch_size, MIN_WINDOWS)
        self.validation = Windows(_draw_validation(validation, seed), settings.window, 1024, 2 * MIN_WINDOWS)
        self.settings = settings.for_passes(self.training.steps, training.max_length)
        self.epochs, self.steps = self.settings.epochs(self.training.steps)
        self.seed = seed

    def train_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.training, batch_size=None, sampler=Walk(self.training, self.steps, self.seed))

    def val_dataloader(self) -> DataLoader[Batch]:
        return DataLoader(self.validation, batch_size=None, sampler=Walk(self.validation))


class Windows(Dataset[Batch]):
    """Plans cut into pieces of `windows` windows; equal plans are merged into one row where few are distinct.

    `group_size` pieces are read side by side, window after window; `groups` such groups hold all pieces.
    """

    def __init__(self, plans: Sequences, window: int, batch_size: int, min_windows: int = 1) -> None:
        merged = _merge_equal(plans) if isinstance(plans, Plans) else None
        self.plans: Sequences = plans if merged is None else merged[0]
        self.weight = None if merged is None else merged[1]
        self.window = max(1, min(window, self.plans.max_length))
        lengths = self.plans.mask().sum(1).cpu()
        self.windows = _piece_size(lengths, self.window, batch_size, min_windows)
        size = self.windows * self.window
        pieces = (lengths + size - 1).div(size, rounding_mode="floor").clamp(min=1)
        self.plan = torch.arange(len(lengths)).repeat_interleave(pieces)
        rank = torch.arange(len(self.plan)) - (pieces.cumsum(0) - pieces).repeat_interleave(pieces)
        self.first = rank * size
        batch_size = len(self) if merged is not None else batch_size
        self.groups = -(-len(self) // batch_size)
        self.group_size = -(-len(self) // self.groups)

    def __len__(self) -> int:
        """The number of pieces."""
        return len(self.plan)

    @property
    def steps(self) -> int:
        """The number of batches that take every action once."""
        return self.groups * self.windows

    def __getitem__(self, index: Step) -> Batch:
        """The batch of a step."""
        pieces, number, continues = index
        plans, device = self.plans, self.plans.actions.device
        plan, first = self.plan[pieces].to(device), (self.first[pieces] + number * self.window).to(device)
        place = first[:, None] + torch.arange(self.window, device=device)
        lengths = plans.max_length if plans.lengths is None else plans.lengths[plan][:, None]
        weight = (place < lengths).float()
        if self.weight is not None:
            weight = weight * self.weight[plan][:, None]
        place = place.clamp(max=plans.max_length - 1)
        context = plans.context
        if context is not None:
            context = context[plan[:, None], place]
        previous = None
        if self.window < plans.max_length:
            last = plans.actions[plan, (first - 1).clamp(0, plans.max_length - 1)]
            none = torch.tensor(plans.num_actions if isinstance(plans, Plans) else nan, device=device)
            follows = (first > 0).view(-1, *[1] * (last.dim() - 1))
            previous = torch.where(follows, last.to(none.dtype), none)
        return Batch(plans.actions[plan[:, None], place], weight, context, previous, continues)


class Walk(Sampler[Step]):
    """The order of the batches of one epoch.

    Args:
        windows: what is read.
        steps: batches an epoch, in an endless stream of shuffled passes; None: one pass in order.
        seed: draws the passes.
    """

    def __init__(self, windows: Windows, steps: int | None = None, seed: int = 0) -> None:
        self.windows, self.steps, self.seed, self.epoch = windows, steps, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Set the number of the next epoch; Lightning calls this."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.steps if self.steps is not None else self.windows.steps

    def __iter__(self) -> Iterator[Step]:
        a_pass = self.windows.steps
        start = 0 if self.steps is None else self.epoch * self.steps
        order, drawn = torch.arange(len(self.windows)), -1
        for step in range(start, start + len(self)):
            if self.steps is not None and step // a_pass != drawn:
                drawn = step // a_pass
                # Mixed by a multiplier, so that the passes of one seed are not those of the next.
                generator = torch.Generator().manual_seed((self.seed * 1_000_003 + drawn) % 2**63)
                order = torch.randperm(len(self.windows), generator=generator)
            group, number = divmod(step % a_pass, self.windows.windows)
            size = self.windows.group_size
            pieces = order[group * size : (group + 1) * size]
            yield Step(pieces, number, number > 0 and step > start)


def _draw_validation(plans: Sequences, seed: int) -> Sequences:
    """Plans drawn at random, enough to validate on; all of them where they are fewer."""
    lengths = plans.mask().sum(1).cpu()
    taken = lengths.nonzero()[:, 0]
    if len(taken) == 0:
        raise ValueError("plans: no validation plan has an action")
    order = taken[torch.randperm(len(taken), generator=torch.Generator().manual_seed(seed))]
    so_far, number = lengths[order].cumsum(0), torch.arange(1, len(order) + 1)
    too_few = (so_far < VALIDATION_ACTIONS) | ((so_far < MAX_VALIDATION_ACTIONS) & (number < VALIDATION_PLANS))
    return plans[order[: int(too_few.sum()) + 1].sort().values.to(plans.actions.device)]


def _piece_size(lengths: Tensor, window: int, batch_size: int, least: int) -> int:
    """Windows a piece: enough to carry the hidden state far, few enough to fill batches and to leave few empty."""
    needed = (lengths + window - 1).div(window, rounding_mode="floor").clamp(min=1)
    total = int(needed.sum())
    size = min(int(needed.max()), max(least, -(-total // batch_size)))
    while size > 1 and size * int(((needed + size - 1) // size).sum()) > 1.5 * total:
        size = (size + 1) // 2
    return size


def _merge_equal(plans: Plans) -> tuple[Plans, Tensor] | None:
    """The distinct plans and their numbers, where they are few; None where they are not."""
    if plans.context is not None or (plans.num_actions + 1) ** plans.max_length > 2**20:
        return None
    key = plans.actions.long().masked_fill(~plans.mask(), plans.num_actions)
    base = (plans.num_actions + 1) ** torch.arange(plans.max_length, device=key.device)
    _, which, counts = (key * base).sum(1).unique(return_inverse=True, return_counts=True)
    if len(counts) > min(MAX_DISTINCT, len(plans) // 2):
        return None
    first = torch.empty_like(counts).scatter_(0, which, torch.arange(len(plans), device=key.device))
    return plans[first], counts.float()
