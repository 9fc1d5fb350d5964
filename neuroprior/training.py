"""Training of priors with Lightning: the module, the data module, and `train`; knows a prior only by `forward`."""

import logging
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import cos, log, pi
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from torch import Tensor, nn
from torch.utils.data import BatchSampler, DataLoader, Dataset, RandomSampler, SequentialSampler

from neuroprior.plans import Plans

MOST_DISTINCT = 1024
"""Distinct plans that one training step takes together, each weighted by its number."""

SMALL_STEP = 1e9
"""Operations in a training step below which it runs on one thread."""

Batch = tuple[Tensor, Tensor, Tensor | None]  # actions [N, L], weight of each action [N, L], context


@dataclass(frozen=True)
class Settings:
    """How a prior is trained.

    Attributes:
        max_steps: gradient steps; the learning rate falls to 0 over them.
        batch_size: plans a step.
        learning_rate: of AdamW, after the first tenth of the steps.
        weight_decay: of AdamW.
        gradient_clip: the largest norm of a gradient.
        validation: share of plans (of groups, where there are any) held out for early stopping.
        check_every: steps between two looks at the held-out plans.
        patience: looks without improvement after which training stops.
        progress: show a progress bar.
    """

    max_steps: int = 1000
    batch_size: int = 256
    learning_rate: float = 5e-3
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    validation: float = 0.1
    check_every: int = 100
    patience: int = 4
    progress: bool = True

    def __post_init__(self) -> None:
        for name in ("max_steps", "batch_size", "learning_rate", "gradient_clip", "check_every", "patience"):
            kind = float if name in ("learning_rate", "gradient_clip") else int
            value = getattr(self, name)
            if not isinstance(value, int | kind) or not 0 < value < float("inf"):
                raise ValueError(
                    f"{name}: a positive {'number' if kind is float else 'integer'} is expected, not {value}"
                )
        if self.weight_decay < 0:
            raise ValueError(f"weight_decay: must not be negative, not {self.weight_decay}")


