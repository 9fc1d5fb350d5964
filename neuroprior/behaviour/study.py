"""Simulated studies of behaviour: the table that a laboratory has, with known truth.

Needs pandas (`pip install 'neuroprior[report]'`).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

BEHAVIOURS = ("drink", "eat", "freeze", "groom", "rear", "rest", "sniff", "walk")

NEXT = {  # how often each behaviour follows each, in the order of BEHAVIOURS
    "drink": (0, 3, 0, 3, 1, 2, 2, 4),
    "eat": (4, 0, 1, 4, 1, 3, 2, 2),
    "freeze": (0, 0, 0, 1, 2, 2, 4, 2),
    "groom": (1, 2, 1, 0, 2, 5, 3, 3),
    "rear": (1, 1, 1, 3, 0, 1, 6, 7),
    "rest": (2, 3, 1, 5, 1, 0, 3, 3),
    "sniff": (1, 2, 1, 2, 5, 1, 0, 6),
    "walk": (2, 2, 1, 1, 6, 2, 7, 0),
}
SECONDS = (3.0, 6.0, 2.0, 5.0, 1.5, 20.0, 1.0, 2.5)
"""Median durations of the behaviours, in their order."""

SPREAD = 0.6
"""Standard deviation of the logarithm of durations."""

RITUAL, RITUAL_WEIGHT = ("eat", "drink", "groom"), 6.0
"""After the first two behaviours the third is so many times as frequent, in odds, as after the second alone."""

MOVED = ("rear", "walk", "groom", 0.25)
"""The treatment: after the first behaviour so much of the probability of the second goes to the third."""

LONGER = ("rest", 2.0)
"""The treatment: the median of this behaviour's durations is so many times as long."""

ANIMALS, SESSIONS, ACTIONS = 12, 2, 300
UNLABELLED, PAUSES = 0.01, 0.005
"""Shares of rows without a label, and of rows after which the animal is out of view for a minute."""


def simulated_study(
    seed: int, *, effect: bool = True, within: bool = False, animal_effect: float = 0.2, alike: bool = False
) -> Any:
    """The table of a study: 12 animals, 2 sessions each, 8 behaviours, start and stop of each, gaps, a treatment.

    What is done next depends on the last behaviour, and after "eat, drink" on both. Animals differ in all transitions
    and durations. The treatment changes two transitions (`MOVED`) and one duration (`LONGER`).

    Args:
        seed: draws the study.
        effect: whether the treatment does anything.
        within: each animal is under both conditions, in an order drawn at random; else six animals are treated.
        animal_effect: standard deviation, over animals, of the logits of all transitions and of the logarithms of all
            median durations; it has nothing to do with the treatment.
        alike: the second session of an animal repeats the first, apart from the treatment's effect.

    Returns:
        A pandas frame with a row for each event, with the columns `animal`, `session`, `behaviour` (missing where no
        label was given: one row in a hundred), `start` and `stop` (seconds), `treatment` ("drug" or "saline") and
        `observer`.

    Example:
        >>> simulated_study(seed=0)["animal"].nunique()
        12
    """
    random = np.random.default_rng(seed)
    logits = np.log(np.array([NEXT[name] for name in BEHAVIOURS]) + 1e-9)
    logits = logits + animal_effect * random.standard_normal((ANIMALS, 1, 8, 8))
    medians = np.array(SECONDS) * np.exp(animal_effect * random.standard_normal((ANIMALS, 1, 8)))
    probs = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    if within:
        treated = (random.random((ANIMALS, 1)) < 0.5) == np.arange(SESSIONS)
    else:
        treated = np.repeat(random.permutation(ANIMALS) < ANIMALS // 2, SESSIONS).reshape(ANIMALS, SESSIONS)
    probs, medians = (np.broadcast_to(one, (ANIMALS, SESSIONS, *one.shape[2:])).copy() for one in (probs, medians))
    if effect:
        before, loser, winner = (BEHAVIOURS.index(name) for name in MOVED[:3])
        moved = np.where(treated, np.minimum(MOVED[3], probs[..., before, loser]), 0)
        probs[..., before, loser] -= moved
        probs[..., before, winner] += moved
        medians[..., BEHAVIOURS.index(LONGER[0])] *= np.where(treated, LONGER[1], 1)
    shape = (ANIMALS, 1 if alike else SESSIONS, ACTIONS)
    drawn, normal = random.random(shape), random.standard_normal(shape)
    actions = _chain(probs, np.broadcast_to(drawn, (ANIMALS, SESSIONS, ACTIONS)))
    seconds = np.take_along_axis(medians, actions, -1) * np.exp(SPREAD * normal)
    return _table(random, actions, seconds, treated)


def _chain(probs: NDArray[Any], drawn: NDArray[Any]) -> NDArray[Any]:
    """Actions `[..., L]` of chains with transition probabilities `[..., A, A]`, with the ritual."""
    first, second, third = (BEHAVIOURS.index(name) for name in RITUAL)
    more = np.where(np.arange(len(BEHAVIOURS)) == third, RITUAL_WEIGHT, 1.0)
    before, at = np.zeros((2, *probs.shape[:-2]), int)
    actions = []
    for t in range(drawn.shape[-1]):
        rows = np.take_along_axis(probs, at[..., None, None], -2)[..., 0, :]
        rows = rows * np.where(((before == first) & (at == second))[..., None], more, 1.0)
        rows = rows.cumsum(-1)
        before, at = at, (rows < drawn[..., t, None] * rows[..., -1:]).sum(-1)
        actions.append(at)
    return np.stack(actions, -1)


def _table(random: np.random.Generator, actions: NDArray[Any], seconds: NDArray[Any], treated: NDArray[Any]) -> Any:
    import pandas as pd

    pause = np.where(random.random(actions.shape) < PAUSES, 60.0, 0.0)
    stop = (seconds + pause).cumsum(-1) - pause
    animal, session, _ = np.indices(actions.shape)
    labels = np.array(BEHAVIOURS, dtype=object)[actions]
    labels[random.random(actions.shape) < UNLABELLED] = None
    columns = {
        "animal": [f"m{number + 1:02d}" for number in animal.ravel()],
        "session": session.ravel() + 1,
        "behaviour": labels.ravel(),
        "start": (stop - seconds).round(2).ravel(),
        "stop": stop.round(2).ravel(),
        "treatment": np.where(treated[..., None], "drug", "saline").repeat(actions.shape[-1], -1).ravel(),
        "observer": np.where(animal % 2, "AB", "CD").ravel(),
    }
    return pd.DataFrame(columns)
