"""Online learning: an agent plans, executes, and fits its prior to what it executed, again and again."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuroprior._checks import check_flags, check_memory, check_sizes, is_number
from neuroprior._random import generator_on
from neuroprior.agents.replay import Replay
from neuroprior.planners import Decision, Execution, Planner
from neuroprior.planners.execution import Change, check_change, follow, join_executions, observations
from neuroprior.planners.planner import check_is_planner
from neuroprior.planners.warm_start import with_rest
from neuroprior.plans import Plans
from neuroprior.priors import AdaptivePrior, CombinedPrior, Prior
from neuroprior.priors.prior import check_is_prior
from neuroprior.sampling.stepping import check_actions
from neuroprior.worlds.world import World, check_is_world, is_over


class Steps(NamedTuple):
    """Steps of B agents that are to be stored as plans.

    Attributes:
        before: `[B, T, ...]`: the state before each action.
        actions, rewards: `[B, T]`.
        fresh: `[B]` bool: whose first step begins a new episode.
    """

    before: Tensor
    actions: Tensor
    rewards: Tensor
    fresh: Tensor


class Agent:
    """Plans, executes the first actions, replans, and so on; meanwhile its prior is fitted to what was executed.

    Where an episode is over, the agent begins anew in a state that `world.reset` draws, before it plans again.

    B agents, each in a state of its own, share one prior and learn from one another. What they execute is cut into
    plans of `plan_length` actions, fewer where an episode ends, which go into a `Replay`. Every `learn_every` steps
    some of the stored plans are forgotten, and the prior is fitted to the rest: count-based priors anew, so that their
    counts decay exponentially; neural ones from their present weights. The prior is fitted in place, so that a planner
    with the same prior changes along. It is not fitted to fewer than two plans. An `AdaptivePrior` is not fitted at
    all: it counts each stored plan at once, and every `learn_every` steps its earlier counts are multiplied by
    `retention`.

    Args:
        world: the world.
        planner: its plans have at least `replan_every` actions, or end where the world terminates.
        prior: the prior that learns, usually the planner's. It also continues the rest of the last plan.
        state: `[B, ...]`: the states of the agents; None: one agent in a state that `world.reset` draws.
        replan_every: actions that are executed before replanning.
        change: applied to the states after each step; planners do not foresee it.
        warm_start: the rest of the last plan, continued by the prior, is one of the candidates. Without effect for
            best-first searches, whose plans end by themselves.
        num_rollouts: of this candidate and of the planner's best one in a stochastic world, where they are compared.
        learn_every: steps after which the prior is fitted; a multiple of `plan_length`. None: never.
        plan_length: actions in a stored plan; a multiple of `replan_every`.
        retention: the probability with which a stored plan is kept before each fit, see `Replay`.
        min_score: only plans whose rewards sum to more than this are stored; None: all.
        generator: draws everything that is random.
        training: settings of the prior's `fit`, such as `{"max_steps": 50}`; None: none.

    Attributes:
        world, planner, prior, state: as given; the state is the present one.
        time: steps so far.
        replay: the stored plans.

    Raises:
        ValueError: an argument is out of range, or prior and world do not fit one another.

    Example:
        >>> world, prior = gridworld(5, 5, seed=0), MarkovPrior(4, 1)
        >>> start = world.reset(8, torch.Generator().manual_seed(0))
        >>> agent = Agent(world, SamplingPlanner(prior, length=4, num_plans=16), prior, start)
        >>> agent.run(10).rewards.shape
        torch.Size([8, 10])
    """

    def __init__(
        self,
        world: World,
        planner: Planner,
        prior: Prior,
        state: Tensor | None = None,
        *,
        replan_every: int = 1,
        change: Change | None = None,
        warm_start: bool = True,
        num_rollouts: int = 1,
        learn_every: int | None = 64,
        plan_length: int = 16,
        retention: float = 0.9,
        min_score: float | None = None,
        generator: torch.Generator | None = None,
        training: Mapping[str, Any] | None = None,
    ) -> None:
        learns = {} if learn_every is None else {"learn_every": learn_every}
        check_sizes(replan_every=replan_every, plan_length=plan_length, num_rollouts=num_rollouts, **learns)
        check_flags(warm_start=warm_start)
        check_is_planner(planner)
        check_change(change)
        if not isinstance(training, Mapping | None):
            raise ValueError(f"`training` must be a dictionary of settings, got {training!r}")
        check_is_prior(prior)
        check_is_world(world)
        if plan_length % replan_every:
            raise ValueError(f"`plan_length` must be a multiple of replan_every = {replan_every}, got {plan_length}")
        if learn_every is not None and learn_every % plan_length:
            raise ValueError(f"`learn_every` must be a multiple of plan_length = {plan_length}, got {learn_every}")
        check_actions(prior, world)
        planner_prior = getattr(planner, "prior", None)
        chooses = isinstance(prior, CombinedPrior) and prior.given is None
        if chooses and planner_prior is not prior and any(planner_prior is e for e in prior.modules()):
            raise ValueError(
                "`planner` must sample from the prior itself, got one that samples from an expert, in whose place"
                " the prior fits others when it learns"
            )
        if min_score is not None and (not is_number(min_score) or min_score != min_score):
            raise ValueError(f"`min_score` must be a number, got {min_score!r}")
        self.generator = generator_on(generator, prior.device)
        self.state = world.reset(1, self.generator) if state is None else state
        world.check_state(self.state)
        self.world, self.planner, self.prior, self.replay = world, planner, prior, Replay(retention)
        self.made = prior.config  # before it learns, which may change sizes that were not given
        self.replan_every, self.change, self.warm_start = replan_every, change, warm_start
        self.num_rollouts, self.learn_every, self.plan_length = num_rollouts, learn_every, plan_length
        self.min_score, self.training, self.time = min_score, dict(training or {}), 0
        prior.check_settings(self.training)
        self.last: Decision | None = None  # the rest of the last plan
        self.recent: list[Steps] = []  # since plans were stored last

    def run(self, num_steps: int) -> Execution:
        """Go on for `num_steps` steps, a multiple of `replan_every`.

        Returns:
            What was executed: actions, rewards and states, `[B, num_steps]` each (and the states' own dimensions).

        Raises:
            ValueError: another number of steps, plans that are too short, or plans that the prior cannot be fitted to.
        """
        check_sizes(num_steps=num_steps)
        check_memory(8 * num_steps, num_steps=num_steps)
        if num_steps % self.replan_every:
            raise ValueError(f"`num_steps` must be a multiple of replan_every = {self.replan_every}, got {num_steps}")
        parts = []
        for _ in range(num_steps // self.replan_every):
            fresh = self._begin_anew()
            decision = self._decide()
            done = follow(decision, self.world, self.state, self.replan_every, self.generator, self.change)
            before = torch.cat([self.state[:, None], done.states[:, :-1]], 1)
            self.state, self.last = done.states[:, -1], self._rest(decision)
            self.time += self.replan_every
            parts.append(done)
            self._learn(Steps(before, done.actions, done.rewards, fresh))
        return join_executions(parts)

    def _begin_anew(self) -> Tensor:
        """Begins a new episode where one is over; returns for which agents, `[B]` bool."""
        over = is_over(self.world, self.state)
        if over.any():
            self.state = self.state.clone()
            self.state[over] = self.world.reset(int(over.sum()), self.generator).to(self.state)
            if self.last is not None:
                lengths = self.last.lengths
                if lengths is None:
                    lengths = torch.full_like(over, self.last.plan.shape[1], dtype=torch.long)
                self.last = self.last._replace(lengths=lengths.masked_fill(over, 0))
        return over

    def _decide(self) -> Decision:
        decision = self.planner.plan(self.world, self.state, self.generator)
        if not self.warm_start or self.last is None or self.last.plan.shape[1] == 0:
            return decision
        rest, lengths = self.last.plan, self.last.lengths
        if lengths is None:
            lengths = torch.full_like(rest[:, 0], rest.shape[1], dtype=torch.long)
        warm = (self.prior, self.world, self.state, decision, rest, lengths, self.num_rollouts, self.generator)
        return with_rest(self.planner, *warm)

    def _rest(self, decision: Decision) -> Decision:
        """The rest of a plan of which `replan_every` actions were executed."""
        lengths = None if decision.lengths is None else (decision.lengths - self.replan_every).clamp(min=0)
        return decision._replace(plan=decision.plan[:, self.replan_every :], lengths=lengths)

    def _learn(self, steps: Steps) -> None:
        """Store what was executed, and fit the prior, when it is time to."""
        if self.learn_every is None:
            return
        self.recent.append(steps)
        if self.time % self.plan_length:
            return
        stored = self._store()
        self.recent = []
        due = self.time % self.learn_every == 0
        if due:
            self.replay.forget(self.generator)
        if isinstance(self.prior, AdaptivePrior):
            if stored is not None:
                self.prior.count(stored, self.replay.retention if due else 1.0)
        elif due and self.replay.plans is not None and len(self.replay) > 1:
            self.prior.fit(self.replay.plans, generator=self.generator, **self.training)

    def _store(self) -> Plans | None:
        """Store, and return, the plans that were executed recently: of each agent one for each episode it was in."""
        before, actions, rewards = (
            torch.cat([getattr(steps, name) for steps in self.recent], 1) for name in ("before", "actions", "rewards")
        )
        begins = torch.zeros(actions.shape, dtype=torch.bool, device=actions.device)
        begins[:, :: self.replan_every] = torch.stack([steps.fresh for steps in self.recent], 1)
        begins[:, 0] = True
        alive = ~is_over(self.world, before.flatten(0, 1)).view(actions.shape)
        # Plans in the order of agents, and then of time; an episode that is over fills up the rest of its plan.
        row, first = begins.nonzero(as_tuple=True)
        time = torch.arange(actions.shape[1], device=actions.device)
        episode = begins.flatten().cumsum(0).view(actions.shape) - 1
        inside = alive[row] & (episode[row] == torch.arange(len(row), device=actions.device)[:, None])
        lengths, score = inside.sum(1), (inside * rewards[row]).sum(1)
        kept = lengths > 0
        if self.min_score is not None:
            kept &= score > self.min_score
        if not kept.any():
            return None
        place = row[kept, None], (first[kept, None] + time).clamp(max=actions.shape[1] - 1)
        context = observations(self.world, before[place], self.prior.context_per)
        plans = Plans(actions[place], self.world.num_actions, lengths[kept], self.world.action_names, context)
        self.replay.add(plans)
        return plans
