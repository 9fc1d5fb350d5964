"""`python -m eval compare --planners`: several planners with the same priors and as many model steps."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import Any, Literal, TypeAlias

import pandas as pd
import torch
from matplotlib.figure import Figure

from eval.compare.curves import ROLLOUTS
from eval.compare.figures import View, score_panels
from eval.compare.run import Contest, Contestant, Settings
from eval.worlds import runs
from eval.worlds.starts import Starts, worth
from eval.worlds.suite import TASKS
from neuroprior.behaviour.reporting.document import Document
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.planners import FrontierPlanner, MCTSPlanner, Planner, SamplingPlanner, execute
from neuroprior.planners.tuning import TEMPERATURES
from neuroprior.worlds import World

ORDERS = (3,)
"""Orders of the Markov priors that planners are compared with."""

PLANNERS: dict[str, Callable[..., Planner]] = {
    "sampling": SamplingPlanner,
    "frontier": FrontierPlanner,
    "mcts": MCTSPlanner,
    "halving": partial(SamplingPlanner, halving=True),
    "replanning": partial(SamplingPlanner, halving=True),
}
"""By their names in tables; "replanning" is halving in a closed loop, planning anew after each action."""

PlannerName: TypeAlias = Literal[tuple(PLANNERS)]  # type: ignore[valid-type]

STOCHASTIC, ONLY_STOCHASTIC = {"sampling", "halving", "replanning"}, {"halving", "replanning"}
"""Planners for stochastic worlds, and those that plan like another one in deterministic worlds."""

TRAJECTORIES = 8
"""From each start with "replanning", whose score is no single plan's and so cannot be computed."""

PLACE = ["world", "planner", "prior", "context", "num_plans"]
NAMES = {"prior": "prior", "context": "context", "planner": "planner"}


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """As `Settings`, with some of `PLANNERS`; no `context`: the last of each world's."""

    planners: tuple[str, ...] = ()


def check_planners(planners: Sequence[str], worlds: Sequence[str]) -> None:
    """Raise ValueError where a planner is given twice, or none suits one of the worlds."""
    runs.check_distinct(planners=planners)
    if set(planners) & STOCHASTIC and set(planners) - ONLY_STOCHASTIC:
        return  # whatever the worlds are: some take long to make
    for world in worlds:
        held_out = TASKS[world].worlds(0).held_out
        if not any(suits(name, held_out) for name in planners):
            names = " ".join(planners)
            raise ValueError(f"planners: none of {names} is for {world}; leave it out, or add sampling")


def planner_run(run: runs.Run, settings: PlannerSettings) -> dict[str, Any]:
    """Collect plans, fit priors, extend their horizons, and plan with each planner and prior, in one seed's worlds.

    Returns:
        `entries`, one of each planner, prior and number of plans: `share` (the normalised score), the `model_steps`
        that were taken, and the `seconds` of a decision.
    """
    task = TASKS[run.world]
    contest = Contest(run, task, replace(settings, context=settings.context or task.contexts[-1:]), ORDERS)
    entries = [
        entry
        for one in contest.after_curriculum()
        for name in settings.planners
        if suits(name, contest.worlds.held_out)
        for entry in _entries(contest, one, name)
    ]
    return run._asdict() | {"about": task.about, "entries": entries}


def suits(name: str, world: World) -> bool:
    """Whether a planner can plan in a world, and is not there what another one is, too."""
    return name in STOCHASTIC if world.stochastic else name not in ONLY_STOCHASTIC


