"""Numbers that stand for rows."""

import pytest
import torch

from neuroprior._hashing import row_hashes
from tests.support.sources import seeded


@pytest.mark.parametrize("states", [torch.int64, torch.uint8, torch.float32, torch.float64])
def test_states_have_different_hashes(states):
    state = torch.randint(3, (500, 2, 6), generator=seeded(0)).to(states)
    if states != torch.uint8:
        state -= 1
    code = row_hashes(state)
    _, number = state.flatten(1).unique(dim=0, return_inverse=True)
    assert torch.equal(code[:, None] == code, number[:, None] == number)
    row = torch.arange(-2, 5)
    assert torch.equal(row_hashes(row), row)


def test_numbers_and_their_complements_have_different_hashes():
    """All rows of three whole numbers from -4 to 4, of which x and -x - 1 have the same bits, inverted."""
    rows = torch.cartesian_prod(*[torch.arange(-4, 5)] * 3)
    for some in (rows, rows.double(), rows[:, None].expand(-1, 2, -1)):
        assert len(row_hashes(some).unique()) == 9**3
    assert len(row_hashes(torch.arange(-4, 5)[:, None]).unique()) == 9


def test_zero_has_no_sign():
    rows = torch.tensor([[0.0, 1.0], [-0.0, 1.0]])
    for some in (rows, rows.double(), rows[:, 0]):
        assert len(row_hashes(some).unique()) == 1


def test_fractions_count():
    """All pairs of eighths from 0 to 1, of either precision."""
    rows = torch.cartesian_prod(*[torch.arange(8) / 8] * 2)
    for some in (rows, rows.double()):
        assert len(row_hashes(some).unique()) == 64
    assert len(row_hashes(torch.arange(8) / 8).unique()) == 8


def test_the_last_bits_count():
    for rows in (torch.tensor([[1.0], [1 + 2.0**-52]], dtype=torch.double), torch.tensor([[2**60], [2**60 + 1]])):
        for some in (rows, torch.cat([rows, rows * 0], 1)):
            assert len(row_hashes(some).unique()) == 2


def test_no_rows():
    for shape in ((0,), (0, 3), (0, 2, 3)):
        assert row_hashes(torch.zeros(shape)).shape == (0,)
