"""The switching prior against enumeration of all mode paths, a plain Baum-Welch, and sources whose modes are known."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import nbinom

from neuroprior import Plans
from neuroprior.priors import SwitchingPrior
from neuroprior.priors.switching.mode_chains import ModeChains
from neuroprior.testing import check_prior
from tests.support.sources import refuses, seeded

SHORT = {"restarts": 1, "max_iterations": 10}
"""Of a prior that may be any: what is asked of it does not depend on how well it has learned."""

STICKY = torch.tensor([[0.9, 0.1], [0.2, 0.8]], dtype=torch.double)
"""Transitions of the source of two modes."""


def some_plans(seed=0, num=40, length=6, actions=3, contexts=None):
    generator = seeded(seed)
    context = None if contexts is None else torch.randint(contexts, (num, length), generator=generator)
    return Plans(torch.randint(actions, (num, length), generator=generator), actions, context=context)


def switching_source(num, length, seed=0, matrix=STICKY):
    """Plans of two modes, 0 1 2 0 1 2 ... and 2 1 0 2 1 0 ..., a fifth of the actions random; and their modes."""
    rng = np.random.default_rng(seed)
    modes, actions = np.zeros((num, length), dtype=int), np.zeros((num, length), dtype=int)
    mode, action = rng.integers(2, size=num), rng.integers(3, size=num)
    for t in range(length):
        modes[:, t], wild = mode, rng.random(num) < 0.2
        action = np.where(wild, rng.integers(3, size=num), (action + np.where(mode == 0, 1, 2)) % 3)
        actions[:, t] = action
        mode = np.where(rng.random(num) < np.asarray(matrix)[mode, 0], 0, 1)
    return torch.from_numpy(actions), torch.from_numpy(modes)


def enumerated(prior, plans):
    """Of each plan its likelihood, the probabilities of the mode of each action, and the best path: over all paths."""
    rows, cells = prior.cells(plans.actions, plans.context)
    num, length = plans.actions.shape
    where = torch.tensor(list(itertools.product(range(prior.num_modes), repeat=length)))
    joint, each = torch.ones(num, len(where), dtype=torch.double), torch.arange(num)[:, None]
    for t, mode in enumerate(where.T):
        before = prior.first[mode] if t == 0 else prior.transitions[cells[:, t]][each, where[:, t - 1], mode]
        log_probs = prior.log_probs[rows[:, t]][each, mode, plans.actions[:, t].long()[:, None]]
        joint *= before * log_probs.double().exp()
    smoothed = torch.stack([(joint[:, :, None] * (where == k)).sum(1) for k in range(prior.num_modes)], -1)
    pairs = torch.nn.functional.one_hot(where[:, :-1] * prior.num_modes + where[:, 1:], prior.num_modes**2).sum(1)
    moves = (joint @ pairs.double() / joint.sum(1)[:, None]).view(num, prior.num_modes, prior.num_modes)
    return joint.sum(1), smoothed / joint.sum(1)[:, None, None], where[joint.argmax(1)], moves


@pytest.mark.parametrize(
    ("contexts", "order", "switching"),
    [(None, 0, "context"), (None, 1, "context"), (4, 0, "context"), (4, 2, "context"), (4, 1, "constant")],
)
def test_inference_equals_enumeration(contexts, order, switching):
    plans, how = some_plans(contexts=contexts), {"smoothing": 0.5, "switching": switching}
    prior = SwitchingPrior(3, 3, order, contexts, **how, **SHORT).fit(plans, generator=seeded(0))
    assert len(prior.transitions) == (1 if switching == "constant" else contexts or 1)
    some = plans[:8]
    likelihood, smoothed, path, moves = enumerated(prior, some)
    torch.testing.assert_close(prior.log_prob(some).double(), likelihood.log(), atol=2e-6, rtol=0)
    found = prior.posterior(some)
    torch.testing.assert_close(found.smoothed, smoothed, atol=1e-6, rtol=0)
    assert found.path.equal(path)
    torch.testing.assert_close(found.moves, moves, atol=1e-6, rtol=0)
    cut = replace(some, lengths=torch.tensor([6, 1, 6, 3, 2, 5, 0, 4]))
    short = replace(
        cut, lengths=None, actions=some.actions[:, :3], context=None if contexts is None else some.context[:, :3]
    )
    torch.testing.assert_close(prior.posterior(cut).moves[3], enumerated(prior, short)[3][3], atol=1e-6, rtol=0)
    assert prior.posterior(cut).moves.sum((1, 2)).round().tolist() == [5, 0, 5, 2, 1, 4, 0, 3]
    for t in range(1, 7):  # what is known after t actions is what whole plans of t actions say
        short = replace(some, actions=some.actions[:, :t], context=None if contexts is None else some.context[:, :t])
        torch.testing.assert_close(found.filtered[:, t - 1], enumerated(prior, short)[1][:, -1], atol=1e-6, rtol=0)


def baum_welch(sequences, first, moves, emit, iterations):
    """The formulas of Rabiner 1989, section III.C, in plain loops."""
    for _ in range(iterations):
        new_first, new_moves, new_emit = np.zeros_like(first), np.zeros_like(moves), np.zeros_like(emit)
        for actions in sequences:
            length = len(actions)
            alpha, beta = np.zeros((length, len(first))), np.ones((length, len(first)))
            alpha[0] = first * emit[:, actions[0]]
            for t in range(1, length):
                alpha[t] = alpha[t - 1] @ moves * emit[:, actions[t]]
            for t in range(length - 2, -1, -1):
                beta[t] = moves @ (emit[:, actions[t + 1]] * beta[t + 1])
            gamma = alpha * beta / alpha[-1].sum()
            new_first += gamma[0]
            for t in range(length):
                new_emit[:, actions[t]] += gamma[t]
                if t:
                    new_moves += np.outer(alpha[t - 1], emit[:, actions[t]] * beta[t]) * moves / alpha[-1].sum()
        first, moves, emit = (x / x.sum(-1, keepdims=True) for x in (new_first, new_moves, new_emit))
    return first, moves, emit


def test_em_is_that_of_baum_and_welch():
    actions = switching_source(30, 20)[0]
    rng = np.random.default_rng(1)
    start = rng.dirichlet(np.ones(2)), rng.dirichlet(np.ones(2), 2), rng.dirichlet(np.ones(3), 2)
    prior = SwitchingPrior(3, 2, order=0, smoothing=0, stay=0, sharing=0, folds=1, max_iterations=7, tolerance=0)
    prior.learn(*prior.count(actions))
    prior.first.copy_(torch.from_numpy(start[0]))
    prior.transitions[0] = torch.from_numpy(start[1])
    prior.log_probs[:] = torch.from_numpy(start[2]).log()
    prior.fit(actions, warm_start=True)
    expected = baum_welch(actions.tolist(), *start, iterations=7)
    found = prior.first, prior.transitions[0], prior.log_probs[0].exp()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one.numpy(), other, atol=1e-6)


def test_first_modes_and_transitions_are_smoothed():
    """One iteration, by expected numbers over all paths: `smoothing` counts in all for the first mode and for each row.

    The rows in a context are those of all contexts in advance, and these stay where they are in advance.
    """
    plans, smoothing, stay = some_plans(num=12, length=4, contexts=2), 3.0, 2.0
    how = {"order": 0, "num_contexts": 2, "smoothing": smoothing, "stay": stay, "restarts": 1}
    prior = SwitchingPrior(3, 3, **how, max_iterations=1).fit(plans, generator=seeded(0))
    likelihood, smoothed, *_ = enumerated(prior, plans)
    rows, cells = prior.cells(plans.actions, plans.context)
    moved = torch.zeros(2, 3, 3, dtype=torch.double)
    for path in itertools.product(range(3), repeat=4):
        joint = prior.first[path[0]] / likelihood
        for t, mode in enumerate(path):
            joint = joint * prior.log_probs[rows[:, t], mode, plans.actions[:, t].long()].double().exp()
            joint = joint * (prior.transitions[cells[:, t], path[t - 1], mode] if t else 1)
        for t in range(1, 4):
            moved[:, path[t - 1], path[t]].index_add_(0, cells[:, t], joint)
    first = smoothed[:, 0].sum(0) + smoothing / 3
    everywhere = moved.sum(0) + stay * torch.eye(3)
    each = moved + smoothing * everywhere / everywhere.sum(1, keepdim=True)
    prior.fit(plans, warm_start=True)
    torch.testing.assert_close(prior.first, first / first.sum(), atol=1e-6, rtol=0)
    torch.testing.assert_close(prior.transitions, each / each.sum(2, keepdim=True), atol=1e-6, rtol=0)


def test_em_takes_all_its_iterations():
    """Of 24 those of the restarts are the first 8; the prior after 8 goes on to that of 16 and of 24."""
    modes = switching_source(30, 20)[1]
    actions = torch.where(torch.rand(30, 20, generator=seeded(1)) < 0.7, modes, 2)

    def fitted(iterations, more=0):
        how = {"order": 0, "folds": 1, "restarts": 1, "tolerance": 0.0, "smoothing": 0.5}
        prior = SwitchingPrior(3, 2, **how, max_iterations=iterations).fit(actions, generator=seeded(0))
        prior.max_iterations = more
        return prior.fit(actions, warm_start=True).transitions

    whole = fitted(24)
    torch.testing.assert_close(fitted(8, 16), whole, atol=1e-5, rtol=0)
    assert (fitted(8, 8) - whole).abs().max() > 1e-3


def test_long_sequences_are_inferred_in_chunks_as_in_steps():
    actions = switching_source(2, 700)[0]
    prior = SwitchingPrior(3, 2, **SHORT).fit(actions, generator=seeded(0))
    logits, state = prior.start(2)
    found = []
    for t in range(700):
        found.append(logits.log_softmax(-1).gather(1, actions[:, t, None])[:, 0])
        logits, state = prior.step(actions[:, t], state)
    torch.testing.assert_close(prior.action_log_probs(actions), torch.stack(found, 1), atol=1e-5, rtol=0)
    # one by one, where a chunk is shorter still
    whole, single = prior.posterior(actions), [prior.posterior(actions[i : i + 1]) for i in range(2)]
    for what in range(3):
        torch.testing.assert_close(whole[what], torch.cat([one[what] for one in single]), atol=1e-9, rtol=0)


def prior_row(prior, action):
    """The row of the table after one action, in the middle of a plan."""
    return prior.cells(torch.tensor([[0, 0, action, 0]]), None)[0][0, 3]


def test_one_mode_is_the_chain_that_its_docstring_says():
    plans = some_plans(num=30, length=8)
    prior = SwitchingPrior(3, 1, 1, smoothing=2.0, sharing=0.3).fit(plans)
    counts, after = torch.zeros(3), torch.zeros(3, 3)
    for row in plans.actions.tolist():
        for t, action in enumerate(row):
            counts[action] += 1
            if t:
                after[row[t - 1], action] += 1
    all_modes = (counts + 2 * 3 / 3) / (counts.sum() + 2 * 3)
    lower = (counts + 2 * 3 * all_modes) / (counts.sum() + 2 * 3)
    whole = (after + 2 * 3 * all_modes) / (after.sum(1, keepdim=True) + 2 * 3)
    expected = (after + 2 * 3 * (0.7 * lower + 0.3 * whole)) / (after.sum(1, keepdim=True) + 2 * 3)
    for action in range(3):
        torch.testing.assert_close(prior.log_probs[prior_row(prior, action), 0].exp(), expected[action])


@pytest.mark.parametrize("sharing", [0.0, 0.25, 1.0])
def test_a_mode_does_in_strange_places_what_the_others_do(sharing):
    """The mode of 0 1 0 1 never met 2: there it does what the others do, as far as `sharing` says."""
    actions = torch.tensor([[0, 1] * 10, [2, 3] * 10] * 20)
    prior = SwitchingPrior(4, 2, 1, sharing=sharing, smoothing=1.0, stay=0, folds=1, max_iterations=1)
    prior.learn(*prior.count(actions))
    prior.transitions[0] = torch.eye(2)
    prior.log_probs[:] = torch.tensor([[0.5, 0.5, 1e-30, 1e-30], [1e-30, 1e-30, 0.5, 0.5]]).log()
    prior.fit(actions, warm_start=True)
    of_first = prior.log_probs[prior_row(prior, 2), 0].exp()
    alone, together = (200 + 1.0) / 404 / 2, 1.0  # 3 without history: hardly ever; all modes after 2: always
    assert float(of_first[3]) == pytest.approx(sharing * together, abs=0.02)
    assert float(of_first[0]) == pytest.approx((1 - sharing) * 2 * alone, abs=0.02)


def test_groups_are_not_divided_between_folds():
    actions = switching_source(20, 30)[0]
    one, two = (Plans(actions, 3, group=torch.arange(20) % number) for number in (1, 2))
    fitted = [
        SwitchingPrior(3, 2, folds=folds, **SHORT).fit(plans, generator=seeded(0))
        for plans in (one, two)
        for folds in (1, 4)
    ]
    assert fitted[0].log_probs.equal(fitted[1].log_probs)  # one group is one fold
    assert not fitted[2].log_probs.allclose(fitted[3].log_probs, atol=1e-4)


def test_phases_make_durations_negative_binomial():
    """Two modes that always do the same: runs of actions are durations, of three phases each left with chance 1/4."""
    runs = nbinom(3, 0.25).rvs((60, 40), random_state=0) + 3  # failures, and the three that end it
    actions = torch.stack([torch.arange(40).repeat_interleave(torch.from_numpy(row))[:200] % 2 for row in runs])
    prior = SwitchingPrior(2, 2, 0, phases=3, smoothing=1e-3).fit(actions, generator=seeded(0))
    assert prior.transitions[0].diagonal().tolist() == pytest.approx([0.75, 0.75], abs=0.02)
    geometric = SwitchingPrior(2, 2, 0, smoothing=1e-3).fit(actions, generator=seeded(0))
    assert float(prior.log_prob(actions).mean()) > float(geometric.log_prob(actions).mean()) + 5


@pytest.mark.parametrize("contexts", [None, 4])
def test_the_most_probable_path_ends_with_the_plan(contexts):
    # Beyond the end a path would have gained by being in a mode that lasts.
    plans = some_plans(contexts=contexts)
    prior = SwitchingPrior(3, 2, 1, contexts, smoothing=0.5, **SHORT).fit(plans, generator=seeded(0))
    prior.transitions[:] = STICKY.flip(0, 1)
    lengths = torch.arange(40) % 6 + 1
    path = prior.posterior(replace(plans, lengths=lengths)).path
    for length in range(1, 7):
        own = lengths == length
        context = None if contexts is None else plans.context[own, :length]
        cut = replace(plans[own], actions=plans.actions[own, :length], context=context)
        assert path[own, :length].equal(prior.posterior(cut).path)
        assert path[own, :length].equal(enumerated(prior, cut)[2])


def test_modes_are_numbered_by_how_often_they_occur():
    actions, modes = switching_source(60, 100, matrix=torch.tensor([[0.7, 0.3], [0.05, 0.95]]))
    prior = SwitchingPrior(3, 2).fit(actions, generator=seeded(4))
    found = prior.posterior(actions).smoothed.argmax(-1)
    assert (found == 0).double().mean() > 0.6
    assert ((found == 0) == (modes == 1)).double().mean() > 0.8


def test_counting_anew_keeps_the_modes():
    training = switching_source(60, 100)[0]
    prior = SwitchingPrior(3, 2).fit(training, generator=seeded(0))
    before = prior.posterior(training).smoothed
    more = torch.cat([training, switching_source(60, 100, seed=9)[0]])
    after = prior.recount(Plans(more, 3)).posterior(training).smoothed
    assert float((before - after).abs().mean()) < 0.02


def test_going_on_from_nothing_begins():
    # Modes that are all alike would remain so.
    plans = Plans(switching_source(10, 30)[0], 3)
    fitted = SwitchingPrior(3, 2, **SHORT).fit(plans, generator=seeded(0)).log_probs
    assert SwitchingPrior(3, 2, **SHORT).fit(plans, generator=seeded(0), warm_start=True).log_probs.equal(fitted)
    assert SwitchingPrior(3, 2, **SHORT).recount(plans).log_probs.equal(fitted)


@pytest.mark.parametrize("shape", [(0, 5), (4, 0)])
def test_plans_without_actions(shape):
    none = Plans(torch.zeros(shape, dtype=torch.long), 3)
    prior = SwitchingPrior(3, 2).fit(none, generator=seeded(0))
    assert [tuple(values.shape) for values in prior.posterior(none)] == [
        (*shape, 2),
        (*shape, 2),
        shape,
        (shape[0], 2, 2),
    ]
    torch.testing.assert_close(prior.log_prob([[0, 1]]).exp(), torch.tensor([1 / 9]))


def test_what_no_mode_can_do_says_nothing_about_the_modes():
    actions = switching_source(10, 30)[0]
    prior = SwitchingPrior(4, 2, smoothing=0).fit(Plans(actions, 4), generator=seeded(0))
    held_out = torch.randint(4, (10, 20), generator=seeded(4))
    for values in prior.posterior(Plans(held_out, 4))[:2]:
        torch.testing.assert_close(values.sum(-1), torch.ones(10, 20, dtype=torch.double))


@pytest.mark.parametrize(("phases", "contexts"), [(1, None), (2, 3)])
def test_it_is_a_prior(phases, contexts):
    plans = some_plans(contexts=contexts)
    check_prior(SwitchingPrior(3, 2, 2, contexts, phases=phases, max_iterations=10).fit(plans, generator=seeded(0)))


def test_wrong_plans_are_refused():
    prior = SwitchingPrior(3, 2)
    with refuses("actions"):
        prior.fit(some_plans(actions=4))
    with refuses("max_steps"):
        prior.fit(some_plans(), max_steps=3)
    with refuses("context"):
        SwitchingPrior(3, 2, num_contexts=2).fit(some_plans())
    with refuses("actions"):
        prior.posterior(some_plans(actions=4))


@pytest.mark.parametrize(("order", "num_contexts"), [(0, None), (0, 3), (2, None), (2, 3)])
def test_what_occurred_is_expected_as_in_the_whole_table(order, num_contexts):
    """EM needs the probabilities of what occurred alone; counts of a mode may be 0 after some histories."""
    prior = SwitchingPrior(7, 2, order=order, num_contexts=num_contexts)
    context = None if num_contexts is None else torch.randint(3, (9, 6), generator=seeded(1))
    lengths = torch.tensor([6, 1, 3, 5, 2, 6, 4, 0, 6])
    plans = Plans(torch.randint(7, (9, 6), generator=seeded(0)), 7, lengths=lengths, context=context)
    tree, counts = prior.count(plans)
    chains = ModeChains(tree, counts, num_contexts, 7, 0.7, 0.4)
    longest = torch.rand(len(counts.row), 2, generator=seeded(2)).double().round(decimals=1).sub(0.3).clamp(min=0)
    expected = chains.totals(longest)
    found = chains.entry_log_probs(expected)
    torch.testing.assert_close(found, chains.log_probs(expected)[counts.row, :, counts.action])


@pytest.mark.parametrize("contexts", [None, 2])
def test_one_mode_is_a_chain_however_many_phases_it_has(contexts):
    plans = some_plans(contexts=contexts)
    one, three = (SwitchingPrior(3, 1, 1, contexts, phases=phases, **SHORT).fit(plans) for phases in (1, 3))
    torch.testing.assert_close(three.log_prob(plans), one.log_prob(plans))
    check_prior(three)
