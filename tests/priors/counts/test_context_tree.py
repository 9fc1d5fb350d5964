"""Context tree weighting against the sum over every tree, and its best tree against the package vlmc."""

import itertools
import math

import pytest
import torch
import vlmc
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import ContextTreePrior, Plans
from tests.support.sources import seeded

BEGINNING = "beginning"


def trees(num_actions, depth, beta):
    """Every tree of histories, as (its leaves, its prior probability); a history here has its last action first."""
    if depth == 0:
        return [([()], 1.0)]
    below = trees(num_actions, depth - 1, beta)
    out = [([()], beta)]
    for choice in itertools.product(below, repeat=num_actions):
        leaves = [(action, *leaf) for action in range(num_actions) for leaf in choice[action][0]]
        probability = (1 - beta) * math.prod(p for _, p in choice)
        out.append(([(BEGINNING,), *leaves], probability))
    return out


def forests(num_actions, depth, beta, contexts):
    """The same with the present context as the most recent symbol."""
    below = trees(num_actions, depth, beta)
    if contexts is None:
        return below
    out = [([()], beta)]
    for choice in itertools.product(below, repeat=contexts):
        leaves = [(f"context {c}", *leaf) for c in range(contexts) for leaf in choice[c][0]]
        out.append((leaves, (1 - beta) * math.prod(p for _, p in choice)))
    return out


def past_of(actions, t, current):
    past = (*reversed(actions[:t]), BEGINNING)
    return past if current is None else (f"context {current}", *past)


def leaf_of(leaves, past):
    """The one leaf that begins this past."""
    (leaf,) = (leaf for leaf in leaves if past[: len(leaf)] == leaf)
    return leaf


def pseudo_counts(rows, num_actions, alpha, base):
    taken = [action for actions, _ in rows for action in actions]
    if base == "uniform" or not taken:
        return [alpha] * num_actions
    kinds = len(set(taken))
    share = [(taken.count(a) + kinds / num_actions) / (len(taken) + kinds) for a in range(num_actions)]
    return [alpha * num_actions * p for p in share]


class EveryTree:
    """The sum over all trees, word by word."""

    def __init__(self, rows, num_actions, depth, beta, pseudo, contexts):
        self.pseudo = pseudo
        self.trees = forests(num_actions, depth, beta, contexts)
        self.joint, self.counts = [], []
        for leaves, probability in self.trees:
            counts = {leaf: [0] * num_actions for leaf in leaves}
            log_joint = math.log(probability)
            for actions, contexts_seen in rows:
                for t, action in enumerate(actions):
                    n = counts[leaf_of(leaves, past_of(actions, t, contexts_seen[t]))]
                    log_joint += math.log((n[action] + pseudo[action]) / (sum(n) + sum(pseudo)))
                    n[action] += 1
            self.joint.append(log_joint)
            self.counts.append(counts)
        self.joint = torch.tensor(self.joint, dtype=torch.double)

    def log_evidence(self):
        return float(self.joint.logsumexp(0))

    def next(self, actions, current):
        pseudo = torch.tensor(self.pseudo, dtype=torch.double)
        out = torch.zeros_like(pseudo)
        for (leaves, _), counts, weight in zip(self.trees, self.counts, self.joint.softmax(0), strict=True):
            n = torch.tensor(counts[leaf_of(leaves, past_of(actions, len(actions), current))], dtype=torch.double)
            out += weight * (n + pseudo) / (n.sum() + pseudo.sum())
        return out

    def best(self):
        """The leaves that occurred, of each tree that is as probable as the best, and their counts."""
        top = float(self.joint.max())
        return [
            {leaf: n for leaf, n in counts.items() if sum(n)}
            for joint, counts in zip(self.joint, self.counts, strict=True)
            if joint > top - 1e-9 * max(abs(top), 1)
        ]


