"""Saved priors for a world: actions told by their names."""

from itertools import permutations

import pytest
import torch

from eval.compare.saved import Renumbered, load_for
from neuroprior import GRUPrior, MarkovPrior, Plans, Prior, SamplingPlanner, gridworld, save
from neuroprior.sampling import sample_in_world
from tests.support.chains import markov_plans, markov_probs
from tests.support.sources import FALSE_ALARM, every_plan, p_value, plan_number, refuses, seeded

NAMES = ("up", "right", "down")


def learned(names=NAMES, **more) -> Plans:
    plans = markov_plans(markov_probs(3, 1, 0), 40, 6, 1)
    return Plans(plans.actions, 3, action_names=names, **more)


def saved(tmp_path, prior, plans: Plans) -> str:
    how = {} if isinstance(prior, MarkovPrior) else {"max_steps": 5, "progress": False}
    return str(save(prior.fit(plans, **how), tmp_path / "prior"))


@pytest.mark.parametrize("order", list(permutations(range(3))))
@pytest.mark.parametrize("make", [lambda: MarkovPrior(3, 2), lambda: GRUPrior(3, 8)])
def test_plans_cost_what_they_cost_under_their_names(make, order, tmp_path):
    prior = make()
    folder = saved(tmp_path, prior, learned())
    names = [NAMES[known] for known in order]
    found = load_for(folder, "maze", 3, names)
    assert isinstance(found, Renumbered) == (order != (0, 1, 2))
    assert found.action_names == tuple(names)
    plans = every_plan(3, 5)
    with torch.no_grad():
        want = prior.eval().log_prob(torch.tensor(order)[plans])
        torch.testing.assert_close(found.log_prob(plans), want)
        # the same by `start` and `step`
        torch.testing.assert_close(Prior.forward(found, plans), found(plans))


def test_samples_have_the_renumbered_distribution(tmp_path):
    """A chi-square test over all plans of 3 actions; a false alarm has a probability of 1e-6."""
    prior = MarkovPrior(3, 1)
    found = load_for(saved(tmp_path, prior, learned()), "maze", 3, ("down", "up", "right"))
    plans = every_plan(3, 3)
    want = prior.log_prob(torch.tensor([2, 0, 1])[plans]).exp().double()
    drawn = found.sample(20_000, 3, generator=seeded(0))
    assert p_value(plan_number(drawn, 3), want) > FALSE_ALARM


@pytest.mark.parametrize("per", ["plan", "step"])
def test_context_goes_to_the_prior(per, tmp_path):
    shape = (40,) if per == "plan" else (40, 6)
    plans = learned(context=torch.randint(25, shape, generator=seeded(2)))
    prior = MarkovPrior(3, 1, num_contexts=25)
    found = load_for(saved(tmp_path, prior, plans), "maze", 3, ("down", "up", "right"))
    assert (found.context_per, found.num_contexts) == (per, 25)
    some, seen = every_plan(3, 3), torch.randint(25, (27,) if per == "plan" else (27, 3), generator=seeded(3))
    there = Plans(torch.tensor([2, 0, 1])[some], 3, context=seen)
    torch.testing.assert_close(found.log_prob(Plans(some, 3, context=seen)), prior.log_prob(there))


def test_a_planner_takes_it(tmp_path):
    names = ("left", "down", "right", "up")
    world = gridworld(5, 5)
    assert set(names) == set(world.action_names)
    plans = Plans(torch.zeros(20, 4, dtype=torch.long), 4, action_names=names)  # always left
    found = load_for(saved(tmp_path, MarkovPrior(4, 1), plans), "grid", 4, world.action_names)
    drawn, _ = sample_in_world(found, world, world.reset(3, seeded(0)), 50, 4, generator=seeded(0))
    left = world.action_names.index("left")
    assert float((drawn == left).double().mean()) > 0.7
    decision = SamplingPlanner(found, 4, 20).plan(world, world.reset(3, seeded(0)), seeded(0))
    assert decision.plan.shape == (3, 4)


def test_what_has_no_names_is_taken_by_number(tmp_path):
    for names, of_world in ((None, ("a", "b", "c")), (NAMES, None)):
        prior = MarkovPrior(3, 1)
        found = load_for(saved(tmp_path, prior, learned(names)), "maze", 3, of_world)
        torch.testing.assert_close(found.log_prob(every_plan(3, 3)), prior.log_prob(every_plan(3, 3)))


def test_what_does_not_fit_is_named(tmp_path):
    folder = saved(tmp_path, MarkovPrior(3, 1), learned())
    with refuses(folder, "knows 3 actions", "taxi has 6"):
        load_for(folder, "taxi", 6, None)
    with refuses(folder, "'on'", "world maze", "up, right, down"):
        load_for(folder, "maze", 3, ("up", "on", "down"))
    with refuses("nowhere", error=FileNotFoundError):
        load_for(str(tmp_path / "nowhere"), "maze", 3, None)
    ends = save(MarkovPrior(4, 1).fit(learned().with_end()), tmp_path / "ends")
    with refuses("ends", "end symbol", "--data.end"):
        load_for(str(ends), "maze", 4, None)
    with pytest.raises(NotImplementedError):
        load_for(folder, "maze", 3, NAMES[::-1]).fit(learned())
