"""The trainer: Lightning's, with early stopping and checkpoints, for `fit` and for the command line alike."""

import io
import logging
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint, WeightAveraging
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from neuroprior._files import write_whole
from neuroprior._threads import one_thread
from neuroprior.plans.folds import check_alike, fair_split
from neuroprior.plans.sequences import Sequences
from neuroprior.training.batches import PlansModule
from neuroprior.training.module import PriorModule
from neuroprior.training.settings import FEWEST, PATIENCE, Settings

SMALL_STEP = 1e9
"""Operations in a training step below which it runs on one thread."""

DECAY, WARM_UP = 0.98, 10
"""Of the moving average of the weights over steps: after n steps it decays by (n + 1) / (n + `WARM_UP`), at most by
`DECAY`."""

QUIET = 10.0
"""Seconds at least between two lines of progress."""

CHECKPOINTS = "checkpoints"
"""Folder of `best.ckpt` and `last.ckpt`, in the folder of a training."""


def train(prior: nn.Module, plans: Sequences, settings: Settings, seed: int) -> float:
    """Train `prior` in place, keeping the weights with the lowest loss on held-out plans.

    Args:
        prior: any module with `forward(plans, context) -> logits [N, L, A]`; one without `forward_from` (see
            `NeuralPrior`) is trained on whole plans, however long. For plans of vectors, one with `log_probs_from` (see
            `VectorGRU`).
        plans: at least two plans (two groups, where there are any), each with an action; or a single long one, whose
            end is then held out.
        settings: how.
        seed: draws the held-out plans and the order of training; the same seed gives the same weights on a CPU.

    Returns:
        Bits per action on the held-out plans; of vectors the log-density, in bits.

    Raises:
        ValueError: too few plans or groups, validation plans with other actions or contexts, or the training diverged.
    """
    device = next(prior.parameters()).device
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
    cuda = device.type == "cuda"
    with quiet(), torch.random.fork_rng([device] if cuda else []):
        torch.manual_seed(seed)
        trainer = make_trainer(
            "",
            data.settings.max_steps,
            data.settings.patience,
            data.steps,
            accelerator="gpu" if cuda else device.type,
            devices=[device.index or 0] if cuda else 1,
            gradient_clip_val=settings.gradient_clip,
            enable_progress_bar=settings.progress,
            logs=False,
        )
        module = PriorModule(prior, settings.learning_rate, settings.weight_decay, seed)
        best = run_training(trainer, module, data)
        module.to(device)
    return best


def make_trainer(
    folder: str = "",
    max_steps: int | None = None,
    patience: int | None = None,
    validate_every: int = 100,
    accelerator: str = "auto",
    devices: int | str | list[int] = 1,
    num_nodes: int = 1,
    strategy: str = "auto",
    precision: str | int = "32-true",
    gradient_clip_val: float = 1.0,
    accumulate_grad_batches: int = 1,
    max_time: str | None = None,
    enable_progress_bar: bool = True,
    logs: bool = True,
    callbacks: list[lightning.Callback] | None = None,
) -> lightning.Trainer:
    """Lightning's trainer for a `PriorModule` and a `PlansModule`.

    What is validated and kept is a moving average of the weights; see `AverageWeights`. An epoch is what lies between
    two validations. After each of them the best and the last checkpoint are kept; without logs the best weights, in
    memory.

    Args:
        folder: of checkpoints and logs.
        max_steps: gradient steps at most (rounded up to whole epochs); the learning rate falls to 0 over them. None:
            on the command line by the number of plans, see `Settings`; else 1,000.
        patience: steps without lower validation bits after which training stops (rounded up to whole epochs). None: 0.3
            of all steps.
        validate_every: steps between two validations, as in `PlansModule.steps`.
        accelerator: "cpu", "gpu", or "auto".
        devices: number of devices, or their numbers.
        num_nodes: machines.
        strategy: "ddp" for several devices (processes, on a CPU).
        precision: "bf16-mixed" on a GPU that has it.
        gradient_clip_val: the largest norm of a gradient.
        accumulate_grad_batches: batches for one step of the optimiser.
        max_time: stop after so much time, DD:HH:MM:SS.
        enable_progress_bar: show it, in a terminal or a notebook; elsewhere see `ProgressLines`.
        logs: write checkpoints, and logs as CSV and for TensorBoard.
        callbacks: further callbacks of Lightning's.

    Raises:
        ValueError: a number of steps or batches below 1.
    """
    max_steps = FEWEST if max_steps is None else max_steps
    patience = ceil(PATIENCE * max_steps) if patience is None else patience
    steps = {"max_steps": max_steps, "patience": patience, "accumulate_grad_batches": accumulate_grad_batches}
    for name, number in steps.items():
        if number < 1:
            raise ValueError(f"trainer.{name}: at least 1 is expected, not {number}")
    stopping = Stopping("validation_bits", patience=ceil(patience / validate_every), min_delta=1e-4)
    average = AverageWeights()
    bar = enable_progress_bar and (sys.stdout.isatty() or "ipykernel" in sys.modules)
    epochs = ceil(max_steps / validate_every)
    lines = [ProgressLines(epochs * validate_every)] if enable_progress_bar and not bar else []
    kept: list[lightning.Callback] = [BestWeights(average)]
    if logs:
        # Two callbacks: with `save_last` Lightning writes the last one only where it writes the best one, too.
        kept = [
            Checkpoints(
                Path(folder) / CHECKPOINTS,
                name,
                monitor=monitor,
                save_on_train_epoch_end=True,
                enable_version_counter=False,
            )
            for name, monitor in (("best", "validation_bits"), ("last", None))
        ]
    return lightning.Trainer(
        max_epochs=epochs,
        accelerator=accelerator,
        devices=devices,
        num_nodes=num_nodes,
        strategy=strategy,
        precision=precision,  # type: ignore[arg-type]
        gradient_clip_val=gradient_clip_val,
        accumulate_grad_batches=accumulate_grad_batches,
        max_time=max_time,
        enable_progress_bar=bar,
        callbacks=[average, stopping, *kept, *lines, *(callbacks or [])],
        enable_checkpointing=logs,
        logger=[CSVLogger(folder, "logs"), TensorBoardLogger(folder, "tensorboard", "")] if logs else False,
        plugins=[WholeCheckpoints()],
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        use_distributed_sampler=False,
        enable_model_summary=False,
        default_root_dir=folder or None,
    )


