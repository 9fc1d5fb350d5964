"""`neuroprior fit`: trains a prior on executed plans, saves it, and compares it with baselines."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, replace
from functools import partial
from importlib.resources import files
from inspect import signature
from pathlib import Path
from typing import Any, Literal

import pandas as pd
import torch
from jsonargparse import ActionConfigFile, ArgumentError  # type: ignore[attr-defined]
from jsonargparse.typing import NonNegativeInt, PositiveInt
from rich.console import Console

from neuroprior._files import write_whole
from neuroprior._folders import LOCK, as_folder, claim
from neuroprior.behaviour.analysis.comparison import best_chain
from neuroprior.behaviour.analysis.modes import choose_modes
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.reporting.document import Column, printed, table, write_frames
from neuroprior.behaviour.reporting.modes import choice_table
from neuroprior.behaviour.reporting.options import ReadOptions
from neuroprior.cli.fit_data import Parts, divide
from neuroprior.cli.fit_report import report
from neuroprior.cli.program import make_parser
from neuroprior.cli.reading import add_reading_arguments, pop_reading
from neuroprior.planners import Planner, collect
from neuroprior.plans import write_plans
from neuroprior.plans.io.npz import read_npz
from neuroprior.priors import CombinedPrior, MarkovPrior, Prior, SwitchingPrior, load
from neuroprior.priors.ensembles.candidates import Effort
from neuroprior.priors.fitting import PRIORS, make_prior
from neuroprior.priors.learning import plans_for
from neuroprior.priors.neural import NeuralPrior
from neuroprior.priors.saved import SavedModule
from neuroprior.priors.scoring import is_learned
from neuroprior.training import Settings, train
from neuroprior.worlds import World

OPTIONS, PLANS = "run.yaml", "plans.npz"
"""What a run writes to go on from, in its folder."""

DEFAULTS = Settings()

TRAINING = tuple(field.name for field in fields(Settings) if field.name != "validation")
"""Options of the command that are settings of training."""


def recipes() -> dict[str, Path]:
    """Return the recipes that come with the package, by name: from the wheel, or from `train/` in a checkout."""
    shipped = Path(str(files("neuroprior.cli"))) / "recipes"
    folder = shipped if shipped.is_dir() else Path(__file__).parents[2] / "train"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


class Recipe(ActionConfigFile):
    """The option `--config`: the path of a recipe, or the name of one that comes with the package."""

    def __call__(self, parser: Any, cfg: Any, values: Any, option_string: str | None = None) -> None:
        path = recipes().get(values, Path(values))
        if not path.is_file():
            raise ValueError(f"`config` must be a file or one of {', '.join(recipes())}, got {values}.")
        try:
            super().__call__(parser, cfg, str(path), option_string)
        except (TypeError, UnicodeDecodeError, ArgumentError) as error:
            raise ValueError(f"`config` must be a recipe in YAML, got {path}: {error}") from error


def run(arguments: list[str]) -> None:
    """Run the command.

    Raises:
        ValueError: an argument, a file or a training that went wrong.
        OSError: a file that cannot be read or written.
        KeyboardInterrupt: Ctrl-C; the message says how to go on.
    """
    parser = make_parser(fit, "neuroprior fit", skip={"plans", "training", "options"})
    add_reading_arguments(parser, ReadOptions)
    parser.add_argument("plans", nargs="*", type=str, default=[], help="Files of behaviour or plans, or minari:NAME.")
    parser.add_argument("--config", action=Recipe, help=f"A recipe: a file, or one of {', '.join(recipes())}.")
    parser.add_class_arguments(Settings, as_group=False, skip={"validation"})
    parsed = parser.parse_args(_with_classes(arguments))
    if (folder := parsed.resume) is not None:
        if parsed != parser.parse_args(["--resume", folder]):
            raise ValueError("`resume` must be given alone: a run goes on with its own options.")
        if not (Path(folder) / OPTIONS).is_file():
            raise ValueError(f"`resume` must be the folder of a run, which holds {OPTIONS}, got {folder}.")
        if not (Path(folder) / PLANS).is_file():
            raise ValueError(f"`resume` must be a run that has kept its {PLANS}, got {folder}; give its command again.")
        parsed = parser.parse_args(["--config", str(Path(folder) / OPTIONS), "--resume", folder])
    options, values = parser.dump(parsed), parser.instantiate(parsed).as_dict()
    del values["config"]
    training = Settings(**{name: values.pop(name) for name in TRAINING})
    reading = pop_reading(values, ReadOptions)
    fit(**values, training=training, options=options, reading=reading)


def _with_classes(arguments: list[str]) -> list[str]:
    """Return the arguments with names of priors, such as gru, as the classes or functions that make them."""
    words = [word for one in arguments for word in (one.split("=", 1) if one.startswith("--prior=") else [one])]
    places = [number for number, before in enumerate(words, 1) if before == "--prior" and number < len(words)]
    for place in places:
        name = words[place]
        if name.isidentifier() and PRIORS.find(name) is None and SavedModule.known.find(name) is None:
            raise ValueError(f"`prior` must be one of {', '.join(PRIORS)}, or a class, got {name}.")
        if (kind := PRIORS.find(name)) is not None:
            words[place] = f"{kind.__module__}.{getattr(kind, '__name__', '')}"
    return words


def fit(
    plans: list[str] | None = None,
    prior: Callable[[int], Prior] = CombinedPrior,
    effort: Effort | None = None,
    modes: list[PositiveInt] | None = None,
    orders: list[NonNegativeInt] | None = None,
    use_context: bool = True,
    world: World | None = None,
    planner: Planner | None = None,
    num_plans: int = 10_000,
    context: Literal["plan", "step"] | None = None,
    past_durations: int = 0,
    end: bool = False,
    validation: float = 0.1,
    held_out: float = 0.1,
    folds: int | None = None,
    training: Settings = DEFAULTS,
    seed: int = 0,
    out: str = "runs/prior",
    resume: str | None = None,
    options: str = "",
    reading: ReadOptions = ReadOptions(),  # noqa: B008
) -> None:
    """Train a prior on executed plans, save it, and compare it with count-based ones.

    Args:
        plans: files of behaviour (see `neuroprior.behaviour.read`), or of plans: `.npz`, `.jsonl`, or `minari:` and
            the name of a Minari dataset.
        prior: its name, such as gru, or class, such as GRUPrior; its own arguments go below it
            (`--prior.hidden_size 128`). The number of actions, and the context if the prior can take one, come from the
            plans.
        effort: how much the combined prior spends on networks.
        modes: numbers of hidden modes of a SwitchingPrior to choose from: the fewest that predict held-out plans as
            well as the best.
        orders: of a MarkovPrior to choose from, with its back-off and smoothing: those that predict held-out plans
            best. An order that the prior is given (`--prior.order 2`, other than 1) is the only one.
        use_context: whether the prior takes the context of the plans, where they have one.
        world: where plans are collected if no file is given, such as `neuroprior.worlds.gridworld`.
        planner: that chooses them, such as `ExhaustivePlanner`.
        num_plans: how many are collected.
        context: the world's observations as context: none, that at the start, or that before each action.
        past_durations: how many of the last actions' durations are a context of each action (features, for gru and
            transformer); 0 for none.
        end: close each plan with a symbol for its end, so that the prior learns how long plans are.
        validation: share of plans (of groups, where there are any) for early stopping and the choice of baselines.
        held_out: share of plans (or groups) for the table at the end; nothing is learned or chosen on them.
        folds: of a cross-validation over groups (over plans without groups), in place of a held-out share: the prior
            and the baselines are fitted once more for each fold, for the table alone, and the prior that is saved
            learns from all plans. By default 5 with fewer than 50 groups, 2 with two plans, else 1, which holds out a
            share.
        training: settings of networks.
        seed: draws the collected plans, the parts and the order of training.
        out: folder of the run, new or empty.
        resume: folder of a run to go on with, in place of all other options.
        options: the options in YAML, to be kept in the folder.
        reading: how files are read.
    """
    new = as_folder("out", out)
    folder, generator = Path(resume) if resume else new, torch.Generator().manual_seed(seed)
    make: Callable[..., Prior] = prior
    if effort is not None:
        # Of a class that the command line names, its arguments stand among those that are given already.
        if "effort" not in {*signature(prior).parameters, *getattr(prior, "keywords", ())}:
            raise ValueError(f"`effort` must be left out for another prior than the combined one, got {effort}.")
        make = partial(make, effort=effort)
    with claim(folder, owns_all=True, name="out" if resume is None else "resume"):
        if resume is None:
            _check_new(folder, options)
        if resume is not None:
            source = read_npz(folder / PLANS, None, None, RecordedPlans)
        elif plans:
            source = reading.read(plans)
        elif world is not None and planner is not None:
            source = RecordedPlans.of(collect(planner, world, num_plans, context=context, generator=generator))
        else:
            raise ValueError(f"`plans` must be a file, or give --config and a recipe: {', '.join(recipes())}.")
        ended = source.with_end() if end and source.end is None else source
        parts = divide(ended, validation, held_out, folds, past_durations, seed)
        training = replace(training, validation=validation)
        try:
            model = make_prior(parts.plans, make, use_context)
        except TypeError as error:
            raise ValueError(
                f"`prior` must take what it is given: {error}; --use_context false leaves the context out."
            ) from error
        frames = {}
        if modes is not None:
            model, frames["modes"] = _choose_modes(model, modes, parts)
        if orders is not None:
            model, frames["orders"] = _choose_order(model, orders, parts)
        if model.fit_settings and torch.cuda.is_available():
            model.cuda()
        fresh = deepcopy(model)
        if isinstance(model, NeuralPrior):
            model.prepare(parts.learned_from, training.window)
        if resume is None:
            write_whole(folder / OPTIONS, options.encode())  # first: it says whose folder it is
            write_plans(source, folder / PLANS)
        write_frames(folder, frames)
        for note in source.notes:
            print(f"note: {note}")
        # Defaults are left to the prior, as in `neuroprior.fit`: those of the networks inside it may be others.
        changed = {name: value for name, value in vars(training).items() if value != getattr(DEFAULTS, name)}
        settings = {name: changed[name] for name in model.fit_settings if name in changed}
        curve: list[dict[str, float]] = []
        try:
            if isinstance(model, NeuralPrior):
                how = replace(training, validation=parts.chosen_on)
                curve = train(model, parts.learned_from, how, seed, folder)
            elif is_learned(folder):
                model = load(folder)
            else:
                learned_from = parts.plans if parts.folds > 1 else parts.learned_from
                model.fit(learned_from, generator=torch.Generator().manual_seed(seed), **settings)
            if isinstance(model, CombinedPrior) and isinstance(fresh, CombinedPrior):
                fresh.networks = model.trained  # those that did not pay are not tried again in each fold
            if "progress" in model.fit_settings:
                settings["progress"] = False  # of several processes, which would get mixed
            report(folder, model, curve, parts, fresh, settings)
        except KeyboardInterrupt as interrupted:
            raise KeyboardInterrupt(f"interrupted; go on with: neuroprior fit --resume {folder}") from interrupted


def _choose_modes(prior: Prior, modes: list[int], parts: Parts) -> tuple[Prior, Any]:
    """Choose the number of modes on the plans that the prior learns from; return it, and what speaks for it."""
    if not isinstance(prior, SwitchingPrior):
        raise ValueError(
            f"`prior` must be a SwitchingPrior (--config switching) for modes, got {type(prior).__name__}."
        )
    arguments = prior.config
    for name in ("num_modes", "num_actions", "num_contexts"):  # are found, or follow from the plans
        arguments.pop(name, None)
    choice = choose_modes(
        parts.plans if parts.folds > 1 else parts.learned_from,
        modes,
        use_context=prior.takes_context,
        generator=torch.Generator().manual_seed(parts.seed),
        **arguments,
    )
    Console(markup=False, emoji=False).print(printed("Hidden modes", choice_table(choice)))
    return SwitchingPrior(**prior.config | {"num_modes": choice.chosen}), choice.frame()


def _choose_order(prior: Prior, orders: list[int], parts: Parts) -> tuple[Prior, pd.DataFrame]:
    """Choose order, back-off and smoothing on plans that are not learned from; return what was tried, too."""
    if not isinstance(prior, MarkovPrior):
        raise ValueError(f"`prior` must be a MarkovPrior (--config markov) for orders, got {type(prior).__name__}.")
    if prior.order != 1:
        orders = [prior.order]
    contexts = [prior.num_contexts]
    plans = [plans_for(prior, subset) for subset in (parts.learned_from, parts.chosen_on)]
    tried = [best_chain(plans[0], order, contexts, plans[1]) for order in sorted(set(orders))]
    best = min(tried, key=lambda one: one.validation_bits)
    if not isinstance(best.prior, MarkovPrior):
        raise ValueError(f"`orders` must leave a chain that fits into memory, got {orders}.")
    rows = [(one.model, one.how, one.validation_bits, one is best) for one in tried]
    frame = pd.DataFrame(rows, columns=["chain", "how", "bits", "chosen"])
    columns: dict[str, Column] = {"chain": "chain", "back-off, smoothing": "how", "bits per action": "bits:.4f"}
    columns[""] = lambda row: "chosen" if row.chosen else ""
    shown = table(frame, columns, "On plans that the chains did not learn from.", align="llrl")
    Console(markup=False, emoji=False).print(printed("Order of the chain", shown))
    chosen = {name: best.prior.config[name] for name in ("order", "smoothing", "backoff")}
    return MarkovPrior(**prior.config | chosen), frame


def _check_new(folder: Path, options: str) -> None:
    """Raise ValueError unless a folder is empty, or was when a run with these options was killed at its beginning."""
    there = {path.name for path in folder.iterdir()} - {LOCK}
    if there == {OPTIONS} and (folder / OPTIONS).read_bytes() == options.encode():
        return
    if there:
        goes_on = f"; --resume {folder} goes on with the run there" if {OPTIONS, PLANS} <= there else ""
        raise ValueError(f"`out` must be a new or empty folder, got {folder}{goes_on}.")
