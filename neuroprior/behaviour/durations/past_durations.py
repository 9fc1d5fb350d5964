"""How long the last actions took, as a context of the next action."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch

from neuroprior._checks import check_sizes
from neuroprior._files import read_json, write_json
from neuroprior.behaviour.recorded_plans import durations_of
from neuroprior.plans.plans import AnyPlans, Plans

FILE = "past_durations.json"
"""In the folder of a prior that was trained with these features."""

QUARTILES = 1.349
"""Standard deviations between the quartiles of a normal distribution."""

MOST = 4.0
"""Standardised logarithms are between -MOST, which a duration of 0 has, too, and MOST."""


@dataclass(frozen=True)
class PastDurations:
    """The durations of the last actions as features, so that a neural prior can predict the next action from them.

    Before each action, for each of the last `number` actions, the last one first: the standardised logarithm of its
    duration, and 1 where that is unknown or there was no such action (the logarithm is then 0), else 0. The duration of
    the action that is to be predicted, and all later ones, are not among them.

    Attributes:
        number: k, how many of the last actions.
        center, spread: median and standard deviation of the logarithms of the durations above 0 in the plans that a
            prior learns from; `of` computes them.

    Raises:
        ValueError: a value is out of range.

    Example:
        >>> PastDurations(number=2, center=0.5, spread=1.0).number
        2
    """

    number: int
    center: float
    spread: float

    def __post_init__(self) -> None:
        check_sizes(number=self.number)
        if not -1e3 < self.center < 1e3 or not 0 < self.spread < 1e3:
            raise ValueError(
                "`center` must be between -1000 and 1000, and `spread` above 0 to 1000, those of logarithms of times,"
                f" got {self.center} and {self.spread}"
            )

    @classmethod
    def of(cls, plans: Plans, number: int = 1) -> "PastDurations":
        """With the median, and the standard deviation by the quartiles, of the logarithms of the known durations.

        Args:
            plans: those that a prior is to learn from.
            number: k.

        Raises:
            ValueError: the plans have no durations, or none above 0 is known.
        """
        times = durations_of(plans)[plans.mask(end=False)]
        logs = times[times > 0].double().log().sort()[0]
        if not len(logs):
            raise ValueError("`durations` must have at least one above 0 that is known")
        # torch.quantile takes no more than 16 million numbers.
        low, middle, high = (float(logs[round(share * (len(logs) - 1))]) for share in (0.25, 0.5, 0.75))
        return cls(number, middle, (high - low) / QUARTILES or 1.0)

    @classmethod
    def load(cls, folder: Path) -> "PastDurations | None":
        """What `save` wrote beside a prior; None where nothing was.

        Raises:
            ValueError: the file is damaged.
        """
        place = folder / FILE
        if not place.is_file():
            return None
        try:
            return cls(**read_json(place))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{place}: damaged ({str(error).removeprefix(f'{place}: ')})") from error

    def save(self, folder: Path) -> None:
        """Write it to the folder of the prior that was trained with these features."""
        write_json(folder / FILE, asdict(self))

    def added_to(self, plans: AnyPlans) -> AnyPlans:
        """The plans with these features as their context, behind the features that they have already.

        For a prior with an end symbol, plans have it before the features are added.

        Args:
            plans: N plans with durations; without a context, or with features.

        Returns:
            Plans with the context `[N, L, C + 2k]`, float32.

        Raises:
            ValueError: the plans have no durations, or a context index.
        """
        context = plans.context
        if context is not None and not context.is_floating_point():
            raise ValueError(
                "context: an index cannot stand beside past durations, which are features; write it as numbers with a"
                " decimal point, one for each context, or leave it out"
            )
        times = durations_of(plans).masked_fill(~plans.mask(), torch.nan)
        logs = ((times.log() - self.center) / self.spread).clamp(-MOST, MOST)
        features = torch.stack([logs.nan_to_num(0.0), logs.isnan().float()], -1)
        nothing = features.new_tensor([0.0, 1.0]).expand(len(plans), self.number, 2)
        before = torch.cat([nothing, features], 1)
        parts = [
            before[:, self.number - lag : self.number - lag + plans.max_length] for lag in range(1, self.number + 1)
        ]
        if context is not None:
            parts.insert(0, context.float())
        return replace(plans, context=torch.cat(parts, -1), context_names=None)
