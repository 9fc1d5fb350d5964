"""Training: the loss, what is validated and kept, early stopping, checkpoints, given validation plans, interruption."""

import itertools
import math
import time
from types import SimpleNamespace

import pytest
import torch

from neuroprior import GRUPrior, Plans, TransformerPrior
from neuroprior.priors import StackedPrior
from neuroprior.priors.ensembles import candidates
from neuroprior.priors.neural.neural import NeuralPrior
from neuroprior.training import PlansModule, PriorModule, Settings, train, trainer
from neuroprior.training.batches import MAX_DISTINCT
from tests.support.sources import refuses, seeded

LOG_2 = math.log(2)


def drawn(num: int = 40, length: int = 4, seed: int = 0) -> Plans:
    return Plans(torch.randint(3, (num, length), generator=seeded(seed)), 3)


def how(steps: int, **more) -> Settings:
    return Settings(steps, **{"check_every": steps, "patience": 1000, "progress": False} | more)


def bits(prior, plans: Plans) -> float:
    return -float(prior.log_prob(plans).detach().sum()) / int(plans.mask().sum()) / LOG_2


@pytest.mark.parametrize(("length", "merged"), [(5, True), (6, False)])
def test_equal_plans_are_merged_where_few_are_distinct(length, merged):
    plans = Plans(torch.randint(4, (9000, length), generator=seeded(0)), 4)
    rows = PlansModule(plans, plans[:10], Settings(batch_size=256, max_steps=1 if merged else 36), seed=0)
    assert (4**length <= MAX_DISTINCT) == merged
    assert (rows.training.weight is not None, rows.training.groups == 1) == (merged, merged)
    assert sum(float(batch.weight.sum()) for batch in rows.train_dataloader()) == 9000 * length


def test_plans_of_other_lengths_are_not_merged():
    plans = Plans(torch.zeros(100, 3, dtype=torch.long), 2, torch.arange(100) % 3 + 1)
    (batch,) = PlansModule(plans, plans[:4], Settings(max_steps=1), seed=0).train_dataloader()
    assert sorted(batch.weight.sum(1).tolist()) == [1 * 34, 2 * 33, 3 * 33]


@pytest.mark.parametrize(
    ("setting", "value"), [("max_steps", 0), ("window", 2.5), ("learning_rate", math.inf), ("seconds", -1)]
)
def test_bad_settings(setting, value):
    with refuses(f"`{setting}` must be", f"got {value}."):
        Settings(**{setting: value})


def test_the_curve_holds_the_learning_rate_and_the_bits_of_each_epoch(monkeypatch):
    """Of the weights in training; in validation of their moving average, of which the best is what is learned."""
    plans, prior, watched = drawn(), GRUPrior(3, 4, lags=1), []

    def watch(module, *_):
        watched.append({name: value.detach().clone() for name, value in module.prior.state_dict().items()})

    monkeypatch.setattr(PriorModule, "on_train_batch_end", watch)
    curve = train(prior, plans, how(20, learning_rate=0.01, check_every=1, validation=plans), 0)
    assert [entry["step"] for entry in curve] == list(range(1, 21))
    due = [0.01 * min((k / 20 + 1e-3) / 0.1, (1 + math.cos(math.pi * k / 20)) / 2) for k in range(1, 21)]
    assert [entry["learning_rate"] for entry in curve] == pytest.approx(due, abs=1e-9)

    learned, average, averages = {name: value.clone() for name, value in prior.state_dict().items()}, {}, []
    for step, weights in enumerate(watched):
        decay = min(0.98, (step + 1) / (step + 10)) if step else 0
        average = {name: decay * average.get(name, 0) + (1 - decay) * value for name, value in weights.items()}
        averages.append(average)

    def bits_of(weights: dict[str, torch.Tensor]) -> float:
        prior.load_state_dict(weights)
        return bits(prior, plans)

    # A step takes all plans, with the weights after the step before it.
    assert [entry["train_bits"] for entry in curve[1:]] == pytest.approx(list(map(bits_of, watched[:-1])), rel=1e-5)
    held_out = [entry["validation_bits"] for entry in curve]
    assert held_out == pytest.approx(list(map(bits_of, averages)), rel=1e-5)
    best = averages[held_out.index(min(held_out))]
    assert all(torch.allclose(value, best[name], atol=1e-6) for name, value in learned.items())