def met(prior):
    """The leaves of `map_tree`, written as here."""
    out = {}
    for leaf in prior.map_tree():
        past = tuple(reversed(leaf.history)) + ((BEGINNING,) if leaf.opening else ())
        key = past if leaf.context is None else (f"context {leaf.context}", *past)
        n = leaf.probs * (leaf.count + prior.pseudo_counts.sum()) - prior.pseudo_counts
        out[key] = [round(v) for v in n.tolist()]
        assert sum(out[key]) == leaf.count
    return out


@st.composite
def problems(draw):
    num_actions, depth = draw(st.sampled_from([(1, 2), (2, 0), (2, 1), (2, 2), (2, 3), (3, 1), (3, 2)]))
    contexts = draw(st.sampled_from([None, None, 1, 2])) if depth < 3 and num_actions < 3 else None
    per = draw(st.sampled_from(["plan", "step"])) if contexts else None
    num, length, seed = draw(st.integers(0, 8)), draw(st.integers(0, 9)), draw(st.integers(0, 2**31))
    generator = seeded(seed)
    # Sticky actions, so that trees differ in how well they fit.
    actions = torch.randint(num_actions, (num, length), generator=generator)
    stay = torch.rand(num, length, generator=generator) < draw(st.sampled_from([0.0, 0.7, 0.95]))
    for t in range(1, length):
        actions[:, t] = torch.where(stay[:, t], actions[:, t - 1], actions[:, t])
    lengths = torch.randint(length + 1, (num,), generator=generator) if draw(st.booleans()) else None
    context = None
    if contexts:
        shape = (num,) if per == "plan" else (num, length)
        context = torch.randint(contexts, shape, generator=generator)
    arguments = {
        "num_actions": num_actions,
        "depth": depth,
        "base": draw(st.sampled_from(["uniform", "frequencies"])),
        "beta": draw(st.sampled_from([0.2, 0.5, 0.9])),
        "alpha": draw(st.sampled_from([0.1, 0.5, 1.0])),
    }
    return Plans(actions, num_actions, lengths, context=context), contexts, per, arguments, generator


def rows_of(plans, per):
    current = torch.zeros_like(plans.actions) if per is None else plans.context
    lengths = plans.mask().sum(1).tolist()
    rows = [(plans.actions[i, :n].tolist(), current[i, :n].tolist()) for i, n in enumerate(lengths)]
    return rows if per else [(actions, [None] * len(actions)) for actions, _ in rows]


@settings(max_examples=50, deadline=None, derandomize=True)
@given(problems())
def test_every_tree(problem):
    plans, contexts, per, arguments, generator = problem
    num_actions = arguments["num_actions"]
    prior = ContextTreePrior(**arguments, num_contexts=contexts).fit(plans)
    rows = rows_of(plans, per)
    pseudo = pseudo_counts(rows, num_actions, arguments["alpha"], arguments["base"])
    assert prior.pseudo_counts.tolist() == pytest.approx(pseudo, rel=1e-12)
    truth = EveryTree(rows, num_actions, arguments["depth"], arguments["beta"], pseudo, contexts)
    assert prior.log_evidence() == pytest.approx(truth.log_evidence(), rel=1e-12, abs=1e-12)
    num, length = 6, 5
    test = torch.randint(num_actions, (num, length), generator=generator)
    context = None
    if contexts:
        drawn = torch.randint(contexts, (num, 1 if per == "plan" else length), generator=generator)
        context = drawn.expand(num, length)
    got = prior(test, context).double().exp()
    for i in range(num):
        for t in range(length):
            current = None if context is None else int(context[i, t])
            torch.testing.assert_close(got[i, t], truth.next(test[i, :t].tolist(), current), rtol=1e-6, atol=1e-7)
    best = truth.best()
    assert met(prior) in best
    assert len(met(prior)) == min(map(len, best))


