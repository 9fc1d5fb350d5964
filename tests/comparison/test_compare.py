"""`compare`, in worlds whose scores are known: exact, by closed forms, or whatever a planner claims."""

import random
import sys
from functools import partial

import numpy as np
import pytest
import torch

import neuroprior
from neuroprior import GRUPrior, MarkovPrior, SamplingPlanner, TabularWorld, World, compare, gridworld, load, save
from neuroprior.comparison import Row, experiment
from neuroprior.comparison.contestants import fit_markov, fit_prior, learns, make_planner
from neuroprior.comparison.trial import Design, draw_starts, run_seed, training_plans, true_scores
from neuroprior.planners import Decision, Planner
from neuroprior.worlds import Categories, EpisodicWorld, from_simulator
from tests.support import simulators
from tests.support.sources import refuses, seeded

LENGTH = 4
"""Actions on the only path to the goal of `path_world`."""

QUICK = {"length": LENGTH, "starts": 40, "training_starts": 40, "seeds": 6, "seconds": None, "progress": False}


def path_world():
    """Cells 0 to 4 in a row: action 1 goes on and action 0 falls into cell 5, for ever; cell 4 is the goal."""
    ahead = torch.tensor([1, 2, 3, 4, 4, 5])
    back = torch.tensor([5, 5, 5, 5, 4, 5])
    reward = torch.zeros(6, 2)
    reward[3, 1] = 1.0
    ended = torch.tensor([False, False, False, False, True, True])
    return EpisodicWorld(torch.stack([back, ahead], 1), reward, None, starts=torch.eye(6)[0], ended=ended)


class Fixed:
    """A prior whose action does not depend on anything before it."""

    def __init__(self, *logits):
        self.num_actions, self.logits = len(logits), torch.tensor(logits)

    def start(self, batch_size):
        return self.logits.expand(batch_size, -1), torch.zeros(batch_size, 1)

    def step(self, action, state):
        return self.logits.expand(len(action), -1), state


def test_scores_are_those_of_the_closed_form():
    """One of 16 plans reaches the goal. 240 decisions at 5 standard errors: a false alarm in 2 million."""
    priors = {"perfect": Fixed(0.0, 60.0)}
    comparison = compare(path_world(), priors, ["sampling"], [4, 16], **QUICK, generator=seeded(0))
    q = 1 / 2**LENGTH
    for row in comparison.rows:
        p = 1.0 if row.prior == "perfect" else 1 - (1 - q) ** row.budget
        error = (p * (1 - p) / 240) ** 0.5
        assert row.mean_score == pytest.approx(p, abs=5 * error + 1e-12)
        assert row.model_steps == row.budget * LENGTH
        # The interval is of 95 %, for this seed; the mean of random plans is q.
        assert row.low - 1e-6 <= (p - q) / (1 - q) <= row.high + 1e-6 or row.prior == "perfect"
        assert row.prior == "uniform" or row.score == pytest.approx(1.0)
    assert [row.p < 0.01 for row in comparison.rows if row.prior == "perfect"] == [True, True]
    assert comparison.scale == "the optimum"


class Noisy(World):
    """Whatever is done, a reward of mean 0 and standard deviation 10."""

    num_actions, stochastic = 3, True

    def reset(self, batch_size, generator=None):
        return torch.rand(batch_size, 1, generator=generator)

    def step(self, state, action, generator=None):
        return state, 10 * torch.randn(len(action), generator=generator)


def test_what_the_best_of_many_got_by_luck_is_no_score_in_a_noisy_world():
    """Over 160 starts of 64 rollouts of 4 steps the mean has a standard deviation of 20 / sqrt(10240) = .2."""
    world = Noisy()
    planner = SamplingPlanner(neuroprior.UniformPrior(3), 4, 256)
    planner.keep_candidates = True
    decision = planner.plan(world, world.reset(160), seeded(0))
    assert decision.candidates.scores.amax(1).mean() > 3
    assert abs(decision.score.mean()) < 1.2
    comparison = compare(world, ["uniform"], ["sampling"], [256], **QUICK | {"seeds": 4}, generator=seeded(0))
    assert abs(comparison.rows[0].mean_score) < 1.2
    assert comparison.scale == "the best score found"


