"""Conformance suites: what every prior and every world must do, to be run on your own as on the library's."""

import tempfile
from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from neuroprior.chi_square import alike, chi_square
from neuroprior.plans import all_plans, sees_each_step
from neuroprior.priors import Prior, load, save
from neuroprior.sampling import sample
from neuroprior.worlds import TabularWorld, World
from neuroprior.worlds.world import is_integer

FALSE_ALARM = 1e-6
"""The probability with which a right prior fails one of the tests on samples."""


def check_prior(prior: Prior, length: int | None = None, num_plans: int = 20_000, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless `prior` does what a prior must.

    With each kind of context that it takes: stepping equals `forward`, also past its window and after states were
    reordered, and `advance` equals stepping; `log_prob` sums to one over all plans of a length and fits what `sample`
    draws, by prefix tree and plan by plan (chi-square tests, each with a false alarm of 1e-6); the same seed gives the
    same plans and torch's global generator is left alone; saving and loading, and moving to a GPU where there is one,
    change nothing.

    Args:
        prior: the prior to check, trained or not.
        length: of the plans; None: the longest (at most 5) with at most 1,024 plans.
        num_plans: samples of a chi-square test.
        seed: draws plans and contexts.

    Raises:
        AssertionError: the prior breaks a rule.
    """
    actions = prior.num_actions
    if length is None:
        length = max((n for n in range(1, 6) if actions**n <= 1024), default=1)
    generator = torch.Generator().manual_seed(seed)
    window = getattr(prior, "window", None) or 0
    for kind in ("plan", "step") if prior.takes_context else (None,):
        for steps in (1, length, window + 3):
            plans = torch.randint(actions, (7, steps), generator=generator).to(prior.device)
            context = _random_context(prior, kind, 7, steps, generator)
            _check_stepping(prior, plans, context)
            _check_advancing(prior, plans, context)
        _check_total(prior, _random_context(prior, kind, 1, length, generator), length)
        for method in ("tree", "ancestral"):
            context = _random_context(prior, kind, 1, length, generator)
            _check_samples(prior, context, length, num_plans, method, generator)
        _check_seeds(prior, kind, length, generator)
    _check_copies(prior, length, generator)


def check_world(world: World, num_states: int = 50, length: int = 6, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless `world` does what a world must.

    `reset`, `step`, `observe` and `legal` return what the interface says; `step` leaves its arguments alone and treats
    each state of a batch by itself; the same seed gives the same course; `rollout` equals stepping and refuses plans of
    a wrong shape, dtype or range. A world with chance says so (`stochastic`), and its rollouts have the distribution of
    its steps (chi-square tests, together with a false alarm of 1e-6); those of a table let all plans of a start meet
    the same chance.

    Args:
        world: the world to check.
        num_states: how many random states.
        length: of the plans.
        seed: draws states and plans.

    Raises:
        AssertionError: the world breaks a rule.
    """
    generator = torch.Generator().manual_seed(seed)
    state = world.reset(num_states, torch.Generator().manual_seed(seed))
    again = world.reset(num_states, torch.Generator().manual_seed(seed))
    _require(len(state) == num_states, f"reset({num_states}) gave {len(state)} states")
    _require(state.equal(again), "reset: the same seed gave other states")
    actions = world.num_actions
    plans = torch.randint(actions, (num_states, 3, length), generator=generator).to(state.device)
    _check_step(world, state, plans[:, 0, 0], seed)
    _check_views(world, state)
    by_steps, rewards, chance = _step_through(world, state, plans, seed)
    rollout = world.rollout(state, plans, torch.Generator().manual_seed(seed))
    _require(
        rollout.rewards.shape == plans.shape, f"rollout: rewards {list(rollout.rewards.shape)}, not {list(plans.shape)}"
    )
    shape = (num_states, 3, *state.shape[1:])
    _require(rollout.final_state.shape == shape, f"rollout: final_state {list(rollout.final_state.shape)}, not {shape}")
    if not chance:
        _require(_same(rollout.final_state, by_steps), "rollout ends in other states than stepping")
        _require(_same(rollout.rewards, rewards), "rollout gives other rewards than stepping")
    else:
        _require(world.stochastic, "step: chance was seen, but the world's `stochastic` is False")
        _check_chance(world, state, plans[:, 0], seed)
    none = world.rollout(state, plans[:, :, :0])
    _require(none.final_state[:, 0].equal(state), "rollout of plans of length 0 must end where it starts")
    for wrong, what in (
        (plans[:, 0], "plans of shape [B, L]"),
        (plans[1:], "plans for too few starts"),
        (plans.float(), "plans of floating point numbers"),
        (plans + actions, "actions past the last"),
        (plans - actions, "negative actions"),
    ):
        _require(_raises(partial(world.rollout, state, wrong)), f"rollout must raise ValueError for {what}")


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)


