"""The trainer: Lightning's, with averaged weights, early stopping and a checkpoint, for `fit` and the command alike."""

import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import ceil, inf, isfinite
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import WeightAveraging
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from neuroprior._files import replacing
from neuroprior._threads import one_thread
from neuroprior.plans.folds import check_alike, fair_split
from neuroprior.plans.sequences import Sequences
from neuroprior.training.batches import PlansModule
from neuroprior.training.module import PriorModule
from neuroprior.training.settings import Settings

SMALL_STEP = 1e9
"""Operations in a training step below which it runs on one thread: more gain little there, and wait for one another."""

DECAY, WARM_UP = 0.98, 10
"""Of the moving average of the weights over steps: after n steps it decays by (n + 1) / (n + `WARM_UP`), at most by
`DECAY`."""

MIN_GAIN = 1e-4
"""Bits by which the validation loss must fall, for a training not to run out of patience."""

MIN_SECONDS = 10.0
"""Seconds at least between two lines of progress."""

LAST, LOGS = "last.ckpt", "tensorboard"
"""What a training writes into its folder."""


def train(
    prior: nn.Module, plans: Sequences, settings: Settings, seed: int, folder: Path | None = None
) -> list[dict[str, float]]:
    """Train `prior` in place, keeping the weights with the lowest loss on held-out plans.

    Args:
        prior: any module with `forward(plans, context) -> logits [N, L, A]`; one without `forward_from` (see
            `NeuralPrior`) is trained on whole plans, however long. For plans of vectors, one with `log_probs_from` (see
            `VectorGRU`).
        plans: at least two plans (two groups, where there are any), each with an action; or a single long one, whose
            end is then held out.
        settings: how.
        seed: draws the held-out plans and the order of training; the same seed gives the same weights on a CPU.
        folder: of a checkpoint, from which the training goes on where there is one, and of TensorBoard's logs.

    Returns:
        The learning curve, see `PriorModule.curve`; validation bits are those of the averaged weights.

    Raises:
        ValueError: too few plans or groups, validation plans with other actions or contexts, a damaged checkpoint, or
            the training diverged.
        KeyboardInterrupt: Ctrl-C.
    """
    device, plans = next(prior.parameters()).device, plans.trimmed()  # padding decides no batches and windows
    training: Sequences
    validation: Sequences
    in_windows = hasattr(prior, "forward_from") or hasattr(prior, "log_probs_from")
    with one_thread():
        if isinstance(settings.validation, Sequences):
            training, validation = plans, settings.validation
            check_alike(training, validation)
        else:
            training, validation = fair_split(plans, settings.validation, torch.Generator().manual_seed(seed))
        window = settings.window if in_windows else plans.max_length
        data = PlansModule(training, validation, replace(settings, window=window), seed)
    module = PriorModule(prior, settings.learning_rate, settings.weight_decay, seed)
    tokens = data.training.group_size * data.training.window
    operations = 6 * tokens * sum(weight.numel() for weight in prior.parameters())
    random = torch.random.fork_rng([device] if device.type == "cuda" else [])
    with one_thread(operations < SMALL_STEP), quiet(), random:
        torch.manual_seed(seed)
        trainer, keeper = make_trainer(data, device, folder)
        try:
            trainer.fit(module, datamodule=data, ckpt_path=_checkpoint(folder), weights_only=True)
        except SystemExit as interrupted:  # Lightning turns Ctrl-C into this
            if not trainer.interrupted:
                raise
            raise KeyboardInterrupt from interrupted
    if not isfinite(keeper.best_bits):
        raise ValueError(f"`learning_rate` must be lower, as the training diverged, got {settings.learning_rate}.")
    module.load_state_dict(keeper.best_weights)
    module.eval().to(device)
    return module.curve


def planned_steps(plans: Sequences, settings: Settings) -> int:
    """Return the most gradient steps that a training takes.

    Args:
        plans: to learn from.
        settings: how.

    Example:
        >>> planned_steps(Plans(torch.zeros(9, 5, dtype=torch.long), num_actions=2), Settings())
        1000
    """
    steps = PlansModule(plans, plans, settings, 0).settings.max_steps
    assert steps is not None
    return steps


