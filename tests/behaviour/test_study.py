"""The simulated study has the structure that it says."""

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import read, simulated_study


def followed(study, first, second, treatment):
    """The share of `first` that `second` follows, in sessions under this treatment."""
    own = study[study.treatment == treatment]
    after = own.groupby(["animal", "session"]).behaviour.shift(-1)
    there = (own.behaviour == first) & after.notna()
    return float((after[there] == second).mean())


def many(**options):
    """Ten studies without differences between animals, as one table."""
    tables = [simulated_study(seed, animal_effect=0.0, **options) for seed in range(10)]
    return pd.concat([table.assign(animal=f"{n}-" + table.animal) for n, table in enumerate(tables)])


def test_the_treatment_changes_what_it_says() -> None:
    study = many()
    labels = study.behaviour.dropna()
    # Some 5,000 pairs under each treatment: a standard error of .01 at most, and 4.5 of them are a false alarm in
    # 150,000.
    for second, control, change in (("walk", 7 / 20, -0.25), ("groom", 3 / 20, 0.25), ("sniff", 6 / 20, 0)):
        assert followed(study, "rear", second, "saline") == pytest.approx(control, abs=0.045)
        assert followed(study, "rear", second, "drug") == pytest.approx(control + change, abs=0.045)
    assert followed(study, "walk", "sniff", "drug") == pytest.approx(7 / 21, abs=0.045)
    lasted = np.log(study.stop - study.start).groupby([study.behaviour, study.treatment]).mean().unstack()
    change = np.exp(lasted.drug - lasted.saline)
    assert change["rest"] == pytest.approx(2, rel=0.15)
    assert change.drop("rest").to_numpy() == pytest.approx(1, rel=0.15)
    assert 0.005 < 1 - len(labels) / len(study) < 0.015


def test_grooming_follows_the_ritual() -> None:
    study = many(effect=False)
    own = study.groupby(["animal", "session"]).behaviour
    there = (own.shift(2) == "eat") & (own.shift(1) == "drink") & study.behaviour.notna()
    assert (study.behaviour[there] == "groom").mean() == pytest.approx(18 / 30, abs=0.06)
    assert followed(study, "drink", "groom", "drug") == pytest.approx(
        followed(study, "drink", "groom", "saline"), abs=0.06
    )


@pytest.mark.parametrize("within", [False, True])
def test_designs(within) -> None:
    study = simulated_study(3, within=within)
    conditions = study.groupby("animal").treatment.nunique()
    assert set(conditions) == {2 if within else 1}
    sessions = study.groupby(["animal", "session"]).treatment
    assert (sessions.nunique() == 1).all()
    assert (sessions.first() == "drug").sum() == 12
    plans = read(study).plans()
    assert plans.durations is not None
    assert len(plans.group.unique()) == 12


def test_sessions_that_are_alike() -> None:
    study = simulated_study(0, effect=False, alike=True)
    first, second = (study[study.session == number].reset_index() for number in (1, 2))
    same = first.behaviour == second.behaviour
    assert same[first.behaviour.notna() & second.behaviour.notna()].all()


def test_the_same_seed_gives_the_same_study() -> None:
    pd.testing.assert_frame_equal(simulated_study(5), simulated_study(5))
    assert not simulated_study(5).equals(simulated_study(6))
