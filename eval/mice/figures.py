"""The mice's maze drawn as it is, and figures of what priors bring a planner there."""

from typing import Any

import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from torch import Tensor

from eval.worlds.labyrinth_drawing import coordinates, corridors, signs
from neuroprior import Plans, Prior, TabularWorld, oracle
from neuroprior.sampling import sample_in_world
from neuroprior.worlds import labyrinth
from neuroprior.worlds.labyrinth import DEPTH, WATER

COLORS = {"uniform": "#7f7f7f", "markov": "#2171b5", "gru": "#e6550d", "transformer": "#88419d", "oracle": "black"}
"""The colour of each kind of prior."""

STYLES: dict[str, Any] = {"": "-", "node": "-", "moves": (0, (4, 2))}
TITLES = {"mice": "from mice", "planner": "from exhaustive search", "reached": "from random search"}

START: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "markersize": 8, "zorder": 6}


def passages(plans: Plans) -> Tensor:
    """How often each corridor was walked through, in or out: `[127]`, that of node n leading from it to its parent.

    That of node 0 leads to the home cage; a mouse that comes back from there to node 0 has walked it twice.
    """
    assert plans.context is not None
    after = labyrinth().next_state[plans.context, plans.actions.long()]
    # The further in of two neighbours is the one with the higher number.
    inner = torch.maximum(plans.context, after)
    return inner.flatten().bincount((1 + (plans.context == after)).flatten(), minlength=2 ** (DEPTH + 1) - 1)


def left_turns(plans: Plans) -> tuple[Tensor, Tensor]:
    """At each junction the share of moves in that went to the left, and the number of moves in: `[63]` each."""
    assert plans.context is not None
    junctions = 2**DEPTH - 1
    left, right = (plans.context[plans.actions == move].bincount(minlength=junctions)[:junctions] for move in (0, 1))
    return left / (left + right), left + right


def maze(plans: Plans) -> Figure:
    """The maze twice: how often mice walked through each corridor, and which way they turned at each junction."""
    place = coordinates(labyrinth())
    figure = Figure(figsize=(12.4, 6.2))
    visits, turns = figure.subplots(1, 2)
    walked = passages(plans)
    scale = LogNorm(int(walked.min().clamp(min=1)), int(walked.max()))
    corridors(visits, place, 8.5, walked.clamp(min=1), cmap="YlOrBr", norm=scale)
    visits.set_title(f"how often mice walked through each corridor\n({len(plans)} x {plans.max_length} moves)")
    figure.colorbar(ScalarMappable(scale, "YlOrBr"), ax=visits, label="passages, in or out", shrink=0.75, pad=0.02)
    share, number = left_turns(plans)
    corridors(turns, place, 8.5)
    even = Normalize(0, 1)
    junction = place[: len(share)].numpy()
    size = 30 + 190 * (number / number.max()).sqrt().numpy()
    turns.scatter(*junction.T, s=size, c=share.numpy(), cmap="PuOr", norm=even, edgecolor="#444444", zorder=4)
    turns.set_title("which way mice turned on their way in\n(the larger, the more moves inward)")
    bar = figure.colorbar(ScalarMappable(even, "PuOr"), ax=turns, shrink=0.75, pad=0.02, ticks=[0, 0.25, 0.5, 0.75, 1])
    bar.set_ticklabels(["always right", "25 % left", "equally often", "75 % left", "always left"])
    for axes in (visits, turns):
        signs(axes, place)
    return figure


