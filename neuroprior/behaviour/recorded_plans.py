"""Plans that are parts of recordings of behaviour: with times, conditions and the names of the recordings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neuroprior.plans.plans import Plans, as_integers, as_numbers, check_numbered, check_shape, check_texts


@dataclass(frozen=True, eq=False, repr=False)
class RecordedPlans(Plans):
    """N sequences of up to L actions that are parts of recordings, such as those between gaps.

    Attributes:
        actions, num_actions, lengths, action_names, context, group, context_names, group_names, end: see `Plans`.
        recording: N names of the recordings that the plans are parts of, or None. Recordings of different groups may
            have the same name.
        began: when each action began, in the time of the recording, floating point `[N, L]`, stored as float64: NaN
            where it is not known; None for plans without times. The unit is the user's, as of durations.
        durations: how long each action took, floating point `[N, L]`, stored as float32: at least 0, NaN where it is
            not known; None for plans without times. An end symbol takes no time.
        condition: integers `[N]`: what plans are compared by, such as the treatment of the subject; None for none.
        condition_names: names of the conditions, numbered from 0, or None.
        notes: what the reader of a file has to say of them, a line each.

    Raises:
        ValueError: a shape, dtype or value is wrong; the message says which and where.

    Example:
        >>> plans = RecordedPlans(torch.tensor([[0, 1], [1, 0]]), 2, durations=torch.tensor([[1.5, 0.5], [2.0, 1.0]]))
        >>> plans[1:].durations.tolist()
        [[2.0, 1.0]]
    """

    PER_PLAN: ClassVar[tuple[str, ...]] = (*Plans.PER_PLAN, "recording", "condition")
    PER_ACTION: ClassVar[tuple[str, ...]] = (*Plans.PER_ACTION, "began", "durations")

    recording: Sequence[str] | None = None
    began: Tensor | None = None
    durations: Tensor | None = None
    condition: Tensor | None = None
    condition_names: Sequence[str] | None = None
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        num = len(self)
        if check_texts("recording", self.recording):
            if len(self.recording or ()) != num:
                raise ValueError(f"`recording` must be {num} names, one a plan, got {len(self.recording or ())}")
            object.__setattr__(self, "recording", tuple(self.recording or ()))
        taken, acted = self.mask(), self.mask(end=False)
        if self.began is not None:
            began = self._times("began", self.began, torch.float64, -torch.inf)
            object.__setattr__(self, "began", began.masked_fill(~acted, torch.nan).masked_fill(~taken, 0))
        if self.durations is not None:
            durations = self._times("durations", self.durations, torch.float32, 0)
            object.__setattr__(self, "durations", durations.masked_fill(~acted, 0))
        if self.condition is not None:
            object.__setattr__(self, "condition", as_integers("condition", self.condition, num))
        check_numbered("condition", self.condition, self.condition_names)
        if check_texts("notes", self.notes):
            object.__setattr__(self, "notes", tuple(self.notes))

    def _times(self, name: str, values: Tensor, dtype: torch.dtype, lowest: float) -> Tensor:
        """Numbers `[N, L]`, where there are actions finite and at least `lowest`, or NaN."""
        times = as_numbers(name, values).to(dtype)
        check_shape(name, times, tuple(self.actions.shape))
        wrong = ((times < lowest) | times.isinf()) & self.mask(end=False)
        if wrong.any():
            where = wrong.nonzero()[0].tolist()
            bound = " from 0" if lowest == 0 else ""
            raise ValueError(f"`{name}{where}` must be finite times{bound}, got {float(times[tuple(where)])}")
        return times

    @classmethod
    def of(cls, plans: Plans) -> "RecordedPlans":
        """The same plans as `RecordedPlans`: without times and conditions, if they are not of this class already.

        Example:
            >>> RecordedPlans.of(Plans(torch.tensor([[0, 1]]), 2)).durations is None
            True
        """
        return plans if isinstance(plans, cls) else cls(**vars(plans))


def durations_of(plans: Plans) -> Tensor:
    """The durations `[N, L]` of plans; ValueError where they have none."""
    durations = plans.durations if isinstance(plans, RecordedPlans) else None
    if durations is None:
        raise ValueError(
            "durations: these plans have none; give RecordedPlans(durations=), or a file with start and stop times"
        )
    return durations
