"""`python -m eval bench`: speed against plain code, in the same run."""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from neuroprior import (
    ExhaustivePlanner,
    GRUPrior,
    MarkovPrior,
    Plans,
    Prior,
    SamplingPlanner,
    TransformerPrior,
    UniformPrior,
    collect,
    gridworld,
)
from neuroprior.output import versions, write_csv, write_json
from neuroprior.sampling import sample
from neuroprior.values import q_learning


def bench(repetitions: int = 5, starts: int = 0, out: str = "runs/bench") -> None:
    """Measure the library against plain code; prints a table, writes CSV and results.json.

    Args:
        repetitions: how often each job is timed, in turn with its peer.
        starts: also plan from so many starts with 256 plans of 8 moves each, and report time and peak memory.
        out: folder to write to.
    """
    if repetitions < 1 or starts < 0:
        raise ValueError(f"repetitions and starts: at least 1 and 0 are expected, not {repetitions} and {starts}")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    console = Console()
    # Memory first: the process's peak never falls again.
    many = _many_starts(starts, console) if starts else None
    rows = []
    for name, job, peer, rival, share in track(_jobs(), description="measuring", console=console, transient=True):
        job(), rival()
        times = [(_seconds(job), _seconds(rival)) for _ in range(repetitions)]
        ratios = sorted(theirs / share / ours for ours, theirs in times)
        rows.append(
            {
                "job": name,
                "seconds": median(ours for ours, _ in times),
                "peer": peer,
                "ratio": median(ratios),
                "low": ratios[0],
                "high": ratios[-1],
            }
        )
    results: dict[str, Any] = {"versions": versions(), "threads": torch.get_num_threads(), "rows": rows}
    console.print(_table(rows))
    if many is not None:
        results["many_starts"] = many
    write_csv(folder / "bench.csv", rows)
    write_json(folder / "results.json", results)
    console.print(f"written to {folder}")


Job = Callable[[], object]


Measured = tuple[str, Job, str, Job, float]  # a job's name, the job, its peer's name and job, the share that it does


def _jobs() -> list[Measured]:
    world = gridworld(20, 20, "torus", num_worlds=10)
    generator = torch.Generator().manual_seed(0)
    plans = collect(ExhaustivePlanner(4), world, 10_000, generator=generator)
    starts = world.reset(10_000, generator)
    candidates = UniformPrior(4).sample(2_560_000, 8, generator=generator).view(10_000, 256, 8)
    return [
        *_sampling_jobs(plans, generator),
        (
            "evaluate 10,000 starts x 256 plans x 8 steps",
            partial(world.rollout, starts, candidates),
            "plain torch indexing",
            partial(_plain_rollout, world.next_state, world.reward, starts, candidates),
            1,
        ),
        (
            "Q-learning, 200 agents x 10,000 steps",
            partial(q_learning, world, 210, num_agents=200),
            "numpy over agents",
            partial(_numpy_q_learning, world.next_state.numpy(), 210, 200, 10_000),
            1,
        ),
        (
            "fit a GRU on 10,000 plans of length 4",
            partial(_fit, GRUPrior, plans),
            "fit a transformer",
            partial(_fit, TransformerPrior, plans),
            1,
        ),
    ]


