"""`HistoryPrior.forward`, which reads long plans in chunks side by side, against stepping, bit for bit."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from neuroprior import ContextTreePrior, MarkovPrior, Plans, Prior
from neuroprior.priors.counts import HistoryPrior
from tests.support.sources import seeded

CHUNK = HistoryPrior.chunk_length
MARKOV = [(initial, order) for initial in ("joint", "lower") for order in range(7)]
PRIORS = {f"markov-{order} {initial}": (MarkovPrior, order, {"initial": initial}) for initial, order in MARKOV}
PRIORS |= {f"tree-{depth}": (ContextTreePrior, depth, {}) for depth in (0, 1, 2, 3, 4, 5, 6, 10)}


def some_plans(num_actions: int, kind: str, used: int | None = None, seed: int = 0) -> Plans:
    """60 short plans and a few long ones; of `num_contexts` 3 the last does not occur."""
    actions = torch.randint(used or num_actions, (60, 40), generator=seeded(seed))
    lengths = torch.randint(41, (60,), generator=seeded(seed + 1))
    return Plans(actions, num_actions, lengths, context=contexts(kind, 2, 60, 40, seed + 2))


def contexts(kind: str, num_contexts: int, num: int, length: int, seed: int) -> torch.Tensor | None:
    if kind == "none":
        return None
    drawn = torch.randint(num_contexts, (num, 1 if kind == "plan" else length), generator=seeded(seed))
    return drawn.expand(num, length)


def fitted(make, depth: int, more: dict, kind: str, num_actions: int = 3) -> Prior:
    prior = make(num_actions, depth, num_contexts=None if kind == "none" else 3, **more)
    return prior.fit(some_plans(num_actions, kind, max(num_actions - 1, 1)))


def equals_stepping(prior: Prior, length: int, kind: str, seed: int = 0, num: int = 3) -> bool:
    plans = torch.randint(prior.num_actions, (num, length), generator=seeded(seed))
    # One as those learned from, in which the histories go on and on.
    plans[0] = torch.randint(max(prior.num_actions - 1, 1), (length,), generator=seeded(seed + 1))
    current = contexts(kind, prior.num_contexts or 1, num, length, seed + 2)
    got = prior(plans, current)
    assert got.shape == (num, length, prior.num_actions)
    assert got.dtype == torch.float32
    return torch.equal(got, Prior.forward(prior, plans, current))


@pytest.mark.parametrize("kind", ["none", "plan", "step"])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if PRIORS[name][1] in (0, 3, 10) else pytest.mark.slow) for name in PRIORS]
)
def test_forward_is_stepping(name, kind):
    """At every length from which plans are read in other chunks; the shorter ones are beginnings of the longest."""
    make, depth, more = PRIORS[name]
    prior, longest = fitted(make, depth, more, kind), 1500 if name in ("markov-3 joint", "tree-6") else 600
    plans = torch.randint(3, (3, longest), generator=seeded(depth))
    plans[0] = torch.randint(2, (longest,), generator=seeded(depth + 1))  # as those learned from
    current = contexts(kind, 3, 3, longest, seed=depth + 2)
    want, edge = Prior.forward(prior, plans, current), CHUNK + depth
    for length in (0, 1, CHUNK, edge - 1, edge, edge + 1, 2 * edge - 1, 2 * edge, 2 * edge + 1, longest - 1, longest):
        got = prior(plans[:, :length], None if current is None else current[:, :length])
        assert got.shape == (3, length, 3)
        assert torch.equal(got, want[:, :length]), length


@st.composite
def problems(draw):
    make = draw(st.sampled_from([MarkovPrior, ContextTreePrior]))
    more = {"initial": draw(st.sampled_from(["joint", "lower"]))} if make is MarkovPrior else {}
    kind, num_actions = draw(st.sampled_from(["none", "plan", "step"])), draw(st.integers(1, 4))
    return fitted(make, draw(st.integers(0, 8)), more, kind, num_actions), kind, draw(st.integers(0, 70))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(problems(), st.integers(1, 12), st.integers(0, 2**31))
def test_in_chunks_of_any_size(problem, chunk, seed):
    """Also where a chunk is shorter than the histories that matter."""
    prior, kind, length = problem
    prior.chunk_length = chunk
    assert equals_stepping(prior, length, kind, seed)


@pytest.mark.parametrize("depth", [CHUNK, CHUNK + 1, CHUNK + 44])
def test_histories_longer_than_a_chunk(depth):
    """What matters lies further back than a chunk: plans that repeat `depth` random actions."""
    period = torch.randint(2, (1, depth), generator=seeded(3))
    plans = period.repeat(1, 4)
    prior = ContextTreePrior(2, depth).fit(Plans(plans, 2))
    assert torch.equal(prior(plans), Prior.forward(prior, plans))
    other = torch.cat([1 - plans[:, :7], plans], 1)
    assert torch.equal(prior(other), Prior.forward(prior, other))
