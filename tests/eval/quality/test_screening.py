"""The experiment on screening, run end to end on one small source; what its first sentence counts."""

import pandas as pd
import pytest

from eval.__main__ import main
from eval.quality import screening
from tests.support.sources import seeded


@pytest.mark.slow
def test_a_small_run(tmp_path, monkeypatch):
    one = screening.sources(seeded(0))[:1]
    monkeypatch.setattr(screening, "sources", lambda generator: one)
    for name in ("STUDIES", "LABYRINTH"):
        monkeypatch.setattr(screening, name, {})
    assert main(["screening", "--sizes", "120", "--num-sequences", "0", "--out", str(tmp_path)]) == 0
    frame = pd.read_csv(tmp_path / "screening.csv")
    assert frame["network"].tolist() == ["GRUPrior", "StackedPrior"]
    assert set(frame["actions"]) == {120 * 32}
    assert (frame["trained"] == (frame["promised"] >= frame["needed"]).cummin()).all()
    assert frame["gain"].abs().max() < 0.02
    assert (tmp_path / "report.html").exists()


def test_networks_that_are_missed_or_trained_in_vain_are_counted():
    """Missed: not trained, and more than .005 nats on other plans; in vain: trained, for nothing."""
    rows = [("a", True, 0.02, 3.0), ("b", True, -0.001, 5.0), ("c", False, 0.006, 7.0), ("d", False, 0.004, 11.0)]
    frame = pd.DataFrame(rows, columns=["network", "trained", "gain", "training_seconds"])
    frame = frame.assign(data="x", actions=1, promised=0.0, needed=0.0, screening_seconds=1.0)
    lead = screening._document(frame, {}).lead
    assert lead.startswith("1 of 4 networks would have brought more than 0.005 nats")
    assert "5 of 26 seconds of training went to networks that brought nothing" in lead
    assert lead.endswith("12 seconds were needed in all.")
