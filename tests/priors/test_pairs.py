"""Every two values of two options together, of every prior that `fit` knows by name: a covering array."""

import itertools
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from neuroprior.behaviour import RecordedPlans
from neuroprior.plans import Plans
from neuroprior.priors import Prior, fit, load, save
from neuroprior.priors.fitting import PRIORS
from neuroprior.sampling import sample
from tests.support.sources import every_plan, seeded

A, C, N, L = 3, 4, 30, 5

TRAINED, QUICK = ("gru", "transformer", "stacked", "mixture", "combined"), {"max_steps": 2, "progress": False}

AXES: dict[str, tuple[str, ...]] = {
    "prior": tuple(PRIORS),
    "context": ("none", "plan", "step", "features"),
    "lengths": ("equal", "unequal", "one"),
    "type": ("uint8", "int16", "int32", "int64"),
    "layout": ("contiguous", "strided"),
    "group": ("none", "unequal", "one each"),
    "end": ("open", "closed"),
    "kept": ("in memory", "saved"),
    "drawn": ("tree", "ancestral"),
}


def covering_array(axes: dict[str, tuple[str, ...]], seed: int = 0) -> list[tuple[str, ...]]:
    """Rows that hold every two values of every two axes; each row is the best of some drawn at random."""
    places = list(itertools.combinations(range(len(axes)), 2))
    values = list(axes.values())
    missing = {(i, j, one, other) for i, j in places for one in values[i] for other in values[j]}
    draws, rows = seeded(seed), []

    def new_pairs(row: tuple[str, ...]) -> set[tuple[int, int, str, str]]:
        return missing & {(i, j, row[i], row[j]) for i, j in places}

    while missing:
        first = min(missing)
        rivals = []
        for _ in range(40):
            row = [axis[int(torch.randint(len(axis), (), generator=draws))] for axis in values]
            row[first[0]], row[first[1]] = first[2:]
            rivals.append(tuple(row))
        rows.append(max(rivals, key=lambda row: len(new_pairs(row))))
        missing -= new_pairs(rows[-1])
    return rows


CASES = covering_array(AXES)


def study(context: str, lengths: str, group: str, end: str) -> RecordedPlans:
    """Plans in which nothing is equal that these options leave open."""
    draws = seeded(1)
    actions = torch.multinomial(torch.tensor([0.2, 0.3, 0.5]), N * L, replacement=True, generator=draws).view(N, L)
    observed: Any = {
        "none": None,
        "plan": torch.randint(C, (N,), generator=draws),
        "step": torch.randint(C, (N, L), generator=draws),
        "features": torch.randn(N, L, 2, generator=draws),
    }[context]
    number = {"equal": None, "unequal": torch.arange(N) % (L + 1), "one": (torch.arange(N) == 7).long() * L}[lengths]
    groups = {"none": None, "unequal": torch.arange(N).div(7, rounding_mode="floor") ** 2, "one each": torch.arange(N)}
    plans = RecordedPlans(
        actions, A, number, context=observed, group=groups[group], durations=torch.rand(N, L, generator=draws) + 0.1
    )
    return plans.with_end() if end == "closed" else plans


def test_all_pairs_are_there():
    found = {(i, j, row[i], row[j]) for row in CASES for i, j in itertools.combinations(range(len(AXES)), 2)}
    sizes = [len(axis) for axis in AXES.values()]
    assert len(found) == sum(one * other for one, other in itertools.combinations(sizes, 2))


@pytest.mark.filterwarnings("ignore:.*ignores the context")
@pytest.mark.parametrize("case", CASES, ids=" ".join)
def test_pairs_of_options(case, tmp_path, monkeypatch):
    """The type, the layout and the file change nothing; probabilities sum to one; what is drawn can be scored."""
    monkeypatch.setattr("neuroprior.priors.ensembles.candidates.ORDERS", range(3))
    name, context, lengths, kind, layout, group, end, kept, drawn = case
    plans = study(context, lengths, group, end)
    learn = partial(fit, prior=name, **QUICK if name in TRAINED else {})
    stored = plans.actions.to(getattr(torch, kind))
    if layout == "strided":
        stored = torch.stack([stored, stored + 1], -1)[..., 0]
    plain, other = learn(plans, generator=seeded(2)), learn(replace(plans, actions=stored), generator=seeded(2))
    if kept == "saved":
        other = load(save(other, tmp_path))
    known = plans if plain.takes_context else plans.without_context()
    with torch.no_grad():
        expected = plain.log_prob(known)
        torch.testing.assert_close(other.log_prob(replace(known, actions=stored)), expected, rtol=1e-5, atol=1e-6)
    assert bool((expected <= 1e-6).all())
    observed = None if known.context is None else known.context[:1]
    assert total(other, observed) == pytest.approx(1, abs=1e-4)
    first, again = (sample(other, 6, 3, start(observed), method=drawn, generator=seeded(3)) for _ in range(2))
    assert torch.equal(first, again)
    assert int(first.max()) < plans.num_actions


def start(observed: torch.Tensor | None) -> torch.Tensor | None:
    return None if observed is None else observed[:, :3].expand(6, *observed[:, :3].shape[1:])


def total(prior: Prior, observed: torch.Tensor | None) -> float:
    """The probability of all plans of three actions."""
    plans = every_plan(prior.num_actions, 3)
    given = None if observed is None else observed[:, :3].expand(len(plans), *observed[:, :3].shape[1:])
    with torch.no_grad():
        return float(prior.log_prob(Plans(plans, prior.num_actions, context=given)).exp().sum())
