"""The library alone on an accelerator, in `python -m eval bench`: absolute times, as no peer runs beside it."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from eval.bench.jobs import JOBS, ON_DEVICES
from eval.bench.packages import Run
from eval.bench.timing import seconds_again


def measured(device: torch.device, scale: float, repetitions: int) -> Iterator[dict[str, Any]]:
    """A row for each job that can be done there: seconds, and bytes of the device at the peak."""
    cuda = device.type == "cuda"
    for name in ON_DEVICES:
        job = JOBS[name](scale)
        run = job.make(device)
        if cuda:
            torch.cuda.reset_peak_memory_stats(device)
        yield {
            "job": name,
            "about": job.about,
            "device": torch.cuda.get_device_name(device) if cuda else device.type,
            "seconds": seconds_again(partial(_finished, run, device), repetitions),
            "peak_bytes": torch.cuda.max_memory_allocated(device) if cuda else None,
        }


def _finished(run: Run, device: torch.device) -> None:
    """Work is done when the device is: it has only taken orders when `run` comes back."""
    run()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