def plans_in_maze(priors: dict[str, Prior], world: TabularWorld, seed: int, number: int = 60) -> Figure:
    """Plans of 16 moves from a node far from the water, a panel for each of up to three priors."""
    place, start = coordinates(world), far_from_water(world)
    figure = Figure(figsize=(4.3 * len(priors), 4.9))
    colors = (COLORS["uniform"], COLORS["markov"], COLORS["gru"])
    for axes, (name, prior), color in zip(figure.subplots(1, len(priors)), priors.items(), colors, strict=True):
        corridors(axes, place, 5.5)
        generator = torch.Generator().manual_seed(seed)
        _, rollout = sample_in_world(prior, world, start, number, 16, generator=generator, keep_states=True)
        assert rollout.states is not None
        trajectory = torch.cat([start.expand(number, 1), rollout.states[0]], 1)
        shift = 0.4 * (torch.rand(number, 1, 2, generator=generator) - 0.5)
        lines = LineCollection(
            list((place[trajectory] + shift).numpy()), colors=color, linewidths=1.1, alpha=0.4, zorder=3
        )
        axes.add_collection(lines)
        axes.plot(*place[start].T.numpy(), "o", label="start", **START)
        signs(axes, place)
        reached = int((rollout.rewards.sum(-1) > 0).sum())
        axes.set_title(f"{name}\n{reached} of {number} plans reach the water", fontsize=10)
    figure.tight_layout()
    return figure


def far_from_water(world: TabularWorld) -> Tensor:
    """`[1]`: of the nodes from which the water is furthest to walk, the one that lies furthest from it."""
    place, every = coordinates(world), torch.arange(world.num_states)
    short = [oracle(world, every, length, objective="return") == 0 for length in range(1, 2 * DEPTH)]
    moves = torch.stack(short).sum(0) * (every != WATER)
    apart = (place - place[WATER]).norm(dim=1)
    return torch.where(moves == moves.max(), apart, -1).argmax()[None]


def reached_against_candidates(rows: pd.DataFrame) -> Figure:
    """The share of nodes from which the water was found against the number of candidates.

    A column of panels for each length of plans, a row for what the priors learned from, with 95 % bands.
    """
    lengths = sorted(rows.length.unique())
    sources = [source for source in rows.learned_from.unique() if source]
    figure = Figure(figsize=(3.1 * len(lengths) + 1, 2.6 * len(sources) + 0.4))
    panels = figure.subplots(len(sources), len(lengths), sharex=True, sharey=True, squeeze=False)
    for line, source in zip(panels, sources, strict=True):
        for axes, length in zip(line, lengths, strict=True):
            _panel(axes, rows[(rows.length == length) & rows.learned_from.isin(["", source])])
        line[0].set_ylabel(f"learned {TITLES[source]}\nwater reached, % of nodes")
    for axes, length in zip(panels[0], lengths, strict=True):
        axes.set_title(f"plans of {length} moves", fontsize=10)
    for axes in panels[-1]:
        axes.set_xlabel("candidate plans")
    lines: dict[str, tuple[str, Any]] = {"random legal moves": (COLORS["uniform"], "-")}
    lines |= {kind: (COLORS[kind], "-") for kind in ("markov", "gru", "transformer")}
    lines |= {"context: the node": ("black", "-"), "no context": ("black", STYLES["moves"]), "oracle": ("black", ":")}
    handles = [Line2D([], [], color=color, linestyle=style, linewidth=1.8) for color, style in lines.values()]
    panels[0, -1].legend(handles, list(lines), frameon=False, loc="upper left", bbox_to_anchor=(1.02, 1.0))
    figure.tight_layout()
    return figure


def _panel(axes: Axes, rows: pd.DataFrame) -> None:
    best = rows[rows.prior == "oracle"].reached.iloc[0]
    axes.axhline(100 * best, color=COLORS["oracle"], linestyle=":", linewidth=1.4)
    tried = rows[rows.prior != "oracle"].astype({"num_plans": int}).sort_values("num_plans", kind="stable")
    for _, curve in tried.groupby(["prior", "context"], sort=False):
        color, style = COLORS[curve.prior.iloc[0]], STYLES[curve.context.iloc[0]]
        axes.plot(curve.num_plans, 100 * curve.reached, color=color, linestyle=style, linewidth=1.8)
        axes.fill_between(curve.num_plans, 100 * curve.low, 100 * curve.high, color=color, alpha=0.18, linewidth=0)
    axes.set_xscale("log", base=2)
    numbers = tried.num_plans.unique()
    axes.set_xticks(numbers, [f"{number:,}" for number in numbers])
    axes.minorticks_off()
    axes.set_ylim(0, 104)
    axes.grid(color="#e6e6e6", linewidth=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
