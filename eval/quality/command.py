"""`python -m eval quality`: how near priors come to sources whose entropy is known; long sequences of many kinds."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import log
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt
from torch import Tensor

from eval.quality.sequences import CONDITIONS, Sequences, sequences
from eval.worlds.runs import Seed, plus_minus
from neuroprior import CombinedPrior, GRUPrior, MarkovPrior, Plans, Prior, TransformerPrior, fit
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun, Progress
from neuroprior._random import draw_seed
from neuroprior._statistics import paired_difference
from neuroprior.behaviour.analysis.comparison import Score, score
from neuroprior.behaviour.reporting.document import Column, Document, publish, table
from neuroprior.behaviour.reporting.page import Section, Table
from neuroprior.priors.ensembles.candidates import best_chain

LENGTH = 32
CONTEXTS = 8
LAG, REPEAT = 12, 0.8

MARKOV = "markov"

OF_SOURCES: dict[str, Callable[..., Prior]] = {
    MARKOV: MarkovPrior,
    "gru": GRUPrior,
    "transformer": TransformerPrior,
    "combined": CombinedPrior,
    "combined, full": partial(CombinedPrior, effort="full"),
}
"""Priors that learn sources of known entropy: a chain of the source's order, and others by default settings."""

PARTS = (MARKOV, "context-tree", "gru", "stacked")
"""The experts of the combined prior, but the uniform prior."""

OF_SEQUENCES = (*PARTS, "transformer", "combined")
"""Priors that learn long sequences, as `neuroprior.fit` knows them, with their default settings."""

GAP = ("more", "more_low", "more_high", "p_value")
"""Columns: how many bits per action more than the combined prior's."""


class LongJob(NamedTuple):
    """One of the kinds of `sequences`, by its number, and the seed of its sequences and of the priors."""

    kind: int
    seed: int

    @property
    def name(self) -> str:
        return f"sequences-{self.kind}-{self.seed}"


@dataclass(frozen=True)
class Source:
    """A process that plans are drawn from.

    Attributes:
        name: of tables.
        table: `[C, A**order, A]`: the probabilities of each action in each context after each history; before there
            are `order` actions, all are equally likely.
        order: actions that count.
        context: whether each plan has a context, each step one of its own, or there is none (C is 1).
        lag: in place of a table: the action so many steps ago comes again with probability `REPEAT`.
    """

    name: str
    table: Tensor
    order: int
    context: str | None = None
    lag: int = 0

    @property
    def num_actions(self) -> int:
        return self.table.shape[-1]

    def draw(self, num_plans: int, generator: torch.Generator) -> tuple[Plans, Tensor]:
        """Plans, and the log-probability `[N, L]` (nats) of each action under the source."""
        actions = torch.zeros(num_plans, LENGTH, dtype=torch.long)
        size = (num_plans, LENGTH if self.context == "step" else 1)
        context = torch.randint(len(self.table), size, generator=generator).expand(num_plans, LENGTH)
        history = torch.zeros(num_plans, dtype=torch.long)
        taken = torch.zeros(num_plans, LENGTH, dtype=torch.double)
        for t in range(LENGTH):
            probs = self._probs(actions, context[:, t], history, t)
            action = torch.multinomial(probs, 1, generator=generator)
            taken[:, t] = probs.gather(1, action)[:, 0].log()
            actions[:, t] = action[:, 0]
            history = (history * self.num_actions + action[:, 0]) % self.num_actions**self.order
        plan_context = None if self.context is None else context if self.context == "step" else context[:, 0]
        return Plans(actions, self.num_actions, context=plan_context), taken

    def _probs(self, actions: Tensor, context: Tensor, history: Tensor, t: int) -> Tensor:
        even = torch.full((len(actions), self.num_actions), 1 / self.num_actions, dtype=torch.double)
        if t < (self.lag or self.order):
            return even
        if not self.lag:
            return self.table[context, history]
        again = torch.nn.functional.one_hot(actions[:, t - self.lag], self.num_actions)
        return REPEAT * again + (1 - REPEAT) * even

    @property
    def contexts(self) -> int | None:
        """The number of contexts that a prior for this source is given."""
        return None if self.context is None else len(self.table)


def sources(generator: torch.Generator) -> list[Source]:
    """Sources with random tables (Dirichlet, 1/2), by which each kind of dependence is met."""

    def table(contexts: int, order: int, num_actions: int) -> Tensor:
        gamma = torch.distributions.Gamma(torch.tensor(0.5, dtype=torch.double), torch.tensor(1.0, dtype=torch.double))
        with torch.random.fork_rng():
            torch.manual_seed(draw_seed(generator))
            draws = gamma.sample((contexts, num_actions**order, num_actions)).clamp(min=1e-6)
        return draws / draws.sum(-1, keepdim=True)

    return [
        Source("order 1, 4 actions", table(1, 1, 4), 1),
        Source("order 3, 4 actions", table(1, 3, 4), 3),
        Source("order 6, 2 actions", table(1, 6, 2), 6),
        Source(f"repeats at distance {LAG}", torch.full((1, 1, 4), 0.25, dtype=torch.double), 0, lag=LAG),
        Source("order 1, initial context", table(CONTEXTS, 1, 4), 1, "plan"),
        Source("order 1, per-step context", table(CONTEXTS, 1, 4), 1, "step"),
    ]