def make_trainer(
    data: PlansModule, device: torch.device, folder: Path | None = None
) -> tuple[lightning.Trainer, "Keeper"]:
    """Return Lightning's trainer for a `PriorModule`, and what keeps its best weights.

    An epoch is what lies between two validations.
    """
    progress = data.settings.progress
    bar = progress and (sys.stdout.isatty() or "ipykernel" in sys.modules)
    keeper = Keeper(device, data, lines=progress and not bar, folder=folder)
    trainer = lightning.Trainer(
        max_epochs=data.epochs,
        accelerator="gpu" if device.type == "cuda" else device.type,
        devices=[device.index or 0] if device.type == "cuda" else 1,
        gradient_clip_val=data.settings.gradient_clip,
        enable_progress_bar=bar,
        callbacks=[keeper],
        enable_checkpointing=False,
        logger=False if folder is None else TensorBoardLogger(folder, LOGS, ""),
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        enable_model_summary=False,
        default_root_dir=folder,
    )
    return trainer, keeper


def _checkpoint(folder: Path | None) -> Path | None:
    """The checkpoint to go on from; ValueError where it is damaged. Nothing in it is executed."""
    if folder is None or not (folder / LAST).exists():
        return None
    try:
        torch.load(folder / LAST, weights_only=True, map_location="cpu")["callbacks"]
    except (UnpicklingError, EOFError, KeyError, TypeError, RuntimeError, OSError) as error:
        raise ValueError(f"{folder / LAST} is damaged; without it the training starts over.") from error
    return folder / LAST


class Keeper(WeightAveraging):
    """Averages the weights over steps, and keeps the average with the lowest validation bits.

    The weights themselves are as noisy as the learning rate is high, and where training is stopped early, the rate has
    not fallen far (Polyak and Juditsky 1992). After each validation it also stops a training that no longer gets
    better, or whose time is up, prints a line of progress now and then, and writes a checkpoint.

    Args:
        device: of the training: Lightning moves the module there only after the averages are made.
        data: of the training, with its patience.
        lines: print progress on standard error.
        folder: of the checkpoint.

    Attributes:
        best_bits: infinite before the first validation, and where the training diverged.
        best_weights: of the module.
    """

    last_line = time.monotonic()
    """When a line was printed, in this training or one before."""

    def __init__(
        self, device: torch.device, data: PlansModule, lines: bool = False, folder: Path | None = None
    ) -> None:
        super().__init__(device, use_buffers=False, multi_avg_fn=_update_averages)
        assert data.settings.patience is not None
        self.patience, self.max_steps = ceil(data.settings.patience / data.steps), data.epochs * data.steps
        self.stop_at = inf if data.settings.seconds is None else time.monotonic() + data.settings.seconds
        self.lines, self.folder = lines, folder
        self.best_bits, self.best_weights = inf, dict[str, Tensor]()
        self.bits_to_beat, self.epochs_without = inf, 0

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        trainer.should_stop = self.epochs_without >= self.patience  # as a training that is resumed may be

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        bits = float(trainer.callback_metrics["validation_bits"])
        if bits < self.best_bits:
            assert self._average_model is not None
            weights = self._average_model.module.state_dict()
            self.best_bits, self.best_weights = bits, {name: value.clone() for name, value in weights.items()}
        self.epochs_without += 1
        if bits + MIN_GAIN < self.bits_to_beat:
            self.bits_to_beat, self.epochs_without = bits, 0
        if self.epochs_without >= self.patience or not isfinite(bits) or time.monotonic() >= self.stop_at:
            trainer.should_stop = True
        if self.lines and time.monotonic() - self.last_line >= MIN_SECONDS:
            Keeper.last_line = time.monotonic()
            steps = f"step {trainer.global_step:,} of at most {self.max_steps:,}"
            print(f"training: {steps}, {bits:.4f} validation bits", file=sys.stderr, flush=True)
        if self.folder is not None:
            with replacing(self.folder / LAST) as partial:
                trainer.save_checkpoint(partial)

    def state_dict(self) -> dict[str, Any]:
        kept = {name: getattr(self, name) for name in KEPT}
        return super().state_dict() | kept

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        for name in KEPT:
            setattr(self, name, state_dict[name])


KEPT = ("best_bits", "best_weights", "bits_to_beat", "epochs_without")
"""Attributes of a `Keeper` that a checkpoint holds."""


def _update_averages(averages: Any, weights: Any, steps: Tensor) -> None:
    """Take the weights after a step into their averages over the `steps` before it."""
    done = int(steps)
    get_ema_multi_avg_fn(min(DECAY, (done + 1) / (done + WARM_UP)))(averages, weights, None)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence Lightning's remarks on the machine and on worker processes; its errors and progress bar stay."""
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