class PriorModule(lightning.LightningModule):
    """The loss of a prior, bits per action, and its optimiser."""

    def __init__(self, prior: nn.Module, settings: Settings) -> None:
        super().__init__()
        self.prior, self.settings = prior, settings

    def training_step(self, batch: Batch, batch_index: int) -> Tensor:
        total, weight = bits(self.prior, batch)
        loss = total / weight
        self.log("train_bits", loss, prog_bar=True, batch_size=1)
        return loss

    def validation_step(self, batch: Batch, batch_index: int) -> None:
        total, weight = bits(self.prior, batch)
        self.log("validation_bits", total / weight, prog_bar=True, on_epoch=True, batch_size=int(weight))

    def configure_optimizers(self) -> Any:
        settings = self.settings
        optimizer = torch.optim.AdamW(self.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step / settings.max_steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


class PlansModule(lightning.LightningDataModule):
    """Plans for training and for validation, in batches.

    Where at most `MOST_DISTINCT` plans are distinct, and few enough of them, each step takes them all, each weighted by
    its number: the exact gradient. Otherwise steps take batches of plans.
    """

    def __init__(self, training: Plans, validation: Plans, settings: Settings, seed: int) -> None:
        super().__init__()
        self.training, self.validation = _Rows(training), _Rows(validation)
        self.batch_size = len(self.training) if self.training.merged else settings.batch_size
        self.seed = seed

    def train_dataloader(self) -> DataLoader[Batch]:
        generator = torch.Generator().manual_seed(self.seed)
        sampler = RandomSampler(self.training, generator=generator)
        batches = BatchSampler(sampler, self.batch_size, drop_last=False)
        return DataLoader(self.training, batch_size=None, sampler=batches)

    def val_dataloader(self) -> DataLoader[Batch]:
        sampler = SequentialSampler(self.validation)
        return DataLoader(self.validation, batch_size=None, sampler=BatchSampler(sampler, 1024, drop_last=False))


class _Rows(Dataset[Batch]):
    """Plans as rows with weights; equal plans are merged into one row where few are distinct."""

    def __init__(self, plans: Plans) -> None:
        weight, merged = torch.ones(len(plans), device=plans.actions.device), False
        if plans.context is None and (plans.num_actions + 1) ** plans.max_length <= 2**20:
            key = plans.actions.long().masked_fill(~plans.mask(), plans.num_actions)
            base = (plans.num_actions + 1) ** torch.arange(plans.max_length, device=key.device)
            _, which, counts = (key * base).sum(1).unique(return_inverse=True, return_counts=True)
            if len(counts) <= min(MOST_DISTINCT, len(plans) // 2):
                first = torch.empty_like(counts).scatter_(0, which, torch.arange(len(plans), device=key.device))
                plans, weight, merged = plans[first], counts.float(), True
        self.plans, self.merged = plans, merged
        self.weight = plans.mask() * weight[:, None]

    def __len__(self) -> int:
        return len(self.plans)

    def __getitem__(self, index: list[int]) -> Batch:
        rows = torch.tensor(index)
        context = self.plans.context
        return self.plans.actions[rows], self.weight[rows], None if context is None else context[rows]


def bits(prior: nn.Module, batch: Batch) -> tuple[Tensor, Tensor]:
    """The weighted sum of the bits that `prior` takes for the actions of a batch, and the sum of the weights."""
    actions, weight, context = batch
    log_probs = torch.log_softmax(prior(actions, context), -1)
    taken = log_probs.gather(-1, actions.long()[..., None])[..., 0]
    return -(taken * weight).sum() / log(2), weight.sum()


def train(prior: nn.Module, plans: Plans, settings: Settings, seed: int) -> float:
    """Train `prior` in place, keeping the weights that tell held-out plans best.

    Args:
        prior: any module with `forward(plans, context) -> logits [N, L, A]`.
        plans: at least two plans (two groups, where there are any), each with an action.
        settings: how.
        seed: draws the held-out plans and the order of training; the same seed gives the same weights on a CPU.

    Returns:
        Bits per action on the held-out plans.

    Raises:
        ValueError: too few plans or groups, or the training diverged.
    """
    device = next(prior.parameters()).device
    training, validation = plans.split(settings.validation, torch.Generator().manual_seed(seed))
    devices = [device.index or 0] if device.type == "cuda" else 1
    rows = PlansModule(training, validation, settings, seed)
    with _quiet(), _few_threads(prior, rows), tempfile.TemporaryDirectory() as folder, torch.random.fork_rng():
        torch.manual_seed(seed)
        best = ModelCheckpoint(folder, monitor="validation_bits", save_weights_only=True)
        stop = EarlyStopping("validation_bits", patience=settings.patience, min_delta=1e-4)
        trainer = lightning.Trainer(
            accelerator="gpu" if device.type == "cuda" else device.type,
            devices=devices,
            max_steps=settings.max_steps,
            max_epochs=-1,
            gradient_clip_val=settings.gradient_clip,
            val_check_interval=min(settings.check_every, settings.max_steps),
            check_val_every_n_epoch=None,
            num_sanity_val_steps=0,
            callbacks=[best, stop],
            logger=False,
            enable_model_summary=False,
            enable_progress_bar=settings.progress,
        )
        module = PriorModule(prior, settings)
        try:
            trainer.fit(module, datamodule=rows)
        except SystemExit as interrupted:
            # Lightning turns Ctrl-C into this; a script or program above should see what it was.
            raise KeyboardInterrupt from interrupted
        if best.best_model_score is None or not best.best_model_score.isfinite():
            raise ValueError(f"training diverged; a learning_rate below {settings.learning_rate} may help")
        checkpoint = torch.load(best.best_model_path, weights_only=True, map_location=device)
        module.to(device).load_state_dict(checkpoint["state_dict"])
    prior.eval()
    return float(best.best_model_score)


def _rate(done: float) -> float:
    """Share of the learning rate after a share `done` of the steps: a linear rise over a tenth, then half a cosine."""
    return min((done + 1e-3) / 0.1, 0.5 * (1 + cos(pi * min(done, 1.0))))


@contextmanager
def _few_threads(prior: nn.Module, rows: PlansModule) -> Iterator[None]:
    """One thread for small steps: there, more gain little, and on a busy machine they wait for one another."""
    plans = rows.training.plans
    tokens = min(len(plans), rows.batch_size) * plans.max_length
    operations = 6 * tokens * sum(weight.numel() for weight in prior.parameters())
    threads = torch.get_num_threads()
    if operations < SMALL_STEP:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _quiet() -> Iterator[None]:
    """Lightning without its remarks on the machine and on worker processes; its errors and progress bar stay."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="lightning")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
