"""Planners at their limits: chunks of starts, rewards that are not numbers, states of a wrong dtype."""

import pytest
import torch

from neuroprior import ExhaustivePlanner, Planner, SamplingPlanner, UniformPrior, World, gridworld, oracle


def test_chunks_are_put_together_with_lengths() -> None:
    world = gridworld(5, 5, num_worlds=2, seed=1)
    state = torch.arange(50)
    planner = ExhaustivePlanner(3, any_prefix=True)
    whole = planner.plan(world, state, torch.Generator().manual_seed(0))
    planner.steps_at_once = 400
    parts = planner.plan(world, state, torch.Generator().manual_seed(0))
    assert parts.score.equal(whole.score)
    assert parts.lengths is not None
    for b in range(50):
        rollout = world.rollout(state[b : b + 1], parts.plan[b, : parts.lengths[b]][None, None])
        assert int(rollout.final_state) == int(parts.final_state[b])
        assert float(rollout.rewards[0, 0, -1]) == float(parts.score[b])


@pytest.mark.parametrize("planner", [ExhaustivePlanner(2), SamplingPlanner(UniformPrior(2), 2, 8)])
def test_rewards_that_are_not_numbers_are_said(planner: Planner) -> None:
    class Broken(World):
        num_actions = 2

        def reset(self, batch_size: int, generator: torch.Generator | None = None) -> torch.Tensor:
            return torch.zeros(batch_size, 1)

        def step(self, state, action, generator=None):
            return state, torch.where(action == 0, torch.nan, 1.0)

    with pytest.raises(ValueError, match="NaN"):
        planner.plan(Broken(), torch.zeros(50, 1))


def test_scores_of_prefixes_are_those_of_plans_as_long() -> None:
    """Rewards 1, 2, 4 and values 1, 3, 9 at a discount of one half, by hand."""
    rewards, states = torch.tensor([[1.0, 2.0, 4.0]]), torch.tensor([[1, 3, 9]])
    how = {"value": lambda state: state.double()}
    due = {"terminal": [1 + 1, 2 + 3, 4 + 9], "return": [1 + 1 / 2, 1 + 1 + 3 / 4, 1 + 1 + 1 + 9 / 8]}
    for objective, scores in due.items():
        discount = 0.5 if objective == "return" else 1.0
        planner = ExhaustivePlanner(3, objective=objective, discount=discount, **how)
        assert planner.prefix_scores(rewards, states).tolist() == [scores]
        assert [float(planner.score(rewards[:, :k], states[:, k - 1])) for k in (1, 2, 3)] == scores


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.float32])
def test_states_of_another_dtype_are_refused(dtype: torch.dtype) -> None:
    world = gridworld(20, 20)
    for call in (ExhaustivePlanner(2).plan, lambda w, s: oracle(w, s, 3)):
        with pytest.raises(ValueError, match="state"):
            call(world, torch.tensor([250]).to(dtype))
