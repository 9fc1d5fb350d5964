"""The conformance suite of priors."""

import tempfile
from copy import deepcopy
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor

from neuroprior._checks import kind_of
from neuroprior.plans import Plans, all_plans
from neuroprior.priors import Prior, load, save
from neuroprior.sampling.ancestral import sample
from neuroprior.sampling.states import map_state, select_rows, tensors_in
from neuroprior.sampling.stepping import check_outputs
from neuroprior.testing.chi_square import chi_square
from neuroprior.testing.rules import FALSE_ALARM, PRIOR_CHECKS, check_by_kind, raises, require, unless_refused


def check_prior(prior: Any, length: int | None = None, num_plans: int = 20_000, seed: int = 0) -> None:
    """Raise AssertionError, with a message that says how, unless `prior` does what a prior must.

    `fit` returns the prior (tried of those without settings), and `step` leaves the state that it is given as it is.
    With each kind of context that it takes: stepping equals `forward`, also past its window; rows of a state taken
    alone, in another order, predict what they predict among all; `log_prob` sums to one over all plans of a length and
    fits what `sample` draws, by prefix tree and plan by plan (chi-square tests, each with a false alarm of 1e-6); the
    same seed gives the same plans and torch's global generator is left alone; saving and loading, and moving to a GPU
    where there is one, change nothing.

    A prior over vectors is checked by `neuroprior.control.check_vector_prior`.

    Args:
        prior: the prior to check, trained or not; over numbered actions or over vectors.
        length: of the plans; None: the longest (at most 5) with at most 1,024 plans; 5 for vectors.
        num_plans: samples of a chi-square test, at most.
        seed: draws plans and contexts.

    Raises:
        AssertionError: the prior breaks a rule.

    Example:
        >>> check_prior(MarkovPrior(3, order=1).fit(torch.tensor([[0, 1, 2, 0, 1]])))
    """
    if check_by_kind(PRIOR_CHECKS, prior, length, num_plans, seed):
        return
    received = f"the class {prior.__name__}" if isinstance(prior, type) else type(prior).__name__
    require(isinstance(prior, Prior), f"`prior` must be a Prior, as `fit` has to return it, got {received}")
    actions = prior.num_actions
    if length is None:
        length = max((n for n in range(1, 6) if actions**n <= 1024), default=1)
    generator = torch.Generator().manual_seed(seed)
    window = getattr(prior, "window", None) or 0
    for stays in (False, True) if prior.takes_context else (False,):
        for steps in (1, length, window + 3):
            plans = torch.randint(actions, (7, steps), generator=generator).to(prior.device)
            context = _random_context(prior, 7, steps, generator, stays)
            _check_outputs(prior, plans, context)
            _check_stepping(prior, plans, context, stays)
        _check_total(prior, _random_context(prior, 1, length, generator, stays), length)
        for method in ("tree", "ancestral"):
            context = _random_context(prior, 1, length, generator, stays)
            _check_samples(prior, context, length, num_plans, method, generator)
        _check_seeds(prior, length, generator)
    _check_copies(prior, length, generator)
    _check_fit(prior, length, generator)
    if type(prior).__module__.startswith("neuroprior."):
        _check_refusals(prior, generator)


def _random_context(
    prior: Prior, num: int, length: int, generator: torch.Generator, stays: bool = False
) -> Tensor | None:
    """A random context of each step, of the kind that the prior takes; one that `stays` is that of all steps."""
    if stays:
        once = _random_context(prior, num, 1, generator)
        return None if once is None else once.expand(num, length, *once.shape[2:])
    shape = (num, length)
    if prior.num_contexts is not None:
        return torch.randint(prior.num_contexts, shape, generator=generator).to(prior.device)
    if prior.num_patterns is not None:
        # Low numbers, which a prior may have learned, and one that no plans have.
        codes = torch.randint(8, (*shape, prior.num_patterns), generator=generator, dtype=torch.int32)
        return torch.where(codes == 7, 2**31 - 1, codes).to(torch.int32).to(prior.device)
    if prior.context_size is None:
        return None
    return torch.randn(*shape, prior.context_size, generator=generator).to(prior.device)


