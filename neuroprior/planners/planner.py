"""The interface of a planner, its objective, and how ties are broken (`random_best`)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from typing import Literal, NamedTuple, Self, TypedDict, Unpack

import torch
from torch import Tensor

from neuroprior._checks import check_flags, check_memory, check_sizes, kind_of
from neuroprior._random import generator_on
from neuroprior.sampling.draws import check_temperature
from neuroprior.sampling.stepping import Steppable, Stepper, check_in_world
from neuroprior.worlds.world import Rollout, World, check_objective

STEPS_CACHED = 2**19
"""Simulator steps whose results stay in a CPU's cache."""


class Candidates(NamedTuple):
    """What a planner tried from B starts: P plans of L actions from each.

    Attributes:
        plans: `[B, P, L]`; zeros where there is none.
        scores: `[B, P]`, with `any_prefix` those of the best prefixes; -inf: there is no such plan, or it is not legal.

    Example:
        >>> tried = Candidates(torch.tensor([[[1, 0], [1, 1], [2, 0]]]), torch.tensor([[2.0, 4.0, 1.0]]))
        >>> tried.visits(4).tolist(), tried.values(4).tolist()
        ([[0, 2, 1, 0]], [[nan, 3.0, 1.0, nan]])
    """

    plans: Tensor
    scores: Tensor

    def visits(self, num_actions: int) -> Tensor:
        """How many plans begin with each action: int64 `[B, A]`. Of tree search they are a policy to learn from."""
        counts = torch.zeros(len(self.plans), num_actions, dtype=torch.long, device=self.plans.device)
        return counts.scatter_add_(1, self.plans[:, :, 0].long(), (self.scores > -torch.inf).long())

    def values(self, num_actions: int) -> Tensor:
        """The mean score of the plans that begin with each action: `[B, A]`; NaN where there is none."""
        scores = self.scores.masked_fill(self.scores == -torch.inf, 0)
        sums = scores.new_zeros(len(scores), num_actions).scatter_add_(1, self.plans[:, :, 0].long(), scores)
        return sums / self.visits(num_actions)


class Decision(NamedTuple):
    """What a planner decided for B starts.

    Attributes:
        plan: `[B, L]`: the best plan that it found; 0 beyond `lengths`.
        score: `[B]`: the score of that plan; in a stochastic world its mean over rollouts that had no part in the
            choice.
        final_state: `[B, ...]`: where the plan (where there are `lengths`, its executed part) ends; in a stochastic
            world, in the first of the planner's rollouts.
        model_steps: single simulator steps taken for each start.
        lengths: `[B]`: how many actions of each plan are to be executed; None: all.
        candidates: all that was tried, where `Planner.keep_candidates` is set; else None.
    """

    plan: Tensor
    score: Tensor
    final_state: Tensor
    model_steps: int
    lengths: Tensor | None = None
    candidates: Candidates | None = None

    def __repr__(self) -> str:
        batch, length = self.plan.shape
        mean = f"mean score {float(self.score.double().mean()):.4g}, " if batch else ""
        return f"Decision({batch:,} plans of {length} actions, {mean}{self.model_steps:,} model steps each)"


class Objective(TypedDict, total=False):
    """What a planner optimises, as keyword arguments; see `Planner`."""

    objective: Literal["terminal", "return"] | None
    discount: float | None
    value: Callable[[Tensor], Tensor] | None
    any_prefix: bool


