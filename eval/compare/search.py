"""`python -m eval search`: what helps a planner that samples, beside predicting well."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from jsonargparse.typing import PositiveInt
from torch import Tensor

from eval.compare.command import TrainingStarts
from eval.compare.curves import Sampling, best, tried
from eval.compare.planners import ORDERS, planner_document, planner_pairs
from eval.compare.priors import NEURAL, TRAINING, chain, network
from eval.compare.run import Contest, Contestant, Settings
from eval.worlds import runs
from eval.worlds.suite import TASKS, WorldName
from neuroprior import Plans, Prior
from neuroprior._folders import claim_out
from neuroprior._random import draw_seed
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.page import Section
from neuroprior.planners import search_weights
from neuroprior.plans.folds import folds

WORLDS, KINDS = ("grid", "egocentric", "taxi", "cliff"), ("markov", "gru")
"""Worlds that are tried where no others are asked for, and kinds of priors."""

BOTH = "both"
"""Temperature and uniform share, chosen together at each number of candidates; what all else is compared with."""

LIMITED: dict[str, Callable[[Sampling], bool]] = {
    "neither": lambda one: one == Sampling(),
    "temperature": lambda one: one.uniform_share == 0,
    "uniform share": lambda one: one.temperature == 1,
    BOTH: lambda _: True,
}
"""Ways of sampling: what may be chosen from."""

AT_MOST = "both, at {}"
"""As `BOTH`, chosen once, at the largest number of candidates."""

FIRST = ", first plans"
"""Behind the name of a prior that has learned from short plans alone, before the horizon curriculum."""

SEARCHED = 64
"""Candidates of which one should be the plan that is learned from."""

WEIGHTS: dict[str, Callable[[Tensor], Tensor]] = {
    "even weights": torch.ones_like,
    "hard plans": lambda log_prob: -log_prob.double(),
    f"one of {SEARCHED}": lambda log_prob: search_weights(log_prob, SEARCHED),
}
"""How much plans count that are learned from, by their log-probability under a prior that was fitted to others.

