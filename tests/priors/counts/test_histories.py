"""The tree of histories against a dictionary of all of them; read in one part or in many; and its limits."""

from collections import Counter

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import ContextTreePrior, MarkovPrior, Plans
from neuroprior.priors.counts import histories
from neuroprior.priors.counts.histories import count_histories
from tests.support.sources import refuses, seeded


@st.composite
def problems(draw):
    num_actions, num, length = draw(st.integers(1, 5)), draw(st.integers(0, 20)), draw(st.integers(0, 8))
    contexts, generator = draw(st.sampled_from([None, 3])), seeded(draw(st.integers(0, 2**31)))
    actions = torch.randint(num_actions, (num, length), generator=generator)
    lengths = torch.randint(length + 1, (num,), generator=generator) if draw(st.booleans()) else None
    context = None
    if contexts:
        shape = draw(st.sampled_from([(num,), (num, length)]))
        context = torch.randint(contexts, shape, generator=generator)
    return Plans(actions, num_actions, lengths, context=context), contexts, draw(st.integers(0, 10))


def dictionary(plans, contexts, depth):
    """How often each action followed each (at a plan's beginning, history, context)."""
    out = Counter()
    for i in range(len(plans)):
        length = plans.max_length if plans.lengths is None else int(plans.lengths[i])
        actions = plans.actions[i, :length].tolist()
        for t, action in enumerate(actions):
            current = 0
            if contexts:
                current = int(plans.context[i] if plans.context.dim() == 1 else plans.context[i, t])
            for k in range(min(t, depth) + 1):
                out[False, tuple(actions[t - k : t]), current, action] += 1
            if t < depth:
                out[True, tuple(actions[:t]), current, action] += 1
    return out


def names(tree, depth):
    """Every node's (at a plan's beginning, history), by walking from the two roots."""
    out = {0: (False, ())}
    if tree.start:
        out[tree.start] = (True, ())
    todo = list(out)
    for node in todo:
        opening, history = out[node]
        for action, after in enumerate(tree.next_node[node].tolist()):
            longer = (*history, action)
            if after not in out and len(longer) <= depth:
                out[after] = (opening and after >= tree.start, longer)
                todo.append(after)
    return out


@settings(max_examples=100, deadline=None, derandomize=True)
@given(problems(), st.sampled_from([1, 7, 2**18]))
def test_the_tree_and_its_counts(problem, at_once):
    plans, contexts, depth = problem
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(histories, "ACTIONS_AT_ONCE", at_once)
        tree, counts = count_histories(plans, depth, contexts, True, torch.device("cpu"))
    truth = dictionary(plans, contexts, depth)
    name = names(tree, depth)
    assert len(name) == len(tree.parent) == len(tree.next_node)
    found = {}
    for row, action, count in zip(counts.row.tolist(), counts.action.tolist(), counts.count.tolist(), strict=True):
        node, current = divmod(int(counts.row_code[row]), contexts or 1)
        found[(*name[node], current, action)] = count
    assert found == dict(truth)
    for node, (opening, history) in name.items():
        if node:
            assert name[int(tree.parent[node])] == (False, history if opening else history[1:])
            assert int(tree.parent[node]) < node


@pytest.mark.parametrize(
    "make", [lambda: MarkovPrior(3, 4, num_contexts=2), lambda: ContextTreePrior(3, 6, num_contexts=2)]
)
def test_read_in_parts(make, monkeypatch):
    """Parts of any size give the same prior, but for the numbering of its histories."""
    generator = seeded(0)
    lengths = torch.randint(10, (300,), generator=generator)
    plans = Plans(torch.randint(3, (300, 9), generator=generator), 3, lengths, context=torch.arange(300) % 2)
    test, current = torch.randint(3, (50, 12), generator=generator), torch.randint(2, (50, 12), generator=generator)
    want, prior = make().fit(plans)(test, current), make()
    depth = getattr(prior, "depth", 4)
    monkeypatch.setattr(histories, "ACTIONS_AT_ONCE", 50)
    prior.learn(*count_histories(plans, depth, 2, True, prior.device))
    torch.testing.assert_close(prior(test, current), want)


