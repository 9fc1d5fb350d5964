"""Numbers that stand for rows."""

import pytest
import torch

from neuroprior.codes import row_codes
from tests.sources import seeded


@pytest.mark.parametrize("states", [torch.int64, torch.uint8, torch.float32, torch.float64])
def test_states_are_told_apart(states):
    state = torch.randint(3, (500, 2, 6), generator=seeded(0)).to(states)
    code = row_codes(state)
    _, number = state.flatten(1).unique(dim=0, return_inverse=True)
    assert torch.equal(code[:, None] == code, number[:, None] == number)
    row = torch.arange(5)
    assert torch.equal(row_codes(row), row)
