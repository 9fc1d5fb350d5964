"""The command line of `python -m train`, by LightningCLI's conventions, and the order of what a run does."""

import sys
from math import ceil
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
import yaml
from jsonargparse import ArgumentError
from lightning import Callback, Trainer
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from neuroprior._files import write_whole
from neuroprior.cli.fit_data import PlansData
from neuroprior.cli.fit_model import PriorModel
from neuroprior.cli.fit_report import report
from neuroprior.plans import write_plans
from neuroprior.training import few_threads, quiet
from neuroprior.training.fitting import Stopping, WholeCheckpoints, checkpoints_and_stopping, take_best

USAGE = """python -m train fit --config train/gru.yaml [--data.file PLANS] [--out FOLDER] [--SECTION.FIELD VALUE ...]
       python -m train fit --resume FOLDER"""
CONFIG, PLANS = "run.yaml", "plans.npz"
STATES = ("curve", "pytorch-lightning_version", "epoch", "global_step", "loops", "callbacks", "optimizer_states")
LAST, BEST = "checkpoints/last.ckpt", "checkpoints/best.ckpt"


def run(arguments: list[str]) -> None:
    """Train as the arguments say.

    Raises:
        ValueError: an argument, a file or a training that went wrong.
        OSError: a file that cannot be read or written.
        KeyboardInterrupt: Ctrl-C; the message says how to go on.
    """
    with quiet():
        try:
            TrainCLI(arguments)
        except ArgumentError as error:
            raise ValueError(str(error)) from error
        except MisconfigurationException as error:
            raise ValueError(str(error)) from error


def make_trainer(
    folder: str = "",
    max_steps: int = 1000,
    patience: int = 400,
    accelerator: str = "auto",
    devices: int | str | list[int] = 1,
    num_nodes: int = 1,
    strategy: str = "auto",
    precision: str | int = "32-true",
    gradient_clip_val: float = 1.0,
    accumulate_grad_batches: int = 1,
    max_time: str | None = None,
    enable_progress_bar: bool = True,
    callbacks: list[Callback] | None = None,
) -> Trainer:
    """Lightning's trainer, with the logs and checkpoints of a run.

    Args:
        folder: of the run.
        max_steps: gradient steps at most, about; the learning rate falls to 0 over them.
        patience: steps without better validation bits after which training stops.
        accelerator: "cpu", "gpu", or "auto".
        devices: number of devices, or their numbers.
        num_nodes: machines.
        strategy: "ddp" for several devices (processes, on a CPU).
        precision: "bf16-mixed" on a GPU that has it.
        gradient_clip_val: the largest norm of a gradient.
        accumulate_grad_batches: batches for one step of the optimiser.
        max_time: stop after so much time, DD:HH:MM:SS.
        enable_progress_bar: show it.
        callbacks: further callbacks of Lightning's.
    """
    for name, number in (("patience", patience), ("accumulate_grad_batches", accumulate_grad_batches)):
        if number < 1:
            raise ValueError(f"trainer.{name}: at least 1 is expected, not {number}")
    del max_steps  # it and patience are turned into looks when the data are there: see `instantiate_trainer`
    own: list[Callback] = checkpoints_and_stopping(Path(folder) / "checkpoints", patience)
    bar: list[Callback] = [RichProgressBar()] if enable_progress_bar and sys.stdout.isatty() else []
    return Trainer(
        max_epochs=-1,
        accelerator=accelerator,
        devices=devices,
        num_nodes=num_nodes,
        strategy=strategy,
        precision=precision,  # type: ignore[arg-type]
        gradient_clip_val=gradient_clip_val,
        accumulate_grad_batches=accumulate_grad_batches,
        max_time=max_time,
        enable_progress_bar=bool(bar),
        callbacks=[*own, *bar, *(callbacks or [])],
        logger=[CSVLogger(folder, "logs"), TensorBoardLogger(folder, "tensorboard", "")],
        plugins=[WholeCheckpoints()],
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        use_distributed_sampler=False,
        enable_model_summary=False,
        default_root_dir=folder,
    )


