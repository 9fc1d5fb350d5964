"""The command `fit`: trains a prior as a recipe says, by LightningCLI's conventions, and compares it with baselines."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import pandas as pd
import torch
import yaml
from jsonargparse import ArgumentError, class_from_function  # type: ignore[attr-defined]
from jsonargparse.typing import PositiveInt
from lightning import Trainer
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning_utilities.core.rank_zero import rank_zero_only
from rich.console import Console

from neuroprior._files import write_whole
from neuroprior.behaviour.analysis.modes import choose_modes
from neuroprior.behaviour.report.document import printed, write_frames
from neuroprior.behaviour.report.modes import choice_table
from neuroprior.cli.fit_recipe import PlansData, PriorModel, recipe_path, recipes
from neuroprior.cli.fit_report import report
from neuroprior.cli.program import one_line
from neuroprior.plans import write_plans
from neuroprior.priors import Prior, SwitchingPrior, load
from neuroprior.priors.neural import NeuralPrior
from neuroprior.priors.serialization import FILES
from neuroprior.training import Settings, make_trainer, quiet, run_training
from neuroprior.training.trainer import ProgressLines

USAGE = """{0} fit PLANS [--effort fast|standard|full] [--max-steps N] [--out FOLDER]
       {0} fit --config gru [--data.file PLANS] [--out FOLDER] [--SECTION.FIELD VALUE ...]
       {0} fit --resume FOLDER"""
CONFIG, PLANS, MODEL = "run.yaml", "plans.npz", FILES[0]
WRITTEN = (
    PLANS,
    *FILES,
    "metrics.json",
    "metrics.csv",
    "modes.csv",
    "learned.json",
    "learning_curve.png",
    "checkpoints",
)
"""What a run writes beside its configuration."""

LAST, BEST = "checkpoints/last.ckpt", "checkpoints/best.ckpt"
STATES = ("curve", "pytorch-lightning_version", "epoch", "global_step", "loops", "callbacks", "optimizer_states")
"""What a checkpoint must hold for a training to go on from it."""

DEFAULT, OF_MODES = "combined", "switching"
"""The recipes where plans are given and no other, without `--modes` and with it."""

OF_PLANS = ("num_modes", "num_actions", "num_contexts")
"""Arguments of a switching prior that are found, or follow from the plans."""

OTHERWISE = {
    "--config",
    "-c",
    "--model",
    "--model.prior",
    "--model.prior.class_path",
    "--resume",
    "--help",
    "-h",
    "--print_config",
}
"""Options with which no default recipe is needed."""

OF_TABLES = ("--columns", "--missing", "--merge_repeats", "--max_gap")
"""Options of `--data` that other commands have, too."""

EFFORT = "--model.prior.effort"
"""What `--effort` stands for, an option that other commands have, too."""

STEPS = "--max_steps"
"""`--trainer.max_steps`, as other commands call it."""

MadeTrainer = class_from_function(make_trainer)
"""Made once: Lightning would make it twice for each run, and look through the whole stack of calls for it."""

NETWORKS_ALONE = {"devices": 1, "num_nodes": 1, "precision": "32-true", "accumulate_grad_batches": 1, "max_time": None}
"""Options of the trainer, with their defaults, that do not reach the networks inside other priors."""


def run(arguments: list[str], program: str = "neuroprior") -> None:
    """Run the command.

    Args:
        arguments: `fit`, and its options.
        program: what precedes them, for usage and messages.

    Raises:
        ValueError: an argument, a file or a training that went wrong.
        OSError: a file that cannot be read or written.
        KeyboardInterrupt: Ctrl-C; the message says how to go on.
    """
    with quiet():
        try:
            FitCLI(arguments, program)
        except (ArgumentError, MisconfigurationException) as error:
            raise ValueError(one_line(str(error), {})) from error


class FitCLI(LightningCLI):
    """LightningCLI with `fit` alone, and with the options `--out` and `--resume`."""

    def __init__(self, arguments: list[str], program: str) -> None:
        self.program = program
        super().__init__(
            PriorModel,
            PlansData,
            save_config_callback=None,
            trainer_class=MadeTrainer,
            seed_everything_default=0,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,
            parser_kwargs={
                "prog": program,
                "description": "Train priors.",
                "exit_on_error": False,
                "fit": {
                    "usage": USAGE.format(program),
                    "description": "Train a prior on executed plans, and compare it with count-based ones.",
                    "exit_on_error": False,
                },
            },
            args=_with_saved_config(_in_full(arguments), program),
        )

    @staticmethod
    def subcommands() -> dict[str, set[str]]:
        return {"fit": {"model", "train_dataloaders", "val_dataloaders", "datamodule", "ckpt_path", "weights_only"}}

    def add_default_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument("--seed_everything", type=int, default=0, help="Seed of all random numbers.")

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        parser.add_argument(
            "--out",
            type=str,
            default="runs/prior",
            help="Folder of the run, which must hold none yet.",
        )
        parser.add_argument(
            "--resume",
            type=str | None,
            default=None,
            help="Folder of a run to go on with; only --trainer options may change.",
        )
        parser.add_argument(
            "--modes",
            type=PositiveInt,
            nargs="+",
            default=None,
            help="Numbers of hidden modes to choose from: the fewest that predict held-out plans as well as the best.",
        )
        parser.link_arguments("seed_everything", "data.seed")
        parser.link_arguments(("out", "resume"), "trainer.folder", compute_fn=folder_of)
        parser.link_arguments("trainer.max_steps", "data.max_steps")
        parser.link_arguments("data", "model.data", apply_on="instantiate")
        parser.link_arguments("data.steps", "trainer.validate_every", apply_on="instantiate")

    def before_instantiate_classes(self) -> None:
        fit = self.config.fit
        if not (fit.resume or fit.out):
            raise ValueError("out: the name of a folder is expected")
        self.folder = Path(fit.resume or fit.out)
        if getattr(rank_zero_only, "rank", 0) != 0:
            return
        if fit.resume is None:
            if any((self.folder / name).exists() for name in (CONFIG, MODEL)):
                raise ValueError(
                    f"{self.folder}: holds a run already; --resume {self.folder} goes on with it, or give another --out"
                )
            if other := [name for name in WRITTEN if (self.folder / name).exists()]:
                raise ValueError(
                    f"out: {self.folder / other[0]} is there, and of no run that began; move it away, or give another"
                    " folder"
                )
            self.folder.mkdir(parents=True, exist_ok=True)

    def instantiate_trainer(self, **more: Any) -> Trainer:
        """The trainer, with the steps and the patience that suit the plans."""
        chosen = self.datamodule.settings
        given = self.config.fit.trainer.patience
        patience = chosen.patience if given is None else given
        try:
            return super().instantiate_trainer(max_steps=chosen.max_steps, patience=patience, **more)
        except TypeError as error:  # Lightning's, of devices
            raise ValueError(f"trainer: {error}") from error

    def fit(self, model: PriorModel, datamodule: PlansData, **_: Any) -> None:
        """Train, or count; then compare and save."""
        neural, many = isinstance(model.prior, NeuralPrior), datamodule.folds > 1
        ProgressLines.last = time.monotonic()  # what is done at once is not commented on
        modes = self._choose_modes(model, datamodule) if self.config.fit.modes else None
        settings = {} if neural and not many else self._settings(model, datamodule)
        fresh = deepcopy(model.prior) if many else None
        silent = {"progress": False} if "progress" in model.prior.fit_settings else {}
        if isinstance(model.prior, NeuralPrior):
            model.prior.prepare(datamodule.learned_from, datamodule.settings.window)
            self._check_checkpoints(model, datamodule)
        saved = None if neural else self._saved()
        # A prior of other options is in the folder, with these, until the new one has been learned.
        other = not neural and saved is None and (self.folder / MODEL).exists()
        if self.trainer.is_global_zero:
            self._keep(datamodule, options=not other)
            write_frames(self.folder, {} if modes is None else {"modes": modes})
            for note in datamodule.source.notes:
                print(f"note: {note}")
        if neural:
            self._train(model, datamodule)
        elif saved is not None:
            model.prior = saved
        else:
            generator = torch.Generator().manual_seed(datamodule.seed)
            model.prior.fit(datamodule.plans if many else datamodule.learned_from, generator=generator, **settings)
            if other and self.trainer.is_global_zero:
                (self.folder / MODEL).unlink()
                self._keep(datamodule)
        if self.trainer.is_global_zero:
            with self._saying_how_to_go_on(lambda: "the prior is saved"):
                report(self.folder, model, datamodule, fresh, settings | silent)

    def _choose_modes(self, model: PriorModel, data: PlansData) -> pd.DataFrame:
        """Choose the number of modes on the plans that the prior learns from; print and return what speaks for it."""
        prior, plans = model.prior, data.plans if data.folds > 1 else data.learned_from
        if not isinstance(prior, SwitchingPrior):
            raise ValueError(f"modes: a SwitchingPrior is expected (--config switching), not a {type(prior).__name__}")
        config = {name: value for name, value in prior.config.items() if name not in OF_PLANS}
        choice = choose_modes(
            plans,
            self.config.fit.modes,
            use_context=prior.takes_context,
            generator=torch.Generator().manual_seed(data.seed),
            **config,
        )
        Console().print(printed("Hidden modes", choice_table(choice)))
        model.prior = SwitchingPrior(**prior.config | {"num_modes": choice.chosen})
        frame: pd.DataFrame = choice.frame()
        return frame

    def _settings(self, model: PriorModel, data: PlansData) -> dict[str, Any]:
        """The settings of the recipe that the `fit` of a prior takes which trains networks inside, or none."""
        prior, trainer = model.prior, self.config.fit.trainer
        if not prior.fit_settings:
            return {}
        neural = isinstance(prior, NeuralPrior)
        for name, default in NETWORKS_ALONE.items():
            if trainer[name] != default:
                hint = " in cross-validation; --data.folds 1 holds out a share of the plans instead" if neural else ""
                raise ValueError(f"trainer.{name}: a {type(prior).__name__} is trained with {default} alone{hint}")
        prior.to(self.trainer.strategy.root_device)
        settings = asdict(data.given) | {
            "learning_rate": model.learning_rate,
            "weight_decay": model.weight_decay,
            "gradient_clip": trainer.gradient_clip_val,
            "patience": trainer.patience,
            "progress": trainer.enable_progress_bar,
        }
        # Defaults are left to the prior, as in `neuroprior.fit`: those of the networks inside it may be others.
        default = vars(Settings())
        return {name: settings[name] for name in prior.fit_settings if settings.get(name) != default.get(name)}

    def _check_checkpoints(self, model: PriorModel, data: PlansData) -> None:
        last = self.folder / LAST
        if not last.exists():
            return
        saved = _check(last, model)
        _check(self.folder / BEST, model)
        if saved["epoch"] >= data.epochs:
            raise ValueError(
                f"trainer.max_steps: more than the {saved['global_step']} steps are expected that {self.folder} has"
                f" made, not {data.settings.max_steps}"
            )

    def _saved(self) -> Prior | None:
        """The prior that a resumed run had learned and saved; None where options of the trainer were changed."""
        if self.config.fit.resume is None:
            return None
        before = yaml.safe_load((self.folder / CONFIG).read_text(encoding="utf-8")).get("trainer")
        if before != self._as_written()["trainer"]:
            return None
        try:
            return load(self.folder)
        except (ValueError, OSError):  # the run ended before the prior was saved, or meanwhile: it learns anew
            return None

    def _as_written(self) -> dict[str, Any]:
        """The configuration of the run, as it is written."""
        written: dict[str, Any] = yaml.safe_load(self._parser("fit").dump(self.config.fit))
        return written

    def _keep(self, data: PlansData, options: bool = True) -> None:
        """Keep what the run needs to be resumed, and nothing else is needed then: its configuration and its plans.

        Without `options` those of the trainer stay as they were written before.
        """
        if self.config.fit.resume is None or not (self.folder / PLANS).exists():
            write_plans(data.source, self.folder / PLANS)
        config = self._as_written()
        if (self.folder / CONFIG).exists():
            if not options:
                return
            # What is resumed with other trainer options goes on with them when it is resumed again.
            config = yaml.safe_load((self.folder / CONFIG).read_text()) | {"trainer": config["trainer"]}
        write_whole(self.folder / CONFIG, yaml.safe_dump(config, sort_keys=False, allow_unicode=True).encode())

    def _train(self, model: PriorModel, data: PlansData) -> None:
        last = self.folder / LAST
        with self._saying_how_to_go_on(lambda: f"saved up to step {model.curve[-1]['step']}" if model.curve else ""):
            run_training(self.trainer, model, data, last if last.exists() else None)

    @contextmanager
    def _saying_how_to_go_on(self, saved: Callable[[], str]) -> Iterator[None]:
        """Ctrl-C within says what is saved and how to go on."""
        try:
            yield
        except KeyboardInterrupt as interrupted:
            raise KeyboardInterrupt(
                f"interrupted; {saved() or 'nothing to save yet'}; go on with: {self.program} fit --resume"
                f" {self.folder}"
            ) from interrupted


def folder_of(out: str | None, resume: str | None) -> str | None:
    """The folder of a run, new or resumed; the help names this function."""
    return resume or out


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


def _in_full(arguments: list[str]) -> list[str]:
    """The arguments, with the paths of recipes that are given by name, and the sections of short options.

    The first argument may be the file of plans. With plans and no recipe, the recipe is that of the combined prior,
    or with `--modes` of a switching prior.
    """
    if arguments[:1] == ["fit"]:
        if len(arguments) > 1 and not arguments[1].startswith("-"):
            arguments = ["fit", "--data.file", *arguments[1:]]
        given = {argument.partition("=")[0] for argument in arguments}
        if "--data.file" in given and not given & OTHERWISE:
            arguments = ["fit", "--config", OF_MODES if "--modes" in given else DEFAULT, *arguments[1:]]
    out: list[str] = []
    given_recipes = set()
    for argument in arguments:
        if out and out[-1] in ("--config", "-c"):
            given_recipes.add(argument)
            argument = recipe_path(argument)
        elif argument.startswith("--config="):
            given_recipes.add(argument.removeprefix("--config="))
            argument = f"--config={recipe_path(argument.removeprefix('--config='))}"
        elif argument.startswith(OF_TABLES):
            argument = f"--data.{argument.removeprefix('--')}"
        elif argument.partition("=")[0] == STEPS:
            argument = f"--trainer.{argument.removeprefix('--')}"
        out.append(argument)
    effort, out = _taken_out("--effort", out)
    if effort is None:
        return out
    if effort.startswith("--"):
        raise ValueError("effort: fast, standard or full is expected after --effort")
    if without := sorted(given_recipes & set(recipes()) - {DEFAULT}):
        raise ValueError(f"effort: it is of the recipe {DEFAULT}, and the recipe {without[0]} has none")
    return [*out, f"{EFFORT}={effort}"]  # last: the prior that it belongs to may be given after it


def _with_saved_config(arguments: list[str], program: str) -> list[str]:
    """The arguments, and before them those that a run to be resumed was started with."""
    folder, others = _resumed(arguments)
    if folder is None:
        sources = ("--config", "-c", "--model", "--help", "-h", "--print_config")
        made = [one for one in arguments if one.startswith(sources) and not one.startswith(EFFORT)]
        if arguments[:1] == ["fit"] and not made:
            raise ValueError(
                f"{program} fit: give a file of plans, --config and a recipe ({', '.join(recipes())}, or a file), or"
                " --resume and the folder of a run"
            )
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
        saved += ["--data.file", str(place / PLANS), "--data.columns=null", "--data.missing=gap"]
        saved += ["--data.merge_repeats=false", "--data.max_gap=null"]
    return ["fit", *saved, *others]


def _resumed(arguments: list[str]) -> tuple[str | None, list[str]]:
    """The folder after `--resume`, or None, and the other arguments of `fit`."""
    return _taken_out("--resume", arguments[arguments.index("fit") + 1 :] if "fit" in arguments else [])


def _taken_out(option: str, arguments: list[str]) -> tuple[str | None, list[str]]:
    """The value of an option ("" where none follows it), or None, and the arguments without the two."""
    for number, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == option:
            rest = arguments[number + 1 :]
            if not equals:
                value, rest = (rest[0] if rest else ""), rest[1:]
            return value, [*arguments[:number], *rest]
    return None, arguments
