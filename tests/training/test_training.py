"""Training: what is learned where plans repeat, bad settings, interruption, and sampling past the training length."""

import math

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior, Plans, TransformerPrior
from neuroprior.training import PlansModule, PriorModule, Settings, train
from neuroprior.training.batches import MOST_DISTINCT


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("length", [4, 5, 6])
def test_frequent_plans_keep_their_probability(length: int) -> None:
    # Half of all plans are one and the same; the others are one of 4**length, below and above MOST_DISTINCT.
    same = torch.zeros(4000, length, dtype=torch.long)
    plans = torch.cat([same, torch.randint(4, (4000, length), generator=generator())])
    prior = GRUPrior(4, 32).fit(plans, generator=generator(), progress=False, max_steps=150)
    assert float(prior.log_prob(same[:1]).detach().exp()) == pytest.approx(0.5 * (1 + 4.0**-length), abs=0.03)


@pytest.mark.parametrize(("length", "merged"), [(5, True), (6, False)])
def test_equal_plans_are_merged_where_few_are_distinct(length: int, merged: bool) -> None:
    plans = Plans(torch.randint(4, (9000, length), generator=generator()), 4)
    rows = PlansModule(plans, plans[:10], Settings(batch_size=256, max_steps=1 if merged else 36), seed=0)
    assert (rows.training.weight is not None) == merged
    assert (4**length <= MOST_DISTINCT) == merged
    batches = list(rows.train_dataloader())
    assert sum(float(batch.weight.sum()) for batch in batches) == 9000 * length
    assert (rows.training.groups == 1) == merged


def test_plans_of_other_lengths_are_not_merged() -> None:
    plans = Plans(torch.zeros(100, 3, dtype=torch.long), 2, torch.arange(100) % 3 + 1)
    rows = PlansModule(plans, plans[:4], Settings(max_steps=1), seed=0)
    (batch,) = rows.train_dataloader()
    assert sorted(batch.weight.sum(1).tolist()) == [1 * 34, 2 * 33, 3 * 33]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("max_steps", 0), ("max_steps", 2.5), ("learning_rate", 0.0), ("learning_rate", math.inf), ("weight_decay", -1.0)],
)
def test_bad_settings(setting: str, value: float) -> None:
    with pytest.raises(ValueError, match=setting):
        Settings(**{setting: value})


def test_the_best_weights_are_kept_not_the_last() -> None:
    """Noise is learned by heart: the loss on the plans held out rises again after the first steps."""
    plans = Plans(torch.randint(3, (40, 8), generator=generator()), 3)
    _, held_out = plans.split(0.3, generator(7))

    prior = GRUPrior(3, 16)
    how = Settings(50, learning_rate=0.05, validation=0.3, check_every=10, patience=1000, progress=False)
    best = train(prior, plans, how, 7)
    bits = -float(prior.log_prob(held_out).detach().mean()) / 8 / math.log(2)
    assert bits == pytest.approx(best, abs=1e-5)


def test_a_training_that_diverges_is_said(recwarn: pytest.WarningsRecorder) -> None:
    plans = torch.randint(3, (50, 4), generator=generator())
    with pytest.raises(ValueError, match="diverged"):
        GRUPrior(3, 8).fit(plans, max_steps=20, learning_rate=1e30, progress=False, check_every=5)


def test_ctrl_c_is_a_keyboard_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PriorModule, "training_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        GRUPrior(3, 8).fit(torch.randint(3, (50, 4), generator=generator()), progress=False)


def test_fitting_again_takes_the_new_plans_window() -> None:
    prior = GRUPrior(3, 8)
    for length in (3, 6):
        prior.fit(torch.randint(3, (50, length), generator=generator()), max_steps=2, progress=False)
        assert prior.window == length - 1
    given = GRUPrior(3, 8, window=2).fit(torch.randint(3, (50, 6), generator=generator()), max_steps=2, progress=False)
    assert given.window == 2


@pytest.mark.slow
@pytest.mark.parametrize("make", [GRUPrior, TransformerPrior])
def test_past_the_training_length(make: type[GRUPrior] | type[TransformerPrior]) -> None:
    """Plans of a chain of order 2: trained on length 8, scored at actions 20 to 32. Prints bits an action by window."""
    g = generator(1)
    table = torch.distributions.Dirichlet(torch.full((16, 4), 0.5))
    torch.manual_seed(0)
    probs = table.sample()
    plans = torch.randint(4, (20_000, 2), generator=g)
    for _ in range(50):
        last = plans[:, -2] * 4 + plans[:, -1]
        plans = torch.cat([plans, torch.multinomial(probs[last], 1, generator=g)], 1)
    training, test = plans[2000:, 20:28], plans[:2000, 20:]
    last = test[:, 18:-2] * 4 + test[:, 19:-1]
    entropy = -float(probs[last].log2().gather(-1, test[:, 20:, None]).mean())
    prior = make(4).fit(training, generator=generator(), progress=False)
    taken = {}
    for window in (7, 5, 3, None):
        prior.window = window
        with torch.no_grad():
            log_probs = prior(test).log_softmax(-1).gather(-1, test[..., None])[:, 20:]
        taken[window] = -float(log_probs.mean()) / math.log(2)
    markov = MarkovPrior(4, 2).fit(training)(test).log_softmax(-1).gather(-1, test[..., None])[:, 20:]
    print(
        f"\n{make.__name__}: source {entropy:.3f}, Markov-2 {-float(markov.mean()) / math.log(2):.3f}, by window:",
        taken,
    )
    assert taken[7] < 1.01 * entropy
    assert min(taken.values()) > 0.995 * entropy
    if make is TransformerPrior:
        assert taken[None] > 1.2 * entropy