def test_a_noisy_table_is_scored_exactly():
    """Action 0 gives 1 with probability .3, action 1 gives .5 with probability .5."""
    outcomes = torch.zeros(1, 2, 2, dtype=torch.long)
    reward = torch.tensor([[[1.0, 0.0], [0.5, 0.0]]])
    world = TabularWorld(outcomes, reward, probability=torch.tensor([[[0.3, 0.7], [0.5, 0.5]]]))
    world.objective = "return"
    plans = torch.tensor([[[0, 0, 1], [1, 1, 1]]])
    assert true_scores(world, torch.tensor([0]), plans, 0)[0].tolist() == pytest.approx([0.85, 0.75])


class Boastful(Planner):
    """Does nothing but action 0, and says that it is worth a million."""

    def __init__(self, prior, length, num_plans, steps=1, **goal):
        super().__init__(**goal)
        self.length, self.steps = length, steps

    def plan(self, world, state, generator=None):
        plan = torch.zeros(len(state), self.length, dtype=torch.long)
        return Decision(plan, torch.full((len(state),), 1e6), state, self.steps)


def test_planners_are_scored_by_what_they_reach_within_their_budget():
    comparison = compare(path_world(), ["uniform"], [Boastful], [2], **QUICK, generator=seeded(0))
    assert comparison.rows[0].mean_score == 0
    assert comparison.rows[0].planner == "Boastful"
    with refuses("`planners` must take at most 8 simulator steps", "got 9 of greedy"):
        compare(path_world(), ["uniform"], {"greedy": partial(Boastful, steps=9)}, [2], **QUICK)


def test_jobs_do_not_change_the_result(monkeypatch):
    """Also where the world is a class that only this module has."""
    monkeypatch.setattr(experiment, "WORKER_SECONDS", 0.0)
    how = QUICK | {"seeds": 3, "starts": 8}
    frames = [
        compare(Line(), ["markov"], ["sampling"], [2, 4], **how, jobs=jobs, generator=seeded(7)).frame()
        for jobs in (1, 2)
    ]
    assert frames[0].equals(frames[1])
    assert not frames[0].equals(
        compare(Line(), ["markov"], ["sampling"], [2, 4], **how, jobs=1, generator=seeded(8)).frame()
    )


class Line(World):
    """Numbers, which action 1 increases and action 0 decreases; large ones are good."""

    num_actions = 2

    def reset(self, batch_size, generator=None):
        return torch.rand(batch_size, generator=generator)

    def step(self, state, action, generator=None):
        after = state + 0.1 * (2 * action - 1)
        return after, after


class Fork(Line):
    """A third action, which does as the second."""

    num_actions = 3


def test_more_seeds_keep_the_first():
    first, more = (
        compare(Line(), ["markov"], ["sampling"], [2], **QUICK | {"seeds": seeds}, generator=seeded(0))
        for seeds in (2, 3)
    )
    assert np.array_equal(first.outcomes[1].scores, more.outcomes[1].scores)
    assert not np.array_equal(first.outcomes[0].scores, first.outcomes[1].scores)


def test_a_frame_has_a_row_for_each_contestant():
    comparison = compare(Line(), ["markov"], ["sampling", "mcts"], [2, 4], **QUICK, generator=seeded(0))
    frame = comparison.frame()
    assert list(frame.columns) == list(Row._fields)
    assert len(frame) == 2 * 2 * 2
    assert frame[frame["prior"] == "uniform"]["p"].isna().all()
    assert (frame[frame["prior"] != "uniform"]["p_holm"] >= frame[frame["prior"] != "uniform"]["p"]).all()


