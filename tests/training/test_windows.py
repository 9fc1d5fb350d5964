"""Training in windows: what each batch holds, the hidden state carried over, and priors that read as trained."""

import math

import pytest
import torch

from neuroprior import GRUPrior, Plans, TransformerPrior
from neuroprior.training import PlansModule, Settings, bits
from neuroprior.training.batches import MAX_VALIDATION_ACTIONS, Walk, Windows
from tests.support.sources import refuses, seeded

SMALL = [GRUPrior(3, 8, lags=4, seed=1), GRUPrior(3, 8, num_layers=2, lags=1), TransformerPrior(3, 16, lags=3, seed=1)]


def long_plans(num_plans: int = 5, length: int = 37) -> Plans:
    actions = torch.randint(3, (num_plans, length), generator=seeded(0))
    lengths = torch.randint(1, length + 1, (num_plans,), generator=seeded(1))
    return Plans(actions, 3, lengths=lengths, context=torch.arange(length).expand(num_plans, -1))


@pytest.mark.parametrize(("window", "batch_size"), [(4, 3), (4, 100), (7, 1), (37, 2), (50, 9)])
def test_a_pass_reads_every_action_once_and_in_order(window, batch_size):
    plans = long_plans()
    windows = PlansModule(plans, plans, Settings(batch_size=batch_size, window=window), seed=3).training
    current = []
    for index in Walk(windows, windows.steps, 3):
        batch = windows[index]
        for row in range(len(batch.actions)):
            taken = batch.weight[row] > 0
            place = batch.context[row][taken]
            if len(place):
                before = int(batch.previous[row]) if batch.previous is not None else 3
                current.append((batch.actions[row][taken].tolist(), place.tolist(), before))
    total = sorted(len(actions) for actions, _, _ in current)
    assert sum(total) == int(plans.lengths.sum())
    steps = torch.zeros(5, 37, dtype=torch.long)
    for actions, place, before in current:
        assert place == list(range(place[0], place[0] + len(place)))
        found = [
            n
            for n in range(5)
            if plans.actions[n, place].tolist() == actions
            and plans.lengths[n] > place[-1]
            and before == (3 if place[0] == 0 else int(plans.actions[n, place[0] - 1]))
            and steps[n, place].sum() == 0
        ]
        assert found
        steps[found[0], place] = 1
    assert torch.equal(steps.bool(), plans.mask())


def test_an_epoch_depends_on_its_number_and_the_seed_alone():
    windows = Windows(long_plans(9), 4, 2)

    def epoch(number: int, seed: int = 0):
        walk = Walk(windows, 10, seed)
        walk.set_epoch(number)
        return [(step.pieces.tolist(), step.number, step.continues) for step in walk]

    assert epoch(3) == epoch(3) != epoch(4)
    assert epoch(3) != epoch(3, seed=1)
    # An epoch begins without a hidden state, in the middle of pieces too, so that it can be begun anywhere.
    first = [epoch(k)[0] for k in range(8)]
    assert {number for _, number, _ in first} > {0}
    assert not any(continues for _, _, continues in first)
    # No pass of one seed is a pass of the next.
    walks = [Walk(windows, 6 * windows.steps, seed) for seed in (0, 1)]
    pieces = [torch.cat([step.pieces for step in walk if step.number == 0]).view(6, -1).tolist() for walk in walks]
    assert not any(order in pieces[1] for order in pieces[0])


@pytest.mark.parametrize("prior", SMALL)
def test_windows_with_the_hidden_state_cost_what_the_whole_costs(prior):
    prior.set_training_window(40)
    plans = long_plans()
    lengths = torch.tensor([37, 33, 29, 36, 30])
    windows = Windows(Plans(plans.actions, 3, lengths=lengths), 5, 100, min_windows=8)
    assert windows.windows == 8, "pieces as long as the longest plan, so that the hidden state goes all the way"
    total, hidden = 0.0, None
    for index in Walk(windows):
        cost, _, hidden = bits(prior, windows[index], hidden)
        total += float(cost.detach())
    whole = -float(prior.log_prob(Plans(plans.actions, 3, lengths)).sum().detach()) / math.log(2)
    assert total == pytest.approx(whole, rel=1e-5)


@pytest.mark.parametrize("prior", SMALL)
def test_stepping_equals_forward_far_past_the_window(prior):
    prior.set_training_window(5)
    plans = torch.randint(3, (4, 40), generator=seeded(2))
    logits, state = prior.start(4)
    stepped = [logits]
    for t in range(39):
        logits, state = prior.step(plans[:, t], state)
        stepped.append(logits)
    assert torch.allclose(torch.stack(stepped, 1), prior(plans), atol=1e-5)
    if isinstance(prior, TransformerPrior):
        far = plans.clone()
        far[:, :10] = (far[:, :10] + 1) % 3
        # two layers of span 5 and three lags reach no further than 13 inputs back
        assert torch.allclose(prior(far)[:, 25:], prior(plans)[:, 25:], atol=1e-6)