@torch.no_grad()
def _check_outputs(prior: Prior, plans: Tensor, context: Tensor | None) -> None:
    """`start` and `step` return floating point logits `[N, A]` and a state, and leave the state before as it is."""
    step_context = _context_at(context, 0)
    state: Any = None
    kept: Any = None
    for method in ("start", "step"):
        outputs = (
            prior.start(len(plans), step_context) if method == "start" else prior.step(plans[:, 0], state, step_context)
        )
        _, after = unless_refused(partial(check_outputs, outputs, len(plans), prior.num_actions, method))
        if kept is not None:
            same = all(map(torch.equal, tensors_in(kept), tensors_in(state)))
            require(same, "step must leave the state that it is given as it is, and return another")
        kept, state = map_state(torch.clone, after), after


def _check_fit(prior: Prior, length: int, generator: torch.Generator) -> None:
    """`fit` returns the prior itself, of which a copy learns: not of those whose training takes long."""
    if prior.fit_settings:
        return
    context, copy = _random_context(prior, 7, length, generator), deepcopy(prior)
    plans = torch.randint(prior.num_actions, (7, length), generator=generator).to(prior.device)
    try:
        result = copy.fit(Plans(plans, prior.num_actions, context=context), generator=generator)
    except ValueError:  # it cannot learn from these
        return
    require(result is copy, f"fit must return the prior itself, got {kind_of(result)}")


@torch.no_grad()
def _check_stepping(prior: Prior, plans: Tensor, context: Tensor | None, stays: bool) -> None:
    """`start` and `step` give what `forward` gives; some rows, reordered, have the logits that they have among all."""
    num, length = plans.shape
    if stays:
        _, state = prior.start(num, _context_at(context, 0))
        try:
            prior.step(plans[:, 0], state, None)
        except Exception as error:
            raise AssertionError(
                f"step: {error}; `step` is given None where the last context goes on: what is needed later has to be"
                " kept in the state"
            ) from error
    whole = unless_refused(partial(prior, plans, context))
    # On a GPU cuDNN reads sequences with 10 bits of mantissa (TF32), unless that is switched off.
    rounding = 1e-4 if plans.device.type == "cpu" else 1e-3
    require(not whole.isnan().any(), "forward: NaN in the logits")
    whole = whole.log_softmax(-1)
    step_context = _context_at(context, 0)
    logits, state = prior.start(num, step_context)
    rows = torch.arange(num - 1, -1, -2, device=plans.device)
    gap = _largest_gap(prior(plans[rows], None if context is None else context[rows]), whole[rows])
    require(gap < rounding, f"forward: the logits of a plan change by {gap:.2g} nats with the plans beside it")
    for t in range(length):
        kind = "no context" if context is None else f"context {list(context.shape)}"
        where = f"plans of length {length}, action {t}, {kind}"
        gap = _largest_gap(logits, whole[:, t])
        require(gap < rounding, f"stepping differs from forward by {gap:.2g} nats ({where})")
        if t + 1 < length:
            step_context = None if stays else _context_at(context, t + 1)
            few, _ = prior.step(
                plans[rows, t], select_rows(state, rows), None if step_context is None else step_context[rows]
            )
            logits, state = prior.step(plans[:, t], state, step_context)
            gap = _largest_gap(few, logits[rows])
            message = f"step: the logits of a plan change by {gap:.2g} nats with the plans beside it ({where})"
            require(gap < rounding, message)


def _largest_gap(logits: Tensor, others: Tensor) -> float:
    """The largest difference of two log-probabilities."""
    return float((logits.log_softmax(-1) - others.log_softmax(-1)).abs().nan_to_num(0).max())