def test_time_limits_the_seeds_and_the_first_is_always_finished():
    comparison = compare(path_world(), ["markov"], ["sampling"], [2], **QUICK | {"seconds": 1e-9}, generator=seeded(0))
    assert len(comparison.outcomes) == 1
    assert any(note.startswith("Time for 1 of 6 seeds") for note in comparison.notes)
    assert "how much a prior varies" in str(comparison)
    design = Design(path_world(), None, {"uniform": "uniform"}, {"sampling": "sampling"}, (2,), 4, 8, 20, 16)
    assert run_seed(0, design, start_by=0.0) is None


def test_an_interrupt_returns_the_finished_seeds(monkeypatch):
    begun = []

    def interrupted(number, *args, **options):
        begun.append(number)
        if len(begun) == stop:
            raise KeyboardInterrupt
        return run_seed(number, *args, **options)

    monkeypatch.setattr(experiment, "run_seed", interrupted)
    stop = 3
    comparison = compare(path_world(), ["markov"], ["sampling"], [2], **QUICK, jobs=1, generator=seeded(0))
    assert len(comparison.outcomes) == 2
    assert "Interrupted after 2 of 6 seeds." in comparison.notes
    begun.clear()
    stop = 1
    with pytest.raises(KeyboardInterrupt):
        compare(path_world(), ["markov"], ["sampling"], [2], **QUICK, jobs=1, generator=seeded(0))


def test_progress_goes_to_standard_error_at_once(capsys):
    compare(path_world(), ["markov"], ["sampling"], [2], **QUICK | {"progress": True, "seeds": 2}, generator=seeded(0))
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[0].startswith("compare: priors uniform, markov; planners sampling")
    assert "2 of 2 seeds" in err
    compare(path_world(), ["markov"], ["sampling"], [2], **QUICK, generator=seeded(0))
    assert capsys.readouterr().err == ""


def test_priors_that_have_learned_are_compared_as_they_are(tmp_path):
    ahead = MarkovPrior(2, 0).fit(torch.ones(50, LENGTH, dtype=torch.long))
    saved = load(save(ahead, tmp_path / "ahead"))
    untaught = MarkovPrior(2, 1)
    assert not learns(saved)
    assert learns(untaught)
    assert learns(GRUPrior)
    assert learns("markov")
    assert not learns("uniform")
    assert fit_prior(saved, None, 2, seeded(0)) is saved
    priors = {"saved": saved, "untaught": untaught, "function": lambda actions: MarkovPrior(actions, 0)}
    comparison = compare(path_world(), priors, ["sampling"], [64], **QUICK, generator=seeded(0))
    assert comparison.priors == ("uniform", "saved", "untaught", "function")
    assert all(row.mean_score > 0.95 for row in comparison.rows)
    assert not untaught.has_learned


def test_the_order_of_a_markov_prior_is_chosen():
    """Plans that alternate need order 1; independent actions need none. Of 400 plans the choice is certain enough."""
    first = torch.randint(2, (400, 1), generator=seeded(0))
    alternating = (first + torch.arange(6)) % 2
    assert fit_markov(neuroprior.Plans(alternating, 2), seeded(0)).order >= 1
    independent = torch.multinomial(torch.tensor([0.8, 0.2]), 2400, True, generator=seeded(0)).view(400, 6)
    assert fit_markov(neuroprior.Plans(independent, 2), seeded(0)).order == 0


def test_starts_are_held_out():
    design = Design(gridworld(6, 6, seed=0), None, {}, {}, (1,), 3, 10, 60, 16)
    training, held_out, same = draw_starts(design, seeded(0))
    assert (len(training), len(held_out), same) == (60, 10, False)
    assert not set(training.tolist()) & set(held_out.tolist())
    design = Design(path_world(), None, {}, {}, (1,), 3, 10, 60, 16)
    training, held_out, same = draw_starts(design, seeded(0))
    assert training.tolist() == [0] * 60
    assert held_out.tolist() == [0] * 10
    assert same