def test_the_hidden_state_is_learned_to_be_used():
    """A plan's bit comes again every fourth action; at the beginning of a window only the hidden state holds it."""
    bit = torch.randint(2, (400, 1), generator=seeded(0))
    actions = torch.where(torch.arange(24) % 4 == 0, bit, 2)
    prior = GRUPrior(3, 16, lags=1).fit(
        Plans(actions, 3),
        generator=seeded(1),
        window=12,
        batch_size=100,
        max_steps=220,
        progress=False,
        learning_rate=0.01,
    )
    assert prior.window is None
    again = prior.action_log_probs(Plans(actions, 3))[:, 12].detach()
    assert float(again.mean()) > -0.1


def test_a_window_of_its_own_does_not_go_with_long_plans():
    with refuses("window"):
        GRUPrior(3, 8, window=4).fit(torch.randint(3, (9, 30), generator=seeded(0)), window=10, progress=False)


def test_the_seed_draws_what_is_validated():
    """As few plans as have enough actions: two of eight, the same for one seed, others for other seeds."""
    actions = torch.randint(2, (8, MAX_VALIDATION_ACTIONS * 3 // 4), generator=seeded(0), dtype=torch.uint8)
    some = Plans(actions[:, :9], 2)
    drawn = [PlansModule(some, Plans(actions, 2), Settings(), seed).validation.plans.actions for seed in range(6)]
    assert all(len(plans) == 2 for plans in drawn)
    assert PlansModule(some, Plans(actions, 2), Settings(), 3).validation.plans.actions.equal(drawn[3])
    assert sum(not plans.equal(drawn[0]) for plans in drawn) > 2


@pytest.mark.parametrize(
    ("lengths", "read"),
    [
        ([16] * 2000, 1024),  # enough actions, of enough plans
        ([100] * 300, 256),  # enough plans
        ([1000] * 40, 40),  # too few plans: all
        ([1000] * 90, 66),  # as many actions as are read at most
        ([MAX_VALIDATION_ACTIONS] * 3, 1),
        ([12_000, *[10] * 300, *[0] * 50], 301),  # a long one does not crowd out the others; empty ones are ignored
        ([17_000, *[10] * 2000, *[0] * 50], 256),
    ],
)
def test_validation_reads_enough_actions_of_enough_plans(lengths, read):
    """2 ** 14 actions, if these are of 256 plans; else 256 plans, or 2 ** 16 actions if these are of fewer plans."""
    actions = torch.arange(max(lengths)).remainder(57).to(torch.uint8).expand(len(lengths), -1)
    data = PlansModule(long_plans(), Plans(actions, 57, torch.tensor(lengths)), Settings(), 0)
    assert len(data.validation.plans) == read


@pytest.mark.parametrize(("num_plans", "length"), [(1, 10_000), (20, 1000), (100, 1000), (1, 100_000)])
def test_the_hidden_state_is_carried_by_default(num_plans, length):
    plans = Plans(torch.randint(3, (num_plans, length), generator=seeded(0)), 3)
    data = PlansModule(plans, plans, Settings(), 0)
    for windows in (data.training, data.validation):
        longest = -(-length // 128)
        assert windows.windows >= min(8, longest)
        share = sum(step.continues for step in Walk(windows)) / windows.steps
        assert share >= 0.8


def test_few_plans_are_validated_often():
    plans = Plans(torch.randint(3, (200, 20), generator=seeded(0)), 3)
    data = PlansModule(plans, plans, Settings(), 0)
    assert (data.steps, data.epochs) == (10, 100)
    data = PlansModule(plans, plans, Settings(check_every=40, max_steps=100), 0)
    assert (data.steps, data.epochs) == (34, 3)
    # Two passes between two validations, but at least 10 steps and at most 100.
    assert [Settings(max_steps=1000).epochs(steps) for steps in (2, 20, 200)] == [(100, 10), (25, 40), (10, 100)]


def test_training_is_as_long_as_the_plans_are_many():
    """Fifty passes, but 1,000 to 4,000 steps, 1,000 where plans are short; patience is a share; what is given stays."""
    chosen = [Settings().for_passes(steps, 33) for steps in (2, 20, 40, 200)]
    assert [how.max_steps for how in chosen] == [1000, 1000, 2000, 4000]
    assert [how.patience for how in chosen] == [300, 300, 600, 1200]
    assert [Settings().for_passes(steps, 32).max_steps for steps in (2, 200)] == [1000, 1000]
    assert Settings(max_steps=30, patience=7).for_passes(200, 500) == Settings(max_steps=30, patience=7)
    assert [Settings().batches_of(length) for length in (4, 32, 64, 500)] == [64, 64, 32, 16]
    assert Settings(batch_size=5).batches_of(500) == 5
    plans = Plans(torch.randint(3, (400, 300), generator=seeded(0)), 3)
    data = PlansModule(plans, plans, Settings(), 0)
    assert data.training.group_size == 16
    assert data.settings.max_steps == min(50 * data.training.steps, 4000)
