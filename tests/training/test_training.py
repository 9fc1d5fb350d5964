"""Training: what is learned where plans repeat, bad settings, interruption, and sampling past the training length."""

import math
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest
import torch

from neuroprior import GRUPrior, Plans, TransformerPrior
from neuroprior.training import PlansModule, PriorModule, Settings, make_trainer, run_training, train
from neuroprior.training.batches import MOST_DISTINCT
from tests.support.sources import seeded


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("length", [4, 6])
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


def trained(
    prior: GRUPrior,
    plans: Plans,
    held_out: Plans,
    how: Settings,
    folder: Path,
    logs: bool = False,
    callbacks: list[lightning.Callback] | None = None,
) -> PriorModule:
    """The module after a training on these plans, with its learning curve."""
    data = PlansModule(plans, held_out, how, seed=0)
    more = {"enable_progress_bar": False, "logs": logs, "callbacks": callbacks}
    trainer = make_trainer(str(folder), how.max_steps, how.patience, data.steps, "cpu", **more)
    module = PriorModule(prior, how.learning_rate, how.weight_decay)
    run_training(trainer, module, data)
    return module


class Watch(lightning.Callback):
    """The weights after each step."""

    def __init__(self) -> None:
        self.weights: list[dict[str, torch.Tensor]] = []

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.weights.append({name: value.detach().clone() for name, value in pl_module.prior.state_dict().items()})


@pytest.mark.parametrize("logs", [False, True])
def test_the_curve_holds_the_learning_rate_and_the_bits_of_each_epoch(logs: bool, tmp_path: Path) -> None:
    """Of the weights in training; in validation of their moving average, of which the best is what is learned."""
    plans = Plans(torch.randint(3, (40, 4), generator=generator()), 3)
    how, watch = Settings(20, learning_rate=0.01, check_every=1), Watch()
    prior = GRUPrior(3, 4, lags=1)
    curve = trained(prior, plans, plans, how, tmp_path, logs, [watch]).curve
    assert [entry["step"] for entry in curve] == list(range(1, 21))
    due = [0.01 * min((k / 20 + 1e-3) / 0.1, (1 + math.cos(math.pi * k / 20)) / 2) for k in range(1, 21)]
    assert [entry["learning_rate"] for entry in curve] == pytest.approx(due, abs=1e-9)

    learned, average, averages = {name: value.clone() for name, value in prior.state_dict().items()}, {}, []
    for step, weights in enumerate(watch.weights):
        decay = min(0.98, (step + 1) / (step + 10)) if step else 0
        average = {name: decay * average.get(name, 0) + (1 - decay) * value for name, value in weights.items()}
        averages.append(average)

    def bits(weights: dict[str, torch.Tensor]) -> float:
        prior.load_state_dict(weights)
        return -float(prior.log_prob(plans).detach().mean()) / 4 / math.log(2)

    # A step takes all plans, with the weights after the step before it.
    assert [entry["train_bits"] for entry in curve[1:]] == pytest.approx(list(map(bits, watch.weights[:-1])), rel=1e-5)
    held_out = [entry["validation_bits"] for entry in curve]
    assert held_out == pytest.approx(list(map(bits, averages)), rel=1e-5)
    best = averages[held_out.index(min(held_out))]
    for name, value in learned.items():
        assert torch.allclose(value, best[name], atol=1e-6)


class Constant(torch.nn.Module):
    """A prior of one logit for each action, the same before all actions."""

    def __init__(self) -> None:
        super().__init__()
        self.logits = torch.nn.Parameter(torch.tensor([1.0, 0.0, -1.0]))

    def forward(self, plans: torch.Tensor, context: torch.Tensor | None = None) -> torch.Tensor:
        return self.logits.expand(*plans.shape, 3)


