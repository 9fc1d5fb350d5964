"""Networks on patterns and on boards."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuroprior import Plans
from neuroprior.priors import MixturePrior, UniformPrior, load, save
from neuroprior.puzzles import BoardNetwork, LogLinearPrior, PatternNetwork


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def exclusive_or() -> Plans:
    """The action is the exclusive or of two bits, which no sum of rows gives."""
    bits = torch.randint(2, (100, 10, 2), generator=seeded(), dtype=torch.int32)
    return Plans((bits[..., 0] ^ bits[..., 1]).long(), 2, context=bits + torch.tensor([0, 2], dtype=torch.int32))


def test_the_network_learns_what_sums_cannot() -> None:
    plans = exclusive_or()
    network = PatternNetwork(2, 2).fit(plans, generator=seeded(1), epochs=30)
    linear = LogLinearPrior(2, 2).fit(plans, generator=seeded(1))
    assert float(linear.log_prob(plans).mean()) < -6.5  # ten bits are 6.9 nats
    assert float(network.log_prob(plans).mean()) > -1
    assert network.embeddings.shape == (5, 16)
    assert not network.embeddings[-1].any()
    assert network.layers.shape == (1, 16, 16)
    assert network.out.shape == (2, 16)


def test_the_same_seed_gives_the_same_network() -> None:
    first, second = (PatternNetwork(2, 2).fit(exclusive_or(), generator=seeded(1)) for _ in range(2))
    assert first.out.equal(second.out)
    assert first.out.any()


def boards() -> Plans:
    """The action is the quarter of a 4x4 board in which the one piece stands."""
    place = torch.randint(16, (60, 8), generator=seeded())
    quarter = place // 8 * 2 + place % 4 // 2
    return Plans(quarter, 4, context=torch.eye(16)[place])


def test_a_network_learns_from_boards(tmp_path: Path) -> None:
    plans = boards()
    network = BoardNetwork(4, (1, 4, 4), 8, 1).fit(plans, generator=seeded(), epochs=20, batch_size=32)
    assert float(network.log_prob(plans).detach().mean()) > -0.8  # chance: -11
    copy = load(save(network, tmp_path))
    assert copy.config == {"num_actions": 4, "board": [1, 4, 4], "channels": 8, "depth": 1}
    assert copy.log_prob(plans).equal(network.log_prob(plans))
    again = BoardNetwork(4, (1, 4, 4), 8, 1).fit(plans, generator=seeded(), epochs=20, batch_size=32)
    assert again.out.equal(network.out)


def test_a_network_is_stopped_by_the_plans_that_it_is_given() -> None:
    """Those of another rule get less likely with each epoch: the network stays as it began. A mixture gives such."""
    plans = boards()
    others = replace(plans, actions=3 - plans.actions)
    network = BoardNetwork(4, (1, 4, 4), 8, 1).fit(plans, generator=seeded(), validation=others, epochs=20)
    assert not network.out.any()
    named = replace(plans, action_names=("a", "b", "c", "d"))
    network.fit(named, generator=seeded(), validation=others, epochs=1)
    assert network.action_names == named.action_names
    with pytest.raises(ValueError, match=r"action_names: .+ in those that are learned from"):
        network.fit(named, validation=replace(named, action_names=("d", "c", "b", "a")))
    prior = MixturePrior(4, [BoardNetwork(4, (1, 4, 4), 8, 1), UniformPrior(4)])
    assert prior.fit(plans, generator=seeded(), epochs=20, batch_size=32).log_prob(plans).mean() > -1


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="board"):
        BoardNetwork(4, (4, 4))
    with pytest.raises(ValueError, match="height"):
        BoardNetwork(4, (1, 0, 4))
    with pytest.raises(ValueError, match="size 12"):
        BoardNetwork(4, (3, 2, 2)).fit(boards())
    with pytest.raises(ValueError, match="memory"):
        BoardNetwork(4, (1, 10**6, 10**6))
    with pytest.raises(RuntimeError, match="shape"):  # and not two boards
        BoardNetwork(4, (1, 4, 4)).start(1, torch.zeros(1, 32))
    for sizes in ({"depth": -1}, {"depth": 1.5}, {"depth": True}, {"size": 10**11}):
        with pytest.raises(ValueError, match=next(iter(sizes))):
            PatternNetwork(2, 2, **sizes)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="learning_rate"):
        PatternNetwork(2, 2).fit(exclusive_or(), learning_rate=0.0)
