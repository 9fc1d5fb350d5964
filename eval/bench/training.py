"""Training a GRU to within 1 % of the entropy rate, by the library and by a plain loop, in `python -m eval bench`."""

from collections.abc import Callable
from functools import partial
from itertools import product
from time import perf_counter

import torch
from torch import Tensor, nn

from eval.bench.packages import Run
from eval.bench.peers import PlainGRU, plain_training
from neuroprior import GRUPrior, MarkovPrior, Prior

CLOSE = 1.01
"""Held-out bits per action, as a multiple of the source's own."""

STEPS = (25, 50, 100, 200, 400, 800)
"""Numbers of gradient steps that are tried, until one is enough."""

SETTINGS = tuple(product((64, 256, 1024), (1e-3, 3e-3, 1e-2)))
"""Batch sizes and learning rates that both may choose from."""


class TrainingRace:
    """A GRU of 64 units learns from the plans of a known source, in as many steps as it needs.

    Both sides may choose their batch size and learning rate, and take the smallest number of steps that is enough: what
    is timed is that training alone, without the search for its settings.

    Args:
        source: what the plans are drawn from.
        plans: `[N, L]`.
    """

    def __init__(self, source: MarkovPrior, plans: Tensor) -> None:
        self.source, self.plans = source, plans
        self.held_out = source.sample(10_000, plans.shape[1], generator=torch.Generator().manual_seed(2))
        self.least = float(-source.log_prob(self.held_out).mean())

    def ours(self) -> Run:
        """The library's training."""

        def train(batch_size: int, learning_rate: float, steps: int) -> Prior:
            how = {"batch_size": batch_size, "learning_rate": learning_rate, "max_steps": steps}
            prior, generator = GRUPrior(self.source.num_actions, lags=1), torch.Generator().manual_seed(0)
            return prior.fit(self.plans, generator=generator, progress=False, **how)

        return self._quickest(train)

    def theirs(self) -> Run:
        """The plain loop."""

        def train(batch_size: int, learning_rate: float, steps: int) -> PlainGRU:
            return plain_training(self.plans, self.source.num_actions, steps, batch_size, learning_rate)

        return self._quickest(train)

    @torch.no_grad()
    def excess(self, model: nn.Module) -> float:
        """Nats a plan on held-out plans, divided by the source's own."""
        logits = model(self.held_out)
        nats = nn.functional.cross_entropy(logits.flatten(0, 1), self.held_out.flatten().long())
        return float(nats) * self.plans.shape[1] / self.least

    def _quickest(self, train: Callable[[int, float, int], nn.Module]) -> Run:
        """The training that is within 1 % in the least time.

        Raises:
            ValueError: none is.
        """
        train(*SETTINGS[0], STEPS[0])  # what is first is slow
        enough: dict[tuple[int, float, int], float] = {}
        for batch_size, learning_rate in SETTINGS:
            for steps in STEPS:
                begin = perf_counter()
                model = train(batch_size, learning_rate, steps)
                seconds = perf_counter() - begin
                if self.excess(model) <= CLOSE:
                    enough[batch_size, learning_rate, steps] = seconds
                if enough and seconds >= min(enough.values()):
                    break
        if not enough:
            raise ValueError(f"train: no training of {STEPS[-1]} steps came within {CLOSE - 1:.0%} of the entropy rate")
        return partial(train, *min(enough, key=lambda how: enough[how]))