def _check_refusals(prior: Prior, generator: torch.Generator) -> None:
    """Unknown actions and contexts are refused, as `Prior.check_start` and `Prior.check_step` do."""
    context = _context_at(_random_context(prior, 3, 1, generator), 0)
    _, state = prior.start(3, context)
    for action in (-1, prior.num_actions):
        wrong = torch.full((3,), action, device=prior.device)
        refused = raises(partial(prior.step, wrong, state))
        require(refused, f"step must raise ValueError for action {action}, see `Prior.check_step`")
    wrong_context = None if prior.takes_context else torch.zeros(3, dtype=torch.long, device=prior.device)
    what = "no context" if prior.takes_context else "a context, of which it takes none"
    refused = raises(partial(prior.start, 3, wrong_context))
    require(refused, f"start must raise ValueError for {what}, see `Prior.check_start`")
    if prior.num_contexts is not None:
        unknown = torch.full((3,), prior.num_contexts, device=prior.device)
        require(raises(partial(prior.start, 3, unknown)), "start must raise ValueError for an unknown context")
        right = torch.zeros(3, dtype=torch.long, device=prior.device)
        refused = raises(partial(prior.step, right, state, unknown))
        require(refused, "step must raise ValueError for an unknown context")


def _context_at(context: Tensor | None, t: int) -> Tensor | None:
    return None if context is None else context[:, t]


def _all_log_probs(prior: Prior, length: int, context: Tensor | None) -> Tensor:
    plans = all_plans(prior.num_actions, length).to(prior.device)
    context = None if context is None else context.expand(len(plans), *context.shape[1:])
    return prior.log_prob(Plans(plans, prior.num_actions, context=context)).detach()


def _check_total(prior: Prior, context: Tensor | None, length: int) -> None:
    """Probabilities of all plans sum to one."""
    log_probs = _all_log_probs(prior, length, context)
    total = float(log_probs.double().exp().sum())
    require(abs(total - 1) < 1e-4, f"the probabilities of all plans of length {length} sum to {total:.6f}, not 1")


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
    contexts = None if context is None else context.expand(num_plans, *context.shape[1:])
    plans = sample(prior, num_plans, length, contexts, generator=generator, method=method).cpu().long()
    require(plans.shape == (num_plans, length), f"sample: {list(plans.shape)}, not {[num_plans, length]}")
    base = prior.num_actions ** torch.arange(length - 1, -1, -1)
    counts = (plans * base).sum(1).bincount(minlength=len(expected)).double()
    impossible = int(counts[expected < 1e-9 * num_plans].sum())
    require(impossible == 0, f"{method} samples: {impossible} plans whose log_prob says they cannot occur")
    p = chi_square(counts, expected)
    require(p > FALSE_ALARM, f"{method} samples do not fit log_prob: chi-square p = {p:.2g}, {num_plans} plans")


def _check_seeds(prior: Prior, length: int, generator: torch.Generator) -> None:
    """The same seed gives the same plans; torch's global generator is not used."""
    context = _random_context(prior, 64, length, generator)
    before = torch.get_rng_state()
    first, second = (prior.sample(64, length, context, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    require(first.equal(second), "sample: the same seed gave other plans")
    require(torch.get_rng_state().equal(before), "sample used torch's global generator")


@torch.no_grad()
def _check_copies(prior: Prior, length: int, generator: torch.Generator) -> None:
    """A saved and loaded copy, and one on the GPU where there is one, say the same."""
    context = _random_context(prior, 64, length, generator)
    plans = torch.randint(prior.num_actions, (64, length), generator=generator).to(prior.device)
    want = prior.log_prob(Plans(plans, prior.num_actions, context=context)).cpu()
    with tempfile.TemporaryDirectory() as folder:
        try:
            copy = load(save(prior, folder))
        except ValueError as error:
            raise AssertionError(f"the prior cannot be saved and loaded: {error}") from error
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    for device in devices:
        copy.to(device)
        there = None if context is None else context.to(device)
        got = copy.log_prob(Plans(plans.to(device), prior.num_actions, context=there))
        require(got.device.type == device, f"log_prob on {device} came back on {got.device}")
        # what is impossible for both is no difference
        gap = float((got.cpu() - want).abs().masked_fill(got.cpu() == want, 0).max())
        require(gap < 1e-3, f"saved, loaded and moved to {device}, the prior differs by {gap:.2g} nats")
