"""Figures of the paper's simulations, as PNG."""

from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from eval.paper import second_simulation
from eval.paper.first_simulation import Outcome
from neuroprior import GridWorld
from neuroprior._files import write_whole
from neuroprior.worlds.grid import MOVES

COLORS = {
    "deterministic": "#31a354",
    "random": "#d9a441",
    "markov-1": "#6baed6",
    "markov-2": "#2171b5",
    "markov-3": "#08306b",
    "gru": "#e6550d",
    "transformer": "#88419d",
}
"""The colour of each planner, the same in every figure."""

mpl.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})


def save(figure: Figure, path: Path) -> None:
    """Save as PNG: whole or not at all."""
    picture = BytesIO()
    figure.savefig(picture, format="png", dpi=150, bbox_inches="tight", facecolor="white")
    write_whole(path, picture.getvalue())


def best_bars(path: Path, rows: list[dict[str, Any]]) -> None:
    """How often each planner was best, with intervals, and the paper's figures."""
    rows = [row for row in rows if row["planner"] != "oracle"]
    figure = Figure(figsize=(7, 3.6))
    axes = figure.subplots()
    names = [row["planner"] for row in rows]
    best = [100 * row["best"] for row in rows]
    spread = [
        [100 * (row["best"] - row["low"]) for row in rows],
        [100 * (row["high"] - row["best"]) for row in rows],
    ]
    axes.bar(names, best, yerr=spread, color=[COLORS[name] for name in names], capsize=4, width=0.65)
    told = [(i, 100 * row["paper"]) for i, row in enumerate(rows) if row["paper"] is not None]
    axes.plot(*zip(*told, strict=True), "D", color="black", markersize=6, label="paper", linestyle="none")
    for i, share in enumerate(best):
        axes.text(i, 3, f"{share:.1f}", ha="center", color="white", fontweight="bold")
    axes.set_ylim(0, 108)
    axes.set_ylabel("best of the paper's four planners,\n% of starts (ties count for each)")
    axes.legend(frameon=False, loc="upper left")
    save(figure, path)


def matrices(path: Path, named: dict[str, Tensor]) -> None:
    """Transition matrices side by side as heat maps."""
    figure = Figure(figsize=(3.6 * len(named), 3.4))
    for axes, (name, matrix) in zip(figure.subplots(1, len(named), squeeze=False)[0], named.items(), strict=True):
        axes.imshow(matrix.numpy(), cmap="Blues", vmin=0, vmax=1)
        for a in range(len(matrix)):
            for b in range(len(matrix)):
                value = float(matrix[a, b])
                axes.text(b, a, f"{value:.2f}", ha="center", va="center", color="white" if value > 0.55 else "black")
        axes.set_xticks(range(4), MOVES)
        axes.set_yticks(range(4), MOVES)
        axes.set_xlabel("next move")
        axes.set_ylabel("last move")
        axes.set_title(name)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
    figure.tight_layout()
    save(figure, path)


def plans_in_world(path: Path, outcome: Outcome) -> None:
    """A world with its rewards, a start, and the plan of each planner from there."""
    world = outcome.world
    row, column = _telling_start(outcome)
    start = outcome.states[row, column]
    figure = Figure(figsize=(7.4, 5.2))
    axes = figure.subplots()
    rewards = world.reward[int(world.reward_map(start))].view(world.height, world.width)
    picture = axes.imshow(rewards.numpy(), cmap="Greys_r", vmin=0, vmax=1)
    figure.colorbar(picture, ax=axes, label="reward", shrink=0.8)
    count = len(outcome.names)
    for k, name in enumerate(outcome.names):
        plan = outcome.plans[k, row, column]
        score = float(outcome.scores[k, row, column])
        shift = (k - (count - 1) / 2) / 14
        _draw_plan(axes, world, start, plan[plan >= 0], COLORS[name], f"{name}: {score:.3f}", shift)
    y, x = world.coordinates(start).tolist()
    axes.plot(x, y, "o", color="white", markeredgecolor="black", markersize=9, zorder=5)
    axes.set_title(f"start and chosen plans (best possible: {float(outcome.oracle[row, column]):.3f})")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(True)
    axes.legend(loc="center left", bbox_to_anchor=(1.25, 0.5), frameon=False, title="reward at the end")
    save(figure, path)


