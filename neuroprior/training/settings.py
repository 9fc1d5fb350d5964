"""The settings of a training, with defaults that suit small priors on a CPU."""

from dataclasses import dataclass
from math import ceil

from neuroprior.plans import Plans

FEWEST_STEPS, MOST_STEPS = 10, 100
"""The least and the most steps between two validations, where these are not given."""


@dataclass(frozen=True)
class Settings:
    """How a prior is trained.

    Attributes:
        max_steps: gradient steps; the learning rate falls to 0 over them.
        batch_size: plans (pieces of plans, where they are longer than a window) a step.
        window: actions that one step reads of a plan. Longer plans are read window by window, in order, with the hidden
            state carried over (truncated backpropagation through time).
        learning_rate: of AdamW, after the first tenth of the steps.
        weight_decay: of AdamW.
        gradient_clip: the largest norm of a gradient.
        validation: share of plans (of groups, where there are any) held out for early stopping; or other `Plans` for
            it, and all plans are learned from.
        check_every: steps between two validations (on the held-out plans); None: two passes through the plans, but at
            least `FEWEST_STEPS` and at most `MOST_STEPS`, so that small data sets are not overfitted before the first.
        patience: steps without a lower validation loss after which training stops.
        progress: show a progress bar.

    Raises:
        ValueError: a value out of range.
    """

    max_steps: int = 1000
    batch_size: int = 64
    window: int = 128
    learning_rate: float = 5e-3
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    validation: float | Plans = 0.1
    check_every: int | None = None
    patience: int = 400
    progress: bool = True

    def __post_init__(self) -> None:
        names = ["max_steps", "batch_size", "window", "learning_rate", "gradient_clip", "patience"]
        for name in names + ["check_every"] * (self.check_every is not None):
            kind = float if name in ("learning_rate", "gradient_clip") else int
            value = getattr(self, name)
            if not isinstance(value, int | kind) or isinstance(value, bool) or not 0 < value < float("inf"):
                raise ValueError(
                    f"{name}: a positive {'number' if kind is float else 'integer'} is expected, not {value}"
                )
        if self.weight_decay < 0:
            raise ValueError(f"weight_decay: must not be negative, not {self.weight_decay}")

    def epochs(self, steps_a_pass: int) -> tuple[int, int]:
        """The number of validations, if training is not stopped early, and the steps before each.

        Args:
            steps_a_pass: steps that take all plans once.
        """
        wanted = self.check_every or min(max(2 * steps_a_pass, FEWEST_STEPS), MOST_STEPS)
        validations = ceil(self.max_steps / wanted)
        return validations, ceil(self.max_steps / validations)
