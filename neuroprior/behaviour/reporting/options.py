"""Options of a report on plans: how their file is read, and which models are fitted to them."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from neuroprior._checks import check_choices, check_sizes
from neuroprior.behaviour.reading import Options
from neuroprior.behaviour.reading.read import read_recordings
from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.behaviour.recordings import Recordings
from neuroprior.plans import Plans, constant_context, read_plans
from neuroprior.plans.columns import check_names
from neuroprior.plans.io import MINARI
from neuroprior.plans.io.npz import read_npz
from neuroprior.priors.ensembles.candidates import OF_EFFORT, Effort, check_effort

ModelName = Literal["counts", "gru", "transformer", "stacked", "combined"]
InputName = Literal["actions", "context", "durations"]

MODELS: tuple[ModelName, ...] = ("counts", "gru", "transformer", "stacked", "combined")
INPUTS: tuple[InputName, ...] = ("actions", "context", "durations")

MAX_SEED = 2**50 - 1
"""Above it the seeds of single fits, a thousand times as large, would not be integers of 64 bits."""


Files = str | Path | Sequence[str | Path]
"""A file, a folder, a glob or several of them."""


@dataclass(frozen=True)
class ReadOptions(Options):
    """How files of behaviour are read as plans: the options of `neuroprior.behaviour.read`, and these.

    Attributes:
        columns, missing, missing_words, unpaired, overlaps, ends: see `neuroprior.behaviour.Options`.
        day_first, words, merge_repeats, from_, to, drop, rename: see there.
        max_gap: a longer pause between two behaviours ends a plan, too; in the unit of the times.
        compare: the factor that is compared, such as the treatment; the first where none is named.
        reference: its level that the others are compared with; by default the one that is called control, vehicle,
            saline, placebo, sham, untreated, naive, baseline or wild type, if there is one, else the first by name.
        strata: factors, such as sex, within whose levels it is compared; by default the others, but for those that vary
            within a subject. None after the option: not within any.
        num_actions: number of actions, where they are numbers and the file does not say.
        action_names: names of the actions in the order of their numbers, where the file does not say.
        unknown: what behaviours do that are none of the names: an error, or a gap, at which a plan ends.

    Example:
        >>> ReadOptions(columns={"behaviour": "Behavior"}, max_gap=10).max_gap
        10
    """

    max_gap: float | None = None
    compare: str | None = None
    reference: str | None = None
    strata: Sequence[str] | None = None
    num_actions: int | None = None
    action_names: Sequence[str] | None = None
    unknown: Literal["error", "gap"] = "error"

    def read(self, files: Files) -> RecordedPlans:
        """Reads the plans of files: tables as recordings, `.npz`, `.jsonl` and Minari with `neuroprior.read_plans`.

        What a reader warns of stands in the notes of the plans.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: an option or a file is wrong.
        """
        file = files if isinstance(files, str | Path) else files[0] if len(files) == 1 else None
        if file is None or is_recording(file):
            return self.plans(read_recordings(files, self))
        of_plans = ("num_actions", "action_names")
        if names := [name for name, value in DEFAULTS.items() if name not in of_plans and getattr(self, name) != value]:
            raise ValueError(f"`{names[0]}` must be left out for {file}, whose kind holds plans and no recordings")
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always", UserWarning)
            plans = _read_recorded(str(file), self.num_actions, self.action_names)
        notes = [str(one.message).removeprefix(f"{file}: ") for one in warned]
        return replace(plans, notes=(*plans.notes, *notes, *_feature_notes(plans)))

    def plans(self, recordings: Recordings) -> RecordedPlans:
        """Returns the plans of recordings, as `Recordings.plans` with these options."""
        plans = recordings.plans(
            max_gap=self.max_gap,
            compare=self.compare,
            reference=self.reference,
            strata=self.strata,
            num_actions=self.num_actions,
            action_names=self.action_names,
            unknown=self.unknown,
        )
        return replace(plans, notes=(*plans.notes, *_feature_notes(plans)))


DEFAULTS = vars(ReadOptions())


def is_recording(files: Files) -> bool:
    """Whether files are read as recordings: all but plans in `.npz`, `.jsonl` and Minari's datasets."""
    if not isinstance(files, str | Path):
        return len(files) != 1 or is_recording(files[0])
    return not str(files).startswith(MINARI) and Path(files).suffix.lower() not in (".npz", ".jsonl")


