"""The option planner: how many candidates begin in each mode, and what they are drawn from."""

import itertools

import pytest
import torch

from eval.options.planner import OptionPlanner
from neuroprior import TabularWorld, UniformPrior
from neuroprior.priors import SwitchingPrior
from neuroprior.testing import check_planner
from tests.support.sources import FALSE_ALARM, every_plan, p_value, plan_number, refuses, seeded

HOW = {"terminal": {}, "prefix": {"any_prefix": True}, "kept": {"terminations": False}, "mixed": {"uniform_share": 0.5}}


def modes_of(**how):
    """A prior of three unlike modes that learned from random plans, over three actions."""
    generator = seeded(0)
    plans = torch.randint(3, (60, 6), generator=generator)
    prior = SwitchingPrior(3, 3, 1, max_iterations=0, **how).fit(plans, generator=generator)
    prior.log_probs = torch.randn(prior.log_probs.shape, generator=generator).log_softmax(-1)
    size = len(prior.first)
    prior.first = torch.rand(size, generator=generator, dtype=torch.double).softmax(0)
    prior.transitions = (2 * torch.randn(1, 3, 3, generator=generator, dtype=torch.double)).softmax(-1)
    return prior


def ring():
    """Every action leads on in a ring of 7; each state pays its number."""
    to = (torch.arange(7)[:, None] + torch.arange(3) + 1) % 7
    return TabularWorld(to, torch.arange(7).float())


def probabilities(prior, first, length, kept):
    """`[A**L]`: the probability of each plan whose first mode is drawn from `first [K]`: summed over all mode paths."""
    plans = every_plan(3, length)
    rows, cells = prior.cells(plans, None)
    total = torch.zeros(len(plans), dtype=torch.double)
    for path in itertools.product(range(3), repeat=length):
        joint = torch.full((len(plans),), float(first[path[0]]), dtype=torch.double)
        for t, mode in enumerate(path):
            if t:
                moved = prior.transitions[cells[:, t], path[t - 1], mode]
                joint *= float(path[t - 1] == mode) if kept else moved
            joint *= prior.log_probs[rows[:, t], mode, plans[:, t]].double().exp()
        total += joint
    return total


@pytest.mark.parametrize("how", HOW.values(), ids=HOW)
def test_it_conforms(how):
    def make(prior, length, number):
        # So many pseudo-counts that all actions are equally probable, as in the prior that it stands for.
        even = SwitchingPrior(prior.num_actions, 2, 0, smoothing=1e9, max_iterations=0)
        return OptionPlanner(even.fit(every_plan(prior.num_actions, 2), generator=seeded(0)), length, number, **how)

    check_planner(make)


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("mode", [0, 1, 2])
def test_candidates_of_a_mode_are_drawn_from_its_exact_distribution(mode, kept):
    """Chi-square tests, each with a false-alarm probability of 1e-6."""
    prior = modes_of()
    planner = OptionPlanner(prior, 3, 30, terminations=not kept)
    plans, _, _ = planner.candidates(ring(), torch.zeros(1000, dtype=torch.long), seeded(mode))
    own = plan_number(plans[:, mode::3], 3)
    for number, first in enumerate(torch.eye(3)):
        agrees = p_value(own, probabilities(prior, first, 3, kept)) > FALSE_ALARM
        assert agrees == (number == mode)


def certain():
    """Mode k only takes action k, and is left for the next one with certainty."""
    prior = modes_of()
    prior.log_probs = torch.eye(3).clamp(min=1e-30).log().expand_as(prior.log_probs).contiguous()
    prior.transitions = torch.eye(3, dtype=torch.double).roll(1, 1)[None]
    return prior


@pytest.mark.parametrize("number", [1, 2, 3, 7, 12])
@pytest.mark.parametrize("legal", [False, True], ids=["blind", "in the world"])
def test_equally_many_begin_in_each_mode(number, legal):
    """By turns, and of the remainder one each in the first modes; from there each mode is left, or kept."""
    world = ring()
    if legal:  # a state where not all is legal, which is never reached, has candidates drawn step by step
        world = TabularWorld(
            torch.cat([world.next_state, torch.zeros(1, 3, dtype=torch.long)]),
            torch.arange(8).float(),
            torch.tensor([[True] * 3] * 7 + [[True, False, False]]),
        )
    state, turn = torch.arange(5), torch.arange(number)
    for ends in (True, False):
        planner = OptionPlanner(certain(), 4, number, terminations=ends)
        plans, score, final = planner.candidates(world, state, seeded(0))
        expected = (turn[:, None] + ends * torch.arange(4)) % 3
        assert plans.equal(expected.expand(5, -1, -1).to(plans.dtype))
        end = (state[:, None] + (expected + 1).sum(1)) % 7
        assert final.equal(end)
        assert score.equal(end.float())


def test_uniform_plans_are_none_of_the_modes():
    planner = OptionPlanner(certain(), 4, 8, uniform_share=0.5)
    plans, _, _ = planner.candidates(ring(), torch.zeros(200, dtype=torch.long), seeded(1))
    assert plans[:, :4, 0].equal((torch.arange(4) % 3).expand(200, -1).to(plans.dtype))
    assert p_value(plan_number(plans[:, 4:, :2], 3), torch.full((9,), 1 / 9)) > FALSE_ALARM


@pytest.mark.parametrize("phases", [1, 2])
def test_beginning_in_a_mode(phases):
    """What it learned stays as it was; the first mode is certain, in the phases that are probable there."""
    prior = modes_of(phases=phases)
    before = {name: values.clone() for name, values in prior.state_dict().items()}
    for mode in range(3):
        begun = prior.beginning_in(mode)
        first = begun.first.view(3, phases)
        assert first.sum(1).tolist() == pytest.approx([float(k == mode) for k in range(3)])
        assert torch.allclose(first[mode], prior.first.view(3, phases)[mode] / prior.first.view(3, phases)[mode].sum())
        kept = prior.beginning_in(mode, keep=True)
        path = kept.posterior(torch.randint(3, (20, 6), generator=seeded(1))).path
        assert (path == mode).all()
    assert all(prior.state_dict()[name].equal(values) for name, values in before.items())
    assert prior.switching == "context"
    prior.first = prior.first.view(3, phases).index_fill(0, torch.tensor(2), 0.0).flatten()
    first = prior.beginning_in(2).first  # in a mode that is never the first, all phases are as probable
    assert first.tolist() == pytest.approx([0.0] * 2 * phases + [1 / phases] * phases)


def test_priors_and_modes_that_do_not_fit():
    with refuses("`prior` must be a SwitchingPrior, got UniformPrior"):
        OptionPlanner(UniformPrior(3), 4, 8)
    for mode in (3, -1, 0.5):
        with refuses("mode"):
            modes_of().beginning_in(mode)
