"""The settings of a training, with defaults that suit small priors on a CPU."""

from dataclasses import dataclass
from math import ceil


@dataclass(frozen=True)
class Settings:
    """How a prior is trained.

    Attributes:
        max_steps: gradient steps; the learning rate falls to 0 over them.
        batch_size: plans (pieces of plans, where they are longer than a window) a step.
        window: actions that one step reads of a plan. Longer plans are read window by window, in order, with the
            prior's memory carried over.
        learning_rate: of AdamW, after the first tenth of the steps.
        weight_decay: of AdamW.
        gradient_clip: the largest norm of a gradient.
        validation: share of plans (of groups, where there are any) held out for early stopping.
        check_every: steps between two looks at the held-out plans.
        patience: looks without improvement after which training stops.
        progress: show a progress bar.

    Raises:
        ValueError: a value out of range.
    """

    max_steps: int = 1000
    batch_size: int = 128
    window: int = 128
    learning_rate: float = 5e-3
    weight_decay: float = 0.01
    gradient_clip: float = 1.0
    validation: float = 0.1
    check_every: int = 100
    patience: int = 4
    progress: bool = True

    def __post_init__(self) -> None:
        for name in ("max_steps", "batch_size", "window", "learning_rate", "gradient_clip", "check_every", "patience"):
            kind = float if name in ("learning_rate", "gradient_clip") else int
            value = getattr(self, name)
            if not isinstance(value, int | kind) or isinstance(value, bool) or not 0 < value < float("inf"):
                raise ValueError(
                    f"{name}: a positive {'number' if kind is float else 'integer'} is expected, not {value}"
                )
        if self.weight_decay < 0:
            raise ValueError(f"weight_decay: must not be negative, not {self.weight_decay}")

    @property
    def epochs(self) -> int:
        """Looks at the held-out plans, if training is not stopped early; an epoch is what lies between two."""
        return ceil(self.max_steps / self.check_every)

    @property
    def steps_per_epoch(self) -> int:
        """Steps in each epoch: `check_every`, or a little fewer where that does not divide `max_steps`."""
        return ceil(self.max_steps / self.epochs)
