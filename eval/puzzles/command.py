"""`python -m eval puzzles`: Sokoban and sliding tiles by policy-guided search."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from jsonargparse.typing import NonNegativeInt, PositiveInt

from eval.puzzles.animation import animation
from eval.puzzles.contest import (
    BOOTSTRAP,
    PLANNERS,
    REROOTED,
    SEARCHES,
    Job,
    Problems,
    Settings,
    WorldName,
    bootstrapped,
    contest,
    problems_of,
)
from eval.worlds.runs import check_distinct, command_line
from neuroprior._files import write_whole
from neuroprior._folders import claim, claim_out
from neuroprior._jobs import JobRun
from neuroprior._statistics import paired_difference
from neuroprior.behaviour.reporting.document import Document, publish, table
from neuroprior.behaviour.reporting.page import Section, Table

DATA = Path(__file__).parents[1] / "data"

FILES = {
    "sokoban": (DATA / "boxoban" / "train.txt.xz", DATA / "boxoban" / "test.txt.xz"),
    "tiles": (DATA / "sliding_tiles" / "train.txt.xz", DATA / "sliding_tiles" / "test.txt.xz"),
}
"""Training and test problems by world."""

PriorName = Literal[BOOTSTRAP, REROOTED, *PLANNERS, *SEARCHES]  # type: ignore[valid-type]


@claim_out
def puzzles(
    world: WorldName = "sokoban",
    train: str | None = None,
    num_train: PositiveInt = 1000,
    test: str | None = None,
    num_test: PositiveInt | None = None,
    budget: PositiveInt = 50_000,
    priors: Sequence[PriorName] = (BOOTSTRAP, REROOTED, "uniform", "greedy"),
    guided: bool | None = None,
    sweeps: PositiveInt = 8,
    seeds: PositiveInt = 1,
    seed: NonNegativeInt = 0,
    processes: PositiveInt | None = None,
    out: str = "runs/puzzles",
) -> None:
    """Puzzles solved by policy-guided search: how many expansions does it need with a prior, and without?

    A log-linear prior of patterns solves training problems and learns from its solutions, in several sweeps. Then
    Levin tree search solves the test problems with it. Interrupted, the same command goes on.

    Args:
        world: sokoban or tiles.
        train: file of training problems (see docs/puzzles.md), plain or .xz; by default those of eval/data.
        num_train: so many of them, the first.
        test: file of test problems; by default those of eval/data.
        num_test: so many of them, the first; all by default.
        budget: expansions for each test problem.
        priors: bootstrap (the log-linear prior after all sweeps); rerooted (the same prior, searched with rerooting);
            frontier, mcts (these planners with the same prior, not Levin tree search, for 50 problems and 2,000
            expansions at most, as they are slow); without any learning: uniform, a-star, weighted-a-star (weight 5),
            greedy, breadth-first.
        guided: search with the heuristic, too (PHS*); by default in tiles alone.
        sweeps: of solving and learning.
        seeds: repeats; each takes the training problems in another order.
        seed: of everything random.
        processes: how many seeds or priors at a time; all cores by default. With 1 the seconds are the most exact.
        out: folder for tables (CSV), `results.json`, `solutions.jsonl`, `report.html` and finished jobs.
    """
    check_distinct(priors=priors)
    files = [str(file or default) for file, default in zip((train, test), FILES[world], strict=True)]
    guided = world == "tiles" if guided is None else guided
    numbers = {"num_train": num_train, "budget": budget, "sweeps": sweeps, "seed": seed}
    settings = Settings(world=world, train=files[0], test=files[1], num_test=num_test, guided=guided, **numbers)
    both = problems_of(settings)
    digests = [sha256(Path(file).read_bytes()).hexdigest() for file in files]
    asked = asdict(settings) | {"digests": digests}
    of_training = {
        name: value for name, value in asked.items() if name not in ("test", "num_test", "budget", "digests")
    }
    of_training["digest"] = digests[0]
    first = JobRun(partial(bootstrapped, settings), Path(out) / "bootstrap", of_training, name="seed-{}".format)
    first.run = partial(bootstrapped, settings, first.folder)
    needed = any(prior not in SEARCHES for prior in priors)
    sweeps_of = first.do(list(range(seeds if needed else 0)), processes=processes, title="solve and learn")
    second = JobRun(partial(contest, settings, first.folder), Path(out) / "search", asked, name=lambda job: job.name)
    jobs = [Job(k, prior) for prior in priors for k in range(seeds if prior not in SEARCHES else 1)]
    searches = second.do(jobs, processes=processes, title="search")
    document = report(searches, [row for rows in sweeps_of for row in rows], both, settings)
    publish(document, Path(out))
    _write_solutions(searches, both[1], Path(out))


def report(
    searches: Sequence[dict[str, Any]], sweeps: Sequence[dict[str, Any]], both: Sequence[Problems], settings: Settings
) -> Document:
    """The tables: of all priors, of problems with walls of their own, of pairs of priors, and of the sweeps."""
    each = pd.concat([_problem_rows(one) for one in searches], ignore_index=True)
    seconds = pd.DataFrame([{key: one[key] for key in ("prior", "seed", "seconds")} for one in searches])
    rows = _rows(each, seconds)
    frames = {"puzzles": rows, "pairs": _pairs(each), "sweeps": pd.DataFrame(sweeps)}
    tables = [_table(rows, "Test problems", settings)]
    if settings.world == "sokoban":
        train_walls, walls = (_walls(problems) for problems in both)
        among = set(train_walls)
        new_walls = [number for number, layout in enumerate(walls) if layout not in among]
        if 0 < len(new_walls) < len(both[1].boards):
            apart = _rows(each[each["problem"].isin(new_walls)], seconds)
            frames["own_walls"] = apart = apart.drop(columns="seconds_per_problem")
            tables.append(_table(apart, "Test problems whose walls are those of no training problem", settings))
    if len(frames["pairs"]):
        tables.append(_pair_table(frames["pairs"]))
    if sweeps:
        tables.append(_sweep_table(frames["sweeps"]))
    best = rows.sort_values(["solved", "mean_expansions"], ascending=[False, True], kind="stable").iloc[0]
    lead = (
        f"{best['prior']} solves {100 * best['solved']:.1f} % of {best['problems']:,} problems within"
        f" {best['budget']:,} expansions, with {best['mean_expansions']:,.0f} on average."
    )
    sections = [Section(one.title, tables=[one]) for one in tables]
    command = command_line("puzzles")
    return Document("Puzzles", lead, sections, frames, asdict(settings), command, keys={"puzzles": "rows"})


def _walls(problems: Problems) -> list[int]:
    """The number of each problem's walls."""
    groups = problems.world.group(problems.boards)
    return [] if groups is None else groups.tolist()


