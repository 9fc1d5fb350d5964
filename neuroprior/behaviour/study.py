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
LARGE_ANIMALS, LARGE_ACTIONS = 24, 400
UNLABELLED, PAUSES = 0.01, 0.005
"""Shares of rows without a label, and of rows after which the animal is out of view for a minute."""

FADING = ("sniff", 2.0)
"""In the large study: the logarithm of the odds of this behaviour falls by so much from start to end of a session."""

CALM, CALM_WEIGHT, STAY = ("drink", "eat", "groom", "rest"), 3.0, 0.97
"""The large study's modes: in the calm one the odds of these behaviours are so many times as high, in the active one
those of the others; and the probability that a mode goes on after a behaviour."""

FEMALES = ("rear", 1.5)
"""In the large study: in females the odds of this behaviour are so many times as high."""

TYPO = ("groom", "grom", 5)
"""In the large study: so many events of the first have the name of the second."""

SCORED_TWICE, CONFUSED, MAX_DELAY = 8, 0.05, 0.5
"""Animals that the second observer scored, too; the share of labels that differ; how much later, in s, at most."""


def simulated_study(
    seed: int,
    *,
    effect: bool = True,
    within: bool = False,
    animal_effect: float = 0.2,
    alike: bool = False,
    animals: int = ANIMALS,
    treated: int | None = None,
    actions: int = ACTIONS,
    unequal: float = 1.0,
    sex_effect: float = 0.0,
) -> Any:
    """The table of a study: 12 animals, 2 sessions each, 8 behaviours, start and stop of each, gaps, a treatment.

    What is done next depends on the last behaviour, and after "eat, drink" on both. Animals differ in all transitions
    and durations. The treatment changes two transitions (`MOVED`) and one duration (`LONGER`).

    Args:
        seed: draws the study.
        effect: whether the treatment does anything.
        within: each animal is under both conditions, in an order drawn at random; else half of them are treated.
        animal_effect: standard deviation, over animals, of the logits of all transitions and of the logarithms of all
            median durations; it has nothing to do with the treatment.
        alike: the second session of an animal repeats the first, apart from the treatment's effect.
        animals: how many.
        treated: how many of them, if not within animals; None: half of them, half of the females and of the males.
        actions: behaviours in a session.
        unequal: sessions of some animals have up to so many times as many behaviours as those of others.
        sex_effect: standard deviation of the logits of transitions between the sexes; above 0, there is a column `sex`.

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
    logits = logits + animal_effect * random.standard_normal((animals, 1, 8, 8))
    medians = np.array(SECONDS) * np.exp(animal_effect * random.standard_normal((animals, 1, 8)))
    female = np.arange(animals) % 2 == 0
    if within:
        drug = (random.random((animals, 1)) < 0.5) == np.arange(SESSIONS)
    else:
        order = random.permutation(animals)
        if sex_effect > 0 and treated is None:
            order = _rank_by_sex(order, female)
        drug = np.repeat(order < (animals // 2 if treated is None else treated), SESSIONS).reshape(animals, SESSIONS)
    if sex_effect > 0:
        logits = logits + sex_effect * random.standard_normal((8, 8)) * female[:, None, None, None]
    probs = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    probs, medians = (np.broadcast_to(one, (animals, SESSIONS, *one.shape[2:])).copy() for one in (probs, medians))
    if effect:
        _treat(probs, medians, drug)
    shape = (animals, 1 if alike else SESSIONS, actions)
    drawn, normal = random.random(shape), random.standard_normal(shape)
    behaviours = _chain(probs, np.broadcast_to(drawn, (animals, SESSIONS, actions)))
    seconds = np.take_along_axis(medians, behaviours, -1) * np.exp(SPREAD * normal)
    table = _table(random, behaviours, seconds, drug)
    if sex_effect > 0:
        table["sex"] = np.where(female, "female", "male").repeat(SESSIONS * actions)
    if unequal > 1:
        lengths = np.ceil(actions * unequal ** -random.random((animals, 1, 1)))
        kept = np.broadcast_to(np.arange(actions) < lengths, behaviours.shape)
        table = table[kept.ravel()].reset_index(drop=True)
    return table


def large_study(seed: int, *, effect: bool = True) -> Any:
    """The table of a larger study: 24 mice, two sexes, a treatment, two observers, gaps, two modes, drift, and a typo.

    Each mouse has one session of 400 behaviours. Half of the mice of each sex are treated. The truth:

    - What is done next depends on the last behaviour, and after "eat, drink" on both (`RITUAL`).
    - The treatment changes two transitions (`MOVED`) and one duration (`LONGER`), in both sexes alike.
    - Females rear more often (`FEMALES`).
    - Two hidden modes, which last some 33 behaviours: calm, and active (`CALM`).
    - Sniffing fades: from start to end of a session its odds fall by e^2 (`FADING`).
    - Mice are out of view for a minute now and then, and one row in a hundred has no label.
    - A second observer scored eight of the mice, too: one label in twenty differs, and times by half a second at most.
    - In five events of the first observer "groom" is spelled "grom" (`TYPO`).

    Args:
        seed: draws the study.
        effect: whether the treatment does anything.

    Returns:
        A pandas frame as of `simulated_study`, with a column `sex`.

    Example:
        >>> large_study(seed=0)["sex"].unique().tolist()
        ['female', 'male']
    """
    random = np.random.default_rng(seed)
    shape = (LARGE_ANIMALS, 1, LARGE_ACTIONS)
    female = np.arange(LARGE_ANIMALS) % 2 == 0
    drug = (_rank_by_sex(random.permutation(LARGE_ANIMALS), female) < LARGE_ANIMALS // 2)[:, None]
    logits = np.log(np.array([NEXT[name] for name in BEHAVIOURS]) + 1e-9)
    logits = logits + 0.2 * random.standard_normal((LARGE_ANIMALS, 1, 8, 8))
    logits[female, ..., BEHAVIOURS.index(FEMALES[0])] += np.log(FEMALES[1])
    probs = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    medians = np.array(SECONDS) * np.exp(0.2 * random.standard_normal((LARGE_ANIMALS, 1, 8)))
    if effect:
        _treat(probs, medians, drug)
    weights = np.where(_modes(random, shape)[..., None] == np.isin(BEHAVIOURS, CALM), CALM_WEIGHT, 1.0)
    weights[..., BEHAVIOURS.index(FADING[0])] *= np.exp(-FADING[1] * np.linspace(0, 1, LARGE_ACTIONS))
    behaviours = _chain(probs, random.random(shape), weights)
    seconds = np.take_along_axis(medians, behaviours, -1) * np.exp(SPREAD * random.standard_normal(shape))
    table = _table(random, behaviours, seconds, drug).assign(observer="A")
    table.insert(1, "sex", np.where(female, "female", "male").repeat(LARGE_ACTIONS))
    return _observe_twice(random, table)


def _rank_by_sex(order: NDArray[Any], female: NDArray[Any]) -> NDArray[Any]:
    """Numbers from 0, in this order of the animals, that rise through both sexes in turn."""
    ranks = np.empty_like(order)
    for first, of_sex in enumerate((female, ~female)):
        ranks[of_sex] = 2 * order[of_sex].argsort().argsort() + first
    return ranks


def _treat(probs: NDArray[Any], medians: NDArray[Any], drug: NDArray[Any]) -> None:
    """Change the transitions and medians of the sessions under the drug, in place."""
    before, loser, winner = (BEHAVIOURS.index(name) for name in MOVED[:3])
    moved = np.where(drug, np.minimum(MOVED[3], probs[..., before, loser]), 0)
    probs[..., before, loser] -= moved
    probs[..., before, winner] += moved
    medians[..., BEHAVIOURS.index(LONGER[0])] *= np.where(drug, LONGER[1], 1)


def _modes(random: np.random.Generator, shape: tuple[int, ...]) -> NDArray[Any]:
    """Whether the mode is the calm one, bool of this shape."""
    switches = random.random(shape) > STAY
    switches[..., 0] = random.random(shape[:-1]) < 0.5
    calm: NDArray[Any] = switches.cumsum(-1) % 2 == 1
    return calm


def _observe_twice(random: np.random.Generator, table: Any) -> Any:
    """The table with a typo, and below it the rows of some animals as a second observer scored them."""
    import pandas as pd

    again = table[table["animal"].isin(table["animal"].unique()[:SCORED_TWICE])].assign(observer="B")
    confused = (random.random(len(again)) < CONFUSED) & again["behaviour"].notna().to_numpy()
    again.loc[confused, "behaviour"] = random.choice(BEHAVIOURS, confused.sum())
    late = MAX_DELAY * random.random(again["animal"].nunique())[again["animal"].factorize()[0]]
    again = again.assign(start=(again["start"] + late).round(2), stop=(again["stop"] + late).round(2))
    right, wrong, number = TYPO
    rows = random.choice(np.flatnonzero(table["behaviour"] == right), number, replace=False)
    table.loc[rows, "behaviour"] = wrong
    return pd.concat([table, again], ignore_index=True)


def _chain(probs: NDArray[Any], drawn: NDArray[Any], weights: NDArray[Any] | None = None) -> NDArray[Any]:
    """Actions `[..., L]` of chains with the ritual.

    Args:
        probs: transition probabilities `[..., A, A]`.
        drawn: uniform numbers `[..., L]`.
        weights: `[..., L, A]`, of each action at each step; None: 1.
    """
    first, second, third = (BEHAVIOURS.index(name) for name in RITUAL)
    more = np.where(np.arange(len(BEHAVIOURS)) == third, RITUAL_WEIGHT, 1.0)
    before, at = np.zeros((2, *probs.shape[:-2]), int)
    actions = []
    for t in range(drawn.shape[-1]):
        rows = np.take_along_axis(probs, at[..., None, None], -2)[..., 0, :]
        rows = rows * np.where(((before == first) & (at == second))[..., None], more, 1.0)
        rows = rows if weights is None else rows * weights[..., t, :]
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