def name_files(files: Files) -> str:
    """Return the name of a file, or of the first of several and how many more there are."""
    if isinstance(files, str | Path):
        return Path(files).name
    return f"{Path(files[0]).name} and {len(files) - 1} more" if len(files) > 1 else Path(files[0]).name


def _read_recorded(file: str, num_actions: int | None, action_names: Sequence[str] | None) -> RecordedPlans:
    """The plans of a file that is no table; of a `.npz` file with what it holds of recordings."""
    if Path(file).suffix.lower() == ".npz" and not file.startswith(MINARI):
        return read_npz(Path(file), num_actions, check_names(num_actions, action_names), RecordedPlans)
    return RecordedPlans.of(read_plans(file, num_actions=num_actions, action_names=action_names))


def _feature_notes(plans: Plans) -> list[str]:
    """A note where features of plans may have been meant as one feature of each action, as many as these."""
    features, length = constant_context(plans), plans.max_length
    if features is None or not features.is_floating_point() or not 1 < features.shape[1] == length:
        return []
    return [
        f"context: {length} features of each plan, known from its first action on; if it is one feature of each of the"
        f" {length} actions, give [N, {length}, 1], lists of one number each"
    ]


@dataclass(frozen=True)
class FitOptions:
    """Which models are fitted to plans, and how.

    Attributes:
        models: which to fit: counts (uniform, Markov chains, context trees), gru, transformer, stacked (a GRU that
            weighs the forecasts of counts), combined (of what `effort` says, which is fitted for it). None: counts and
            combined, and of the networks those that promise to pay, with full effort all.
        inputs: of the models: past actions alone; the context as well, where the plans have one; of gru, transformer
            and combined, durations: how long the last action took, beside the actions. Each in turn; durations, with
            which these take as long again, are left out by default.
        modes: numbers of hidden modes that are tried, such as `[1, 2, 3]`; None: no section on modes, which takes about
            as long for each number as the counts.
        effort: which networks there are: fast (a GRU), standard (and a stacked prior) or full (and a transformer, and
            all are trained).
        folds: of the cross-validation over groups (over plans, where there are no two groups); None: 5, or fewer where
            there are fewer groups.
        max_steps: gradient steps of a neural prior; None: by the plans, see `neuroprior.training.Settings`.
        seed: draws the folds and everything in training.
        processes: how many models are fitted at a time; None: as many as there are cores.
        dask: address of a Dask scheduler whose workers fit the models; None: this machine.

    Raises:
        ValueError: an option is out of range.

    Example:
        >>> FitOptions(effort="fast").kinds
        ['counts', 'combined', 'gru']
    """

    models: Sequence[ModelName] | None = None
    inputs: Sequence[InputName] = INPUTS[:2]
    modes: Sequence[int] | None = None
    effort: Effort = "standard"
    folds: int | None = None
    max_steps: int | None = None
    seed: int = 0
    processes: int | None = None
    dask: str | None = None

    def __post_init__(self) -> None:
        check_effort(self.effort)
        check_choices("models", self.kinds, MODELS)
        check_choices("inputs", self.inputs, INPUTS)
        if self.effort != "standard" and "combined" not in self.kinds:
            raise ValueError(f"`effort` must be left out where `models` has no combined prior, got {self.effort}.")
        sizes = {"folds": self.folds, "max_steps": self.max_steps, "processes": self.processes}
        check_sizes(**{name: size for name, size in sizes.items() if size is not None})
        for number in self.modes or ():
            check_sizes(modes=number)
        if not 0 <= self.seed <= MAX_SEED:
            raise ValueError(f"`seed` must be from 0 to {MAX_SEED}, got {self.seed}.")

    @property
    def kinds(self) -> Sequence[ModelName]:
        """Returns the models to fit; the networks are those of the combined prior."""
        networks = [name for name in MODELS if name in OF_EFFORT[self.effort]]
        return ["counts", "combined", *networks] if self.models is None else self.models

    def changed(self) -> list[str]:
        """Returns the names of the options that have another value than by default, but for those of the machine."""
        named = (field for field in fields(self) if field.name not in ("seed", "processes", "dask"))
        return [field.name for field in named if getattr(self, field.name) != field.default]