def test_only_plans_better_than_random_are_learned_from():
    """A single plan from each start reaches the goal from one in 16 of 600: 37, with a standard deviation of 6."""
    design = Design(path_world(), None, {}, {}, (1,), LENGTH, 10, 600, 1)
    plans = training_plans(design, torch.zeros(600, dtype=torch.long), seeded(0))
    assert plans is not None
    assert 20 <= len(plans) < 67
    assert (plans.actions == 1).all()
    assert training_plans(design, torch.zeros(19, dtype=torch.long), seeded(0)) is None
    barren = gridworld(4, 4, seed=0)
    barren.reward.zero_()
    comparison = compare(barren, ["markov"], ["sampling"], [2], **QUICK, generator=seeded(0))
    assert comparison.summary().startswith("Nothing to compare")
    assert any("Priors learned nothing: fewer than 20 of 40" in note for note in comparison.notes)
    assert comparison.frame()["score"].isna().all()
    assert "uniform  -" in str(comparison)


def test_observations_are_contexts_only_if_the_world_declares_them():
    """In cell s action s % 2 leads on to the next cell of a ring, and the other back; a step on gives 1."""
    cells = torch.arange(8)
    ahead, back, even = (cells + 1) % 8, (cells - 1) % 8, cells % 2 == 0
    next_state = torch.stack([torch.where(even, ahead, back), torch.where(even, back, ahead)], 1)
    world = TabularWorld(next_state, torch.stack([even.float(), (~even).float()], 1))
    world.objective, world.observation = "return", None
    design = Design(world, None, {}, {}, (1,), 6, 10, 60, 64)
    state = torch.zeros(60, dtype=torch.long)
    blind = training_plans(design, state, seeded(0))
    assert blind is not None
    assert blind.context is None
    world.observation = Categories(8)
    plans = training_plans(design, state, seeded(0))
    assert plans is not None
    assert plans.context is not None
    assert plans.context[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert fit_markov(plans, seeded(0)).num_contexts == 8  # cells 6 and 7 were not seen
    comparison = compare(world, ["markov"], ["sampling"], [2], **QUICK | {"length": 6}, generator=seeded(0))
    assert comparison.rows[1].score > comparison.rows[0].score + 0.3


def test_stochastic_worlds_are_left_to_planners_that_can_plan_there():
    comparison = compare(Noisy(), ["uniform"], budgets=[4], **QUICK | {"seeds": 2}, generator=seeded(0))
    assert comparison.planners == ("sampling",)
    assert any("frontier, mcts cannot plan" in note for note in comparison.notes)
    still = compare(Fork(), ["uniform"], budgets=[4], held_out=Noisy(), **QUICK | {"seeds": 2}, generator=seeded(0))
    assert still.planners == ("sampling",)
    with refuses("`planners` must have one for stochastic worlds"):
        compare(Noisy(), ["uniform"], ["mcts"], [4], **QUICK)
    for budget in (1, 2, 16, 256):
        planner = make_planner("sampling", Fixed(0.0, 0.0, 0.0), 5, budget)
        assert isinstance(planner, SamplingPlanner)
        assert 0 < planner.model_steps(Noisy()) <= budget * 5


def test_the_random_state_of_the_caller_stays():
    compare(path_world(), ["gru"], ["sampling"], [2], **QUICK | {"seeds": 1})  # what is imported may draw
    before = torch.get_rng_state(), random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    compare(path_world(), ["gru"], ["sampling"], [2], **QUICK | {"seeds": 1})
    after = torch.get_rng_state(), random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    assert torch.equal(before[0], after[0])
    assert before[1:] == after[1:]


def test_other_worlds_may_be_held_out():
    """In the other world action 0 leads to the goal, which a prior from this one does not propose."""
    other = path_world()
    other.next_state = other.next_state.flip(1)
    other.reward = other.reward.flip(2)
    comparison = compare(path_world(), ["markov"], ["sampling"], [16], held_out=other, **QUICK, generator=seeded(0))
    uniform, markov = comparison.rows
    assert markov.mean_score < 0.1 < uniform.mean_score
    assert markov.difference_high < 0
    assert "markov harms it" in comparison.summary()


BAD = [
    ({"world": "grid"}, ("`world` must be a World",)),
    ({"priors": "gru"}, ("`priors` must be a list",)),
    ({"priors": []}, ("`priors` must have at least one",)),
    ({"priors": ["lstm"]}, ("`priors` must be among combined, uniform", "'lstm'")),
    ({"priors": [MarkovPrior(3, 1)]}, ("`priors` must have the world's 2 actions", "3")),
    ({"priors": ["gru", GRUPrior]}, ("`priors` must have different names", "gru")),
    ({"priors": [7]}, ("`priors` must be names, priors, classes or functions",)),
    ({"priors": {"uniform": "gru"}}, ("`priors` must be named otherwise",)),
    ({"planners": ["best"]}, ("`planners` must be among sampling, frontier, mcts", "'best'")),
    ({"planners": [3]}, ("`planners` must be names, classes or functions",)),
    ({"budgets": []}, ("`budgets` must be a list",)),
    ({"budgets": [0]}, ("`budgets` must be an integer of at least 1",)),
    ({"length": 0}, ("`length`",)),
    ({"training_starts": 5}, ("`training_starts` must be at least 20",)),
    ({"jobs": 0}, ("`jobs`",)),
    ({"seconds": float("inf")}, ("`seconds` must be above 0",)),
    ({"progress": 1}, ("`progress` must be True or False",)),
    ({"generator": 0}, ("`generator` must be a torch.Generator",)),
    ({"held_out": gridworld(3, 3, seed=0)}, ("`held_out` must have 2 actions",)),
]


@pytest.mark.parametrize(("options", "words"), BAD)
def test_bad_arguments_are_refused_in_a_line(options, words):
    with refuses(*words):
        compare(**{"world": path_world(), **QUICK, **options})


def test_what_a_prior_cannot_learn_is_said_with_its_name():
    def broken(num_actions):
        raise ValueError("no prior today")

    with refuses("seed 1: priors: mine: no prior today"):
        compare(path_world(), {"mine": broken}, ["sampling"], [2], **QUICK)


def test_worlds_that_cannot_be_sent_are_compared_in_one_process(monkeypatch):
    monkeypatch.setattr(experiment, "WORKER_SECONDS", 0.0)
    world = path_world()
    world.file = sys.stderr
    comparison = compare(world, ["markov"], ["sampling"], [2], **QUICK | {"seeds": 2}, jobs=2, generator=seeded(0))
    assert len(comparison.outcomes) == 2
    assert any("one after another" in note for note in comparison.notes)


@pytest.mark.parametrize("simulator", [simulators.Walk, simulators.Walk(), [simulators.Walk(), simulators.Walk()]])
def test_simulators_that_all_begin_alike_are_named(simulator):
    comparison = compare(from_simulator(simulator, 2), ["markov"], ["sampling"], [4], **QUICK | {"seeds": 1})
    assert sum("All starts are the same state" in note for note in comparison.notes) == 1


def test_simulators_that_begin_otherwise_are_held_out():
    comparison = compare(from_simulator(simulators.NoisyStart), ["markov"], ["sampling"], [4], **QUICK | {"seeds": 1})
    assert not any("All starts are the same state" in note for note in comparison.notes)


def test_infinite_losses_are_refused():
    ring = torch.stack([torch.arange(12).roll(-1), torch.arange(12).roll(1)], 1)
    world = TabularWorld(ring, torch.arange(12.0).index_fill(0, torch.tensor([5]), -torch.inf))
    with refuses("its rewards must be finite", "got -inf in the mean", "`legal_actions`"):
        compare(world, ["uniform", "markov"], ["sampling"], [2, 16], **QUICK)
