"""The interface of a planner of vectors, and what it carries from one decision to the next."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_share, check_sizes
from neuroprior.planners.planner import check_objective
from neuroprior.priors.vectors import VectorPrior
from neuroprior.worlds.continuous import ContinuousWorld


class Memory(NamedTuple):
    """What a planner knows of the decisions before, for B runs; `control` carries it on.

    Attributes:
        past: `[B, T, D]`: the vectors that were executed, T >= 0, the last one last.
        observations: `[B, T, C]`: what was observed before each of them.
        mean: `[B, L, D]`: the plan from which the next decision starts (the last one, moved on by what was executed);
            None: there is none yet.
        elites: `[B, E, L, D]`: kept candidates, moved on in the same way; None where a planner keeps none.
    """

    past: Tensor
    observations: Tensor
    mean: Tensor | None = None
    elites: Tensor | None = None


class VectorDecision(NamedTuple):
    """What a planner decided for B starts.

    Attributes:
        plan: `[B, L, D]`: the plan to execute the beginning of.
        score: `[B]`: the score of the best candidate that was simulated.
        model_steps: single simulator steps taken for each start.
        memory: for the next decision, not moved on yet: `past` as given; `mean` and `elites` of this decision.
    """

    plan: Tensor
    score: Tensor
    model_steps: int
    memory: Memory


class VectorPlanner(ABC):
    """Chooses, for each start, a sequence of vectors with a high return: the discounted sum of its rewards.

    Args:
        length: L, vectors in a plan.
        num_plans: P, candidates that a decision simulates, over all its iterations.
        prior: proposes candidates; None: all are the planner's own.
        prior_share: the share of candidates that the prior proposes, from 0 to 1; at 0 the plain algorithm, number for
            number.
        discount: of the reward of each further step, above 0 and at most 1.
        value: its value of the final state, times `discount ** L`, is added to a plan's score.

    Raises:
        ValueError: an argument is out of range, or a share without a prior.
    """

    def __init__(
        self,
        length: int,
        num_plans: int,
        *,
        prior: VectorPrior | None = None,
        prior_share: float | None = None,
        discount: float = 1.0,
        value: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        check_sizes(length=length, num_plans=num_plans)
        check_objective("return", discount)
        if prior is not None and not isinstance(prior, VectorPrior):
            raise ValueError(f"prior: a VectorPrior is expected, not {type(prior).__name__}")
        share = prior_share if prior_share is not None else 0.0 if prior is None else 0.5
        check_share("prior_share", share)
        if share and prior is None:
            raise ValueError("prior_share: there is no prior; give prior=")
        self.length, self.num_plans, self.discount, self.value = length, num_plans, discount, value
        self.prior, self.prior_share = prior, share

    @abstractmethod
    def plan(
        self,
        world: ContinuousWorld,
        state: Tensor,
        generator: torch.Generator | None = None,
        memory: Memory | None = None,
    ) -> VectorDecision:
        """Plan from each of B starts.

        Args:
            world: the world, in which the planner tries candidates.
            state: `[B, ...]`.
            generator: draws candidates and the steps of a stochastic world.
            memory: of the decisions before; None: runs begin.

        Raises:
            ValueError: these are no states of the world, or the prior has other bounds than the world.
        """