@claim_out
def quality(
    num_plans: NonNegativeInt = 100_000,
    held_out: PositiveInt = 5_000,
    num_sequences: NonNegativeInt = 40,
    seed: Seed = 0,
    seeds: PositiveInt = 1,
    processes: PositiveInt = 1,
    out: str = "runs/quality",
) -> None:
    """Fit priors to sources whose entropy is known, and to long sequences of many kinds of action.

    Printed are how many bits more than the source they take, bits per action, and the seconds that they learn.
    Interrupted, the same command goes on with the long sequences that are left.

    Args:
        num_plans: plans of 32 actions to learn from, at least 100; 0 leaves the sources of known entropy out.
        held_out: plans to score, at least 100.
        num_sequences: long sequences to learn from, of 1,000 actions each; half as many are scored; 0 for none.
        seed: draws sources and plans.
        seeds: long sequences are drawn with so many seeds, from `seed` on (texts always from the same one); of several,
            intervals are over seeds. The sources of known entropy have one seed.
        processes: how many kinds of long sequences and seeds are learned at a time. With more than one, seconds are
            longer, and less reliable.
        out: folder for `quality.csv`, `sequences.csv`, `results.json` and finished jobs.
    """
    if 0 < num_plans < 100 or held_out < 100:
        raise ValueError(f"num_plans and held_out: at least 100 are needed, not {num_plans} and {held_out}")
    if not num_plans and not num_sequences:
        raise ValueError("`num_plans` or `num_sequences` must be above 0")
    generator = torch.Generator().manual_seed(seed)
    number = len(sequences(num_sequences, torch.Generator().manual_seed(seed)))
    asked = {"command": "quality", "num_sequences": num_sequences}
    run = JobRun(partial(long_rows, number=num_sequences), Path(out) / "runs", asked, name=attrgetter("name"))
    jobs = [LongJob(kind, one) for one in range(seed, seed + seeds) for kind in range(number)]
    of_long = sum(run.do(jobs, processes=processes, title="sequences"), list[dict[str, Any]]())
    every, rows = sources(generator) if num_plans else [], []
    with Progress("sources", len(every) * len(OF_SOURCES), len(every) * len(OF_SOURCES)) as progress:
        for source in every:
            training, _ = source.draw(num_plans, generator)
            test, true = source.draw(held_out, generator)
            for name in OF_SOURCES:
                rows.append(_fit(source, name, training, test, true, seed))
                progress.advance(f"{source.name}: {rows[-1]['model']} {rows[-1]['excess_percent']:+.2f} %")
    sections, frames, lead = [], {}, ""
    if rows:
        frames["quality"] = pd.DataFrame(rows)
        sections.append(Section("Bits more than the source, %", tables=_tables(frames["quality"])))
        lead = f"{num_plans:,} plans of {LENGTH} actions to learn from, {held_out:,} held out."
    if of_long:
        frames["sequences"] = pd.DataFrame(of_long)
        tables = [_table_of_long(rows) for _, rows in frames["sequences"].groupby("source", sort=False)]
        sections.append(Section("Bits per action of long sequences", tables=tables))
    settings = {"num_plans": num_plans, "held_out": held_out, "num_sequences": num_sequences}
    settings |= {"seed": seed, "seeds": seeds}
    publish(Document("Sources of known entropy", lead, sections, frames, settings, keys={"quality": "rows"}), Path(out))


def _fit(source: Source, name: str, training: Plans, test: Plans, true: Tensor, seed: int) -> dict[str, Any]:
    chain, began = name == MARKOV, time.perf_counter()
    how: dict[str, Any] = {"order": source.order} if chain else {}
    prior = OF_SOURCES[name](source.num_actions, num_contexts=source.contexts, **how)
    prior.fit(training, generator=torch.Generator().manual_seed(seed), **({} if chain else {"progress": False}))
    seconds = time.perf_counter() - began
    with torch.no_grad():
        taken = prior.action_log_probs(test).double()
    # The first actions are drawn evenly; the entropy rate is that of those which depend on what was before.
    first = max(source.order, source.lag)
    true, taken = true[:, first:], taken[:, first:]
    rate, excess = -float(true.mean()) / log(2), float((true - taken).mean()) / log(2)
    free = source.table.numel() // source.num_actions * (source.num_actions - 1)
    return {
        "source": source.name,
        "model": name,
        "entropy_rate": rate,
        "bits_per_action": rate + excess,
        "excess_percent": 100 * excess / rate,
        # What maximum likelihood of so many free probabilities costs on new plans, for many plans.
        "expected_percent": 100 * free / (2 * log(2) * len(training) * (LENGTH - first)) / rate
        if chain and not source.lag
        else None,
        "seconds": seconds,
    }


