"""Tests of rows: those taken are those asked for."""

import pytest
import torch

from neuroprior.sampling.rows import rows_of


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize("width", [(), (0,), (1,), (2,), (3,), (8,), (2, 4)], ids=str)
def test_rows_are_those_asked_for(dtype, width):
    values = torch.arange(7 * torch.Size(width).numel()).view(7, *width).to(dtype)
    for row in (torch.tensor([6, 0, 0, 3]), torch.tensor([2], dtype=torch.int32), torch.tensor([], dtype=torch.long)):
        taken = rows_of(values, row)
        assert taken.dtype == dtype
        assert taken.shape == (len(row), *width)
        assert taken.equal(values[row.long()])


def test_rows_of_parts_of_a_tensor():
    values = torch.arange(80, dtype=torch.uint8).view(10, 8)
    row = torch.tensor([4, 0, 4])
    for part in (values[1:], values[:, 2:4], values[:, ::2], values.T):
        assert rows_of(part, row).equal(part[row])


def test_many_rows():
    values = torch.rand(100, 3, dtype=torch.float64)
    row = torch.randint(100, (300_000,), generator=torch.Generator().manual_seed(0))
    assert rows_of(values, row).equal(values[row])


def test_gradients_pass():
    values = torch.rand(4, 2, requires_grad=True)
    rows_of(values, torch.tensor([1, 1, 3])).sum().backward()
    assert values.grad is not None
    assert values.grad[:, 0].tolist() == [0, 2, 0, 1]
