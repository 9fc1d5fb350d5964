"""Work that is shared among threads."""

import pytest
import torch

from neuroprior import GRUPrior, MarkovPrior
from neuroprior._threads import share
from neuroprior.sampling import ancestral, stepping
from tests.support.sources import seeded


@pytest.fixture(params=[1, 3])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@torch.no_grad()
def test_each_part_is_done_once_on_one_thread_of_torch(threads):
    seen = []
    share(lambda part: seen.append((part, torch.get_num_threads(), torch.is_grad_enabled())), range(7))
    assert sorted(seen) == [(part, 1, False) for part in range(7)]
    assert torch.get_num_threads() == threads
    share(seen.append, [])
    assert len(seen) == 7


def test_an_error_in_a_part_is_raised(threads):
    with pytest.raises(ZeroDivisionError):
        share(lambda part: 1 / part, [1, 0, 2])
    assert torch.get_num_threads() == threads


def test_plans_do_not_depend_on_the_number_of_threads(threads, monkeypatch):
    monkeypatch.setattr(ancestral, "CACHED", 1)
    prior, parts = GRUPrior(3, 8, num_contexts=2), []
    context = torch.randint(2, (50, 6), generator=seeded(1))
    whole = prior.sample(50, 6, context, generator=seeded(0))
    monkeypatch.setattr(ancestral, "FEWEST", 8)
    monkeypatch.setattr(stepping, "WORTH_THREADS", 0)  # so few plans are not worth them else
    monkeypatch.setattr(ancestral, "share", lambda work, given: parts.append(len(given)) or share(work, given))
    assert torch.equal(prior.sample(50, 6, context, generator=seeded(0)), whole)
    assert parts == [{1: 7, 3: 9}[threads]]


class Watched:
    """Writes down how many threads torch takes for how many plans."""

    def step(self, action, state, context=None):
        self.log.append((len(action), torch.get_num_threads()))
        return super().step(action, state, context)


class WatchedGRU(Watched, GRUPrior):
    pass


class WatchedChain(Watched, MarkovPrior):
    pass


@pytest.mark.parametrize(
    ("prior", "number", "shared"),
    [(WatchedGRU(3, 64), 10, False), (WatchedGRU(3, 64), 20_000, True), (WatchedChain(3, 1), 20_000, False)],
    ids=["few plans", "many plans", "a table"],
)
def test_only_steps_of_many_plans_and_weights_take_several_threads(threads, prior, number, shared):
    prior.log = []
    stepper = stepping.Stepper(prior)
    with torch.no_grad():
        _, state = stepper.start(number)
        stepper.step(torch.zeros(number, dtype=torch.long), state)
    assert prior.log == [(number, threads if shared else 1)]
    assert torch.get_num_threads() == threads