def _problem_rows(one: dict[str, Any]) -> pd.DataFrame:
    """A row a problem: of one prior and seed."""
    frame = pd.DataFrame({"expansions": one["expansions"], "moves": one["moves"]})
    frame["solved"], frame["length"] = frame["moves"].notna(), frame["moves"].str.len()
    frame["problem"] = range(len(frame))
    return frame.assign(prior=one["prior"], seed=one["seed"], budget=one["budget"])


def _rows(each: pd.DataFrame, seconds: pd.DataFrame) -> pd.DataFrame:
    """A row a prior: means over problems and seeds; expansions of unsolved problems count as far as they went."""
    grouped = each.groupby("prior", sort=False)
    rows = pd.DataFrame(
        {
            "problems": grouped["problem"].nunique(),
            "seeds": grouped["seed"].nunique(),
            "budget": grouped["budget"].first(),
            "solved": grouped["solved"].mean(),
            "mean_expansions": grouped["expansions"].mean(),
            "median_expansions": grouped["expansions"].median(),
            "mean_expansions_solved": each[each["solved"]].groupby("prior", sort=False)["expansions"].mean(),
            "mean_length": grouped["length"].mean(),
        }
    ).reindex(each["prior"].unique())
    rows["seconds_per_problem"] = seconds.groupby("prior")["seconds"].mean() / rows["problems"]
    return rows.rename_axis("prior").reset_index()


