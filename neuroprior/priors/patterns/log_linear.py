"""The log-linear prior: a weight for each active pattern and action, fitted by the loss itself, which is convex."""

from collections.abc import Iterator
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior.priors.patterns.pattern_prior import Loss, PatternPrior
from neuroprior.priors.patterns.steps import Steps, numbered, vocabulary

CHUNK = 2**15
"""Steps whose logits are computed together."""

ROUND = 5
"""Iterations between two looks at the plans that are held out."""


class LogLinearPrior(PatternPrior):
    """A product of experts: the logits are the sum of the rows of the active patterns, the last actions and a bias.

    The context model of Orseau, Hutter and Lelis, "Levin tree search with context models" (IJCAI 2023), section 3.
    The log-loss is convex in the weights; L-BFGS minimises it, over all steps at once, so that nothing is random but
    which plans are held out. `fit` goes on from the present weights, and patterns that are new begin at 0. Where these
    weights have learned some of the plans before, those held out are no fair judge: hold out none then
    (`validation=None`), and limit `epochs`.

    Args:
        num_actions: A.
        num_patterns: F, the number of patterns that are active in each state.
        order: >= 0, the last actions that count.
        min_count: patterns that occur less often in the plans of one `fit` are not made known by it.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(self, num_actions: int, num_patterns: int, *, order: int = 1, min_count: int = 2) -> None:
        super().__init__(num_actions, num_patterns, order=order)
        check_sizes(min_count=min_count)
        self.min_count = min_count

    @property
    def config(self) -> dict[str, Any]:
        return super().config | {"min_count": self.min_count}

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("validation", "epochs", "l2", "loss")

    def learn(
        self,
        steps: Steps,
        held_out: Steps | None,
        generator: torch.Generator | None,
        *,
        epochs: int = 30,
        l2: float = 1e-6,
        loss: Loss = "log",
    ) -> None:
        """Minimise the loss on flat steps.

        Args:
            steps: to learn from.
            held_out: after every few iterations the loss on these is looked at; learning stops where it rose, and the
                best weights are kept.
            generator: not used.
            epochs: the most iterations of L-BFGS; each goes through all steps once or a few times.
            l2: half of this times the sum of the squared weights is added to the loss.
            loss: "log": the mean of -log p(action), nats a step; "levin": the logarithm of the sum over plans of
                d / pi, the expansions that bound a Levin tree search (d: the plan's steps, pi: its probability), which
                is to follow a fit by log-loss.

        Raises:
            ValueError: a setting is out of range.
        """
        check_sizes(epochs=epochs)
        if not l2 >= 0:
            raise ValueError(f"l2: at least 0 is expected, not {l2}")
        if loss not in get_args(Loss):
            raise ValueError(f'loss: "log" or "levin" is expected, not {loss!r}')
        self.know(vocabulary(steps.patterns, self.min_count))
        parts = (self.weights[:-1], self.action_weights, self.bias)
        flat = torch.cat([part.flatten() for part in parts]).requires_grad_()
        objective = _Objective(self, steps, loss)
        validation = None if held_out is None else _Objective(self, held_out, loss)
        # Weights from an earlier fit may have learned what is held out now, so these first ones set no mark.
        best, least = flat.detach().clone(), torch.inf
        optimiser = torch.optim.LBFGS(
            [flat], max_iter=ROUND, history_size=8, line_search_fn="strong_wolfe", tolerance_grad=1e-7
        )

        def closure() -> float:
            value, gradient = objective(flat.detach())
            flat.grad = gradient.add_(flat.detach(), alpha=l2)
            return value + l2 / 2 * float(flat.detach().square().sum())

        for done in range(0, epochs, ROUND):
            optimiser.param_groups[0]["max_iter"] = min(ROUND, epochs - done)
            before = flat.detach().clone()
            optimiser.step(closure)
            if validation is not None:
                now = validation(flat.detach())[0]
                if not now < least:
                    break
                least = now
            best = flat.detach().clone()
            if bool((before == best).all()):
                break
        weights, action_weights, bias = self.unpacked(best)
        self.weights[:-1] = weights
        self.action_weights.copy_(action_weights)
        self.bias.copy_(bias)

    def unpacked(self, flat: Tensor) -> list[Tensor]:
        """`weights` without its last row, `action_weights` and `bias`, from one vector of all."""
        sizes = [len(self.patterns), len(self.action_weights), 1]
        rows = list(flat.view(-1, self.num_actions).split(sizes))
        return [*rows[:2], rows[2][0]]


class _Objective:
    """The loss of flat steps and its gradient, as a function of all weights in one vector."""

    def __init__(self, prior: LogLinearPrior, steps: Steps, loss: Loss) -> None:
        self.prior, self.loss, self.steps = prior, loss, steps
        self.number = torch.empty_like(steps.patterns)
        for here in _chunks(len(steps.action)):
            self.number[here] = numbered(steps.patterns[here], prior.patterns)
        self.ones = np.ones(min(CHUNK, len(steps.action)) * steps.patterns.shape[1], np.float32)
        self.weight = steps.weights() / steps.weights().sum()
        self.plan = steps.plan.unique(return_inverse=True)[1]
        self.length = torch.bincount(self.plan).double()

    def matrix(self, here: slice) -> Any:
        """Which patterns are active, a sparse `[m, V + 1]` of ones."""
        from scipy.sparse import csr_matrix

        number = self.number[here].numpy()
        bounds = np.arange(len(number) + 1, dtype=np.int32) * number.shape[1]
        shape = (len(number), len(self.prior.patterns) + 1)
        return csr_matrix((self.ones[: number.size], number.reshape(-1), bounds), shape)

    def __call__(self, flat: Tensor) -> tuple[float, Tensor]:
        """The loss at these weights, and its gradient."""
        weights, action_weights, bias = self.prior.unpacked(flat)
        table = np.concatenate([weights.numpy(), np.zeros((1, self.prior.num_actions), np.float32)])
        taken = torch.empty(len(self.steps.action))
        log_probs = torch.empty(len(self.steps.action), self.prior.num_actions)
        for here in _chunks(len(taken)):
            logits = torch.from_numpy(self.matrix(here) @ table) + action_weights[self.steps.last[here]] + bias
            log_probs[here] = logits.log_softmax(-1)
            taken[here] = log_probs[here].gather(1, self.steps.action[here, None])[:, 0]
        value, weight = self.value(taken)
        ascent = log_probs.exp_().mul_(weight[:, None])
        ascent.scatter_add_(1, self.steps.action[:, None], -weight[:, None])
        gradient = torch.zeros_like(flat)
        of_patterns, of_actions, of_bias = self.prior.unpacked(gradient)
        for here in _chunks(len(taken)):
            of_patterns += torch.from_numpy(self.matrix(here).T @ ascent[here].numpy())[:-1]
        if self.prior.order:
            of_actions.index_add_(0, self.steps.last, ascent)
        of_bias += ascent.sum(0)
        return value, gradient

    def value(self, taken: Tensor) -> tuple[float, Tensor]:
        """The loss where the actions have these log-probabilities `[M]`, and minus its derivative by them, `[M]`."""
        if self.loss == "log":
            return -float((self.weight.double() * taken.double()).sum()), self.weight
        # The gradient of log sum d / pi is that of the plans' log-losses, weighted by their share of the sum.
        of_plan = torch.zeros_like(self.length).index_add_(0, self.plan, taken.double())
        terms = self.length.log() - of_plan
        return float(terms.logsumexp(0)), terms.softmax(0).float()[self.plan]


def _chunks(number: int) -> Iterator[slice]:
    return (slice(at, at + CHUNK) for at in range(0, number, CHUNK))