def long_rows(job: LongJob, number: int) -> list[dict[str, Any]]:
    """A row a prior: bits per action of the test sequences, and how many more they are than the combined prior's.

    Args:
        job: the kind of sequences, and the seed.
        number: of sequences to learn from.
    """
    source = sequences(number, torch.Generator().manual_seed(job.seed))[job.kind]
    fits = {name: _fit_long(source, name, job.seed) for name in OF_SEQUENCES}
    rows = []
    for name, (fit_score, seconds) in fits.items():
        row = {"source": source.name, "seed": job.seed, "model": name, "entropy": source.entropy}
        row |= {"bits_per_action": fit_score.bits_per_action().mean, "seconds": seconds}
        gap = fit_score.minus(fits["combined"][0])
        rows.append(row | dict(zip(GAP, gap, strict=True)))
    return rows


def _fit_long(source: Sequences, name: str, seed: int) -> tuple[Score, float]:
    """The score of a prior on the test sequences, and the seconds in which it was fitted."""
    generator, began = torch.Generator().manual_seed(seed), time.perf_counter()
    if name == MARKOV:
        chain = best_chain([source.training.split(generator=generator)], None)
        assert chain is not None
        prior: Prior = chain.fit(source.training)
    else:
        silent: dict[str, Any] = {} if name == "context-tree" else {"progress": False}
        prior = fit(source.training, name, generator=generator, **silent)
    seconds = time.perf_counter() - began
    return score(name, prior, source.test), seconds


def _average_seeds(rows: pd.DataFrame) -> pd.DataFrame:
    """A row a model: of several seeds the means, and intervals over these."""
    if rows["seed"].nunique() == 1:
        return rows
    bits = rows.pivot(index="seed", columns="model", values="bits_per_action")
    averages = []
    for name, model_rows in rows.groupby("model", sort=False):
        gap = paired_difference(bits[name], bits["combined"])
        means = model_rows[["entropy", "bits_per_action", "seconds"]].mean().to_dict()
        averages.append({"model": name} | means | dict(zip(GAP, gap, strict=True)))
    return pd.DataFrame(averages)


def _price(rows: pd.DataFrame) -> float:
    """How long the combined prior of a source takes to fit, as a multiple of its parts."""
    seconds = rows.groupby("model")["seconds"].mean()
    return float(seconds["combined"] / seconds[list(PARTS)].sum())


def _table_of_long(rows: pd.DataFrame) -> Table:
    """A row a model of one source: bits per action, how many more than those of the combined prior, and seconds."""
    units = "predicted sequences" if rows["seed"].nunique() == 1 else f"{rows['seed'].nunique()} seeds"
    source_name, rows = rows["source"].iloc[0], _average_seeds(rows)
    columns: dict[str, Column] = {
        "prior": "model",
        "bits per action": "bits_per_action:.4f",
        "more": lambda row: plus_minus(row, "more", digits=4, sign="+", ends="more_"),
        "seconds": "seconds:.0f",
    }
    entropy = rows["entropy"].iloc[0]
    source = (
        "characters of Python's own documentation, of which each seed draws other parts"
        if pd.isna(entropy)
        else f"a chain under {CONDITIONS} hidden conditions; {entropy:.4f} bits under the source itself"
    )
    caption = (
        f"{source}. markov: of the order that predicts a tenth of the training sequences best. more: than the combined"
        f" prior; ±: 95 % interval over the {units}, paired. seconds: of fitting; the combined prior takes"
        f" {_price(rows):.2f} times as long as {', '.join(PARTS)} together."
    )
    shown = rows.assign(more=rows["more"].where(rows["model"] != "combined"))
    return table(shown, columns, caption, source_name)


def _tables(rows: pd.DataFrame) -> list[Table]:
    """A row a source: the excess of each prior; and of all but the chain the seconds of fitting."""
    headings = {"transformer": "trans-\nformer", "combined, full": "combined,\nfull"}
    learned = {headings.get(name, name): name for name in OF_SOURCES if name != MARKOV}
    chains = rows[rows.model == MARKOV]

    def wide(name: str, form: str) -> pd.DataFrame:
        cells = rows.assign(text=[form.format(value) for value in rows[name]])
        return chains.join(
            cells.pivot(index="source", columns="model", values="text")[list(learned.values())], on="source"
        )

    excess: dict[str, Column] = {
        "source": "source",
        MARKOV: "excess_percent:+.3f",
        "ex-\npected": "expected_percent:+.3f",
    }
    caption = (
        "markov: of the source's order; expected: free probabilities / (2 ln 2 x actions), the cost of estimating them."
        ' full: effort="full".'
    )
    times: dict[str, Column] = {"source": "source", "entropy": "entropy_rate:.4f"}
    above = "entropy: bits per action of the source, where it depends on the past."
    return [
        table(wide("excess_percent", "{:+.2f}"), excess | learned, caption),
        table(wide("seconds", "{:.0f}"), times | learned, above, "Seconds of fitting"),
    ]
