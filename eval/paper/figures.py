"""Figures of the paper's simulations."""

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from eval.paper.first_simulation import FirstResult
from eval.paper.planners import ANY_PREFIX, PaperSettings
from eval.paper.second_simulation import SecondResult
from neuroprior.behaviour.reporting.drawing import band, panels
from neuroprior.worlds import GridWorld
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


def best_bars(rows: pd.DataFrame) -> Figure:
    """How often each planner was best, with intervals, and the paper's figures; `rows` as of `FirstResult.table`."""
    rows = rows[rows.planner != "oracle"].reset_index(drop=True)
    best, low, high = (100 * rows[name].astype(float) for name in ("best", "low", "high"))
    figure, (axes,) = panels(1, 1, (7, 3.6))
    colors = [COLORS[name] for name in rows.planner]
    axes.bar(rows.planner, best, yerr=[best - low, high - best], color=colors, capsize=4, width=0.65)
    paper = 100 * rows.paper.astype(float).dropna()
    axes.plot(paper.index, paper, "D", color="black", markersize=6, label="paper", linestyle="none")
    for i, share in enumerate(best):
        axes.text(i, 3, f"{share:.1f}", ha="center", color="white", fontweight="bold")
    axes.set_ylim(0, 108)
    axes.set_ylabel("best of the paper's four planners,\n% of starts (ties count for each)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="upper left")
    return figure


def matrices(named: dict[str, Tensor]) -> Figure:
    """Transition matrices side by side as heat maps."""
    figure, cells = panels(1, len(named), (3.6 * len(named), 3.4))
    for axes, (name, matrix) in zip(cells, named.items(), strict=True):
        axes.imshow(matrix.numpy(), cmap="Blues", vmin=0, vmax=1)
        for (a, b), value in np.ndenumerate(matrix.numpy()):
            axes.text(b, a, f"{value:.2f}", ha="center", va="center", color="white" if value > 0.55 else "black")
        axes.set_xticks(range(4), MOVES)
        axes.set_yticks(range(4), MOVES)
        axes.set(xlabel="next move", ylabel="last move", title=name)
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
    return figure


def plans_in_world(result: FirstResult) -> Figure:
    """A world with its rewards, a start, and the plan of each planner from there."""
    world = result.world
    chosen = _dividing_start(result)
    start = result.states.flatten()[chosen]
    figure, (axes,) = panels(1, 1, (7.4, 5.2))
    rewards = world.reward[int(world.reward_map(start))].view(world.height, world.width)
    picture = axes.imshow(rewards.numpy(), cmap="Greys_r", vmin=0, vmax=1)
    figure.colorbar(picture, ax=axes, label="reward", shrink=0.8)
    for k, (name, decision) in enumerate(result.decisions.items()):
        shift = (k - (len(result.decisions) - 1) / 2) / 14
        label = f"{name}: {float(decision.score[chosen]):.3f}"
        _draw_plan(axes, world, start, decision.plan[chosen].long(), COLORS[name], label, shift)
    y, x = world.coordinates(start).tolist()
    axes.plot(x, y, "o", color="white", markeredgecolor="black", markersize=9, zorder=5)
    axes.set_title(f"start and chosen plans (best possible: {float(result.oracle.flatten()[chosen]):.3f})")
    axes.set(xticks=[], yticks=[])
    axes.legend(loc="center left", bbox_to_anchor=(1.25, 0.5), frameon=False, title="reward at the end")
    return figure


def _dividing_start(result: FirstResult) -> int:
    """The first start, well inside the grid, where the most planners found different rewards."""
    decisions, world = result.decisions.values(), result.world
    scores = torch.stack([decision.score for decision in decisions]).sort(0).values
    different = (scores[1:] > scores[:-1]).sum(0)
    places = world.coordinates(result.states.flatten())
    sides = torch.tensor([world.height, world.width])
    margin = torch.minimum(places, sides - 1 - places).amin(-1)
    reach = max(decision.plan.shape[1] for decision in decisions)
    different[margin < min(reach, (int(sides.min()) - 1) // 2)] -= len(decisions)
    return int(different.argmax())


def _draw_plan(axes: Axes, world: GridWorld, start: Tensor, plan: Tensor, color: str, label: str, shift: float) -> None:
    """A plan as a line that is broken where it goes around the edge; `shift` keeps lines apart."""
    path, state = [world.coordinates(start)], start[None]
    for action in plan:
        state, _ = world.step(state, action[None])
        cell = world.coordinates(state)[0]
        if int((cell - path[-1]).abs().max()) > 1:
            path.append(torch.full((2,), torch.nan))
        path.append(cell)
    places = torch.stack([place.double() for place in path]) + shift
    axes.plot(*places.T.flip(0).numpy(), color=color, linewidth=1.8, label=label, solid_capstyle="round")
    axes.plot(*places[-1:].T.flip(0).numpy(), "s", color=color, markersize=5)


def values_and_stuck(result: SecondResult, settings: PaperSettings) -> Figure:
    """The first approximate value function, the exact one, and where each planner gets stuck.

    Only starts count that can end on the goal with whole plans.
    """
    whole = {name: done for name, done in result.pursuits.items() if not name.endswith(ANY_PREFIX)}
    figure, cells = panels(3, 3, (11, 7.6))
    size, exact, able = settings.size, result.exact, result.ceiling[0]
    maps = {"approximate values": result.values[0], "exact values": exact}
    for axes, (title, values) in zip(cells, maps.items(), strict=False):
        values = values.clone()
        values[settings.goal] = exact[exact < exact[settings.goal]].max()
        axes.imshow(values.view(size, size).numpy(), cmap="Greys_r", vmin=0)
        axes.set_title(title)
    for axes, (name, done) in zip(cells[len(maps) :], whole.items(), strict=True):
        stuck = able & ~done.reached[: len(able)]
        ends = result.world.cell(done.final_state[: len(able)][stuck]).bincount(minlength=size**2)
        axes.imshow((ends / able.sum()).sqrt().view(size, size).numpy(), cmap="Reds", vmin=0, vmax=0.5)
        axes.set_title(f"{name}: {100 * int(stuck.sum()) / max(int(able.sum()), 1):.0f} % stuck")
    for axes in cells:
        axes.plot(size // 2, size // 2, "*", color="gold", markeredgecolor="black", markersize=12)
        axes.set(xticks=[], yticks=[])
    return figure


def success_against_quality(rows: pd.DataFrame) -> Figure:
    """How often each planner reached the goal against the quality of the values, a panel for each way to be wrong."""
    kinds = rows.sort_values("quality", kind="stable").groupby("kind", sort=False)
    order = list(rows["kind"].unique())
    figure, cells = panels(1, len(order), (2.6 * len(order) + 1, 3.4), sharey=True)
    for axes, kind in zip(cells, order, strict=True):
        group = kinds.get_group(kind)
        axes.plot(group.quality, 100 * group.ceiling, color="black", linestyle=":", label="ceiling")
        for name in filter(group.__contains__, COLORS):
            shares = 100 * group[[name, f"{name} low", f"{name} high"]]
            band(axes, np.column_stack([group.quality, shares]), COLORS[name], name, "-")
        axes.set_title({"sweeps": "value iteration cut short"}.get(kind, kind), fontsize=10)
        axes.set_xlabel("quality of the values")
        axes.spines[["top", "right"]].set_visible(False)
    cells[0].set_ylabel("goal reached, % of starts")
    cells[0].set_ylim(0, None)
    cells[-1].legend(frameon=False, loc="center left", bbox_to_anchor=(1.02, 0.5))
    return figure
