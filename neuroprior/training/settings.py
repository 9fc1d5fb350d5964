"""The settings of a training; what is not given follows from the plans."""

from dataclasses import dataclass, replace
from math import ceil

from neuroprior._checks import is_number
from neuroprior.plans.sequences import Sequences, check_validation

FEWEST_STEPS, MOST_STEPS = 10, 100
"""The least and the most steps between two validations, where these are not given."""

FEWEST, MOST, PASSES, SHORT = 1000, 4000, 50, 32
"""Steps of a training, where these are not given: so many passes through the plans, within these bounds; `FEWEST` for
plans of at most `SHORT` actions, from which more steps learn hardly more.
"""

PATIENCE = 0.3
"""Share of the steps without improvement after which training stops. More patience seldom finds better weights (with .4
a GRU takes .0006 nats less per move on the labyrinth's five folds, and a tenth more time); with .2 some short plans are
learned worse."""

ACTIONS_A_STEP, LEAST_BATCH, MOST_BATCH = 2048, 16, 64
"""Actions that a step learns from, about, where the size of batches is not given, and the bounds of that size."""


@dataclass(frozen=True)
class Settings:
    """How a prior is trained.

    Attributes:
        max_steps: gradient steps; the learning rate falls to 0 over them. None: `FEWEST` for short plans; else `PASSES`
            passes through the plans, but at least `FEWEST` and at most `MOST` steps.
        batch_size: plans (pieces of plans, where they are longer than a window) a step. None: as many as have about
            `ACTIONS_A_STEP` actions, from `LEAST_BATCH` to `MOST_BATCH`: smaller batches learn long sequences in less
            time.
        window: actions that one step reads of a plan. Longer plans are read window by window, in order, with the hidden
            state carried over (truncated backpropagation through time).
        learning_rate: of AdamW, after the first tenth of the steps.
        weight_decay: of AdamW.
        gradient_clip: the largest norm of a gradient.
        validation: share of plans (of groups, where there are any) held out for early stopping, where plans are unequal
            about of their actions; or other plans for it, and all plans are learned from.
        check_every: steps between two validations (on the held-out plans); None: two passes through the plans, but at
            least `FEWEST_STEPS` and at most `MOST_STEPS`, so that small data sets are not overfitted before the first.
        patience: steps without a lower validation loss after which training stops. None: `PATIENCE` of all steps.
        progress: show it: a bar in a terminal or a notebook, elsewhere a line now and then.

    Raises:
        ValueError: a value out of range.

    Example:
        >>> Settings(max_steps=500, patience=3).max_steps
        500
    """

    max_steps: int | None = None
    batch_size: int | None = None
    window: int = 128
    learning_rate: float = 5e-3
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    validation: float | Sequences = 0.1
    check_every: int | None = None
    patience: int | None = None
    progress: bool = True

    def __post_init__(self) -> None:
        names = ("max_steps", "batch_size", "window", "learning_rate", "gradient_clip", "check_every", "patience")
        optional = ("max_steps", "batch_size", "check_every", "patience")
        for name in (name for name in names if name not in optional or getattr(self, name) is not None):
            kind = float if name in ("learning_rate", "gradient_clip") else int
            value = getattr(self, name)
            if not isinstance(value, int | kind) or isinstance(value, bool) or not 0 < value < float("inf"):
                raise ValueError(
                    f"{name}: a positive {'number' if kind is float else 'integer'} is expected, not {value}"
                )
        if not is_number(self.weight_decay) or not 0 <= self.weight_decay < float("inf"):
            raise ValueError(f"weight_decay: a finite number of at least 0 is expected, not {self.weight_decay!r}")
        if not isinstance(self.validation, Sequences):
            check_validation(self.validation)

    def batches_of(self, longest: int) -> int:
        """The size of batches of plans of which the longest has so many actions."""
        fits = ACTIONS_A_STEP // max(min(longest, self.window), 1)
        return self.batch_size or min(max(fits, LEAST_BATCH), MOST_BATCH)

    def for_passes(self, steps_a_pass: int, longest: int) -> "Settings":
        """The settings with their number of steps and patience.

        Args:
            steps_a_pass: steps that take all plans once.
            longest: actions of the longest plan.
        """
        passes = PASSES if longest > SHORT else 0
        steps = self.max_steps or min(max(passes * steps_a_pass, FEWEST), MOST)
        return replace(self, max_steps=steps, patience=self.patience or ceil(PATIENCE * steps))

    def epochs(self, steps_a_pass: int) -> tuple[int, int]:
        """The number of validations, if training is not stopped early, and the steps before each.

        Args:
            steps_a_pass: steps that take all plans once.
        """
        wanted = self.check_every or min(max(2 * steps_a_pass, FEWEST_STEPS), MOST_STEPS)
        validations = ceil((self.max_steps or FEWEST) / wanted)
        return validations, ceil((self.max_steps or FEWEST) / validations)
