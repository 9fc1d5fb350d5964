"""The simulated study has the structure that it says."""

import numpy as np
import pandas as pd
import pytest

from neuroprior.behaviour import compare_conditions, large_study, read, simulated_study
from tests.support.sources import seeded


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


def test_sizes_of_studies() -> None:
    study = simulated_study(2, animals=9, treated=2, actions=50, unequal=10.0, sex_effect=0.5)
    animals = study.groupby("animal")
    assert (animals.treatment.first() == "drug").sum() == 2
    assert (animals.sex.first() == "female").sum() == 5
    assert (animals.sex.nunique() == 1).all()
    lengths = study.groupby(["animal", "session"]).size().unstack()
    assert (lengths[1] == lengths[2]).all()
    assert 5 <= lengths[1].min() < 12
    assert 30 < lengths[1].max() <= 50
    halves = simulated_study(3, animals=12, sex_effect=0.5).groupby("animal")[["sex", "treatment"]].first()
    assert halves.value_counts().tolist() == [3, 3, 3, 3]


def large_studies(number: int = 6):
    """Several large studies as one table, without the second observer."""
    tables = [large_study(seed) for seed in range(number)]
    whole = pd.concat([table.assign(animal=f"{n}-" + table.animal) for n, table in enumerate(tables)])
    return whole[whole.observer == "A"].replace({"behaviour": {"grom": "groom"}}).reset_index(drop=True)


def test_the_large_study_is_what_it_says() -> None:
    study = large_studies()
    assert study.groupby("animal").size().eq(400).all()
    designs = study.groupby("animal")[["sex", "treatment"]].first().value_counts()
    assert designs.tolist() == [36] * 4
    # Sniffing fades: after rearing or walking, its odds fall by e^1.8 from the first tenth of a session to the last.
    tenth = study.groupby("animal").cumcount() // 40
    after = study.behaviour.shift(1).isin(["rear", "walk"])
    share = (study.behaviour == "sniff")[after].groupby(tenth).mean()
    odds = share / (1 - share)
    assert np.log(odds[0] / odds[9]) == pytest.approx(1.8, abs=0.25)
    # Modes: what is done at once and twenty behaviours later goes together, which no chain of order 2 does so far.
    calm = study.behaviour.isin(["drink", "eat", "groom", "rest"]).astype(float)
    later = calm.groupby(study.animal).shift(-20)
    assert np.corrcoef(calm[later.notna()], later.dropna())[0, 1] > 0.05
    sexes = (study.behaviour == "rear").groupby([study.sex, study.animal]).mean().groupby("sex").mean()
    assert sexes["female"] > 1.15 * sexes["male"]
    for second, sign in (("walk", -1), ("groom", 1)):
        change = [followed(study.assign(session=1), "rear", second, drug) for drug in ("saline", "drug")]
        assert sign * (change[1] - change[0]) > 0.15
    lasted = np.log(study.stop - study.start).groupby([study.behaviour, study.treatment]).mean().unstack()
    assert np.exp(lasted.drug - lasted.saline)["rest"] == pytest.approx(2, rel=0.15)


def test_observers_and_slips_of_the_large_study() -> None:
    study = large_study(1)
    assert (study.behaviour == "grom").groupby(study.observer).sum().to_dict() == {"A": 5, "B": 0}
    assert study.groupby("observer").animal.nunique().to_dict() == {"A": 24, "B": 8}
    recordings = read(study, columns={"behaviour": "behaviour", "observer": "observer"}, rename={"grom": "groom"})
    assert recordings.agreement().kappa.between(0.5, 0.95).all()
    assert len(recordings.watched) - 24 > 60
    plans = recordings.plans(reference="saline")
    found = compare_conditions(plans, 999, seeded(0))
    assert found.design.kind == "between"
    assert found.p_value < 0.01
    names = plans.action_names
    durations = next(family for family in found.families if family.name == "durations")
    assert [names[int(k)] for k in durations.features[found.significant(durations)][:, 0]] == ["rest"]
    assert found.interaction.p_value > 0.01
    # No effect, no difference (a false alarm in one of a hundred seeds).
    null = read(large_study(1, effect=False), columns={"behaviour": "behaviour", "observer": "observer"})
    assert compare_conditions(null.plans(), 999, seeded(0)).p_value > 0.01
    pd.testing.assert_frame_equal(large_study(1), study)
