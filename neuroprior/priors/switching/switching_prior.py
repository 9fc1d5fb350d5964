"""The switching prior: hidden modes, each a chain of its own, that persist and switch, fitted by exact EM."""

from collections.abc import Iterator
from copy import copy
from math import inf
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_memory, check_share, check_sizes, is_number
from neuroprior._random import generator_on
from neuroprior.plans import Plans
from neuroprior.priors.counts.histories import Counts, Tree
from neuroprior.priors.counts.history_prior import HistoryPrior, check_depth
from neuroprior.priors.learning import counted_plans, plans_for, training_plans
from neuroprior.priors.prior import taken_of
from neuroprior.priors.switching.forward_backward import TINY, Smoothed, most_probable_path, predict, smooth
from neuroprior.priors.switching.mode_chains import ModeChains
from neuroprior.priors.switching.spectral_start import spectral_modes
from neuroprior.sampling.states import State

SEGMENT = 20
"""Mean length of the random segments, a mode each, that a fit starts from."""

SURE = 0.8
"""Probability that a spectral start gives to the mode that it found; the rest is spread evenly."""

SHORT_RUN = 8
"""Iterations after which the best of the restarts goes on alone (Biernacki, Celeux and Govaert 2003)."""

IMPOSSIBLE = 1e-100
"""Likelihood of an action in a mode that cannot take it, where modes are inferred."""

ELEMENTS = 2**24
"""Sequences are inferred together until there are so many elements in a tensor."""


class ModePosterior(NamedTuple):
    """What plans say about the modes behind their actions.

    Attributes:
        filtered: `[N, L, K]`, float64: the modes given the actions so far, the present one among them.
        smoothed: `[N, L, K]`, float64: the modes given the whole plan.
        path: `[N, L]`, int64: the most probable modes of the whole plan together (Viterbi). Beyond a plan's end these
            have no meaning.
        moves: `[N, K, K]`, float64: how often each mode (row) is expected to be followed by each (column), one action
            later, given the whole plan.
    """

    filtered: Tensor
    smoothed: Tensor
    path: Tensor
    moves: Tensor


class Modes(NamedTuple):
    """What is known of the modes.

    Attributes:
        first: `[K * D]`: the probabilities of the first mode and phase.
        transitions: `[C, K, K]`.
        expected: `[F, P, K]`: in each fold, how often a mode took each action after each of the longest histories.
    """

    first: Tensor
    transitions: Tensor
    expected: Tensor