def draw(order, num_actions, length, seed, spread=0.4):
    """One plan `[1, length]` of a random chain of an order."""
    generator = seeded(seed)
    chain = torch.rand(num_actions**order, num_actions, generator=generator) ** (1 / spread)
    uniform = torch.rand(length, generator=generator).tolist()
    edges = (chain / chain.sum(1, keepdim=True)).cumsum(1).tolist()
    plan, code = [], 0
    for u in uniform:
        plan.append(min(sum(u > edge for edge in edges[code]), num_actions - 1))
        code = (code * num_actions + plan[-1]) % num_actions**order
    return torch.tensor([plan])


@pytest.mark.parametrize(("num_actions", "order", "depth"), [(2, 3, 8), (3, 2, 5), (4, 1, 12), (4, 3, 5)])
@pytest.mark.parametrize("beta", [0.5, 0.75, None])
@pytest.mark.parametrize("seed", range(3))
def test_the_best_tree_is_vlmcs(num_actions, order, depth, beta, seed):
    """The package counts from the action after the first `depth` on, this prior from the first: depth counts more."""
    plan = draw(order, num_actions, 3_000, seed)
    beta = 1 - 2.0 ** (1 - num_actions) if beta is None else beta
    theirs = vlmc.VLMC(num_actions, depth, "bct", beta=beta)
    theirs.fit(plan.tolist())
    want = {tuple(leaf): theirs.get_counts(leaf) for leaf in theirs.get_contexts()}
    leaves = ContextTreePrior(num_actions, depth, beta, 0.5, "uniform").fit(plan).map_tree()
    got = {leaf.history: leaf for leaf in leaves if not leaf.opening}
    assert set(got) == {leaf for leaf, count in want.items() if count}
    assert sum(leaf.count for leaf in leaves) == 3_000
    assert 0 <= 3_000 - sum(want.values()) <= depth
    for history, leaf in got.items():
        assert 0 <= leaf.count - want[history] <= depth
        if leaf.count == want[history]:
            torch.testing.assert_close(leaf.probs.tolist(), theirs.get_distribution(list(history)))


def test_krichevsky_trofimov_by_hand():
    """Depth 0, actions 0 1 0 0: 1/2 * 1/4 * 3/6 * 5/8 (Willems, Shtarkov and Tjalkens 1995, section III)."""
    prior = ContextTreePrior(2, 0, alpha=0.5, base="uniform").fit(torch.tensor([[0, 1, 0, 0]]))
    assert prior.log_evidence() == pytest.approx(math.log(5 / 128))
    torch.testing.assert_close(prior(torch.zeros(1, 1).long()).exp()[0, 0], torch.tensor([3.5 / 5, 1.5 / 5]))
    assert met(prior) == {(): [3, 1]}


def test_alpha_is_the_most_probable_one():
    plan = draw(1, 6, 500, 3, spread=0.1)
    found = ContextTreePrior(6, 3).fit(plan)
    sizes = [2.0**k for k in range(-2, 7)]
    evidence = [ContextTreePrior(6, 3, alpha=size / 6).fit(plan).log_evidence() for size in sizes]
    assert found.log_evidence() == pytest.approx(max(evidence))
    assert float(found.pseudo_counts.sum()) == pytest.approx(sizes[evidence.index(max(evidence))])
    # A source that says nothing is best described by the largest one, and one that repeats itself by the smallest.
    noise, again = torch.randint(3, (100, 20), generator=seeded(0)), torch.arange(60).view(1, -1) % 3
    for plans, size in ((noise, 64), (again, 0.25)):
        assert float(ContextTreePrior(3, 2, base="uniform").fit(plans).pseudo_counts.sum()) == size


@pytest.mark.parametrize("name", ["bounds", "pair_row", "pair_action", "pair_count", "pseudo_counts", "parent"])
def test_tables_that_do_not_fit_are_refused(name):
    tables = {key: t.clone() for key, t in ContextTreePrior(3, 2).fit(draw(1, 3, 100, 0)).state_dict().items()}
    tables[name][-1] = -1
    with pytest.raises(RuntimeError, match="do not fit"):
        ContextTreePrior(3, 2).load_state_dict(tables)
