"""An agent that lives: it plans, executes, and learns from what it executed, again and again."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.agents.replay import Replay
from neuroprior.planners import Decision, Execution, Planner
from neuroprior.planners.execution import Change, executed_steps, follow, join_executions, observations
from neuroprior.planners.warm_start import with_rest
from neuroprior.plans import Plans
from neuroprior.priors import Prior, UniformPrior
from neuroprior.priors.counts import HistoryPrior
from neuroprior.priors.neural import NeuralPrior
from neuroprior.worlds.world import World


class Agent:
    """Plans, executes the first actions, and plans anew, as long as it lives; meanwhile its prior learns from that.

    B agents in as many states, each on its own, share one prior: what one of them did, all learn from. What they have
    executed is cut into plans of `plan_length` actions, which go into a `Replay`. Every `learn_every` steps, some of
    what is remembered is forgotten, and the prior learns (by its `fit`) from the rest: priors that count do so anew, so
    that their counts are counts with forgetting; neural ones go on from the weights that they have. The prior learns in
    place, so that a planner that proposes from it goes along. From fewer than two plans it learns nothing.

    Args:
        world: where.
        planner: plans of at least `replan_every` actions.
        prior: what learns; usually that of the planner. It also says how the rest of a plan goes on.
        state: `[B, ...]`: where the agents are; None: one agent in a state that `world.reset` draws.
        replan_every: actions that are executed before planning anew.
        change: what happens after each step besides, unforeseen by planners, such as `ForagingWorld.regrow`: rewards that
            move.
        warm_start: the rest of the last plan, as the prior would go on with it, is one of the candidates.
        num_rollouts: of that one and of the planner's best in a world with chance, where they are then tried together.
        learn_every: steps after which the prior learns; a multiple of `plan_length`. None: it never does.
        plan_length: actions in a plan to learn from; a multiple of `replan_every`.
        retention: what is remembered is kept with this probability at each learning, see `Replay`.
        min_score: only plans whose rewards sum to more than this are remembered; None: all are.
        generator: draws everything that is random.
        training: passed on to the prior's `fit`, together with the generator, such as `{"max_steps": 50}`; None for
            priors that count.

    Attributes:
        world, planner, prior, state: as given; the state is the present one.
        time: steps lived.
        replay: what is remembered.

    Raises:
        ValueError: an argument is out of range, or prior and world do not fit one another.
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
        if not isinstance(prior, Prior):
            raise ValueError(f"prior: a Prior is expected, not a {type(prior).__name__}")
        if plan_length % replan_every:
            raise ValueError(f"plan_length: a multiple of replan_every = {replan_every} is expected, not {plan_length}")
        if learn_every is not None and learn_every % plan_length:
            raise ValueError(f"learn_every: a multiple of plan_length = {plan_length} is expected, not {learn_every}")
        if prior.num_actions != world.num_actions:
            raise ValueError(f"prior: it has {prior.num_actions} actions, the world {world.num_actions}")
        self.generator = generator_on(generator, prior.device)
        self.state = world.reset(1, self.generator) if state is None else state
        world.check_state(self.state)
        self.world, self.planner, self.prior, self.replay = world, planner, prior, Replay(retention)
        self.replan_every, self.change, self.warm_start, self.num_rollouts = (
            replan_every,
            change,
            warm_start,
            num_rollouts,
        )
        self.learn_every, self.plan_length, self.min_score = learn_every, plan_length, min_score
        if training is not None and isinstance(prior, HistoryPrior | UniformPrior):
            raise ValueError(f"training: a {type(prior).__name__} counts, and is not trained; leave it out")
        self.training = dict(training or {}) if training is not None or isinstance(prior, NeuralPrior) else None
        self.time = 0
        self.last: Decision | None = None  # what is left of the last plan
        self.recent: list[Execution] = []  # since a plan was remembered last
        self.before = self.state  # the state then

    def run(self, num_steps: int) -> Execution:
        """Live for so many steps more, a multiple of `replan_every`.

        Returns:
            What was done: actions, rewards and states, `[B, num_steps]` each (and the states' own dimensions).

        Raises:
            ValueError: another number of steps, plans that are too short, or what the prior cannot learn from.
        """
        check_sizes(num_steps=num_steps)
        if num_steps % self.replan_every:
            raise ValueError(
                f"num_steps: a multiple of replan_every = {self.replan_every} is expected, not {num_steps}"
            )
        parts = []
        for _ in range(num_steps // self.replan_every):
            decision = self._decide()
            done = follow(decision, self.world, self.state, self.replan_every, self.generator, self.change)
            self.state, self.last = done.states[:, -1], self._left(decision)
            self.time += self.replan_every
            parts.append(done)
            self._learn(done)
        return join_executions(parts)

    def _decide(self) -> Decision:
        decision = self.planner.plan(self.world, self.state, self.generator)
        if not self.warm_start or self.last is None or self.last.plan.shape[1] == 0:
            return decision
        last, lengths = self.last, self.last.lengths
        if lengths is None:
            lengths = torch.full_like(last.plan[:, 0], last.plan.shape[1], dtype=torch.long)
        return with_rest(
            self.planner,
            self.prior,
            self.world,
            self.state,
            decision,
            last.plan,
            lengths,
            self.num_rollouts,
            self.generator,
        )

    def _left(self, decision: Decision) -> Decision:
        """What is left of a plan of which `replan_every` actions were executed."""
        lengths = None if decision.lengths is None else decision.lengths - self.replan_every
        return decision._replace(plan=decision.plan[:, self.replan_every :], lengths=lengths)

    def _learn(self, done: Execution) -> None:
        """Remember what was done, and learn from it, where it is time to."""
        if self.learn_every is None:
            return
        self.recent.append(done)
        if self.time % self.plan_length:
            return
        self._remember(join_executions(self.recent))
        self.recent, self.before = [], self.state
        if self.time % self.learn_every == 0:
            self.replay.forget(self.generator)
            if self.replay.plans is not None and len(self.replay) > 1:
                settings = {} if self.training is None else self.training | {"generator": self.generator}
                self.prior.fit(self.replay.plans, **settings)

    def _remember(self, done: Execution) -> None:
        """Put a plan that was executed from the state `before` into the replay."""
        before = torch.cat([self.before[:, None], done.states[:, :-1]], 1)
        lengths = executed_steps(self.world, before)
        kept = lengths > 0
        if self.min_score is not None:
            kept &= done.rewards.sum(1) > self.min_score
        seen = observations(self.world, before, self.prior.context_per)
        plans = Plans(done.actions, self.world.num_actions, lengths, self.world.action_names, seen)
        if kept.any():
            self.replay.add(plans[kept])
