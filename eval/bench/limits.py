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
    """What is timed, with the least that it has to do."""

    about: str  # as in the tables
    run: Run
    moved: int  # bytes that have to be read or written in memory, once each; what fits a cache is not counted
    operations: int = 0  # multiplications and additions of matrices


def works(scale: float) -> Iterator[Work]:
    """Trying plans, and sampling by prefix tree and plan by plan; each is made when its turn comes."""
    job, plans = JOBS["evaluate"](scale), scaled(10_000, scale) * 256
    # Plans are read, rewards and final states written; the tables of a small world fit any cache.
    yield Work(job.about, job.make(torch.device("cpu")), plans * (8 * (ACTION + FLOAT) + INTEGER))
    number = scaled(2_560_000, scale)
    about = f"sample {number:,} plans of length 8 by prefix tree"
    chain = MarkovPrior(4, 2).fit(torch.randint(4, (1000, 16), generator=torch.Generator().manual_seed(0)))
    yield Work(f"{about}, Markov-2", partial(chain.sample, number, 8, method="tree"), number * 8 * ACTION)
    prior = TransformerPrior(4)
    products = sum(layer.weight.numel() for layer in prior.modules() if isinstance(layer, torch.nn.Linear))
    # One token for each prefix, at most.
    attention = 2 * prior.num_layers * prior.width
    operations = sum(2 * min(4**t, number) * (products + attention * (t + 1)) for t in range(8))
    run = partial(prior.sample, number, 8, method="tree")
    yield Work(f"{about}, transformer", run, number * 8 * ACTION, operations)
    gru, number, length = GRUPrior(4, lags=1), scaled(8192, scale), 64
    width, steps = gru.hidden_size, number * length
    # The hidden state of each plan is read and written at each step, and multiplied; an input is a row of a table.
    moved, operations = steps * (2 * width * FLOAT + ACTION), 2 * steps * width * (3 * width + gru.num_actions)
    about = f"sample {number:,} plans of length {length} plan by plan, GRU"
    yield Work(about, partial(gru.sample, number, length, method="ancestral"), moved, operations)


def measured(
    works: Iterable[Work], repetitions: int, timed: Callable[[Run, int], float] = median_seconds
) -> Iterator[dict[str, Any]]:
    """A row for the machine's copies, its matrix products, and each work: seconds and the share of the limit.

    The limit is the time that the bytes, or the operations, would take at the machine's measured rates, whichever is
    longer (the roofline: Williams, Waterman and Patterson 2009).
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