class TrainCLI(LightningCLI):
    """`fit` alone, with `--out` and `--resume`."""

    def __init__(self, arguments: list[str]) -> None:
        super().__init__(
            PriorModel,
            PlansData,
            save_config_callback=None,
            trainer_class=make_trainer,
            seed_everything_default=0,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,
            parser_kwargs={
                "prog": "python -m train",
                "description": "Train prior models.",
                "exit_on_error": False,
                "fit": {
                    "usage": USAGE,
                    "description": "Train a prior on executed plans, and compare it with count-based ones.",
                    "exit_on_error": False,
                },
            },
            args=_with_saved_config(arguments),
        )

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {"fit": {"model", "train_dataloaders", "val_dataloaders", "datamodule", "ckpt_path", "weights_only"}}

    def add_default_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--seed_everything", type=int, default=0, help="Seed of all that is drawn at random.")

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--out", type=str, default="runs/prior", help="Folder of the run; made, must be new.")
        parser.add_argument(
            "--resume",
            type=str | None,
            default=None,
            help="Folder of a run to go on with; only --trainer options may change.",
        )
        parser.link_arguments("seed_everything", "data.seed")
        parser.link_arguments(("out", "resume"), "trainer.folder", compute_fn=lambda out, resume: resume or out)
        parser.link_arguments("trainer.max_steps", "data.max_steps")
        parser.link_arguments("data", "model.data", apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        fit = self.config.fit
        if not (fit.resume or fit.out):
            raise ValueError("out: the name of a folder is expected")
        self.folder = Path(fit.resume or fit.out)
        if rank_zero_only.rank != 0:
            return
        if fit.resume is None:
            if any((self.folder / name).exists() for name in (CONFIG, "model.safetensors")):
                raise ValueError(
                    f"{self.folder}: holds a run already; --resume {self.folder} goes on with it, or give another --out"
                )
            self.folder.mkdir(parents=True, exist_ok=True)

    def instantiate_trainer(self, **more: Any) -> Trainer:
        """The trainer, told how many looks at the validation plans its steps are."""
        trainer = super().instantiate_trainer(**more)
        trainer.fit_loop.max_epochs = self.datamodule.epochs
        for callback in trainer.callbacks:
            if isinstance(callback, Stopping):
                callback.patience = ceil(callback.patience / self.datamodule.steps)
        return trainer

    def fit(self, model: PriorModel, datamodule: PlansData, **_: Any) -> None:
        """Train, or count; then compare and save."""
        self._check_checkpoints(model, datamodule)
        if self.trainer.is_global_zero:
            self._keep(datamodule)
        if model.is_neural:
            self._train(model, datamodule)
        else:
            model.prior.fit(datamodule.learned_from)
        if self.trainer.is_global_zero:
            report(self.folder, model, datamodule)

    def _check_checkpoints(self, model: PriorModel, data: PlansData) -> None:
        last = self.folder / LAST
        if not model.is_neural or not last.exists():
            return
        epoch = _check(last, model)["epoch"]
        _check(self.folder / BEST, model)
        if epoch >= data.epochs:
            raise ValueError(
                f"trainer.max_steps: the run in {self.folder} has made more steps than"
                f" {self.config.fit.trainer.max_steps} already"
            )

    def _keep(self, data: PlansData) -> None:
        """Keep what the run needs to be resumed, and nothing else is needed then: its configuration and its plans."""
        if self.config.fit.resume is None or not (self.folder / PLANS).exists():
            write_plans(data.source, self.folder / PLANS)
        config = yaml.safe_load(self._parser("fit").dump(self.config.fit))
        if (self.folder / CONFIG).exists():
            # What is resumed with other trainer options goes on with them when it is resumed again.
            config = yaml.safe_load((self.folder / CONFIG).read_text()) | {"trainer": config["trainer"]}
        write_whole(self.folder / CONFIG, yaml.safe_dump(config, sort_keys=False, allow_unicode=True).encode())

    def _train(self, model: PriorModel, data: PlansData) -> None:
        model.prior.prepare(data.learned_from, data.window)
        last = self.folder / LAST
        try:
            with few_threads(model.prior, data):
                self.trainer.fit(model, datamodule=data, ckpt_path=last if last.exists() else None, weights_only=True)
        except SystemExit as interrupted:
            # Lightning turns Ctrl-C into this.
            if not self.trainer.interrupted or not self.trainer.is_global_zero:
                raise
            saved = f"saved up to step {model.curve[-1]['step']}" if model.curve else "nothing to save yet"
            raise KeyboardInterrupt(
                f"interrupted; {saved}; go on with: python -m train fit --resume {self.folder}"
            ) from interrupted
        if self.trainer.is_global_zero:
            take_best(self.trainer, model)


def _check(checkpoint: Path, model: PriorModel) -> dict[str, Any]:
    """Raise ValueError unless a checkpoint is whole and of this model; nothing in it is executed."""
    try:
        saved: dict[str, Any] = torch.load(checkpoint, weights_only=True, map_location="cpu")
        shapes = {name: value.shape for name, value in saved["state_dict"].items()}
        for key in STATES if checkpoint.name == Path(LAST).name else ():
            saved[key]
    except (UnpicklingError, EOFError, KeyError, AttributeError, TypeError, RuntimeError, OSError) as error:
        raise ValueError(
            f"{checkpoint}: missing, damaged, or no checkpoint of this program; without the folder"
            f" {checkpoint.parent} the run starts over"
        ) from error
    if shapes != {name: value.shape for name, value in model.state_dict().items()}:
        raise ValueError(f"{checkpoint}: of another model; resume without changing the model")
    return saved


def _with_saved_config(arguments: list[str]) -> list[str]:
    """The arguments, and before them those that a run to be resumed was started with."""
    folder, others = _resumed(arguments)
    if folder is None:
        sources = ("--config", "-c", "--model", "--help", "-h", "--print_config")
        if arguments[:1] == ["fit"] and not any(argument.startswith(sources) for argument in arguments):
            raise ValueError("fit: give --config train/gru.yaml, or another recipe, or --resume and a run's folder")
        return arguments
    place = Path(folder)
    if not (place / CONFIG).exists():
        raise ValueError(f"{place}: no run to resume ({CONFIG} is missing)")
    for other in others:
        if other.startswith(("--", "-c")) and not other.startswith("--trainer."):
            raise ValueError(f"{other}: a resumed run keeps its data and model; only --trainer options may change")
    try:
        whole = isinstance(yaml.safe_load((place / CONFIG).read_text(encoding="utf-8")), dict)
    except (yaml.YAMLError, UnicodeDecodeError):
        whole = False
    if not whole:
        raise ValueError(f"{place / CONFIG}: damaged, or not the configuration of a run")
    saved = ["--config", str(place / CONFIG), "--resume", str(place)]
    if (place / PLANS).exists():
        saved += ["--data.file", str(place / PLANS)]
    return ["fit", *saved, *others]


def _resumed(arguments: list[str]) -> tuple[str | None, list[str]]:
    """The folder after `--resume`, or None, and the other arguments of `fit`."""
    for number, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == "--resume" and "fit" in arguments[:number]:
            rest = arguments[number + 1 :]
            if not equals:
                value, rest = (rest[0] if rest else ""), rest[1:]
            return value, [*arguments[:number], *rest][arguments.index("fit") + 1 :]
    return None, arguments