def _same(first: Tensor, second: Tensor) -> bool:
    """Equal, up to rounding where they are floating point numbers."""
    if first.is_floating_point():
        return first.shape == second.shape and torch.allclose(first, second.to(first), atol=1e-5, equal_nan=True)
    return first.equal(second)


def _raises(call: Callable[[], object]) -> bool:
    try:
        call()
    except ValueError:
        return True
    return False


def _random_context(prior: Prior, kind: str | None, num: int, length: int, generator: torch.Generator) -> Tensor | None:
    """A random context of the kind that the prior takes, one a plan or one a step."""
    shape = (num,) if kind == "plan" else (num, length)
    if kind is None:
        return None
    if prior.num_contexts is not None:
        return torch.randint(prior.num_contexts, shape, generator=generator).to(prior.device)
    return torch.randn(*shape, prior.context_size or 0, generator=generator).to(prior.device)


@torch.no_grad()
def _check_stepping(prior: Prior, plans: Tensor, context: Tensor | None) -> None:
    """`start` and `step` give what `forward` gives; reordering the state reorders the logits."""
    num, length = plans.shape
    whole = prior(plans, context)
    shape = (num, length, prior.num_actions)
    _require(whole.shape == shape, f"forward: logits {list(whole.shape)}, not {list(shape)}")
    _require(not whole.isnan().any(), "forward: NaN in the logits")
    whole = whole.log_softmax(-1)
    seen = _at(context, 0)
    logits, state = prior.start(num, seen)
    order = torch.arange(num - 1, -1, -1, device=plans.device)
    for t in range(length):
        kind = "no context" if context is None else f"context {list(context.shape)}"
        where = f"plans of length {length}, action {t}, {kind}"
        _require(isinstance(state, Tensor) and len(state) == num, f"state must be one tensor of {num} rows ({where})")
        _require(logits.shape == (num, prior.num_actions), f"logits {list(logits.shape)} ({where})")
        gap = float((logits.log_softmax(-1) - whole[:, t]).abs().nan_to_num(0).max())
        _require(gap < 1e-4, f"stepping differs from forward by {gap:.2g} nats ({where})")
        if t + 1 < length:
            seen = _at(context, t + 1) if sees_each_step(context) else None
            backwards, _ = prior.step(plans[order, t], state[order], None if seen is None else seen[order])
            logits, state = prior.step(plans[:, t], state, seen)
            gap = float((backwards[order] - logits).abs().nan_to_num(0).max())
            _require(gap < 1e-4, f"reordering the state changes the logits by {gap:.2g} ({where})")


def _check_advancing(prior: Prior, plans: Tensor, context: Tensor | None) -> None:
    """`advance` gives what `step` gives, whether there is room or not, for all plans and for some."""
    num, length = plans.shape
    with torch.no_grad():
        for room in (0, length):
            logits, state = prior.start(num, _at(context, 0))
            _, other = prior.start(num, _at(context, 0))
            for t in range(length - 1):
                seen = _at(context, t + 1) if sees_each_step(context) else None
                logits, state = prior.step(plans[:, t], state, seen)
                again, other = prior.advance(plans[:, t], other, seen, room)
                gap = float((again - logits).abs().nan_to_num(0).max())
                _require(gap < 1e-4, f"advance differs from step by {gap:.2g} (action {t}, room {room})")
                if t % 2:  # states that were picked out go on by themselves
                    other = other[torch.arange(num, device=other.device)]


