"""Individuality: how much of what can be predicted of behaviour is the individual's own."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log, log2

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from neuroprior._statistics import Difference, ratio_difference
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, group_names
from neuroprior.behaviour.recordings import Recordings
from neuroprior.plans.folds import FOLDS, folds
from neuroprior.priors.adaptive import AdaptivePrior
from neuroprior.priors.counts import MarkovPrior

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Individuality:
    """What following each of S subjects saves, in bits per behaviour, over a chain of order 1 of all others.

    Attributes:
        names: S of them.
        action_names: A of them.
        bouts: int64 `[S, A]`: how often each subject did each behaviour.
        bits: `[S, A]`: what the chain of the others takes for these, in all.
        saved: `[S, A]`: how much less it is, in all, if the chain is drawn to what the subject did before.
        total: bits saved per behaviour, with the 95 % interval over subjects and the p-value of 0.
        concentrations: of the shares of behaviours and of the transitions, in all subjects: after so many bouts a
            subject's own count as much as those of the others. Infinite: nothing is saved by following them.
    """

    names: Sequence[str]
    action_names: Sequence[str]
    bouts: NDArray[np.int64]
    bits: Array
    saved: Array
    total: Difference
    concentrations: tuple[float, ...]

    def __repr__(self) -> str:
        """Return how much is saved in all."""
        return f"Individuality({len(self.names)} subjects, {self.total.mean:+.4f} bits per behaviour)"

    @property
    def share(self) -> float:
        """The share of all that is predicted, compared with behaviours that are equally likely, that is saved."""
        predicted = self.bouts.sum() * log2(len(self.action_names)) - self.bits.sum() + self.saved.sum()
        return float(self.saved.sum() / predicted) if predicted > 0 else 0.0

    def frame(self) -> pd.DataFrame:
        """Return a row a subject: `individual, bouts, bits` (per behaviour, of the others' chain) and `saved`."""
        return self._rows("individual", self.names, 1)

    def behaviours(self) -> pd.DataFrame:
        """Return a row a behaviour: `behaviour, bouts, bits` and `saved`, for each time that it was done."""
        return self._rows("behaviour", self.action_names, 0)

    def _rows(self, kind: str, names: Sequence[str], axis: int) -> pd.DataFrame:
        bouts = self.bouts.sum(axis)
        bits, saved = (values.sum(axis) / bouts.clip(min=1) for values in (self.bits, self.saved))
        return pd.DataFrame({kind: list(names), "bouts": bouts, "bits": bits, "saved": saved})


def individuality(source: RecordedPlans | Recordings) -> Individuality:
    """Return how much better each subject is predicted if predictions follow what it did before.

    Each subject is predicted by a chain of order 1 of the others (five folds), and by the same chain in an
    `AdaptivePrior`, whose counts go on from plan to plan of the subject.

    Args:
        source: recordings, or plans with groups, the subjects.

    Raises:
        ValueError: fewer than three subjects.

    Example:
        >>> actions = torch.tensor([[0, 1] * 20, [0, 1] * 20, [0, 0, 1, 1] * 10, [0, 1] * 20])
        >>> frame = individuality(RecordedPlans(actions, 2, group=torch.arange(4))).frame()
        >>> frame.individual[frame.saved.argmax()]
        'group 2'
    """
    plans = (source.plans() if isinstance(source, Recordings) else source).without_context()
    plans = plans[plans.mask().any(1)]
    subjects = 0 if plans.group is None else len(plans.group.unique())
    if plans.group is None or subjects < 3:
        raise ValueError(f"`source` must have at least 3 subjects, got {subjects}")
    size, log_probs = plans.num_actions, torch.zeros(2, *plans.actions.shape)
    for rest, held_out in folds(plans, min(FOLDS, subjects)):
        prior = AdaptivePrior(MarkovPrior(size, 1)).fit(plans[rest])
        log_probs[0, held_out] = prior.base.action_log_probs(plans[held_out])
        log_probs[1, held_out] = prior.individual_log_probs(plans[held_out])
    present, row = plans.group.unique(return_inverse=True)
    mask = plans.mask()
    cell = (row[:, None] * size + plans.actions.long())[mask]
    bouts = cell.bincount(minlength=subjects * size).view(subjects, size)
    alone, adapted = (
        (cell.bincount((-values[mask] / log(2)).double(), minlength=subjects * size)).view(subjects, size).numpy()
        for values in log_probs
    )
    total = ratio_difference((alone - adapted).sum(1), bouts.sum(1).double().numpy())
    whole = AdaptivePrior(MarkovPrior(size, 1)).fit(plans)
    names = group_names(plans, present), action_names(plans)
    return Individuality(*names, bouts.numpy(), alone, alone - adapted, total, whole.concentrations)