class Constant(torch.nn.Module):
    """A prior of one logit for each action, the same before all actions; it draws a mask of dropout, too."""

    def __init__(self) -> None:
        super().__init__()
        self.logits = torch.nn.Parameter(torch.tensor([1.0, 0.0, -1.0]))
        self.masks: list[tuple[float, ...]] = []

    def forward(self, plans: torch.Tensor, context: torch.Tensor | None = None) -> torch.Tensor:
        self.masks.append(tuple(torch.nn.functional.dropout(torch.ones(64), training=self.training).tolist()))
        return self.logits.expand(*plans.shape, 3)


@pytest.mark.parametrize("equal", [1, 40])
def test_in_training_each_action_counts_the_same(equal, monkeypatch):
    """Its gradient, which is clipped where it is long, is that of the mean over actions; also where plans are merged.

    In the plans there are 19 actions, of which 7, 8 and 4 are 0, 1 and 2.
    """
    actions = torch.tensor([[0, 0, 0, 1, 1, 1, 1, 2, 2], [0, 0, 2, 1, 1, 1, 0, 1, 0], [2, 0, 0, 0, 0, 0, 0, 0, 0]])
    plans, prior, slopes = Plans(actions.repeat(equal, 1), 3, torch.tensor([9, 8, 2]).repeat(equal)), Constant(), []
    monkeypatch.setattr(PriorModule, "on_after_backward", lambda module: slopes.append(prior.logits.grad.tolist()))
    (entry,) = train(prior, plans, how(1, validation=plans), 0)
    log_probs, share = torch.tensor([1.0, 0.0, -1.0]).log_softmax(0), torch.tensor([7.0, 8.0, 4.0]) / 19
    assert entry["train_bits"] == pytest.approx(-float(share @ log_probs) / LOG_2, rel=1e-5)
    assert slopes == [pytest.approx(((log_probs.exp() - share) / LOG_2).tolist(), abs=1e-5)]


def test_in_validation_each_action_counts_the_same():
    """Windows near the end hold the actions of few plans, and weigh less."""
    plans = Plans(drawn(4, 12).actions, 3, lengths=torch.tensor([12, 9, 8, 5]))
    prior = GRUPrior(3, 8)
    prior.prepare(plans, 4)
    (entry,) = train(prior, plans, how(1, window=4, validation=plans), 0)
    assert entry["validation_bits"] == pytest.approx(bits(prior, plans), rel=1e-5)


def test_dropout_is_drawn_anew_in_each_step():
    plans, whole, runs = drawn(4, 2), (1.0,) * 64, []
    for seed in (0, 0, 1):
        prior = Constant()
        train(prior, plans, how(6, check_every=3, validation=plans), seed)
        assert [mask == whole for mask in prior.masks] == [False, False, False, True] * 2
        runs.append([mask for mask in prior.masks if mask != whole])
    first, again, other = runs
    assert first == again
    assert len({*first, *other}) == 12


def test_patience_is_counted_in_steps():
    """Hardly anything is learned at so low a rate: after the first validation two more, ten steps each, are awaited."""
    curve = train(GRUPrior(3, 4), drawn(), how(100, learning_rate=1e-9, check_every=10, patience=20), 0)
    assert [entry["step"] for entry in curve] == [10, 20, 30]


