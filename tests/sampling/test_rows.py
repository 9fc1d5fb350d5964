"""Tests of rows: those taken are those asked for."""

import pytest
import torch

from neuroprior.plans import Plans
from neuroprior.sampling import select_rows
from neuroprior.sampling.rows import rows_of
from tests.support.sources import refuses


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


def test_gradients_pass():
    values = torch.rand(4, 2, requires_grad=True)
    rows_of(values, torch.tensor([1, 1, 3])).sum().backward()
    assert values.grad is not None
    assert values.grad[:, 0].tolist() == [0, 2, 0, 1]


@pytest.mark.parametrize("kind", [torch.int8, torch.uint8, torch.int16, torch.int32, torch.int64, torch.uint16])
def test_rows_by_integers_of_every_kind(kind):
    """Integers of 8 bits are no masks, as torch takes them."""
    values = torch.arange(12).view(4, 3)
    row = torch.tensor([3, 0, 1, 1]).to(kind)
    plans = Plans(values, 12, group=torch.tensor([7, 5, 9, 8]))
    for rows in (row, torch.stack([row, row], 1)[:, 0]):
        assert select_rows((values, (values[:, 1],)), rows)[1][0].tolist() == [10, 1, 4, 4]
        assert plans[rows].group.tolist() == [8, 7, 5, 5]
    for wrong in [4, *([-5] if kind.is_signed else [])]:
        given = torch.tensor([0, wrong]).to(kind)
        with refuses(f"`plans` must be indexed by integers from 0 to 3, got {wrong}", error=IndexError):
            plans[given]
        with refuses("out of range", error=IndexError):
            select_rows(values, given)


def test_what_is_no_index_is_refused():
    plans = Plans(torch.arange(12).view(4, 3), 12)
    assert plans[[2, 0]].actions[:, 0].tolist() == [6, 0]
    assert plans[torch.tensor([-1])].actions[:, 0].tolist() == [9]
    assert plans[torch.tensor([True, False, False, True])].actions[:, 0].tolist() == [0, 9]
    assert len(plans[[]]) == 0
    for wrong in (torch.tensor([1.0]), torch.tensor([True, False]), torch.tensor([[0, 1]])):
        with refuses("`plans` must be indexed by a slice, integers [M] or bool [4], got", error=IndexError):
            plans[wrong]
    with refuses("`row` must be integers [M] or a slice, got torch.bool [4]"):
        select_rows(plans.actions, torch.ones(4).bool())