def _at(context: Tensor | None, t: int) -> Tensor | None:
    return context[:, t] if context is not None and sees_each_step(context) else context


def _all_log_probs(prior: Prior, length: int, context: Tensor | None) -> Tensor:
    plans = all_plans(prior.num_actions, length).to(prior.device)
    return prior.log_prob(plans, None if context is None else context.expand(len(plans), *context.shape[1:])).detach()


def _check_total(prior: Prior, context: Tensor | None, length: int) -> None:
    """Probabilities of all plans sum to one; a context a plan is the same context at each step."""
    log_probs = _all_log_probs(prior, length, context)
    total = float(log_probs.double().exp().sum())
    _require(abs(total - 1) < 1e-4, f"the probabilities of all plans of length {length} sum to {total:.6f}, not 1")
    if context is not None and not sees_each_step(context):
        repeated = _all_log_probs(prior, length, context[:, None].repeat(1, length, *[1] * (context.dim() - 1)))
        gap = float((repeated - log_probs).abs().max())
        _require(gap < 1e-3, f"a context a plan differs by {gap:.2g} nats from the same context at each step")


def _check_samples(
    prior: Prior,
    context: Tensor | None,
    length: int,
    num_plans: int,
    method: Literal["tree", "ancestral"],
    generator: torch.Generator,
) -> None:
    """A chi-square test of samples against `log_prob`."""
    expected = _all_log_probs(prior, length, context).double().exp().cpu() * num_plans
    given = None if context is None else context.expand(num_plans, *context.shape[1:])
    plans = sample(prior, num_plans, length, given, generator=generator, method=method).cpu().long()
    _require(plans.shape == (num_plans, length), f"sample: {list(plans.shape)}, not {[num_plans, length]}")
    base = prior.num_actions ** torch.arange(length - 1, -1, -1)
    counts = (plans * base).sum(1).bincount(minlength=len(expected)).double()
    impossible = int(counts[expected < 1e-9 * num_plans].sum())
    _require(impossible == 0, f"{method} samples: {impossible} plans whose log_prob says they cannot occur")
    p = chi_square(counts, expected)
    _require(p > FALSE_ALARM, f"{method} samples do not fit log_prob: chi-square p = {p:.2g}, {num_plans} plans")