def test_when_time_is_up_training_stops_at_the_next_validation(monkeypatch):
    """On a clock that goes on by a second with each look, which the trainer takes at each validation."""
    clock = itertools.count()
    monkeypatch.setattr(trainer, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    curve = train(GRUPrior(3, 4), drawn(), how(100, check_every=10, patience=1000, seconds=2.5), 0)
    assert [entry["step"] for entry in curve] == [10, 20, 30]
    monkeypatch.undo()
    curve = train(GRUPrior(3, 4), drawn(), how(100, check_every=10, seconds=0), 0)
    assert [entry["step"] for entry in curve] == [10]


def test_the_combined_prior_counts_first_and_trains_while_there_is_time(monkeypatch):
    """Of 50 seconds the first of three networks may take a third; it takes 30, the next one 20, and none is left."""
    plans, now, given = Plans(drawn(60, 9).actions, 3), [0.0], []

    def fit(prior, plans, *, seconds, **settings):
        given.append(seconds)
        now[0] += 30 if len(given) == 1 else 20
        return NeuralPrior.fit(prior, plans, max_steps=2, progress=False, validation=settings["validation"])

    monkeypatch.setattr(candidates, "monotonic", lambda: now[0])
    monkeypatch.setattr(GRUPrior, "fit", fit)
    monkeypatch.setattr(candidates, "networks", lambda *_: {name: GRUPrior(3, 4) for name in candidates.NETWORKS})
    settings = {"seconds": 50.0}
    made = candidates.fitted_experts(plans, plans[:10], {}, "full", seeded(0), settings).fitted
    assert given == [50 / 3, 10]
    assert sum(isinstance(prior, GRUPrior) for prior in made) == 2
    assert settings == {"seconds": 50.0}


def test_every_setting_changes_the_training():
    plans = drawn(60, 9).actions
    same = {"max_steps": 6, "check_every": 6, "batch_size": 20, "progress": False}

    def score(**settings: float) -> list[float]:
        return GRUPrior(3, 8).fit(plans, generator=seeded(0), **(same | settings)).log_prob(plans).tolist()

    base = score()
    assert score() == base
    others = {"max_steps": 4, "batch_size": 10, "window": 4, "learning_rate": 0.01, "validation": 0.5}
    others |= {"weight_decay": 9.0, "gradient_clip": 0.01}
    assert [name for name, value in others.items() if score(**{name: value}) == base] == []


def test_the_best_weights_are_kept_and_the_last_checkpoint(tmp_path):
    """Noise is learned by heart: the best validation is the first; a training is resumed from the last."""
    plans, settings = drawn(40, 8), {"learning_rate": 0.05, "check_every": 10, "validation": drawn(12, 8, seed=1)}
    prior, unlogged = GRUPrior(3, 16), GRUPrior(3, 16)
    for each in (prior, unlogged):
        each.prepare(plans, 128)
    curve = train(prior, plans, how(30, **settings), 0, tmp_path)
    losses = [entry["validation_bits"] for entry in curve]
    assert losses == sorted(losses)
    assert bits(prior, settings["validation"]) == pytest.approx(losses[0], abs=1e-5)
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 30
    assert saved["curve"] == curve
    assert {path.name for path in tmp_path.iterdir()} == {"last.ckpt", "tensorboard"}
    train(unlogged, plans, how(30, **settings), 0)
    assert all(value.equal(prior.state_dict()[name]) for name, value in unlogged.state_dict().items())


def test_a_training_that_diverges_is_said(recwarn):
    with refuses("`learning_rate` must be lower", "diverged", "got 1e+30"):
        GRUPrior(3, 8).fit(drawn(), max_steps=20, learning_rate=1e30, progress=False, check_every=5)


def test_ctrl_c_is_a_keyboard_interrupt(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(PriorModule, "training_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        GRUPrior(3, 8).fit(drawn(), progress=False)


@pytest.mark.parametrize(
    ("seconds", "progress", "steps"), [(0.0, True, (2, 4, 6, 8)), (0.0, False, ()), (60, True, ())]
)
def test_progress_in_a_log_file_is_lines(seconds, progress, steps, monkeypatch, capsys):
    """At most one in so many seconds."""
    monkeypatch.setattr("neuroprior.training.trainer.MIN_SECONDS", seconds)
    monkeypatch.setattr("neuroprior.training.trainer.Keeper.last_line", time.monotonic())
    GRUPrior(3, 4).fit(drawn(), progress=progress, max_steps=8, check_every=2, patience=100)
    out, lines = capsys.readouterr()
    assert out == ""
    said = [line.partition(",")[0] for line in lines.splitlines() if line.startswith("training: ")]
    assert said == [f"training: step {step} of at most 8" for step in steps]


def test_a_fair_share_of_unequal_plans_is_held_out(monkeypatch):
    """Of one long plan and many short ones: never nearly all actions, nor hardly any."""
    plans = Plans(torch.zeros(40, 300, dtype=torch.long), 2, torch.tensor([300] + [2] * 39))
    shares = []

    def stop(training, validation, *_):
        shares.append(int(validation.mask().sum()) / int(plans.mask().sum()))
        raise InterruptedError

    monkeypatch.setattr("neuroprior.training.trainer.PlansModule", stop)
    for seed in range(10):
        with pytest.raises(InterruptedError):
            GRUPrior(2, 4).fit(plans, generator=seeded(seed), progress=False)
    assert 0.05 <= min(shares) <= max(shares) <= 0.55


PRIORS = {
    "gru": lambda: GRUPrior(3, 8, lags=2, dropout=0.2),
    "stacked": lambda: StackedPrior(3, 8, orders=(1,), depth=2),
}


@pytest.mark.parametrize("name", PRIORS)
def test_validation_plans_stop_a_training_and_nothing_is_learned_from_them(name):
    named = Plans(drawn(30, 6).actions, 3, action_names=("a", "b", "c"))

    def fitted(plans: Plans, validation: Plans, **more: int):
        settings = {"max_steps": 12, "check_every": 12, "learning_rate": 0.02, "progress": False} | more
        return PRIORS[name]().fit(plans, validation=validation, generator=seeded(0), **settings)

    # With one validation, at the end, they make no difference; each of the plans that are learned from does.
    prior, other = fitted(named, drawn(30, 6, 1)), named.actions.long()
    other[-1] = (other[-1] + 1) % 3
    assert prior.action_names == ("a", "b", "c")
    assert prior(named.actions).equal(fitted(named, drawn(5, 6, 2))(named.actions))
    assert not prior(named.actions).equal(fitted(Plans(other, 3), drawn(30, 6, 1))(named.actions))
    # Plans of another action are predicted worse with each step: the weights of the first validation are kept.
    zeros, ones = (Plans(torch.full((20, 6), action), 3) for action in (0, 1))
    first, last = (fitted(zeros, validation, check_every=2, max_steps=40) for validation in (ones, zeros))
    assert bits(first, zeros) > bits(last, zeros) + 0.002
    with refuses("no validation plan has an action"):
        fitted(named, Plans(named.actions, 3, lengths=torch.zeros(30, dtype=torch.long)))


@pytest.mark.slow
@pytest.mark.parametrize("make", [GRUPrior, TransformerPrior])
def test_past_the_training_length(make):
    """Trained on plans of 12 actions, it predicts no worse in longer ones than where it reads the last 12 anew.

    An action is with probability .7 the fifth last one, else any.
    """

    def draw(num: int, length: int, seed: int) -> torch.Tensor:
        g = seeded(seed)
        plans = torch.randint(4, (num, 20 + length), generator=g)
        again = torch.rand(plans.shape, generator=g) < 0.7
        for t in range(5, plans.shape[1]):
            plans[:, t] = torch.where(again[:, t], plans[:, t - 5], plans[:, t])
        return plans[:, 20:]

    def bits_of(logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return -logits.log_softmax(-1).gather(-1, actions[..., None])[..., 0] / LOG_2

    prior = make(4).fit(draw(20_000, 12, 3), generator=seeded(0), progress=False)
    for times in (2, 16):
        test = draw(64_000 // (times * 12), times * 12, times)
        with torch.no_grad():
            carried = bits_of(prior(test)[:, 12:], test[:, 12:])
            anew = test.unfold(1, 12, 1)[:, 1:]
            logits = torch.cat([prior(some.flatten(0, 1))[:, -1] for some in anew.split(64)])
        assert float((carried - bits_of(logits.view(*anew.shape[:2], 4), test[:, 12:])).mean()) < 0.001


def test_padding_changes_nothing():
    """Batches and windows follow from the longest plan, however wide the tensor is that holds it."""
    lengths = torch.arange(1, 61)
    plans = Plans(torch.randint(3, (60, 60), generator=seeded(1)), 3, lengths)
    wide = Plans(torch.nn.functional.pad(plans.actions, (0, 3000), value=2), 3, lengths)
    first, second = GRUPrior(3, 4, seed=2), GRUPrior(3, 4, seed=2)
    curves = [train(prior, some, how(9, check_every=3), 5) for prior, some in ((first, plans), (second, wide))]
    assert [one["validation_bits"] for one in curves[0]] == [one["validation_bits"] for one in curves[1]]
    assert first.log_prob(plans).equal(second.log_prob(plans))
