"""Sizes that no machine could hold: one line that names the argument and the bytes, before anything is allocated."""

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, SamplingPlanner, TransformerPrior, UniformPrior, collect, gridworld
from neuroprior._checks import physical_memory
from neuroprior.control import VectorGRU
from neuroprior.priors import ContextTreePrior, StackedPrior, SwitchingPrior
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import cube
from tests.support.sources import refuses

PRIOR = UniformPrior(4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: PRIOR.sample(10**9, 10**6),
            ["num_plans and length: 1000000000 and 1000000 ", "1,000,262,1"],
        ),
        (lambda: PRIOR.sample(1, 10**15), ["num_plans and length", "5,000,000,000,000,000 bytes"]),
        (lambda: sample_in_world(PRIOR, gridworld(3, 3), torch.zeros(1, dtype=torch.long), 10**12, 9), ["num_plans"]),
        (lambda: SamplingPlanner(PRIOR, 10**7, 10**9), ["length and num_plans"]),
        (lambda: collect(SamplingPlanner(PRIOR, 2, 3), gridworld(3, 3), 10**13), ["num_plans: 10000000000000 "]),
        (lambda: GRUPrior(3, hidden_size=10**7), ["hidden_size", "2,400,000,000,000,000 bytes"]),
        (lambda: GRUPrior(3, lags=10**13), ["lags"]),
        (lambda: GRUPrior(3, num_contexts=10**13), ["num_contexts"]),
        (lambda: TransformerPrior(3, width=8 * 10**7), ["width"]),
        (lambda: MarkovPrior(10**14), ["num_actions"]),
        (lambda: gridworld(3, 3).reset(10**14), ["batch_size: 100000000000000"]),
        (lambda: cube().reset(10**14), ["batch_size"]),
        (lambda: gridworld(10**7, 10**7), ["height and width and num_worlds"]),
    ],
)
def test_what_no_machine_holds(make, words):
    with refuses(*words, "bytes of memory"):
        make()


@pytest.mark.parametrize(
    ("make", "name", "most"),
    [
        (lambda number: GRUPrior(3, num_layers=number), "num_layers", 1000),
        (lambda number: StackedPrior(3, num_layers=number), "num_layers", 1000),
        (lambda number: TransformerPrior(3, num_layers=number), "num_layers", 1000),
        (lambda number: VectorGRU([-1.0], [1.0], num_layers=number), "num_layers", 1000),
        (lambda number: MarkovPrior(3, number), "order", 10_000),
        (lambda number: SwitchingPrior(3, order=number), "order", 10_000),
        (lambda number: ContextTreePrior(3, number), "depth", 10_000),
    ],
)
def test_what_takes_too_long(make, name, most):
    with refuses(f"`{name}` must be at most {most}, got {most + 1}"):
        make(most + 1)


def test_starts_are_counted():
    for number in (-1, 2.0, True, None):
        with refuses("batch_size", "at least 0"):
            gridworld(3, 3).reset(number)
    assert gridworld(3, 3).reset(0).shape == (0,)


def test_the_memory_of_this_machine():
    there = physical_memory()
    assert there is None or 2**28 < there < 2**60
