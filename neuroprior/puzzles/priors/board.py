"""A convolutional network on the board in each state, without the past actions."""

from collections.abc import Sequence
from math import inf, prod
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from neuroprior._checks import check_memory, check_sizes, is_number
from neuroprior._random import generator_on
from neuroprior.plans import Plans, is_per_step
from neuroprior.plans.folds import check_alike, fair_split, num_units
from neuroprior.priors.prior import Prior
from neuroprior.puzzles.priors.minibatches import train

VALIDATION = 0.1
"""The share of plans (or groups) that are held out to decide when training stops."""

CHUNK = 2**12
"""Boards that are evaluated together where no gradient is needed."""


class BoardNetwork(Prior):
    """A residual convolutional network from the board in each state to the logits.

    A 3x3 convolution to `channels`, then `depth` blocks x + conv(relu(conv(relu(x)))), then a linear layer of all.
    The context is features `[N, C]` with C = planes * height * width, plane after plane, each row by row. The
    state is the logits, float32 `[N, A]`, for steps without a new context.

    Args:
        num_actions: A.
        board: planes, height and width.
        channels: of the convolutions.
        depth: residual blocks.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> prior = BoardNetwork(4, board=(6, 6, 5), channels=8, depth=1)
        >>> prior.num_actions
        4
    """

    def __init__(self, num_actions: int, board: Sequence[int], channels: int = 32, depth: int = 4) -> None:
        if len(board) != 3:
            raise ValueError(f"board: planes, height and width are expected, not {board!r}")
        planes, height, width = board
        check_sizes(planes=planes, height=height, width=width, channels=channels, depth=depth)
        super().__init__(num_actions, context_size=prod(board))
        check_memory(4 * 18 * channels * channels * depth, channels=channels, depth=depth)
        check_memory(4 * num_actions * channels * height * width, channels=channels, board=list(board))
        self.board, self.channels, self.depth = tuple(board), channels, depth
        sizes = [planes] + [channels] * (2 * depth)
        self.kernels = nn.ParameterList([torch.zeros(channels, size, 3, 3) for size in sizes])
        self.biases = nn.ParameterList([torch.zeros(channels) for _ in sizes])
        self.out = nn.Parameter(torch.zeros(num_actions, channels * height * width))
        self.out_bias = nn.Parameter(torch.zeros(num_actions))

    @property
    def config(self) -> dict[str, Any]:
        sizes = {"board": list(self.board), "channels": self.channels, "depth": self.depth}
        return {"num_actions": self.num_actions} | sizes

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("validation", "epochs", "batch_size", "learning_rate")

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        if context is None:
            raise ValueError("context: this prior takes a context, and none was given")
        logits = self.board_logits(context)
        return logits, logits

    def step(self, action: Tensor, state: Tensor, context: Tensor | None = None) -> tuple[Tensor, Tensor]:
        logits = state if context is None else self.board_logits(context)
        return logits, logits

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        assert context is not None
        if not is_per_step(context):
            return self.board_logits(context)[:, None].expand(-1, plans.shape[1], -1)
        boards = context[:, : plans.shape[1]].flatten(0, 1)
        return self.board_logits(boards).view(*plans.shape, self.num_actions)

    def board_logits(self, context: Tensor) -> Tensor:
        """Logits `[M, A]` of boards `[M, C]`."""
        boards = context.float().reshape(len(context), *self.board)
        values = functional.conv2d(boards, self.kernels[0], self.biases[0], padding=1)
        for at in range(1, len(self.kernels), 2):
            inner = functional.conv2d(values.relu(), self.kernels[at], self.biases[at], padding=1)
            values = values + functional.conv2d(inner.relu(), self.kernels[at + 1], self.biases[at + 1], padding=1)
        return functional.linear(values.relu().flatten(1), self.out, self.out_bias)

    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Train on all steps by log-loss, with Adam, from the present weights on; returns self.

        Args:
            plans: `Plans` with features.
            generator: draws the first weights, the plans that are held out, and the order of the steps.
            settings: `epochs` (10), `batch_size` (256), `learning_rate` (1e-3), and `validation` (0.1): the `Plans`
                that are held out, or their share, on which the training is stopped; None: no plans.

        Raises:
            ValueError: plans that this prior cannot learn from, or a setting that it does not have.
        """
        self.check_settings(settings)
        plans = self.training_plans(plans)
        generator = generator_on(generator, "cpu")
        epochs, batch_size = settings.get("epochs", 10), settings.get("batch_size", 256)
        check_sizes(epochs=epochs, batch_size=batch_size)
        learning_rate, share = settings.get("learning_rate", 1e-3), settings.get("validation", VALIDATION)
        if not is_number(learning_rate) or not 0 < learning_rate < inf:
            raise ValueError(f"learning_rate: a finite number above 0 is expected, not {learning_rate}")
        training, held_out = plans, None
        if isinstance(share, Plans):
            check_alike(plans, share)
            held_out = share
        elif share is not None and num_units(plans) > 1:
            training, held_out = fair_split(plans, share, generator)
        self._begin(generator)
        boards, actions = _boards(training)
        if not len(actions):
            raise ValueError("plans: they have no actions to learn from")

        def loss_at(index: Tensor) -> Tensor:
            there = index.to(boards.device)
            return functional.cross_entropy(
                self.board_logits(boards[there].to(self.device)), actions[there].to(self.device)
            )

        validation = None if held_out is None else _boards(held_out)

        @torch.no_grad()
        def held_out_loss() -> float:
            assert validation is not None
            total = 0.0
            for some, taken in zip(validation[0].split(CHUNK), validation[1].split(CHUNK), strict=True):
                logits = self.board_logits(some.to(self.device))
                total += float(functional.cross_entropy(logits, taken.to(self.device), reduction="sum"))
            return total

        parameters = list(self.parameters())
        train(
            parameters,
            [torch.optim.Adam(parameters, learning_rate)],
            loss_at,
            None if validation is None or not len(validation[1]) else held_out_loss,
            len(actions),
            epochs=epochs,
            batch_size=batch_size,
            generator=generator,
        )
        return self

    @torch.no_grad()
    def _begin(self, generator: torch.Generator) -> None:
        """Draw the weights of a network that has not learned yet; the last convolution of each block begins small."""
        if any(bool(kernel.any()) for kernel in self.kernels):
            return
        for at, kernel in enumerate(self.kernels):
            scale = (2 / prod(kernel.shape[1:])) ** 0.5 * (0.1 if at and at % 2 == 0 else 1)
            kernel.copy_(torch.randn(kernel.shape, generator=generator) * scale)


def _boards(plans: Plans) -> tuple[Tensor, Tensor]:
    """The board `[M, C]` and the action, int64 `[M]`, of each step."""
    assert plans.context is not None
    mask = plans.mask()
    context = plans.context
    if not is_per_step(context):
        context = context[:, None].expand(-1, plans.max_length, -1)
    return context[mask], plans.actions[mask].long()