Even weights: what drawing plans with replacement does by itself, since fewer of them are different then. Hard plans: in
proportion to the logarithm of the number of candidates that it takes to find them.
"""


@claim_out
def search(
    worlds: Sequence[WorldName] = WORLDS,
    seeds: PositiveInt = 5,
    num_plans: Sequence[runs.PowerOfTwo] = (16, 64, 256),
    steps: PositiveInt = 600,
    starts: PositiveInt = 32,
    training_starts: TrainingStarts = 1000,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/search",
) -> None:
    """What helps a planner that samples: temperature, uniform plans, or plans that count by how hard they are to find?

    A chain of order 3 and a GRU are fitted to the first, short plans, and to those of the last round of the horizon
    curriculum. Candidates are drawn at a chosen temperature, with a chosen share of uniform plans, with both or
    neither; and from priors that were fitted to the last plans drawn anew with weights. Prints the differences in the
    normalised score; writes tables (CSV), results.json and report.html to a folder. Interrupted, the same command goes
    on.

    Args:
        worlds: to plan in.
        seeds: repeats in each world, each with worlds and priors of its own; intervals are over them.
        num_plans: numbers of candidate plans, powers of two.
        steps: of training of the GRU, at most.
        starts: held-out starts to plan from.
        training_starts: starts from which plans are collected to learn from, in each round.
        seed: of everything random.
        processes: how many runs, a world and a seed each, are done at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers do the runs.
        out: folder for the report and for finished runs.
    """
    runs.check_distinct(worlds=worlds, num_plans=num_plans)
    settings = Settings(tuple(num_plans), KINDS, (), 4, steps, starts, training_starts, seed)
    runs.run_experiment("search", search_run, search_document, settings, worlds, seeds, out, processes, dask)


def search_run(run: runs.Run, settings: Settings) -> dict[str, Any]:
    """Collect plans, extend horizons, fit priors to the last plans in each way, and sample from them in each way.

    Each world has the last of its contexts.

    Returns:
        `entries`, one of each way (`planner`), prior and number of candidates: `share` (the normalised score).
    """
    task = TASKS[run.world]
    contest = Contest(run, task, replace(settings, context=task.contexts[-1:]), ORDERS)
    entries = []
    for one in contest.contestants():
        if one.plans is None:
            continue
        if one.rounds == 0:
            entries += _entries(contest, one, FIRST, one.prior)
        if one.rounds == contest.rounds:
            learner = Learner(contest, one)
            for name, prior in {"": learner.fitted(one.plans), **learner.reweighted(one.plans)}.items():
                entries += _entries(contest, one, name, prior)
    return run._asdict() | {"about": task.about, "entries": entries}


class Learner:
    """Makes priors like one of the comparison, and fits them."""

    def __init__(self, contest: Contest, one: Contestant) -> None:
        self.contest, self.label = contest, one.label
        neural = one.label in NEURAL
        self.training = TRAINING | {"max_steps": contest.settings.steps} if neural else {}

    def fitted(self, plans: Plans) -> Prior:
        """A new prior that has learned from these plans."""
        world, generator = self.contest.worlds.training, self.contest.generator
        if self.label in NEURAL:
            prior = network(self.label, world, plans, draw_seed(generator))
        else:
            prior = chain(int(self.label.removeprefix("markov-")), world, plans, self.contest.task.feature_sets)
        return prior.fit(plans, generator=generator, **self.training)

    def reweighted(self, plans: Plans) -> dict[str, Prior]:
        """Priors that have learned from plans drawn with replacement, with each of `WEIGHTS`."""
        log_prob, priors = torch.empty(len(plans)), {}
        for learned, held_out in folds(plans, 2):
            log_prob[held_out] = self.fitted(plans[learned]).log_prob(plans[held_out])
        for name, weigh in WEIGHTS.items():
            index = torch.multinomial(weigh(log_prob), len(plans), True, generator=self.contest.generator)
            drawn = plans[index]
            # The same plan is never learned from and validated on.
            drawn = drawn if drawn.group is not None else replace(drawn, group=index, group_names=None)
            priors[name] = self.fitted(drawn)
        return priors


def _entries(contest: Contest, one: Contestant, name: str, prior: Prior) -> list[dict[str, Any]]:
    """What a prior reaches, sampled in every way, all from the same draws; with weights, by whose name, in one way."""
    numbers, length = contest.settings.num_plans, contest.task.length
    chances, reached = (
        tried(starts[length], prior, contest.generator, numbers)
        for starts in (contest.validation_at, contest.starts_at)
    )
    ways = {
        way: {
            number: best([{setting: score for setting, score in table.items() if allowed(setting)}])
            for number, table in chances.items()
        }
        for way, allowed in LIMITED.items()
    }
    ways[AT_MOST.format(max(numbers))] = dict.fromkeys(numbers, ways[BOTH][max(numbers)])
    if name in WEIGHTS:
        ways = {name: ways[BOTH]}
    label = one.label + FIRST * (name == FIRST)
    named = {"prior": label, "context": one.context, "seconds": float("nan")}
    return [
        {"planner": way, **named, "num_plans": number, **sampling._asdict(), "share": reached[number][sampling]}
        | {"model_steps": number * length}
        for way, how in ways.items()
        for number, sampling in how.items()
    ]


def search_document(results: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], command: str) -> Document:
    """The tables and figures of the results of `search_run`: those of planners, and first the means over worlds."""
    document = planner_document(results, settings, command, BOTH, "What helps a planner")
    frame = runs.frame_of(results).rename(columns={"share": "oracle_share"})
    by = ["planner", "prior", "num_plans"]
    means = planner_pairs(frame, BOTH).groupby([*by, "seed"], sort=False)[["first", "second"]].mean().reset_index()
    gaps = runs.paired_differences(means.assign(world="all"), ["world", *by])
    cells = [
        f"{100 * row['difference']:+.1f} ±{100 * (row['high'] - row['low']) / 2:.1f}{'*' * (row['p_holm'] < 0.05)}"
        for _, row in gaps.iterrows()
    ]
    caption = (
        f"Normalised score less that of {BOTH}, in points: means over {len(set(frame['world']))} worlds, by number of"
        " candidates. ±: Student's 95 % interval over seeds, paired. *: p < 0.05, corrected for all tests (Holm)."
    )
    differences = runs.table_by(gaps, {"prior": "prior", "": "planner"}, "num_plans", cells, caption, "Over worlds")
    return replace(
        document,
        sections=[Section("Differences", tables=[differences]), *document.sections],
        frames={**document.frames, "differences": gaps},
    )