class SwitchingPrior(HistoryPrior):
    """K hidden modes, each with a Markov chain of its own; the mode persists, and switches depending on the context.

    A hidden Markov model with autoregressive emissions (Hamilton 1989), fitted by expectation maximisation with exact
    forward-backward passes (Baum, Petrie, Soules and Weiss 1970). In mode k action a after the history h of the last
    `order` actions (in a context) has the probability (n_k(h, a) + s d(h) q_k(a | h)) / (n_k(h) + s d(h)), where n_k
    are expected counts, d(h) is the number of different actions that followed h, s is `smoothing`, and q_k is the
    mode's distribution after the history without its oldest action, mixed with a share `sharing` of what all modes
    together did after h. So a mode that was hardly ever in a place does there what the others do.

    EM starts from random modes, from those whose deviations from the average policy go together (`spectral_modes`), and
    from those of a prior of half the order; the most likely after a few iterations go on. Ordinary EM infers the modes
    of a sequence with counts that hold its own actions, and so learns modes that explain these very sequences. Here the
    plans are divided into folds, and the modes of each are inferred with the counts of the others (`folds`; of groups,
    where plans have them).

    Args:
        num_actions: A.
        num_modes: K.
        order: >= 0, the number of past actions that a mode's chain takes into account.
        num_contexts: number of context indices, for a prior that takes an index.
        smoothing: >= 0; s above, and the pseudo-counts with which the transitions in a context are those of all
            contexts. 0: maximum likelihood.
        sharing: from 0 to 1; see above.
        stay: >= 0, pseudo-counts of staying in each mode.
        switching: "context": the transitions into the mode of an action depend on the context of the action;
            "constant": they do not.
        phases: D >= 1. A mode's duration is geometric with 1, and the sum of D geometric ones with more: a negative
            binomial distribution, the semi-Markov option.
        folds: >= 1; 1: ordinary EM.
        restarts: >= 1, random starts of EM.
        max_iterations: >= 0, of EM.
        tolerance: EM ends when an iteration brings less than so many nats per action.

    Raises:
        ValueError: an argument is out of range.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1] * 10 + [2, 3] * 10]).repeat(12, 1), 4)
        >>> prior = SwitchingPrior(4, num_modes=2, order=0, folds=2, restarts=1).fit(
        ...     plans, generator=torch.Generator().manual_seed(0)
        ... )
        >>> modes = prior.posterior(plans[:1]).path[0]
        >>> modes[0].item() == modes[19].item() != modes[20].item()
        True
    """

    first: Tensor
    """`[K * D]`, float64: the probabilities of the first mode (and phase)."""

    transitions: Tensor
    """`[C, K, K]`, float64: from a mode (row) to the next (column), into each context; C is 1 if they are constant."""

    tables: tuple[str, ...] = (*HistoryPrior.tables, "first", "transitions")
    actions_at_once = 2**17

    def __init__(
        self,
        num_actions: int,
        num_modes: int = 2,
        order: int = 1,
        num_contexts: int | None = None,
        smoothing: float = 8.0,
        sharing: float = 0.1,
        stay: float = 5.0,
        switching: Literal["context", "constant"] = "context",
        phases: int = 1,
        folds: int = 5,
        restarts: int = 4,
        max_iterations: int = 100,
        tolerance: float = 1e-4,
    ) -> None:
        check_sizes(num_modes=num_modes, phases=phases, folds=folds, restarts=restarts)
        if num_contexts is not None:
            check_sizes(num_contexts=num_contexts)
        check_depth("order", order)
        check_count("max_iterations", max_iterations, 0)
        numbers: dict[str, object] = {"smoothing": smoothing, "stay": stay, "tolerance": tolerance}
        for name, value in numbers.items():
            if not is_number(value) or not 0 <= value < inf:
                raise ValueError(f"`{name}` must be a finite number of at least 0, got {value!r}")
        check_share("sharing", sharing)
        if switching not in ("context", "constant"):
            raise ValueError(f'`switching` must be "context" or "constant", got {switching!r}')
        self.num_modes, self.order, self.phases, self.folds, self.restarts = num_modes, order, phases, folds, restarts
        self.smoothing, self.sharing, self.stay = float(smoothing), float(sharing), float(stay)
        self.switching: Literal["context", "constant"] = switching
        self.max_iterations, self.tolerance = max_iterations, float(tolerance)
        check_memory(
            8 * (num_contexts or 1) * (num_modes * phases) ** 2,
            num_contexts=num_contexts,
            num_modes=num_modes,
            phases=phases,
        )
        super().__init__(num_actions, order, num_contexts)

    @property
    def config(self) -> dict[str, Any]:
        model = ("num_modes", "order", "smoothing", "sharing", "stay", "switching", "phases")
        learning = ("folds", "restarts", "max_iterations", "tolerance")
        return super().config | {name: getattr(self, name) for name in model + learning}

    @property
    def fit_settings(self) -> tuple[str, ...]:
        return ("warm_start",)

    # Stepping: the state is the filtered modes and the history.

    def start(self, batch_size: int, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_start(batch_size, context)
        node = self.start_node.long().expand(batch_size)
        context = torch.zeros_like(node) if context is None else context.long()
        return self._forecast(self.first.expand(batch_size, -1), node, context)

    def step(self, action: Tensor, state: Any, context: Tensor | None = None) -> tuple[Tensor, State]:
        self.check_step(action, context)
        contexts, action = self.num_contexts or 1, action.long()
        modes, code = state
        node, last = code.div(contexts, rounding_mode="floor"), code % contexts
        modes = modes * self._likelihood(taken_of(self.log_probs[self._row(node, last)], action))
        modes = modes / modes.sum(-1, keepdim=True).clamp(min=TINY)
        context = last if context is None else context.long()
        modes = (modes[:, :, None] * self._matrices()[self._cell(context)]).sum(1)
        return self._forecast(modes, self.next_node.view(-1)[node * self.num_actions + action].long(), context)

    def _forecast(self, modes: Tensor, node: Tensor, context: Tensor) -> tuple[Tensor, State]:
        """The logits, and the state: the modes before the action `[N, K * D]`, and where the chain is, int64 `[N]`."""
        logits = self._mix(modes, self.log_probs[self._row(node, context)])
        return logits, (modes, node * (self.num_contexts or 1) + context)

    def _mix(self, modes: Tensor, log_probs: Tensor) -> Tensor:
        """Logits `[..., A]` of modes `[..., K * D]` with their actions' log-probabilities `[..., K, A]`."""
        weights = self._sum_phases(modes).clamp(min=TINY).log()
        return (weights[..., None] + log_probs).logsumexp(-2).float()

    def forward(self, plans: Tensor, context: Tensor | None = None) -> Tensor:
        num, length = plans.shape
        if plans.numel() == 0:
            return torch.zeros(num, length, self.num_actions, device=self.device)
        rows, cells = self.cells(plans, context)
        log_probs = self.log_probs[rows]
        before, _, _ = predict(self.first, self._steps(cells), self._likelihood(taken_of(log_probs, plans)))
        return self._mix(before, log_probs)

    def cells(self, plans: Tensor, context: Tensor | None) -> tuple[Tensor, Tensor]:
        """Of each action of `plans [N, L]` the row of `log_probs` and that of `transitions` which hold for it."""
        rows, each = self._places(plans, context)
        return rows, self._cell(each)

    def _cell(self, context: Tensor) -> Tensor:
        return context if len(self.transitions) > 1 else torch.zeros_like(context)

    def _likelihood(self, taken: Tensor) -> Tensor:
        """Of actions in each mode and phase, `[..., K * D]`, from their log-probabilities `taken [..., K]`."""
        # An action that no mode can take says nothing about the modes; 1e-300 would be lost in products.
        likelihood = taken.double().exp().clamp(min=IMPOSSIBLE)
        return likelihood if self.phases == 1 else likelihood.repeat_interleave(self.phases, -1)

    def _matrices(self) -> Tensor:
        """The transitions `[C, K * D, K * D]` of modes with their phases: out of the last phase, into a first one."""
        transitions, modes, phases = self.transitions, self.num_modes, self.phases
        if phases == 1:
            return transitions
        matrix = transitions.new_zeros(len(transitions), modes, phases, modes, phases)
        stay = transitions.diagonal(dim1=1, dim2=2)
        for k in range(modes):
            for phase in range(phases):
                matrix[:, k, phase, k, phase] = stay[:, k]
                if phase + 1 < phases:
                    matrix[:, k, phase, k, phase + 1] = 1 - stay[:, k]
            others = [j for j in range(modes) if j != k]
            matrix[:, k, -1, others, 0] = transitions[:, k, others]
            if not others:
                matrix[:, k, -1, k, -1] = 1.0
        return matrix.view(-1, modes * phases, modes * phases)

    def _steps(self, cells: Tensor) -> Tensor:
        """The matrices `[N, L, K * D, K * D]` that lead to each action, the first the identity."""
        steps = self._matrices()[cells]
        steps[:, 0] = torch.eye(steps.shape[-1], dtype=steps.dtype, device=steps.device)
        return steps

    # Learning.

    def learn(self, tree: Tree, counts: Counts) -> None:
        size = self.num_modes * self.phases
        even = torch.full((self.num_modes, self.num_modes), 1 / self.num_modes, dtype=torch.double)
        self.register_buffer("first", torch.full((size,), 1 / size, dtype=torch.double, device=self.device))
        self.register_buffer("transitions", even.expand(self._num_cells, -1, -1).contiguous().to(self.device))
        super().learn(tree, counts)

    def estimate(self, tree: Tree, counts: Counts) -> Tensor:
        chains = ModeChains(tree, counts, self.num_contexts, self.num_actions, self.smoothing, self.sharing)
        even = counts.count.double()[:, None].expand(-1, self.num_modes) / self.num_modes
        return chains.log_probs(even).float()

    @torch.no_grad()
    def fit(self, plans: Plans | Tensor, *, generator: torch.Generator | None = None, **settings: Any) -> Self:
        """Learn the modes by expectation maximisation; returns self. Modes are numbered by how often they occur.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.
            generator: draws the modes that EM starts from, and the folds.
            settings: `warm_start=True`: EM goes on from what was learned before, if anything was.

        Raises:
            ValueError: plans that this prior cannot learn from, an unknown setting, or too many histories.
        """
        self.check_settings(settings)
        plans, generator = training_plans(self, plans), generator_on(generator, self.device)
        if plans.actions.numel() == 0:
            self.learn(*self.count(plans))
            return self
        if settings.get("warm_start", False) and len(self.row_code):
            return self._go_on(plans, generator, self.max_iterations)
        learner = _Learner(self, plans, generator)
        starts = [learner.random_start(generator) for _ in range(self.restarts)]
        spectral = learner.spectral_start(plans, generator) if self.num_modes > 1 else None
        starts += [] if spectral is None else [spectral]
        if self.order and self.num_modes > 1:
            # Short histories leave more to the modes: those found with them are often better to start from.
            lower = SwitchingPrior(**self.config | {"order": self.order // 2}).to(self.device)
            starts.append(
                learner.from_posteriors(lower.fit(plans_for(lower, plans), generator=generator)._posteriors(plans))
            )
        short = min(SHORT_RUN, self.max_iterations)
        modes = max((learner.run(start, short) for start in starts), key=lambda run: run[1])[0]
        modes, _ = learner.run(modes, self.max_iterations - short)
        learner.take(learner.by_occupancy(modes))
        return self

    def recount(self, plans: Plans) -> Self:
        """Learn from `plans` what the modes do, beginning with the modes that are known."""
        generator, has_modes = torch.Generator(self.device).manual_seed(0), bool(len(self.row_code))
        if not has_modes:
            return self.fit(plans, generator=generator)
        return self._go_on(counted_plans(self, plans), generator, SHORT_RUN)

    @torch.no_grad()
    def _go_on(self, plans: Plans, generator: torch.Generator, iterations: int) -> Self:
        if iterations:
            posteriors = self._posteriors(plans)
            learner = _Learner(self, plans, generator)
            learner.take(learner.run(learner.from_posteriors(posteriors), iterations - 1)[0])
        return self

    @torch.no_grad()
    def posterior(self, plans: Plans | Tensor) -> ModePosterior:
        """The modes behind the actions of plans.

        Args:
            plans: `Plans`, or integers `[N, L]` for plans without context.

        Raises:
            ValueError: other actions or another context than this prior's.
        """
        plans = self.as_plans(plans)
        self.check_plans(plans)
        if plans.actions.numel() == 0:
            none = self.first.new_zeros(*plans.actions.shape, self.num_modes)
            return ModePosterior(none, none, none[..., 0].long(), none.new_zeros(len(plans), *[self.num_modes] * 2))
        posteriors = []
        for indices, steps, likelihood in self._in_parts(plans):
            path = most_probable_path(self.first, steps, likelihood).div(self.phases, rounding_mode="floor")
            modes = smooth(self.first, steps, likelihood)
            within = plans[indices].mask()[:, 1:, None, None]
            moves = self._sum_phases(self._sum_phases((modes.moved * within).sum(1)).mT).mT
            posteriors.append(
                ModePosterior(self._sum_phases(modes.filtered), self._sum_phases(modes.smoothed), path, moves)
            )
        return ModePosterior(*(torch.cat(chunks) for chunks in zip(*posteriors, strict=True)))

    def beginning_in(self, mode: int, keep: bool = False) -> "SwitchingPrior":
        """This prior where the first mode is known; what it learned is shared, not copied.

        Args:
            mode: from 0.
            keep: whether the mode never ends.

        Raises:
            ValueError: there is no such mode.
        """
        if isinstance(mode, bool) or not isinstance(mode, int) or not 0 <= mode < self.num_modes:
            raise ValueError(f"`mode` must be an integer from 0 to {self.num_modes - 1}, got {mode!r}")
        phases = self.first.view(self.num_modes, self.phases)[mode]
        first = torch.zeros_like(self.first).view(self.num_modes, self.phases)
        first[mode] = phases / phases.sum() if phases.sum() > 0 else 1 / self.phases
        prior = copy(self)
        prior._buffers = self._buffers | {"first": first.flatten()}
        if keep:
            prior.switching = "constant"
            prior.transitions = torch.eye(self.num_modes, dtype=first.dtype, device=self.device)[None]
        return prior

    @property
    def _num_cells(self) -> int:
        """C, of `transitions`."""
        return self.num_contexts or 1 if self.switching == "context" else 1

    @property
    def _elements(self) -> int:
        """Numbers that inference holds for an action."""
        return (self.num_modes * self.phases) ** 2

    def _sum_phases(self, values: Tensor) -> Tensor:
        """Sums over the phases of modes: `[..., K * D]` to `[..., K]`."""
        summed: Tensor = values.unflatten(-1, (self.num_modes, self.phases)).sum(-1)
        return summed

    def _posteriors(self, plans: Plans) -> list[tuple[Tensor, Smoothed]]:
        """What is known about the modes of plans: indices of some, and of these."""
        return [(indices, smooth(self.first, *inputs)) for indices, *inputs in self._in_parts(plans)]

    def _in_parts(self, plans: Plans) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Indices of plans that are inferred together, and the `steps` and the `likelihood` of inference in them."""
        for indices in _parts(plans, self._elements):
            chunk = plans[indices]
            rows, cells = self.cells(chunk.actions, chunk.context)
            yield indices, *self._inputs(chunk, cells, taken_of(self.log_probs[rows], chunk.actions))

    def _inputs(self, plans: Plans, cells: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
        """The `steps` and the `likelihood` of inference in plans, from the log-probabilities of their actions."""
        steps, likelihood = self._steps(cells), self._likelihood(taken)
        if plans.lengths is not None:
            # Else the most probable path would be that into modes that last, beyond the plan's end.
            beyond = ~plans.mask()
            steps[beyond] = torch.eye(steps.shape[-1], dtype=steps.dtype, device=steps.device)
            likelihood = likelihood.masked_fill(beyond[..., None], 1.0)
        return steps, likelihood

    def tables_fit(self) -> bool:
        modes, whole = self.num_modes, self.log_probs
        if whole.dim() != 3 or whole.shape[1] != modes or self.first.shape != (modes * self.phases,):
            return False
        if self.transitions.shape != (self._num_cells, modes, modes):
            return False
        self.log_probs = whole[:, 0]
        fit = super().tables_fit()
        self.log_probs = whole
        return fit


class _Chunk(NamedTuple):
    """Plans of one fold that are inferred together, with the cell and the entry of each action, `[n, L]`."""

    fold: int
    mask: Tensor | None  # [n, L]: the actions; None: there is nothing beyond the ends
    plans: Plans
    cells: Tensor
    entries: Tensor
    indices: Tensor


class _Learner:
    """Expectation maximisation of a prior in plans; the prior is overwritten."""

    def __init__(self, prior: SwitchingPrior, plans: Plans, generator: torch.Generator) -> None:
        self.prior, self.shape = prior, plans.actions.shape
        tree, counts = prior.count(plans)
        prior.learn(tree, counts)
        self.chains = ModeChains(tree, counts, prior.num_contexts, prior.num_actions, prior.smoothing, prior.sharing)
        fold = _folds(plans, prior.folds, generator)
        self.folds = int(fold.max()) + 1 if len(fold) else 1
        self.chunks, self.count = [], max(int(plans.mask().sum()), 1)
        for number in range(self.folds):
            for indices in _parts(plans, prior._elements, fold == number):
                chunk = plans[indices]
                rows, cells = prior.cells(chunk.actions, chunk.context)
                entries = self.chains.entries(rows.flatten(), chunk.actions.long().flatten()).view(rows.shape)
                mask = None if bool(chunk.mask().all()) else chunk.mask()
                self.chunks.append(_Chunk(number, mask, chunk, cells, entries, indices))

    def random_start(self, generator: torch.Generator) -> Modes:
        """Modes in random segments."""
        size, device = self.prior.num_modes * self.prior.phases, self.prior.device
        new = torch.rand(self.shape, generator=generator, device=device) < 1 / SEGMENT
        first = torch.where(new, torch.arange(self.shape[1], device=device), 0).cummax(1).values
        logits = 3 * torch.rand((*self.shape, size), generator=generator, device=device, dtype=torch.double)
        return self._from_segments(logits.gather(1, first[..., None].expand(-1, -1, size)).softmax(-1))

    def spectral_start(self, plans: Plans, generator: torch.Generator) -> Modes | None:
        """Modes that deviate from the average policy together; see `spectral_modes`."""
        modes = spectral_modes(plans, self.prior.num_modes, SEGMENT / 2, generator)
        if modes is None:
            return None
        size = self.prior.num_modes * self.prior.phases
        sure = torch.nn.functional.one_hot(modes, self.prior.num_modes).double().to(self.prior.device)
        return self._from_segments(
            (SURE * sure.repeat_interleave(self.prior.phases, -1) / self.prior.phases) + (1 - SURE) / size
        )

    def _from_segments(self, smoothed: Tensor) -> Modes:
        """Modes that begin as often, each for a segment; from those of all actions, `[N, L, K * D]`."""
        size, modes = self.prior.num_modes * self.prior.phases, self._empty()
        for chunk in self.chunks:
            self._count(modes, chunk, smoothed[chunk.indices])
        transitions = modes.transitions + 1 / SEGMENT / max(self.prior.num_modes - 1, 1)
        transitions.diagonal(dim1=1, dim2=2).fill_(1 - 1 / SEGMENT if self.prior.num_modes > 1 else 1.0)
        return Modes(torch.full_like(modes.first, 1 / size), transitions, modes.expected)

    def from_posteriors(self, posteriors: list[tuple[Tensor, Smoothed]]) -> Modes:
        """Modes from what is known about those of all plans."""
        modes, totals = self._empty(), self._no_moves()
        every = torch.cat([indices for indices, _ in posteriors]).argsort()
        smoothed = torch.cat([posterior.smoothed for _, posterior in posteriors])[every]
        moved = torch.cat([posterior.moved for _, posterior in posteriors])[every]
        for chunk in self.chunks:
            self._count(modes, chunk, smoothed[chunk.indices])
            self._count_moves(totals, chunk, moved[chunk.indices])
        return self._maximise(modes, totals)

    def run(self, modes: Modes, iterations: int) -> tuple[Modes, float]:
        """Iterate EM; returns the modes, and the log-likelihood per action before the last iteration."""
        before = last = -inf
        for _ in range(iterations):
            modes, last = self._iterate(modes)
            if last - before < self.prior.tolerance:
                break
            before = last
        return modes, last

    def _iterate(self, modes: Modes) -> tuple[Modes, float]:
        """Infer the modes of each fold with what the others say, and count anew."""
        prior, new_modes, totals, log_likelihood = self.prior, self._empty(), self._no_moves(), 0.0
        prior.first, prior.transitions = modes.first, modes.transitions
        whole, fold = modes.expected.sum(0), -1
        for chunk in self.chunks:
            if chunk.fold != fold:
                fold = chunk.fold
                others = whole if self.folds == 1 else whole - modes.expected[fold]
                log_probs = self.chains.entry_log_probs(self.chains.totals(others))
            inferred = smooth(prior.first, *prior._inputs(chunk.plans, chunk.cells, log_probs[chunk.entries]))
            self._count(new_modes, chunk, inferred.smoothed)
            self._count_moves(totals, chunk, inferred.moved)
            log_likelihood += float(_select(inferred.log_likelihood, chunk.mask).sum())
        return self._maximise(new_modes, totals), log_likelihood / self.count

    def take(self, modes: Modes) -> None:
        """Let the prior be what was learned from all folds."""
        self.prior.first, self.prior.transitions = modes.first, modes.transitions
        self.prior.log_probs = self.chains.log_probs(self.chains.totals(modes.expected.sum(0))).float()

    def by_occupancy(self, modes: Modes) -> Modes:
        """Number the modes by how often they occur."""
        order = modes.expected.sum((0, 1)).argsort(descending=True, stable=True)
        first = modes.first.unflatten(0, (-1, self.prior.phases))[order].flatten()
        return Modes(first, modes.transitions[:, order][:, :, order], modes.expected[:, :, order])

    def _empty(self) -> Modes:
        prior = self.prior
        expected = prior.first.new_zeros(self.folds, len(self.chains.code), prior.num_modes)
        return Modes(torch.zeros_like(prior.first), torch.zeros_like(prior.transitions), expected)

    def _no_moves(self) -> Tensor:
        size = self.prior.num_modes * self.prior.phases
        return self.prior.transitions.new_zeros(len(self.prior.transitions), size, size)

    def _count(self, modes: Modes, chunk: _Chunk, smoothed: Tensor) -> None:
        """Add the modes `[n, L, K * D]` of a part to `first` and `expected`."""
        started = smoothed[:, 0].contiguous() if chunk.mask is None else smoothed[chunk.mask[:, 0], 0]
        modes.first.add_(started.sum(0))
        entries, weights = _select(chunk.entries, chunk.mask), _select(self.prior._sum_phases(smoothed), chunk.mask)
        modes.expected[chunk.fold].index_add_(0, entries, weights)

    def _count_moves(self, totals: Tensor, chunk: _Chunk, moved: Tensor) -> None:
        mask = None if chunk.mask is None else chunk.mask[:, 1:]
        totals.index_add_(0, _select(chunk.cells[:, 1:], mask), _select(moved, mask))

    def _maximise(self, modes: Modes, totals: Tensor) -> Modes:
        """The probabilities of the first modes and of the transitions, from expected numbers."""
        prior, size = self.prior, len(modes.first)
        first = modes.first + prior.smoothing / size
        by_mode = totals.view(len(totals), prior.num_modes, prior.phases, prior.num_modes, prior.phases)
        into = by_mode[:, :, -1, :, 0]  # from the last phase of a mode into the first of another
        every = by_mode.diagonal(dim1=1, dim2=3)  # [C, D, D, K]: within a mode
        within = every.diagonal(dim1=1, dim2=2).sum(-1)
        counts = into.clone()
        if prior.phases > 1:
            # Moving on to the next phase counts as leaving; into which mode, only the last phase says.
            counts.diagonal(dim1=1, dim2=2).zero_()
            leaving = every.sum((1, 2)) - within
            leaving = leaving + counts.sum(-1)
            counts = counts * (leaving / counts.sum(-1).clamp(min=TINY))[..., None]
        counts.diagonal(dim1=1, dim2=2).copy_(within)
        everywhere = counts.sum(0) + prior.stay * torch.eye(prior.num_modes, dtype=counts.dtype, device=counts.device)
        everywhere = _rows(everywhere)
        return Modes(first / first.sum(), _rows(counts + prior.smoothing * everywhere), modes.expected)


def _select(values: Tensor, mask: Tensor | None) -> Tensor:
    """What `values [n, L, ...]` are where `mask [n, L]` is true, one after the other; None: all of them."""
    return values.flatten(0, 1) if mask is None else values[mask]


def _rows(counts: Tensor) -> Tensor:
    """Rows that sum to one; a mode that never occurs stays."""
    total = counts.sum(-1, keepdim=True)
    never = torch.eye(counts.shape[-1], dtype=counts.dtype, device=counts.device)
    return torch.where(total > TINY, counts / total.clamp(min=TINY), never)


def _folds(plans: Plans, number: int, generator: torch.Generator) -> Tensor:
    """The fold `[N]` of each plan; groups stay together."""
    group = torch.arange(len(plans)) if plans.group is None else plans.group.unique(return_inverse=True)[1].cpu()
    units = int(group.max()) + 1 if len(group) else 1
    order = torch.randperm(units, generator=generator, device=generator.device).cpu()
    return (order % min(number, units))[group]


def _parts(plans: Plans, elements: int, chosen: Tensor | None = None) -> Iterator[Tensor]:
    """Indices of plans that are inferred together; `elements` numbers an action are held."""
    indices = torch.arange(len(plans)) if chosen is None else chosen.nonzero()[:, 0]
    yield from indices.split(max(ELEMENTS // (elements * max(plans.max_length, 1)), 1)) if len(indices) else ()