def run_training(
    trainer: lightning.Trainer, module: PriorModule, data: PlansModule, checkpoint: Path | None = None
) -> float:
    """Train a module, and load its best weights (of several processes, in the first alone).

    Args:
        trainer: of `make_trainer`.
        module, data: what is trained, and on what.
        checkpoint: where to go on from.

    Returns:
        The validation bits per action of the best weights.

    Raises:
        ValueError: the training diverged, or ended before the first validation.
        KeyboardInterrupt: Ctrl-C.
    """
    try:
        with few_threads(module.prior, data):
            trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    except SystemExit as interrupted:
        # Lightning turns Ctrl-C into this; other processes of the same training are ended by it.
        if not trainer.interrupted or not trainer.is_global_zero:
            raise
        raise KeyboardInterrupt from interrupted
    if not trainer.is_global_zero:
        return float("nan")
    kept = next(one for one in trainer.callbacks if isinstance(one, BestWeights | ModelCheckpoint))  # type: ignore[attr-defined]
    if kept.best_model_score is None:
        raise ValueError("training ended before the first validation; nothing was learned")
    if not kept.best_model_score.isfinite():
        raise ValueError(f"training diverged; a learning_rate below {module.learning_rate} may help")
    if isinstance(kept, BestWeights):
        weights = kept.weights
    else:
        weights = torch.load(kept.best_model_path, weights_only=True, map_location=module.device)["state_dict"]
    module.load_state_dict(weights)
    module.eval()
    return float(kept.best_model_score)


class AverageWeights(WeightAveraging):
    """A moving average of the weights over steps, which is what is validated and kept (Polyak and Juditsky 1992).

    The weights themselves are as noisy as the learning rate is high, and where training is stopped early, the rate has
    not fallen far.
    """

    def __init__(self) -> None:
        super().__init__(use_buffers=False, multi_avg_fn=_take_in)

    def setup(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str) -> None:
        """Make the averages, on the device of the training: the module itself is moved there only later."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    @property
    def weights(self) -> dict[str, Tensor]:
        """The present averages, by the names of the module's weights."""
        assert self._average_model is not None
        return {name: value.clone() for name, value in self._average_model.module.state_dict().items()}


def _take_in(averages: Any, weights: Any, steps: Tensor) -> None:
    """Take the weights after a step into their averages over the `steps` before it."""
    done = int(steps)
    get_ema_multi_avg_fn(min(DECAY, (done + 1) / (done + WARM_UP)))(averages, weights, None)


class BestWeights(lightning.Callback):
    """Keeps the average weights with the lowest validation bits in memory, as `ModelCheckpoint` does in a file.

    Args:
        average: of the same trainer.

    Attributes:
        best_model_score: bits; infinite where the training diverged, None before the first validation.
        weights: of the module.
    """

    def __init__(self, average: AverageWeights) -> None:
        self.average = average
        self.best_model_score: Tensor | None = None
        self.weights: dict[str, Tensor] = {}

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        score = trainer.callback_metrics["validation_bits"].nan_to_num(torch.inf)
        if self.best_model_score is None or score < self.best_model_score:
            self.best_model_score = score
            self.weights = self.average.weights


class ProgressLines(lightning.Callback):
    """Progress where there is no terminal, as in a log file: a line on standard error, at most one in `QUIET` seconds.

    Args:
        max_steps: of the training.
    """

    last = time.monotonic()
    """When the last line was printed, of this training or one before."""

    def __init__(self, max_steps: int) -> None:
        self.max_steps = max_steps

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if not trainer.is_global_zero or time.monotonic() - self.last < QUIET:
            return
        ProgressLines.last = time.monotonic()
        bits = float(trainer.callback_metrics["validation_bits"])
        steps = f"step {trainer.global_step:,} of at most {self.max_steps:,}"
        print(f"training: {steps}, {bits:.4f} validation bits", file=sys.stderr, flush=True)


class Stopping(EarlyStopping):
    """Early stopping that also stops a training which is resumed after it was stopped, unless with more patience."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict | {"patience": self.patience})

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if self.wait_count >= self.patience:
            trainer.should_stop = True


class Checkpoints(ModelCheckpoint):
    """Checkpoints in a folder that may be moved between two runs."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        moved = {name: here(state_dict[name]) for name in paths}
        models = {here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict(state_dict | moved | {"best_k_models": models, "dirpath": self.dirpath})


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints that are written whole or not at all, whenever the process is killed."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(Path(path), content.getvalue())


@contextmanager
def few_threads(prior: nn.Module, data: PlansModule) -> Iterator[None]:
    """One thread for small steps: more threads gain little there, and on a busy machine wait for one another."""
    tokens = data.training.group_size * data.training.window
    operations = 6 * tokens * sum(weight.numel() for weight in prior.parameters())
    with one_thread(operations < SMALL_STEP):
        yield


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