def _pairs(each: pd.DataFrame) -> pd.DataFrame:
    """Each of the others against the bootstrapped prior: how many times as many expansions, over problems.

    The geometric mean of the ratio; of a problem the mean over seeds; the interval is Student's over problems.
    """
    logs = each[each["budget"] == each["budget"].max()].assign(
        log=lambda rows: np.log(rows["expansions"].clip(lower=1))
    )
    wide = logs.pivot_table(index="problem", columns="prior", values="log", sort=False)
    rows = []
    for prior in wide.columns if BOOTSTRAP in wide and len(wide) > 1 else ():
        if prior != BOOTSTRAP:
            difference = paired_difference(wide[prior], wide[BOOTSTRAP])
            ratio, low, high = (float(np.exp(x)) for x in (difference.mean, difference.low, difference.high))
            rows.append({"prior": prior, "problems": len(wide), "ratio": ratio, "low": low, "high": high})
    return pd.DataFrame(rows)


def _table(rows: pd.DataFrame, title: str, settings: Settings) -> Table:
    columns: dict[str, Any] = {
        "prior": "prior",
        "problems": "problems:,",
        "solved, %": lambda row: f"{100 * row.solved:.1f}",
        "expansions": "mean_expansions:,.0f",
        "median": "median_expansions:,.0f",
        "moves": "mean_length:.1f",
    }
    if "seconds_per_problem" in rows:
        columns["ms a problem"] = lambda row: f"{1000 * row.seconds_per_problem:.1f}"
    searched = "Levin tree search with a heuristic (PHS*)" if settings.guided else "Levin tree search"
    caption = (
        f"{searched}, at most {settings.budget:,} expansions a problem. Expansions (mean and median): of all problems,"
        " those that are not solved with what was spent. Means over seeds; one core."
    )
    return table(rows, columns, caption, title)


def _pair_table(pairs: pd.DataFrame) -> Table:
    columns: dict[str, Any] = {
        "prior": "prior",
        "problems": "problems:,",
        "times as many expansions": lambda row: f"{row.ratio:.2f} ({row.low:.2f} to {row.high:.2f})",
    }
    caption = (
        "Expansions in the ratio to those with the bootstrapped prior: geometric mean and 95 % interval (Student's)"
        " over problems, of each the mean over seeds."
    )
    return table(pairs, columns, caption, "Against the bootstrapped prior")


def _sweep_table(sweeps: pd.DataFrame) -> Table:
    columns: dict[str, Any] = {
        **({"seed": "seed:.0f"} if sweeps["seed"].nunique() > 1 else {}),
        "sweep": "number:.0f",
        "problems": "problems:,.0f",
        "budget": "max_nodes:,.0f",
        "solved, %": lambda row: f"{100 * row.solved:.1f}",
        "expansions": "mean_expansions:,.0f",
        "actions": "actions:,.0f",
        "search, s": "search_seconds:.0f",
        "fit, s": "fit_seconds:.0f",
    }
    caption = "Expansions: mean over the problems tried. Actions: learned from, with reflections and rotations."
    return table(sweeps, columns, caption, "Solve and learn")


def _write_solutions(searches: Sequence[dict[str, Any]], test: Problems, out: Path) -> None:
    """`solutions.jsonl`, a line a problem, prior and seed; and an animated solution of the first prior."""
    lines = [
        json.dumps({"prior": one["prior"], "seed": one["seed"], "problem": k, "solved": moves is not None,
                    "expansions": expansions, "moves": moves})
        for one in searches
        for k, (moves, expansions) in enumerate(zip(one["moves"], one["expansions"], strict=True))
    ]  # fmt: skip
    with claim(out) as place:
        place.add(["solutions.jsonl", "solution.svg"])
    write_whole(out / "solutions.jsonl", ("\n".join(lines) + "\n").encode())
    solved = [(len(moves), k) for k, moves in enumerate(searches[0]["moves"]) if moves]
    if solved:
        number = sorted(solved)[len(solved) // 2][1]
        write_whole(
            out / "solution.svg", animation(test.world, test.boards[number], searches[0]["moves"][number]).encode()
        )
