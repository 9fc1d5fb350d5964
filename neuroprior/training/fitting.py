"""Training a prior in place with Lightning, and what every such training shares: checkpoints, stopping, quiet."""

import io
import logging
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import EarlyStopping, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from neuroprior._files import write_whole
from neuroprior._threads import one_thread
from neuroprior.plans import Plans
from neuroprior.training.batches import PlansModule
from neuroprior.training.module import PriorModule
from neuroprior.training.settings import Settings

SMALL_STEP = 1e9
"""Operations in a training step below which it runs on one thread."""


def train(prior: nn.Module, plans: Plans, settings: Settings, seed: int) -> float:
    """Train `prior` in place, keeping the weights that tell held-out plans best.

    Args:
        prior: any module with `forward(plans, context) -> logits [N, L, A]`; without `read_on` (see `NeuralPrior`)
            long plans are read whole.
        plans: at least two plans (two groups, where there are any), each with an action; or one long one, whose end is
            then held out.
        settings: how.
        seed: draws the held-out plans and the order of training; the same seed gives the same weights on a CPU.

    Returns:
        Bits per action on the held-out plans.

    Raises:
        ValueError: too few plans or groups, or the training diverged.
    """
    device = next(prior.parameters()).device
    training, validation = plans.split(settings.validation, torch.Generator().manual_seed(seed))
    window = settings.window if hasattr(prior, "read_on") else plans.max_length
    data = PlansModule(training, validation, replace(settings, window=window), seed)
    own = [device] if device.type == "cuda" else []
    with quiet(), few_threads(prior, data), tempfile.TemporaryDirectory() as folder, torch.random.fork_rng(own):
        torch.manual_seed(seed)
        trainer = lightning.Trainer(
            accelerator="gpu" if device.type == "cuda" else device.type,
            devices=[device.index or 0] if device.type == "cuda" else 1,
            max_epochs=data.epochs,
            gradient_clip_val=settings.gradient_clip,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
            callbacks=checkpoints_and_stopping(folder, ceil(settings.patience / data.steps)),
            plugins=[WholeCheckpoints()],
            logger=False,
            enable_model_summary=False,
            enable_progress_bar=settings.progress,
        )
        module = PriorModule(prior, settings.learning_rate, settings.weight_decay, seed)
        try:
            trainer.fit(module, datamodule=data)
        except SystemExit as interrupted:
            # Lightning turns Ctrl-C into this; a script or program above should see what it was.
            raise KeyboardInterrupt from interrupted
        best = take_best(trainer, module)
        module.to(device)
    return best


def checkpoints_and_stopping(folder: str | Path, patience: int) -> list[lightning.Callback]:
    """The callbacks of a training: keep the best and the last, and stop after `patience` looks without improvement."""
    return [
        Stopping("validation_bits", patience=patience, min_delta=1e-4),
        Checkpoints(
            folder,
            "best",
            monitor="validation_bits",
            save_last=True,
            save_on_train_epoch_end=True,
            enable_version_counter=False,
        ),
    ]


def take_best(trainer: lightning.Trainer, module: PriorModule) -> float:
    """Load the best weights of a training into its module; returns their held-out bits per action.

    Raises:
        ValueError: the training diverged.
    """
    best = trainer.checkpoint_callback
    assert isinstance(best, ModelCheckpoint)
    if best.best_model_score is None:
        raise ValueError("training ended before the first look at the validation plans; nothing was learned")
    if not best.best_model_score.isfinite():
        raise ValueError(f"training diverged; a learning_rate below {module.learning_rate} may help")
    checkpoint = torch.load(best.best_model_path, weights_only=True, map_location=module.device)
    module.load_state_dict(checkpoint["state_dict"])
    module.eval()
    return float(best.best_model_score)


class Stopping(EarlyStopping):
    """Early stopping that a resumed training remembers."""

    def on_train_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        if self.wait_count >= self.patience:
            trainer.should_stop = True


class Checkpoints(ModelCheckpoint):
    """The best and the last checkpoint in a folder that may be moved between two runs."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        def here(path: str) -> str:
            return str(Path(str(self.dirpath)) / Path(path).name) if path else path

        paths = ("best_model_path", "kth_best_model_path", "last_model_path")
        moved = {name: here(state_dict[name]) for name in paths}
        models = {here(path): score for path, score in state_dict["best_k_models"].items()}
        super().load_state_dict(state_dict | moved | {"best_k_models": models, "dirpath": self.dirpath})


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints that are there whole or not at all, whenever the process is killed."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        content = io.BytesIO()
        torch.save(checkpoint, content)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        write_whole(Path(path), content.getvalue())


@contextmanager
def few_threads(prior: nn.Module, data: PlansModule) -> Iterator[None]:
    """One thread for small steps: there, more gain little, and on a busy machine they wait for one another."""
    tokens = data.training.group_size * data.training.window
    operations = 6 * tokens * sum(weight.numel() for weight in prior.parameters())
    with one_thread(operations < SMALL_STEP):
        yield


@contextmanager
def quiet() -> Iterator[None]:
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
