"""How many threads torch takes, and work that is shared among threads as a whole, not step by step."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

Part = TypeVar("Part")


@contextmanager
def one_thread(wanted: bool = True) -> Iterator[None]:
    """torch on one thread where that is `wanted`, and on as many as before when the block ends."""
    threads = torch.get_num_threads()
    if not wanted or threads == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def share(work: Callable[[Part], None], parts: Sequence[Part]) -> None:
    """Call `work` with each of the parts, as many at a time as torch has threads, each on one thread of torch.

    Threads that share every single operation wait for one another after each, and on a busy machine for whatever else
    it does; these wait once, at the end. Operations of torch and compiled loops release Python's lock.
    """
    threads, learning = torch.get_num_threads(), torch.is_grad_enabled()

    def alone(piece: Part) -> None:
        torch.set_num_threads(1)  # of this thread, like the next
        with torch.set_grad_enabled(learning):
            work(piece)

    if min(threads, len(parts)) <= 1:
        for piece in parts:
            work(piece)
        return
    try:
        with ThreadPoolExecutor(min(threads, len(parts))) as pool:
            list(pool.map(alone, parts))
    finally:
        torch.set_num_threads(threads)