@pytest.mark.parametrize("prior", [MarkovPrior(300, 3), ContextTreePrior(300, 3)])
def test_tables_over_the_limit_are_refused(prior):
    prior.max_table_bytes = 10**6
    plans = torch.randint(300, (50, 20), generator=seeded(0))
    with refuses("fewer than 3 actions"):
        prior.fit(plans)
    with refuses("x 300 actions"):
        prior.fit(plans)


def test_rows_of_contexts_over_the_limit_are_refused(monkeypatch):
    plans = Plans(torch.zeros(1_000, 2).long(), 10, context=torch.arange(1_000))
    monkeypatch.setattr(MarkovPrior, "max_table_bytes", 10**5)
    MarkovPrior(10, 1).fit(plans)
    with refuses("histories"):
        MarkovPrior(10, 1, num_contexts=1_000).fit(plans)


@pytest.mark.parametrize("initial", ["joint", "lower"])
@pytest.mark.parametrize(
    ("num_actions", "depth", "length"), [(1, 1, 3), (2, 1, 2), (2, 3, 4), (3, 2, 9), (4, 2, 30), (5, 1, 3)]
)
def test_counted_by_ngrams_or_not_the_prior_is_the_same(num_actions, depth, length, initial, monkeypatch):
    actions = torch.randint(num_actions, (2000, length), generator=seeded(0)).square() % num_actions
    plans = Plans(actions.to(torch.uint8), num_actions)
    test = torch.randint(num_actions, (50, length + 3), generator=seeded(1))
    want = MarkovPrior(num_actions, depth, initial=initial).fit(plans)(test)
    monkeypatch.setattr(histories, "MOST_NGRAMS", 0)
    prior = MarkovPrior(num_actions, depth, initial=initial)
    prior.learn(*count_histories(plans, depth, None, prior.openings, prior.device))
    torch.testing.assert_close(prior(test), want)
    assert torch.equal(plans.actions, actions.to(torch.uint8))


def test_ngrams_are_counted_whole(monkeypatch):
    """Read some plans at a time, every sequence is counted as often as it occurs, and the plans stay as they are."""
    plans = Plans(torch.randint(4, (200, 30), dtype=torch.uint8, generator=seeded(0)), 4)
    kept = plans.actions.clone()
    monkeypatch.setattr(histories, "ACTIONS_AT_ONCE", 7 * 30)
    tree, counts = count_histories(plans, 2, None, True, torch.device("cpu"))
    name = names(tree, 2)
    found = Counter()
    for row, action, count in zip(counts.row.tolist(), counts.action.tolist(), counts.count.tolist(), strict=True):
        found[(*name[int(counts.row_code[row])], 0, action)] = count
    assert found == dictionary(plans, None, 2)
    assert torch.equal(plans.actions, kept)


@pytest.mark.parametrize(("num_plans", "depth"), [(200, 30), (200, 0), (2, 2), (10, 8)])
def test_ngrams_only_where_they_are_few(num_plans, depth, monkeypatch):
    """Depths as long as the plans, of no action, or with too many possible sequences are counted otherwise."""
    plans = Plans(torch.randint(4, (num_plans, 30), generator=seeded(0)), 4)
    found = count_histories(plans, depth, None, True, torch.device("cpu"))
    monkeypatch.setattr(histories, "MOST_NGRAMS", 0)
    want = count_histories(plans, depth, None, True, torch.device("cpu"))
    assert all(a.equal(b) for a, b in zip(found[0][:2], want[0][:2], strict=True))
    assert all(getattr(found[1], name).equal(getattr(want[1], name)) for name in ("row_code", "row", "action", "count"))