def _telling_start(outcome: Outcome) -> tuple[int, int]:
    """The first start, well inside the grid, where the most planners found different rewards."""
    scores = outcome.scores.sort(0).values
    different = (scores[1:] > scores[:-1]).sum(0)
    places = outcome.world.coordinates(outcome.states)
    sides = torch.tensor([outcome.world.height, outcome.world.width])
    margin = torch.minimum(places, sides - 1 - places).amin(-1)
    reach = outcome.plans.shape[-1]
    different[margin < min(reach, (int(sides.min()) - 1) // 2)] -= len(outcome.names)
    return divmod(int(different.argmax()), outcome.states.shape[1])


def _draw_plan(axes: Axes, world: GridWorld, start: Tensor, plan: Tensor, color: str, label: str, shift: float) -> None:
    """A plan as a line that is broken where it goes around the edge; `shift` keeps lines apart."""
    path, state = [world.coordinates(start)], start[None]
    for action in plan:
        state, _ = world.step(state, action[None])
        here = world.coordinates(state)[0]
        if int((here - path[-1]).abs().max()) > 1:
            path.append(torch.full((2,), torch.nan))
        path.append(here)
    places = torch.stack([place.double() for place in path]) + shift
    axes.plot(*places.T.flip(0).numpy(), color=color, linewidth=1.8, label=label, solid_capstyle="round")
    axes.plot(*places[-1:].T.flip(0).numpy(), "s", color=color, markersize=5)


def values_and_stuck(path: Path, outcome: second_simulation.Outcome, task: second_simulation.Task) -> None:
    """The first approximate value function, the exact one, and where each planner gets stuck.

    Only starts count that can end on the goal with whole plans.
    """
    names = [name for name in outcome.names if not name.endswith(second_simulation.ANY_PREFIX)]
    figure = Figure(figsize=(11, 7.6))
    panels = figure.subplots(3, 3).flatten()
    size = task.size
    maps = {"approximate values": outcome.values[0], "exact values": outcome.exact}
    for axes, (title, values) in zip(panels, maps.items(), strict=False):
        values = values.clone()
        values[task.goal] = outcome.exact[outcome.exact < outcome.exact[task.goal]].max()
        axes.imshow(values.view(size, size).numpy(), cmap="Greys_r", vmin=0)
        axes.set_title(title)
    for axes, name in zip(panels[len(maps) :], names, strict=True):
        k = outcome.names.index(name)
        able = outcome.ceiling[0]
        stuck = able & ~outcome.reached[k, 0]
        cells = outcome.world.cell(outcome.final_state[k, 0][stuck]).bincount(minlength=size**2)
        axes.imshow((cells / able.sum()).sqrt().view(size, size).numpy(), cmap="Reds", vmin=0, vmax=0.5)
        axes.set_title(f"{name}: {100 * int(stuck.sum()) / max(int(able.sum()), 1):.0f} % stuck")
    for axes in panels:
        axes.plot(size // 2, size // 2, "*", color="gold", markeredgecolor="black", markersize=12)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(True)
    figure.tight_layout()
    save(figure, path)


def success_against_quality(path: Path, rows: list[dict[str, Any]]) -> None:
    """How often each planner reached the goal against the quality of the values, a panel for each way to be wrong."""
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    figure = Figure(figsize=(2.6 * len(kinds) + 1, 3.4))
    for axes, kind in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
        some = sorted((row for row in rows if row["kind"] == kind), key=lambda row: row["quality"])
        quality = [row["quality"] for row in some]
        axes.plot(quality, [100 * row["ceiling"] for row in some], color="black", linestyle=":", label="ceiling")
        for name, color in COLORS.items():
            axes.plot(quality, [100 * row[name] for row in some], "o-", color=color, markersize=4, label=name)
            low, high = ([100 * row[f"{name} {end}"] for row in some] for end in ("low", "high"))
            axes.fill_between(quality, low, high, color=color, alpha=0.12, linewidth=0)
        axes.set_title({"sweeps": "value iteration cut short"}.get(kind, kind), fontsize=10)
        axes.set_xlabel("quality of the values")
    first, last = figure.axes[0], figure.axes[-1]
    first.set_ylabel("goal reached, % of starts")
    first.set_ylim(0, None)
    last.legend(frameon=False, loc="center left", bbox_to_anchor=(1.02, 0.5))
    save(figure, path)