def _entries(contest: Contest, one: Contestant, name: str) -> list[dict[str, Any]]:
    """What a planner reaches with a prior; the temperature is chosen for both, in the validation worlds."""
    numbers = contest.settings.num_plans

    def make_planner(starts: Starts, number: int, temperature: float) -> Planner:
        how: dict[str, Any] = starts.task.scoring | {"temperature": temperature}
        if starts.world.stochastic:
            how["num_rollouts"] = ROLLOUTS
        # All decisions of "replanning" take no more steps together than one of the others, but for one plan each.
        number = max(number // starts.length, 1) if name == "replanning" else number
        return PLANNERS[name](one.prior, starts.length, number, **how)

    def reached(starts: Starts, number: int, temperature: float) -> dict[str, Any]:
        planner = make_planner(starts, number, temperature)
        return (replanned if name == "replanning" else planned)(starts, planner, contest.generator)

    best = 1.0
    if one.label != "uniform":
        validation = contest.validation_at[contest.task.length]
        shares = {t: reached(validation, max(numbers), t)["share"] for t in TEMPERATURES}
        best = max(shares, key=lambda t: shares[t])
    else:  # a decision that is not timed, since the first may compile loops
        few = make_planner(contest.starts, min(numbers), best)
        few.plan(contest.starts.world, contest.starts.state[:1], torch.Generator().manual_seed(0))
    label = {"planner": name, "prior": one.label, "context": one.context, "temperature": best}
    return [label | {"num_plans": number} | reached(contest.starts, number, best) for number in numbers]


def planned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """The normalised score of a planner's decisions, and their model steps and seconds for each start."""
    begin = perf_counter()
    decision = planner.plan(starts.world, starts.state, generator)
    seconds = (perf_counter() - begin) / len(starts.state)
    score = decision.score
    if starts.world.stochastic:
        score = worth(starts.task, starts.world, starts.state, decision.plan[:, None].long())[:, 0]
    return {"share": starts.normalised(score), "model_steps": decision.model_steps, "seconds": seconds}


def replanned(starts: Starts, planner: Planner, generator: torch.Generator) -> dict[str, Any]:
    """As `planned`, of as many actions as a plan has, each the first of a new plan; the mean of `TRAJECTORIES`."""
    begin = perf_counter()
    state = starts.state.repeat_interleave(TRAJECTORIES, 0)
    done = execute(planner, starts.world, state, starts.length, 1, generator)
    seconds = (perf_counter() - begin) / len(state)
    score = planner.score(done.rewards.double(), done.states[:, -1]).view(-1, TRAJECTORIES).mean(1)
    return {"share": starts.normalised(score), "model_steps": done.model_steps, "seconds": seconds}


def planner_document(
    results: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    command: str,
    baseline: str = "sampling",
    title: str = "Planners compared",
) -> Document:
    """The tables and figures of the results of `planner_run`; `baseline`: the planner that others are compared with."""
    frame = runs.frame_of(results).rename(columns={"share": "oracle_share", "seconds": "seconds_per_decision"})
    rows = runs.seed_means(frame, PLACE, "oracle_share", ["model_steps", "seconds_per_decision"])
    pairs = planner_pairs(frame, baseline)
    gaps = runs.paired_differences(pairs, PLACE)
    # Worlds offer unlike contexts: of each, the last counts.
    last = pairs.drop_duplicates(["world", "planner", "prior", "num_plans", "seed"], keep="last")
    across = runs.across_worlds(last, ["prior", "planner", "num_plans"])
    most = frame["num_plans"].max()
    score = "normalised score, % of the optimum"
    tables, boxes = [], []
    for world, about in {one["world"]: one["about"] for one in results}.items():
        world_rows = rows[rows["world"] == world].merge(gaps[[*PLACE, "p_holm"]], "left", PLACE)
        tables.append(planner_table(world_rows, baseline))
        shown = gaps[(gaps["world"] == world) & (gaps["prior"] != "uniform") & (gaps["num_plans"] == most)]
        if len(shown):
            above = f"{world}, {most:,} plans: differences to {baseline}"
            tables.append(runs.difference_table(shown, above, NAMES, score, 100))
        alt = f"Normalised score in {world} against model steps, a line a planner; the numbers are in the tables."
        caption = f"{world}: {about}. Bands: Student's 95 % intervals over seeds."
        boxes.append(FigureBox(planner_figure(world_rows), caption, alt))
    if len(shown := across[across["num_plans"] == most]):
        names = {"prior": "prior", "planner": "planner"}
        tables.append(runs.across_table(shown, names, "score", baseline, f"the {score}, {most:,} plans", 100))
    lead = runs.significance(gaps, f"Normalised scores against {baseline}")
    sections = [Section("Normalised score against model steps", figures=boxes), Section("Tables", tables=tables)]
    frames = {"rows": rows, "paired": gaps, "across": across}
    return Document(title, lead, sections, frames, settings, command, {"words": [lead]})


def planner_pairs(frame: pd.DataFrame, baseline: str) -> pd.DataFrame:
    """A row a world, planner, prior, number of plans and seed: its score `first`, and `second` that of the baseline."""
    same = [name for name in [*PLACE, "seed"] if name != "planner"]
    base = frame.loc[frame["planner"] == baseline, [*same, "oracle_share"]].rename(columns={"oracle_share": "second"})
    others = frame[frame["planner"] != baseline].rename(columns={"oracle_share": "first"})
    return others.merge(base, on=same)


def planner_table(rows: pd.DataFrame, baseline: str) -> Table:
    """Normalised scores in one world, a row a prior and planner; stars mark significant differences (`p_holm`)."""
    clear = rows["p_holm"] < 0.05
    scores = [runs.plus_minus(row, "oracle_share", 100) for _, row in rows.iterrows()]
    length = round((rows["model_steps"] / rows["num_plans"]).max())
    star = f" *: p < 0.05 against {baseline} with the same prior, corrected for all tests in this world (Holm)."
    caption = (
        f"Normalised score, % of the optimum, by number of plans of {length} model steps each, or as many steps"
        f" otherwise spent; ms: of a decision with the most. {runs.over_seeds(rows)}{star * bool(clear.any())}"
    )
    cells = [score + "*" * star for score, star in zip(scores, clear, strict=True)]
    return runs.table_by(rows, NAMES, "num_plans", cells, caption, rows["world"].iloc[0], timed=rows["num_plans"].max())


def planner_figure(rows: pd.DataFrame) -> Figure:
    """Normalised score against model steps in one world, a panel a prior, a line a planner."""
    # Most planners spend all steps that they may.
    ticks = rows.groupby("num_plans")["model_steps"].max().astype(int).tolist()
    return score_panels(
        [
            View(
                str(prior) if context == "none" else f"{prior}, context: {context}",
                panel_rows.assign(name=panel_rows["planner"]),
                "model_steps",
                "model steps per start",
                ticks,
            )
            for (prior, context), panel_rows in rows.groupby(["prior", "context"], sort=False)
        ],
        log=True,
    )
