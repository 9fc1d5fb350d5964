"""`neuroprior score`: the scores of the library, by plan and by group, in files."""

import pandas as pd
import pytest
import torch

from neuroprior import MarkovPrior, Plans, save
from neuroprior.cli.__main__ import main
from neuroprior.plans import write_plans
from tests.support.sources import seeded


def test_ends_are_scored_but_are_no_actions(tmp_path):
    lengths = torch.randint(1, 7, (30,), generator=seeded(1))
    plans = Plans(torch.randint(3, (30, 6), generator=seeded(0)), 3, lengths, group=torch.arange(30) % 4)
    prior = MarkovPrior(4, 1).fit(plans.with_end())
    save(prior, tmp_path / "prior")
    write_plans(plans, tmp_path / "plans.npz")
    out = tmp_path / "out"
    assert main(["score", str(tmp_path / "prior"), str(tmp_path / "plans.npz"), "--out", str(out)]) == 0
    scores, groups = (pd.read_csv(out / f"{name}.csv") for name in ("plans", "groups"))
    due = prior.log_prob(plans.with_end())
    assert scores["actions"].tolist() == lengths.tolist()
    assert scores["log_likelihood"].tolist() == pytest.approx(due.tolist(), abs=1e-4)
    assert groups["actions"].tolist() == [int(lengths[k::4].sum()) for k in range(4)]
    assert groups["log_likelihood"].tolist() == pytest.approx([float(due[k::4].sum()) for k in range(4)], abs=1e-4)