def _sampling_jobs(plans: Plans, generator: torch.Generator) -> list[Measured]:
    markov = MarkovPrior(4, 2).fit(plans)
    priors: dict[str, Prior] = {"markov-2": markov}
    for name, make in (("gru", GRUPrior), ("transformer", TransformerPrior)):
        priors[name] = make(4).fit(plans, generator=generator, progress=False, max_steps=100)
    number, length = 2_560_000, 8
    jobs: list[Measured] = [
        (
            f"sample 2.56 M plans of length 8, {name}",
            partial(sample, prior, number, length),
            "plan by plan (a tenth of them)",
            partial(sample, prior, number // 10, length, method="ancestral"),
            0.1,
        )
        for name, prior in priors.items()
    ]
    tables = markov.log_probs.exp().double().numpy(), markov.next_node.numpy(), int(markov.start_node)
    rival = partial(_numpy_sample, *tables, number, length)
    return [*jobs, (jobs[0][0], jobs[0][1], "numpy, inverse CDF a step", rival, 1)]


def _numpy_q_learning(next_state: Any, goal: int, agents: int, steps: int) -> Any:
    """Greedy Q-learning in numpy, vectorised over agents."""
    generator = np.random.default_rng(0)
    values = generator.random((agents, *next_state.shape)) * 0.01
    values[:, goal] = 0
    agent = np.arange(agents)
    cell = generator.integers(len(next_state), size=agents)
    for _ in range(steps):
        action = values[agent, cell].argmax(1)
        after = next_state[cell, action]
        target = (after == goal) + 0.9 * values[agent, after].max(1)
        values[agent, cell, action] += 0.5 * (target - values[agent, cell, action])
        cell = np.where(after == goal, generator.integers(len(next_state), size=agents), after)
    return values


def _fit(make: type[GRUPrior] | type[TransformerPrior], plans: Plans) -> object:
    return make(4).fit(plans, generator=torch.Generator().manual_seed(0), progress=False)


def _seconds(job: Job) -> float:
    begin = time.perf_counter()
    job()
    return time.perf_counter() - begin


def _numpy_sample(probs: Any, follow: Any, start: int, num_plans: int, length: int) -> Any:
    """A Markov chain in numpy, vectorised over plans."""
    generator = np.random.default_rng(0)
    cumulative = probs.cumsum(1)
    node = np.full(num_plans, start)
    plans = np.empty((num_plans, length), np.uint8)
    for t in range(length):
        action = (generator.random((num_plans, 1)) > cumulative[node, :-1]).sum(1)
        plans[:, t] = action
        node = follow[node, action]
    return plans


def _plain_rollout(next_state: torch.Tensor, reward: torch.Tensor, state: torch.Tensor, plans: torch.Tensor) -> Any:
    """What one writes first: index two tables at every step."""
    cell, world = state % len(next_state), state // len(next_state)
    cell = cell[:, None].expand(plans.shape[:2])
    world = world[:, None].expand(plans.shape[:2])
    rewards = []
    for t in range(plans.shape[2]):
        cell = next_state[cell, plans[:, :, t].long()]
        rewards.append(reward[world, cell])
    return cell, torch.stack(rewards, -1)


def _many_starts(starts: int, console: Console) -> dict[str, float]:
    """Time and peak memory of planning from `starts` starts with 256 plans of 8 moves each."""
    import resource  # not on every platform, and needed here alone

    world = gridworld(20, 20, "torus", num_worlds=100)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    states = world.reset(starts)
    seconds = _seconds(lambda: SamplingPlanner(UniformPrior(4), 8, 256).plan(world, states))
    unit = 1 if sys.platform == "darwin" else 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {"seconds": seconds, "peak_gb": peak * unit / 1e9, "peak_before_gb": before * unit / 1e9}
    console.print(
        f"{starts:,} starts x 256 plans x 8 moves: {seconds:.1f} s, peak memory of the process"
        f" {found['peak_gb']:.2f} GB ({found['peak_before_gb']:.2f} GB before)"
    )
    return found


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        collapse_padding=True,
        title=f"Speed on {torch.get_num_threads()} threads (medians; ratio: peer's time / ours, min to max)",
    )
    for heading in ("job", "seconds", "peer", "ratio", "min", "max"):
        table.add_column(heading, justify="left" if heading in ("job", "peer") else "right")
    for row in rows:
        figures = (f"{row[key]:.1f}" for key in ("ratio", "low", "high"))
        table.add_row(row["job"], f"{row['seconds']:.3f}", row["peer"], *figures)
    return table
