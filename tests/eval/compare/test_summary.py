"""The findings of a comparison in one table, and the reasons that are given where networks are not better."""

import pytest

from eval.compare.report import compared
from eval.compare.summary import reasons_in_words, reasons_section, summary_table
from tests.support.compare_cells import BUDGETS, cell, entry

ASKED = (16, 256, 4096)


def told(chain: float, network: float, bits: tuple[float, float], early: float = 0.0, seeds: int = 6) -> dict:
    """The first reason for shares of a chain and a network with all numbers of plans, and their bits."""
    cells = []
    for seed in range(seeds):
        noise = 0.001 * (-1) ** seed
        shares = {"markov-1": [chain + noise] * 13, "gru": [network - noise] * 13}
        shares["gru"][BUDGETS.index(16)] += early
        entries = [entry(name, shares[name], bits=own) for name, own in zip(shares, bits, strict=True)]
        cells.append(cell("maze", seed, entries))
    found = compared(cells, ASKED)
    return {"reasons": found.reasons, "table": summary_table(found.words, ASKED)}


def test_both_columns_are_of_the_same_choice():
    """Which of two chains is better changes from half to half: the one that was chosen is not the better one there."""
    cells = []
    for seed in range(6):
        odd = seed % 2
        chains = {"markov-1": 0.7 - 0.1 * odd, "markov-2": 0.6 + 0.1 * odd}
        shares = chains | {"gru": 0.64 + 0.001 * (seed // 2)}
        cells.append(cell("maze", seed, [entry(name, [share] * 13, bits=1.0) for name, share in shares.items()]))
    table = summary_table(compared(cells, ASKED).words, ASKED)
    markov, neural, gap = table.rows[0][2:]
    assert (markov, neural) == ("60.0", "64.1")
    assert gap.startswith("+4.1")


def test_one_number_of_plans_is_not_fewer_than_itself():
    cells = []
    for seed in range(6):
        shares = {"markov-1": 0.7, "gru": 0.7 + (0.02 if seed else -0.01)}
        entries = [entry(name, [share] * 13, bits=2 - share) for name, share in shares.items()]
        cells += [cell(world, seed, entries) for world in ("maze", "grid", "cube")]
    assert all("with 256 plans; with 256" not in one["words"] for one in compared(cells, (256,)).reasons)


def test_a_better_network_needs_no_reason():
    found = told(0.6, 0.7, (1.5, 1.4))
    assert found["reasons"] == []
    assert reasons_section([]) is None
    assert found["table"].rows[0][:4] == ["maze", "nothing", "60.0", "70.0"]
    assert found["table"].rows[0][4].startswith("+10.0 ±")
    assert found["table"].rows[0][4].endswith("*")


@pytest.mark.parametrize(
    ("shares", "bits", "early", "says"),
    [
        ((0.99, 0.9), (1.2, 1.5), 0.0, "networks tell held-out plans no better than chains do (1.50 bits an action"),
        ((0.99, 0.99), (1.5, 1.2), 0.0, "little is left to find: with 256 plans the best chain reaches 99.0 %"),
        ((0.7, 0.7), (1.5, 1.5), 0.0, "networks tell held-out plans no better than chains do (1.50 bits an action"),
        ((0.7, 0.7), (1.5, 1.2), 0.1, "(1.20 bits an action against 1.50), and are ahead by 10.0 points with 16 plans"),
        ((0.7, 0.6), (1.5, 1.2), 0.0, "the best of 256 is no better for it"),
    ],
)
def test_reasons(shares, bits, early, says):
    found = told(*shares, bits, early)
    (row,) = found["reasons"]
    assert says in row["words"]
    assert row["markov_share"] == pytest.approx(shares[0], abs=0.002)
    assert (row["markov_bits"], row["neural_bits"]) == pytest.approx(bits)
    assert says in reasons_section(found["reasons"]).text[1]
    assert says in next(reasons_in_words(found["reasons"]))