class Planner(ABC):
    """Chooses, for each start, a plan with a high score. Ties are broken uniformly at random, see `random_best`.

    Args:
        objective: "terminal": the score of a plan is the reward of its last step (Hyvärinen, both simulations).
            "return": the sum of its rewards, that of step t (from 0) times `discount ** t`. None: what the world
            declares, see `World.objective`.
        discount: above 0, at most 1; only for "return". None: that of the world.
        value: its value of the final state is added to the score: a function from final states `[N, ...]` to `[N]`;
            with "return" it is multiplied by `discount ** L`.
        any_prefix: the agent may stop after any action but none at all: the score of a plan is that of its best prefix,
            and of two prefixes with the same score neither is preferred.

    Attributes:
        steps_at_once: starts are planned for in chunks of about so many simulator steps; bounds memory.
        keep_candidates: whether decisions hold the `Candidates`, too; of `SamplingPlanner`, `MCTSPlanner` and
            `FrontierPlanner` (the plans of full length that it kept to the end).

    Raises:
        ValueError: an argument is out of range.
    """

    steps_at_once: int = 2**22
    keep_candidates: bool = False

    def __init__(
        self,
        objective: Literal["terminal", "return"] | None = None,
        discount: float | None = None,
        value: Callable[[Tensor], Tensor] | None = None,
        any_prefix: bool = False,
    ) -> None:
        check_objective(objective, discount)
        if value is not None and not callable(value):
            raise ValueError(f"`value` must be a function of states [N, ...], got {value!r}")
        check_flags(any_prefix=any_prefix)
        self.objective, self.discount, self.value, self.any_prefix = objective, discount, value, any_prefix

    @property
    def goal(self) -> Objective:
        """The objective, discount, value and any_prefix, to make another planner with the same ones."""
        return {
            "objective": self.objective,
            "discount": self.discount,
            "value": self.value,
            "any_prefix": self.any_prefix,
        }

    def for_world(self, world: World) -> Self:
        """Returns this planner with the objective and discount of `world` where it has none of its own.

        `plan` begins with it, since scores need to know what counts.
        """
        planner = copy(self)
        planner.objective, planner.discount = settle_objective(world, self.objective, self.discount)
        return planner

    @abstractmethod
    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        """Plan from each of B starts.

        Args:
            world: the world, in which the planner tries plans.
            state: `[B, ...]`.
            generator: draws candidates, the steps of a stochastic world, and the winner among equally good plans.

        Raises:
            ValueError: these are no states of the world, or the planner cannot plan there; the message says why.
        """

    def score(self, rewards: Tensor, final_state: Tensor) -> Tensor:
        """The scores `[...]` of plans with `rewards [..., L]` that end in `final_state` (`[...]` and its own shape)."""
        rewards = as_floats(rewards)
        if self._counts_last():
            return self._add_value(rewards[..., -1], final_state)
        weights = self.discounts(rewards)
        return self._add_value((rewards * weights[:-1]).sum(-1), final_state, weights[-1])

    def prefix_scores(self, rewards: Tensor, states: Tensor) -> Tensor:
        """The scores `[..., L]` of all prefixes of plans that have `rewards [..., L]` and lead to `states [..., L]`."""
        rewards = as_floats(rewards)
        if self._counts_last():
            return self._add_value(rewards, states)
        weights = self.discounts(rewards)
        return self._add_value((rewards * weights[:-1]).cumsum(-1), states, weights[1:])

    def score_rollout(self, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Scores and final states for `decide`: of all prefixes where the rollout has states, else of plans."""
        if rollout.states is None:
            return self.score(rollout.rewards, rollout.final_state), rollout.final_state
        return self.prefix_scores(rollout.rewards, rollout.states), rollout.states

    def chunks(self, state: Tensor, steps: int, cached: bool = False) -> tuple[Tensor, ...]:
        """`state [B, ...]` in chunks to plan for one after another, where each start takes so many `steps`.

        Args:
            state: the starts.
            steps: simulator steps for each start.
            cached: on a CPU, use chunks whose results stay in its cache: for steps that cost little but memory.
        """
        at_once = self.steps_at_once
        if cached and state.device.type == "cpu":
            at_once = min(at_once, STEPS_CACHED)
        parts: tuple[Tensor, ...] = state.split(max(at_once // max(steps, 1), 1))
        return parts

    def discounts(self, rewards: Tensor) -> Tensor:
        """The weights in a return, `[L + 1]`: those of `rewards [..., L]`, and that of the final state's value."""
        steps = torch.arange(rewards.shape[-1] + 1, device=rewards.device, dtype=rewards.dtype)
        return (1.0 if self.discount is None else self.discount) ** steps

    def _counts_last(self) -> bool:
        """Whether the last of the rewards is the score."""
        if self.objective is None:
            raise ValueError("objective: it is the world's; score with `planner.for_world(world)`")
        return self.objective == "terminal"

    def _add_value(self, score: Tensor, state: Tensor, weight: Tensor | float = 1.0) -> Tensor:
        """`score [...]` plus the weighted value of `state` (`[...]` and its own shape)."""
        if self.value is None:
            return score
        value = value_of(self.value, state.reshape(-1, *state.shape[score.dim() :]))
        return score + weight * value.view_as(score).to(score.dtype)


class PriorPlanner(Planner):
    """A planner that tries plans which a prior proposes.

    Args:
        prior: any prior over the world's actions; all that is needed is a number of actions, `start` and `step`, see
            `neuroprior.sampling.Steppable`.
        length: number of actions in a plan, L, at least 1.
        num_plans: P, at least 1: the budget of a decision is that of P plans of L actions.
        temperature: divides the prior's logits.
        **goal: objective, discount, value, any_prefix: see `Planner`.

    Raises:
        ValueError: an argument is out of range.
    """

    def __init__(
        self, prior: Steppable, length: int, num_plans: int, *, temperature: float = 1.0, **goal: Unpack[Objective]
    ) -> None:
        super().__init__(**goal)
        check_sizes(length=length, num_plans=num_plans)
        check_memory(num_plans * length, length=length, num_plans=num_plans)
        check_temperature(temperature)
        if not isinstance(prior, Steppable):
            raise ValueError(f"`prior` must be a prior with num_actions, start and step, got {type(prior).__name__}")
        self.prior, self.temperature = prior, temperature
        self.length, self.num_plans = int(length), int(num_plans)

    def _threads_for(self, num_plans: int) -> AbstractContextManager[None]:
        """As `Stepper.threads_for`, but all threads where a value of the user's may be worth them."""
        return nullcontext() if self.value is not None else Stepper(self.prior).threads_for(num_plans)

    def _require_deterministic(self, world: World, reason: str) -> None:
        """Raise ValueError in a stochastic world."""
        if world.stochastic:
            raise ValueError(f"`world` must be deterministic: {reason}")

    def _prepare(self, world: World, state: Tensor, generator: torch.Generator | None) -> tuple[Self, torch.Generator]:
        """Returns the planner for the world, and the generator to draw with.

        Raises:
            ValueError: the prior cannot act in the world from `state`.
        """
        check_in_world(self.prior, world, state)
        return self.for_world(world), generator_on(generator, state.device)


def as_floats(rewards: Tensor) -> Tensor:
    """The same rewards; integers and truth values in single precision."""
    return rewards if rewards.is_floating_point() else rewards.float()


def check_is_planner(planner: object) -> None:
    """Raise ValueError unless it is a `Planner`."""
    if not isinstance(planner, Planner):
        raise ValueError(f"`planner` must be a Planner, got {kind_of(planner)}")


def value_of(value: Callable[[Tensor], Tensor], state: Tensor, name: str = "value") -> Tensor:
    """The values `[N]` of `state [N, ...]`; raises ValueError, which begins with the `name`, unless there are N of them
    and none is NaN.
    """
    values = value(state)
    if not isinstance(values, Tensor):
        raise ValueError(
            f"`{name}` must be a tensor [{len(state)}] of the values of {len(state)} states, got {kind_of(values)}"
        )
    if values.numel() != len(state) or values.isnan().any():
        raise ValueError(f"`{name}` must be a number, not NaN, for each of {len(state)} states, got {values.numel()}")
    return values.view(-1)


def settle_objective(
    world: World, objective: Literal["terminal", "return"] | None, discount: float | None
) -> tuple[Literal["terminal", "return"], float]:
    """Returns the objective and the discount: those of `world` where they are None.

    Raises:
        ValueError: they are out of range, or the discount has no effect.
    """
    settled = world.objective if objective is None else objective
    if discount is None:
        discount = world.discount if settled == "return" else 1.0
    check_objective(settled, discount)
    return settled, discount


def random_best(score: Tensor, generator: torch.Generator, allowed: Tensor | None = None) -> Tensor:
    """The index `[B]` of the highest score in each row of `score [B, P]`; among equal ones a uniform draw.

    Planners of whole plans break the ties between their best ones here; trees choose among actions in
    `compiled_mcts.descend`, and those that keep several candidates in `random_top`.

    Args:
        score: `[B, P]`.
        generator: breaks ties.
        allowed: bool `[B, P]`: the scores that count, at least one in each row; None: all.

    Raises:
        ValueError: a score is NaN, or none of a row counts.

    Example:
        >>> random_best(torch.tensor([[0.0, 2.0, 1.0]]), torch.Generator().manual_seed(0)).tolist()
        [1]
    """
    allowed = None if allowed is None else allowed.expand(score.shape)
    if allowed is not None and not allowed.any(1).all():
        raise ValueError(
            "plans: from some start there is no plan of legal actions alone, to which the prior gives a probability"
            " above 0"
        )
    # Scores are often one column of many, which is slow to read more than once.
    score = score.contiguous() if allowed is None else score.masked_fill(~allowed, -torch.inf)
    highest = score.amax(1, keepdim=True)
    if highest.isnan().any():
        raise ValueError("score: NaN; a reward of the world, or its value, is not a number")
    best = score == highest
    if allowed is not None:
        best = best & allowed
    draws = torch.rand(score.shape, generator=generator, device=score.device)
    return torch.where(best, draws, -1.0).argmax(1)


def random_top(score: Tensor, number: int, generator: torch.Generator) -> Tensor:
    """The indices `[B, number]` of the highest scores in each row of `score [B, P]`; of equals a random choice."""
    mixed = torch.rand(score.shape, generator=generator, device=score.device).argsort(1)
    order = score.gather(1, mixed).argsort(dim=1, descending=True, stable=True)
    return mixed.gather(1, order[:, :number])


def decide(
    plans: Tensor,
    score: Tensor,
    ends: Tensor,
    model_steps: int,
    generator: torch.Generator,
    allowed: Tensor | None = None,
    keep: bool = False,
) -> Decision:
    """The best of the candidates, or of their prefixes.

    Args:
        plans: `[B, P, L]`.
        score: `[B, P]`, or `[B, P, L]` where any prefix may win.
        ends: the final states of the plans or prefixes: the shape of `score`, and the state's own dimensions.
        model_steps: simulator steps taken for each start.
        generator: breaks ties.
        allowed: bool, of the shape of `score` or broadcast to it: what may win, at least one per start; None: all.
        keep: whether the decision holds the candidates.
    """
    row, candidates = torch.arange(len(plans), device=plans.device), None
    if keep:
        counting = score if allowed is None else score.masked_fill(~allowed.expand(score.shape), -torch.inf)
        scores = counting if score.dim() == 2 else counting.amax(2)
        candidates = Candidates(plans.masked_fill((scores == -torch.inf)[..., None], 0), scores)
    if allowed is not None:
        allowed = allowed.expand(score.shape).flatten(1)
    if score.dim() == 2:
        best = random_best(score, generator, allowed)
        return Decision(plans[row, best], score[row, best], ends[row, best], model_steps, None, candidates)
    length = plans.shape[2]
    score = score.flatten(1)
    chosen = random_best(score, generator, allowed)
    best, last = chosen.div(length, rounding_mode="floor"), chosen % length
    beyond = torch.arange(length, device=plans.device) > last[:, None]
    plan = plans[row, best].masked_fill(beyond, 0)
    return Decision(plan, score[row, chosen], ends[row, best, last], model_steps, last + 1, candidates)


def join_decisions(parts: Iterable[Decision], batch_size: int) -> Decision:
    """The decisions for chunks of `batch_size` starts as one; its model steps are the most of any chunk."""
    whole, at, steps, kept = None, 0, 0, list[Candidates]()
    for decision in parts:
        if len(decision.plan) == batch_size:
            return decision
        if whole is None:
            # Allocated once: small results between large temporary blocks would keep memory from being freed.
            plan, score, final_state = (values.new_empty(batch_size, *values.shape[1:]) for values in decision[:3])
            lengths = None if decision.lengths is None else decision.lengths.new_empty(batch_size)
            whole = Decision(plan, score, final_state, 0, lengths)
        if decision.candidates is not None:
            kept.append(decision.candidates)
        for result, values in zip((*whole[:3], whole.lengths), (*decision[:3], decision.lengths), strict=True):
            if isinstance(result, Tensor) and isinstance(values, Tensor):
                result[at : at + len(decision.plan)] = values
        at, steps = at + len(decision.plan), max(steps, decision.model_steps)
    assert whole is not None
    return whole._replace(model_steps=steps, candidates=_join_candidates(kept) if kept else None)


def _join_candidates(parts: list[Candidates]) -> Candidates:
    """The candidates for chunks of starts as one; where there are fewer, -inf says that there is no plan."""
    most = max(candidates.scores.shape[1] for candidates in parts)
    pad = torch.nn.functional.pad
    plans = [pad(candidates.plans, (0, 0, 0, most - candidates.plans.shape[1])) for candidates in parts]
    scores = [pad(candidates.scores, (0, most - candidates.scores.shape[1]), value=-torch.inf) for candidates in parts]
    return Candidates(torch.cat(plans), torch.cat(scores))
