"""How near work comes to what the machine can do, in `python -m eval bench`: bytes moved and operations done."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from eval.bench.jobs import JOBS, scaled
from eval.bench.timing import Run, median_seconds
from neuroprior import GRUPrior, MarkovPrior, TransformerPrior

COPIED, SIDE = 2**28, 2048
"""Bytes of a copy, and the side of the matrices, by which the machine is measured."""

FLOAT, INTEGER, ACTION = 4, 8, 1
"""Bytes of a reward, of a state and of an action in a plan."""


@dataclass(frozen=True)
class Work:
    """What is timed, with the least that it has to do.

    Attributes:
        about: as in the tables.
        run: does it.
        moved: bytes that have to be read from memory or written there, once each; what fits a cache is not counted.
        operations: multiplications and additions of matrices.
    """

    about: str
    run: Run
    moved: int
    operations: int = 0


def works(scale: float) -> Iterator[Work]:
    """Trying plans, and sampling by prefix tree and plan by plan; each is made when its turn comes."""
    yield _evaluate(scale)
    yield _tree_markov(scaled(2_560_000, scale))
    yield _tree_transformer(scaled(2_560_000, scale))
    yield _plan_by_plan(scaled(8192, scale))


def measured(
    works: Iterable[Work], repetitions: int, timed: Callable[[Run, int], float] = median_seconds
) -> Iterator[dict[str, Any]]:
    """A row for the machine's copies, its matrix products, and each work: seconds and the share of the limit.

    The limit is the time that the bytes, or the operations, would take at the machine's measured rates, whichever is
    longer (the roofline: Williams, Waterman and Patterson 2009).

    Args:
        works: what is measured.
        repetitions: how often each is timed.
        timed: how long work takes.
    """
    copied, factor = torch.zeros(COPIED // FLOAT), torch.randn(SIDE, SIDE)
    target, product = torch.empty_like(copied), torch.empty_like(factor)
    copy = Work("copy", lambda: target.copy_(copied), 2 * copied.nbytes)
    multiply = Work("product", lambda: torch.mm(factor, factor, out=product), 0, 2 * SIDE**3)
    taken = {work.about: timed(work.run, repetitions) for work in (copy, multiply)}
    for work in (copy, multiply, *works):
        seconds = taken.get(work.about) or timed(work.run, repetitions)
        least = {
            "memory": work.moved / (copy.moved / taken["copy"]),
            "arithmetic": work.operations / (multiply.operations / taken["product"]),
        }
        bound = max(least, key=lambda what: least[what])
        row = {"work": work.about, "seconds": seconds, "moved": work.moved, "operations": work.operations}
        yield row | {"share": least[bound] / seconds, "bound": bound}


def _evaluate(scale: float) -> Work:
    """Plans are read, rewards and final states written; the tables of a small world fit any cache."""
    job, plans = JOBS["evaluate"](scale), scaled(10_000, scale) * 256
    return Work(job.about, job.make(torch.device("cpu")), plans * (8 * (ACTION + FLOAT) + INTEGER))


def _tree_markov(number: int) -> Work:
    """Plans are written."""
    prior = MarkovPrior(4, 2).fit(torch.randint(4, (1000, 16), generator=torch.Generator().manual_seed(0)))
    about = f"sample {number:,} plans of length 8 by prefix tree, Markov-2"
    return Work(about, partial(prior.sample, number, 8, method="tree"), number * 8 * ACTION)


def _tree_transformer(number: int) -> Work:
    """One token for each prefix, at most; plans are written."""
    prior = TransformerPrior(4)
    products = sum(layer.weight.numel() for layer in prior.modules() if isinstance(layer, torch.nn.Linear))
    operations = 0
    for before in range(8):
        attention = 2 * prior.num_layers * prior.width * (before + 1)
        operations += 2 * min(4**before, number) * (products + attention)
    about = f"sample {number:,} plans of length 8 by prefix tree, transformer"
    return Work(about, partial(prior.sample, number, 8, method="tree"), number * 8 * ACTION, operations)


def _plan_by_plan(number: int) -> Work:
    """The hidden state of each plan is read and written at each step, and multiplied; an input is a row of a table."""
    prior, length = GRUPrior(4, lags=1), 64
    width = prior.hidden_size
    moved = number * length * (2 * width * FLOAT + ACTION)
    about = f"sample {number:,} plans of length {length} plan by plan, GRU"
    run = partial(prior.sample, number, length, method="ancestral")
    return Work(about, run, moved, 2 * number * length * width * (3 * width + prior.num_actions))