@pytest.mark.parametrize("equal", [1, 40])
def test_in_training_each_action_counts_the_same(equal: int, tmp_path: Path) -> None:
    """Its gradient, which is clipped where it is long, is that of the mean over actions; also where plans are merged.

    In the plans there are 19 actions, of which 7, 8 and 4 are 0, 1 and 2.
    """
    actions = torch.tensor([[0, 0, 0, 1, 1, 1, 1, 2, 2], [0, 0, 2, 1, 1, 1, 0, 1, 0], [2, 0, 0, 0, 0, 0, 0, 0, 0]])
    lengths = torch.tensor([9, 8, 2])
    seen: list[tuple[float, list[float]]] = []

    class Watch(lightning.Callback):
        def on_before_backward(
            self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, loss: Any
        ) -> None:
            self.loss = float(loss)

        def on_after_backward(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
            assert isinstance(prior.logits.grad, torch.Tensor)
            seen.append((self.loss, prior.logits.grad.tolist()))

    plans, prior = Plans(actions.repeat(equal, 1), 3, lengths.repeat(equal)), Constant()
    data = PlansModule(plans, plans, Settings(1, window=9, check_every=1), seed=0)
    module, off = PriorModule(prior), {"enable_progress_bar": False, "logs": False}
    run_training(make_trainer(str(tmp_path), 1, 1, data.steps, "cpu", **off, callbacks=[Watch()]), module, data)
    log_probs = torch.tensor([1.0, 0.0, -1.0]).log_softmax(0)
    share = torch.tensor([7.0, 8.0, 4.0]) / 19
    ((bits, slope),) = seen
    assert (data.training.weight is not None) == (equal > 1)
    assert bits == pytest.approx(-float(share @ log_probs) / math.log(2), rel=1e-5)
    assert slope == pytest.approx(((log_probs.exp() - share) / math.log(2)).tolist(), abs=1e-5)


def test_dropout_is_drawn_anew_in_each_step(tmp_path: Path) -> None:
    class Dropped(Constant):
        def forward(self, plans: torch.Tensor, context: torch.Tensor | None = None) -> torch.Tensor:
            masks.append(torch.nn.functional.dropout(torch.ones(64), training=self.training).tolist())
            return super().forward(plans, context)

    plans, how, drawn = Plans(torch.zeros(4, 2).long(), 3), Settings(6, window=2, check_every=3), []
    for number, seed in enumerate((0, 0, 1)):
        masks: list[list[float]] = []
        data, off = PlansModule(plans, plans, how, seed=0), {"enable_progress_bar": False, "logs": False}
        trainer = make_trainer(str(tmp_path / str(number)), 6, 6, data.steps, "cpu", **off)
        run_training(trainer, PriorModule(Dropped(), seed=seed), data)
        whole = [1.0] * 64
        assert [mask == whole for mask in masks] == [False, False, False, True] * 2
        drawn.append([mask for mask in masks if mask != whole])
    first, again, other = drawn
    assert first == again
    assert len({tuple(mask) for mask in first + other}) == 12


def test_in_validation_each_action_counts_the_same(tmp_path: Path) -> None:
    """Windows near the end hold the actions of few plans, and weigh less."""
    lengths = torch.tensor([12, 9, 8, 5])
    plans = Plans(torch.randint(3, (4, 12), generator=generator()), 3, lengths=lengths)
    prior = GRUPrior(3, 8)
    prior.prepare(plans, 4)
    (entry,) = trained(prior, plans, plans, Settings(1, window=4, check_every=1), tmp_path).curve
    bits = -float(prior.log_prob(plans).detach().sum()) / math.log(2) / 34
    assert entry["validation_bits"] == pytest.approx(bits, rel=1e-5)


def test_patience_is_counted_in_steps(tmp_path: Path) -> None:
    """Hardly anything is learned at so low a rate: after the first validation two more, ten steps each, are awaited."""
    plans = Plans(torch.randint(3, (40, 4), generator=generator()), 3)
    how = Settings(100, learning_rate=1e-9, check_every=10, patience=20)
    assert [one["step"] for one in trained(GRUPrior(3, 4), plans, plans, how, tmp_path).curve] == [10, 20, 30]


def test_small_gains_are_worth_going_on_for(tmp_path: Path) -> None:
    how = Settings(40, learning_rate=5e-4, check_every=5, patience=5)
    plans = Plans(torch.randint(3, (40, 4), generator=generator()).clamp(max=1), 3)
    curve = trained(GRUPrior(3, 8), plans, plans, how, tmp_path).curve
    gains = -torch.tensor([entry["validation_bits"] for entry in curve]).diff()
    assert 0 < float(gains.max()) < 0.1
    assert len(curve) > 4


def test_every_setting_changes_the_training() -> None:
    plans = torch.randint(3, (60, 9), generator=generator())
    same = {"max_steps": 6, "check_every": 6, "batch_size": 20, "progress": False}

    def score(**settings: float) -> list[float]:
        prior = GRUPrior(3, 8).fit(plans, generator=generator(), **(same | settings))
        return prior.log_prob(plans).tolist()

    base = score()
    assert score() == base
    others = {"max_steps": 4, "batch_size": 10, "window": 4, "learning_rate": 0.01, "validation": 0.5}
    others |= {"weight_decay": 9.0, "gradient_clip": 0.01}
    assert [name for name, value in others.items() if score(**{name: value}) == base] == []


def test_the_last_checkpoint_is_written_after_each_validation(tmp_path: Path) -> None:
    """Where noise is learned by heart the best one is the first; a training is resumed from the last."""
    plans = Plans(torch.randint(3, (40, 8), generator=generator()), 3)
    how = Settings(30, learning_rate=0.05, check_every=10, patience=1000)
    module = trained(GRUPrior(3, 16), plans[:28], plans[28:], how, tmp_path, logs=True)
    bits = [entry["validation_bits"] for entry in module.curve]
    assert bits == sorted(bits)
    saved = {path.stem: torch.load(path, weights_only=True) for path in (tmp_path / "checkpoints").iterdir()}
    assert {name: one["global_step"] for name, one in saved.items()} == {"best": 10, "last": 30}
    assert len(saved["last"]["curve"]) == 3
    # Without logs the same weights are kept in memory, and nothing is written.
    unlogged = trained(GRUPrior(3, 16), plans[:28], plans[28:], how, tmp_path / "none")
    for name, weights in saved["best"]["state_dict"].items():
        assert unlogged.state_dict()[name].equal(weights)
        assert module.state_dict()[name].equal(weights)
    assert not (tmp_path / "none").exists()


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


@pytest.mark.parametrize("progress", [True, False])
def test_progress_in_a_log_file_is_lines(
    progress: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("neuroprior.training.trainer.QUIET", 0.0)
    plans = torch.randint(3, (40, 4), generator=generator())
    GRUPrior(3, 4).fit(plans, generator=generator(), progress=progress, max_steps=8, check_every=2, patience=100)
    out, lines = capsys.readouterr()
    assert out == ""
    steps = [line.partition(",")[0] for line in lines.splitlines() if line.startswith("training: ")]
    assert steps == ([f"training: step {step} of at most 8" for step in (2, 4, 6, 8)] if progress else [])


def test_fitting_again_takes_the_new_plans_window() -> None:
    prior = GRUPrior(3, 8)
    for length in (3, 6):
        prior.fit(torch.randint(3, (50, length), generator=generator()), max_steps=2, progress=False)
        assert prior.window == length - 1
    given = GRUPrior(3, 8, window=2).fit(torch.randint(3, (50, 6), generator=generator()), max_steps=2, progress=False)
    assert given.window == 2


@pytest.mark.slow
@pytest.mark.parametrize("make", [GRUPrior, TransformerPrior])
@pytest.mark.parametrize("order", [2, 5])
def test_past_the_training_length(make: type[GRUPrior] | type[TransformerPrior], order: int) -> None:
    """Trained on plans of 12 actions, scored past them in plans 2, 4 and 16 times as long; prints bits an action.

    Against the same network that reads the last actions anew for each, as the beginning of a plan. The sources: a chain
    of order 2, and one in which an action is mostly the fifth last one again.
    """
    draw, training = (chain if order == 2 else echo), 12
    prior = make(4).fit(draw(20_000, training, 3), generator=generator(), progress=False)
    for times in (2, 4, 16):
        test = draw(64_000 // (times * training), times * training, times)
        with torch.no_grad():
            carried = bits_of(prior(test)[:, training:], test[:, training:])
            anew = test.unfold(1, training, 1)[:, 1:]
            windows = torch.cat([prior(some.flatten(0, 1))[:, -1] for some in anew.split(64)])
            window = bits_of(windows.view(*anew.shape[:2], 4), test[:, training:])
        differences = (carried - window).mean(1)
        worse, error = float(differences.mean()), float(differences.std() / len(test) ** 0.5)
        print(
            f"\n{make.__name__}, order {order}, {times} times: {float(carried.mean()):.4f} bits an action, window"
            f" {float(window.mean()):.4f}; more by {worse:.5f} (standard error {error:.5f})"
        )
        assert worse < 0.001


def bits_of(logits: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    return -logits.log_softmax(-1).gather(-1, actions[..., None])[..., 0] / math.log(2)


def chain(num: int, length: int, seed: int) -> torch.Tensor:
    """Plans of a chain of order 2, from its 20th action on."""
    probs = torch.from_numpy(np.random.default_rng(1).dirichlet([0.5] * 4, 16)).float()
    g, plans = generator(seed), torch.zeros(num, 2, dtype=torch.long)
    for _ in range(20 + length):
        last = plans[:, -2] * 4 + plans[:, -1]
        plans = torch.cat([plans, torch.multinomial(probs[last], 1, generator=g)], 1)
    return plans[:, -length:]


def echo(num: int, length: int, seed: int) -> torch.Tensor:
    """Plans in which an action is with probability .7 the fifth last one, else any."""
    g = generator(seed)
    plans = torch.randint(4, (num, 20 + length), generator=g)
    again = torch.rand(plans.shape, generator=g) < 0.7
    for t in range(5, plans.shape[1]):
        plans[:, t] = torch.where(again[:, t], plans[:, t - 5], plans[:, t])
    return plans[:, 20:]


def test_a_fair_share_of_unequal_plans_is_held_out(monkeypatch):
    """Of one long plan and many short ones: never nearly all actions, nor hardly any."""
    lengths = torch.tensor([300] + [2] * 39)
    plans, shares = Plans(torch.zeros(40, 300, dtype=torch.long), 2, lengths), []

    def stop(training, validation, *_):
        shares.append(int(validation.mask().sum()) / int(plans.mask().sum()))
        raise InterruptedError

    monkeypatch.setattr("neuroprior.training.trainer.PlansModule", stop)
    for seed in range(10):
        with pytest.raises(InterruptedError):
            GRUPrior(2, 4).fit(plans, generator=seeded(seed), progress=False)
    assert min(shares) >= 0.05
    assert max(shares) <= 0.55
