"""Options of a report on plans: how their file is read, and which models are fitted to them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

from neuroprior._checks import check_sizes
from neuroprior.plans import Plans, read_plans
from neuroprior.plans.columns import Columns, Missing
from neuroprior.priors.ensembles.candidates import Effort, check_effort

ModelName = Literal["counts", "gru", "transformer", "stacked", "combined"]
InputName = Literal["actions", "context", "durations"]

MODELS: tuple[ModelName, ...] = ("counts", "gru", "transformer", "stacked", "combined")
QUICK: tuple[ModelName, ...] = ("counts", "gru", "combined")
INPUTS: tuple[InputName, ...] = ("actions", "context", "durations")

MAX_SEED = 2**50 - 1
"""Above it the seeds of single fits, a thousand times as large, would not be integers of 64 bits."""


@dataclass(frozen=True)
class ReadOptions:
    """How a file of plans is read.

    Attributes:
        columns: which columns of a CSV file hold what: action, plan, context, group, condition, start, stop, duration,
            event_type.
        missing: what rows without a label do: a gap ends the plan; as label they count as an action; or error.
        merge_repeats: take the same label in successive rows for one action, as in files with a row a frame.
        max_gap: a longer pause between two actions ends the plan, too; in the unit of the starts.
        num_actions: number of actions, where a file does not say.
        action_names: names of the actions in the order of their numbers, where a file does not say.

    Example:
        >>> ReadOptions(columns={"action": "behaviour", "plan": "session"}, max_gap=10).missing
        'gap'
    """

    columns: Columns | Mapping[str, Any] | None = None
    missing: Missing = "gap"
    merge_repeats: bool = False
    max_gap: float | None = None
    num_actions: int | None = None
    action_names: Sequence[str] | None = None

    def read(self, file: str) -> Plans:
        """Reads the plans of a file; see `neuroprior.read_plans`."""
        return read_plans(file, **vars(self))


@dataclass(frozen=True)
class FitOptions:
    """Which models are fitted to plans, and how.

    Attributes:
        models: which to fit: counts (uniform, Markov chains, context trees), gru, transformer, stacked (a GRU that
            weighs the forecasts of counts), combined (of what `effort` says, which is fitted for it). None: all; with
            effort fast counts, gru and combined.
        inputs: of the models: past actions alone; the context as well, where the plans have one; of gru, transformer
            and combined, durations: how long the last action took, beside the actions. Each in turn; durations, with
            which these take as long again, are left out by default.
        modes: numbers of hidden modes that are tried, such as `[1, 2, 3]`; None: no section on modes, which takes about
            as long for each number as the counts.
        effort: how much the combined prior spends on networks: fast (a GRU), standard (and a stacked prior) or full
            (and a transformer and a switching network).
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
        ('counts', 'gru', 'combined')
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
        """Returns the models to fit."""
        if self.models is not None:
            return self.models
        return QUICK if self.effort == "fast" else MODELS

    def changed(self) -> list[str]:
        """Returns the names of the options that have another value than by default, but for those of the machine."""
        named = (field for field in fields(self) if field.name not in ("seed", "processes", "dask"))
        return [field.name for field in named if getattr(self, field.name) != field.default]


def check_choices(name: str, given: Sequence[str], known: Sequence[str]) -> None:
    """Raises ValueError unless all are known, and there is one at least."""
    if isinstance(given, str) or not given or set(given) - set(known):
        raise ValueError(f"`{name}` must be a list of some of {', '.join(known)}, got {given!r}.")