def _check_seeds(prior: Prior, kind: str | None, length: int, generator: torch.Generator) -> None:
    """The same seed gives the same plans; torch's global generator is not used."""
    context = _random_context(prior, kind, 64, length, generator)
    before = torch.get_rng_state()
    first, second = (prior.sample(64, length, context, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    _require(first.equal(second), "sample: the same seed gave other plans")
    _require(torch.get_rng_state().equal(before), "sample used torch's global generator")


@torch.no_grad()
def _check_copies(prior: Prior, length: int, generator: torch.Generator) -> None:
    """A saved and loaded copy, and one on the GPU where there is one, say the same."""
    context = _random_context(prior, "plan" if prior.takes_context else None, 64, length, generator)
    plans = torch.randint(prior.num_actions, (64, length), generator=generator).to(prior.device)
    want = prior.log_prob(plans, context).cpu()
    with tempfile.TemporaryDirectory() as folder:
        try:
            copy = load(save(prior, folder))
        except ValueError as error:
            raise AssertionError(f"the prior cannot be saved and loaded: {error}") from error
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    for device in devices:
        copy.to(device)
        got = copy.log_prob(plans.to(device), None if context is None else context.to(device))
        _require(got.device.type == device, f"log_prob on {device} came back on {got.device}")
        # what is impossible for both is no difference
        gap = float((got.cpu() - want).abs().masked_fill(got.cpu() == want, 0).max())
        _require(gap < 1e-3, f"saved, loaded and moved to {device}, the prior differs by {gap:.2g} nats")


def _check_step(world: World, state: Tensor, action: Tensor, seed: int) -> None:
    """`step`: shapes, dtypes, seeds, and no change to what it was given."""
    kept = state.clone()
    after, reward = world.step(state, action, torch.Generator().manual_seed(seed))
    _require(state.equal(kept), "step changed the state that it was given")
    _require(after.shape == state.shape, f"step: state {list(after.shape)}, not {list(state.shape)}")
    _require(after.dtype == state.dtype, f"step: state of {after.dtype}, not {state.dtype}")
    _require(reward.shape == action.shape, f"step: reward {list(reward.shape)}, not {list(action.shape)}")
    _require(reward.is_floating_point(), f"step: reward of {reward.dtype}, not floating point")
    _require(not reward.isnan().any(), "step: NaN in the reward")
    again, _ = world.step(state, action, torch.Generator().manual_seed(seed))
    _require(after.equal(again), "step: the same seed gave other states")


def _check_views(world: World, state: Tensor) -> None:
    """`observe` and `legal`."""
    seen = world.observe(state)
    index = is_integer(seen) and seen.dim() == 1
    _require(
        len(seen) == len(state) and (index or (seen.is_floating_point() and seen.dim() == 2)),
        f"observe must give indices [N] or floating point features [N, C], not {seen.dtype} {list(seen.shape)}",
    )
    over = world.is_over(state)
    _require(over.dtype == torch.bool and over.shape == state.shape[:1], f"is_over must be bool [{len(state)}]")
    legal = world.legal(state)
    shape = [len(state), world.num_actions]
    _require(legal.dtype == torch.bool and list(legal.shape) == shape, f"legal must be bool {shape}")
    _require(bool(legal.any(1).all()), "legal: a state without any legal action")
    if world.all_legal:
        _require(bool(legal.all()), "all_legal is True, but legal leaves actions out")


def _step_through(world: World, state: Tensor, plans: Tensor, seed: int) -> tuple[Tensor, Tensor, bool]:
    """Final states `[B, P]` and rewards `[B, P, L]` of single steps, each start alone; and whether chance was seen."""
    batch, num_plans, length = plans.shape
    finals, rewards = [], []
    chance = False
    for p in range(num_plans):
        now, row = state, []
        for t in range(length):
            after, reward = world.step(now, plans[:, p, t], torch.Generator().manual_seed(seed))
            other, _ = world.step(now, plans[:, p, t], torch.Generator().manual_seed(seed + 1))
            chance = chance or not other.equal(after)
            if not chance:
                half, _ = world.step(now[batch // 2 :], plans[batch // 2 :, p, t])
                _require(_same(half, after[batch // 2 :]), "step: what happens in a state depends on its batch")
            now = after
            row.append(reward)
        finals.append(now)
        rewards.append(torch.stack(row, -1))
    return torch.stack(finals, 1), torch.stack(rewards, 1), chance


def _check_chance(world: World, state: Tensor, plans: Tensor, seed: int, times: int = 200) -> None:
    """Rollouts in a world with chance against steps, `times` from each start `[N, ...]` by its plan `[N, L]`."""
    generator = torch.Generator().manual_seed(seed)
    group = torch.arange(len(state)).repeat_interleave(times)
    now, plans = state.repeat_interleave(times, 0), plans.repeat_interleave(times, 0)
    rollout = world.rollout(now, plans[:, None], generator)
    again = world.rollout(now, plans[:, None], torch.Generator().manual_seed(seed))
    _require(_same(rollout.final_state, again.final_state), "rollout: the same seed gave other states")
    rewards = []
    for t in range(plans.shape[1]):
        now, reward = world.step(now, plans[:, t], generator)
        rewards.append(reward)
    seen = torch.cat([rollout.final_state.reshape(len(now), -1).double(), rollout.rewards[:, 0].double()], 1)
    due = torch.cat([now.reshape(len(now), -1).double(), torch.stack(rewards, 1).double()], 1)
    for column in range(seen.shape[1]):
        p = alike(seen[:, column].cpu(), due[:, column].cpu(), group)
        what = "rewards" if column >= seen.shape[1] - plans.shape[1] else "final states"
        _require(p > FALSE_ALARM / seen.shape[1], f"{what} of rollout do not fit those of steps: p = {p:.2g}")
    if isinstance(world, TabularWorld):
        twice = world.rollout(state, plans[::times, None].expand(-1, 2, -1), generator)
        _require(twice.rewards[:, 0].equal(twice.rewards[:, 1]), "rollout: the same plan twice met different chance")
