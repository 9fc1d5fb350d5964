"""The settings of a training; what is not given follows from the plans."""

from dataclasses import dataclass, replace
from math import ceil, inf

from neuroprior._checks import is_number, is_whole
from neuroprior.plans.sequences import Sequences, check_validation

MIN_CHECK, MAX_CHECK = 10, 100
"""The least and the most steps between two validations, where these are not given."""

MIN_STEPS, MAX_STEPS, PASSES, SHORT_PLAN = 1000, 4000, 50, 32
"""Steps of a training, where these are not given: so many passes through the plans, within these bounds; `MIN_STEPS`
for plans of at most `SHORT_PLAN` actions, from which more steps learn hardly more.
"""

PATIENCE = 0.3
"""Share of the steps without improvement after which training stops. More patience seldom finds better weights (with .4
a GRU takes .0006 nats less per move on the labyrinth's five folds, and a tenth more time); with .2 some short plans are
learned worse."""

ACTIONS_PER_STEP, MIN_BATCH, MAX_BATCH = 2048, 16, 64
"""Actions that a step learns from, about, where the size of batches is not given, and the bounds of that size."""


@dataclass(frozen=True)
class Settings:
    """How a prior is trained.

    Attributes:
        max_steps: gradient steps; the learning rate falls to 0 over them. None: 1,000 for plans of up to 32 actions,
            else for 50 passes through the plans, but 1,000 to 4,000.
        batch_size: plans (pieces of plans, where they are longer than a window) a step. None: as many as have about
            2,048 actions, from 16 to 64: smaller batches learn long sequences in less time.
        window: actions that one step reads of a plan. Longer plans are read window by window, in order, with the hidden
            state carried over (truncated backpropagation through time).
        learning_rate: of AdamW, after the first tenth of the steps.
        weight_decay: of AdamW.
        gradient_clip: the largest norm of a gradient.
        validation: share of plans (of groups, where there are any) held out for early stopping, where plans are unequal
            about of their actions; or other plans for it, and all plans are learned from.
        check_every: steps between two validations (on the held-out plans). None: two passes through the plans, but at
            least 10 and at most 100, so that small data sets are not overfitted before the first.
        patience: steps without a lower validation loss after which training stops. None: .3 of all steps.
        seconds: after which training stops, at the next validation. None: no limit. The combined prior trains networks
            one after the other while there is time, which differs from machine to machine, as does what is learned.
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
    seconds: float | None = None
    progress: bool = True

    def __post_init__(self) -> None:
        for name in ("max_steps", "batch_size", "window", "check_every", "patience"):
            value = getattr(self, name)
            if value is None and name != "window":
                continue
            if not is_whole(value) or value < 1:
                raise ValueError(f"`{name}` must be a whole number of at least 1, got {value}.")
            object.__setattr__(self, name, int(value))
        for name in ("learning_rate", "gradient_clip"):
            value = getattr(self, name)
            if not is_number(value) or not 0 < value < inf:
                raise ValueError(f"`{name}` must be above 0 and finite, got {value}.")
        if self.seconds is not None and (not is_number(self.seconds) or not 0 <= self.seconds < inf):
            raise ValueError(f"`seconds` must be at least 0 and finite, got {self.seconds}.")
        if not is_number(self.weight_decay) or not 0 <= self.weight_decay < inf:
            raise ValueError(f"`weight_decay` must be at least 0 and finite, got {self.weight_decay}.")
        if not isinstance(self.validation, Sequences):
            check_validation(self.validation)

    def batches_of(self, longest: int) -> int:
        """Return the size of batches of plans of which the longest has so many actions."""
        fits = ACTIONS_PER_STEP // max(min(longest, self.window), 1)
        return self.batch_size or min(max(fits, MIN_BATCH), MAX_BATCH)

    def for_passes(self, steps_per_pass: int, longest: int) -> "Settings":
        """Return the settings with their number of steps and patience.

        Args:
            steps_per_pass: steps that take all plans once.
            longest: actions of the longest plan.
        """
        passes = PASSES if longest > SHORT_PLAN else 0
        steps = self.max_steps or min(max(passes * steps_per_pass, MIN_STEPS), MAX_STEPS)
        return replace(self, max_steps=steps, patience=self.patience or ceil(PATIENCE * steps))

    def epochs(self, steps_per_pass: int) -> tuple[int, int]:
        """Return the number of validations, if training is not stopped early, and the steps before each.

        Args:
            steps_per_pass: steps that take all plans once.
        """
        steps = self.max_steps or MIN_STEPS
        validations = ceil(steps / (self.check_every or min(max(2 * steps_per_pass, MIN_CHECK), MAX_CHECK)))
        return validations, ceil(steps / validations)
