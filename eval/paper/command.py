"""`python -m eval paper`: the simulations of the paper, its figures beside ours."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import pandas as pd
from jsonargparse.typing import NonNegativeFloat, NonNegativeInt, PositiveInt
from rich.console import Console

from eval.paper import figures, first_simulation, second_simulation, value_quality
from eval.paper.first_simulation import PAPER_BEST, PAPER_MATRIX, PROTOCOLS
from eval.paper.planners import ANY_PREFIX, PaperSettings, under_each
from eval.paper.second_simulation import PAPER_REACHED, SCALES
from neuroprior._files import versions
from neuroprior._folders import claim_out
from neuroprior._jobs import Progress
from neuroprior.behaviour.reporting.document import (
    Column,
    printed,
    records,
    table,
    write_figures,
    write_frames,
    write_results,
)

SHORT = {"deterministic": "det.", "random": "rand.", "markov-1": "m-1", "markov-2": "m-2", "markov-3": "m-3"}
SHORT |= {"transformer": "trans."}
"""Names of planners in headings."""


@claim_out
def paper(
    worlds: PositiveInt = 100,
    starts: PositiveInt = 1000,
    training_plans: PositiveInt = 20_000,
    size: PositiveInt = 20,
    edges: Literal["torus", "wall"] = "torus",
    ties: Literal["uniform", "first"] = "uniform",
    learn_from: Literal["all", "shortest"] = "all",
    protocols: Literal["one", "all"] = "one",
    reward_power: float = 1.0,
    value_functions: PositiveInt = 10,
    q_steps: NonNegativeInt = 10_000,
    initial_scale: NonNegativeFloat = 0.01,
    max_plans: PositiveInt = 10,
    depth: PositiveInt = 4,
    length: PositiveInt = 8,
    num_plans: PositiveInt = 256,
    steps: PositiveInt = 1000,
    seed: NonNegativeInt = 0,
    out: str = "runs/paper",
) -> None:
    """The paper's two simulations: who finds the best plan on a grid, and who reaches the goal on poor values?

    A deterministic planner tries all plans of a small depth. Priors learn from what it chose. Then planners draw longer
    plans at random, from each prior, and are compared on the same starts. Prints tables; writes them (CSV),
    results.json and figures (PNG) to a folder.

    Args:
        worlds: first simulation: reward maps to compare in; intervals are over them. 1: one world, as the paper may
            have used, where the priors learn too; else they learn in as many other worlds.
        starts: random starts in each world, and for each value function.
        training_plans: about how many plans of the deterministic planner the priors learn from.
        size: side of the square grid.
        edges: a move off the grid comes back on the other side (torus) or stays (wall). The paper does not say.
        ties: first simulation: of equally good plans the deterministic planner executes any (uniform), or the first by
            number (first), as a plain argmax would. The paper does not say.
        learn_from: first simulation: all executed plans, or only the shortest, those that end as many cells away as
            they have moves.
        protocols: one: what the other options say. all: every combination of edges, ties and learn_from, and of edges
            and initial_scale (whatever those options say), with the Markov priors, and which is nearest to the paper.
        reward_power: first simulation: rewards are uniform numbers raised to this power.
        value_functions: second simulation: independent Q-learners to compare with; intervals are over them. The priors
            learn under as many others.
        q_steps: second simulation: steps that each of them learns for.
        initial_scale: second simulation: their initial values are uniform between 0 and this.
        max_plans: second simulation: plans one after another from each start.
        depth: moves in a plan of the deterministic planner.
        length: moves in a plan of the others.
        num_plans: candidate plans of the others.
        steps: of training of each neural prior, at most.
        seed: of everything random.
        out: folder to write to.
    """
    settings = dict(locals())
    for name in ("size", "value_functions"):
        if settings[name] < 2:
            raise ValueError(f"`{name}` must be an integer of at least 2, got {settings[name]}")
    paper_settings = PaperSettings(
        **{name: value for name, value in settings.items() if name not in ("protocols", "out")}
    )
    folder, console = Path(out), Console()
    results = {"settings": settings, "versions": versions(), "seed": seed}
    for simulate in (_all_settings,) if protocols == "all" else (_first, _second):
        results |= simulate(paper_settings, console, folder)
        write_results(folder, results)  # an error in the second part does not lose the first
    console.print(f"written to {folder}")


def _first(settings: PaperSettings, console: Console, folder: Path) -> dict[str, Any]:
    with Progress("first simulation", 11, 11) as progress:
        result = first_simulation.simulate(settings, neural=True, finished=progress.advance)
    rows, paired, matrix = result.table(), result.paired(), result.matrix()
    columns: dict[str, Column] = {
        "planner": "planner",
        "best,\n%": _percent("best"),
        "95 %\ninterval": _interval(),
        "paper,\n%": _percent("paper"),
        "mean\nreward": "mean_reward:.4f",
        "normalised\nscore, %": _percent("oracle_share", ".2f"),
        "optimal,\n%": _percent("at_oracle"),
        "steps": "model_steps:,",
    }
    caption = (
        "best: at least as good as each of the paper's four planners; ties count for each. normalised score: reward /"
        " that of the oracle, which tries all plans. optimal: starts with a plan as good as the oracle's."
    )
    title = f"Table 1 ({settings.protocol}; {_amount(settings)})"
    console.print(printed(title, table(rows, columns, caption)))
    if len(paired):
        console.print(_paired("Table 1, paired over worlds: optimal, points", paired))
    both = matrix.assign(shown=[f"{a:.3f} ({b:.2f})" for a, b in zip(matrix.learned, matrix.paper, strict=True)])
    moves = list(matrix["next"].unique())
    both = both.pivot(index="after", columns="next", values="shown").loc[moves].reset_index()
    title = "Transition matrix, markov-1 (in brackets: the paper's, about)"
    console.print(printed(title, table(both, {name: name for name in ("after", *moves)})))
    write_frames(folder, {"table_1": rows, "paired_1": paired, "transition_matrix": matrix})
    learned = result.transition_matrix
    pictures = {
        "table_1": figures.best_bars(rows),
        "transition_matrix": figures.matrices({"learned": learned, "paper": PAPER_MATRIX}),
        "world": figures.plans_in_world(result),
    }
    write_figures(folder, pictures)
    protocol = {name: getattr(settings, name) for name in PROTOCOLS}
    results = {"protocol": protocol, "rows": records(rows), "paired": records(paired)}
    return {"simulation_1": results | {"transition_matrix": learned.tolist()}}


def _second(settings: PaperSettings, console: Console, folder: Path) -> dict[str, Any]:
    with Progress("second simulation", 23, 23) as progress:
        result, priors = second_simulation.simulate(settings, full=True, finished=progress.advance)
        quality = value_quality.measure(settings, priors, progress.advance)
    rows, ceilings, paired = result.table(), result.ceilings(), result.paired()
    shown = [{"planner": "ceiling" + ANY_PREFIX * ("any" in name), "reached": best} for name, best in ceilings.items()]
    columns: dict[str, Column] = {
        "planner": "planner",
        "reached, %": _percent("reached"),
        "95 % interval": _interval(),
        "paper, %": _percent("paper"),
        "steps": "model_steps:,.0f",
    }
    caption = (
        "reached: starts from which the goal was reached. steps: simulator steps for each plan. any prefix: plans may"
        " end after any move. ceiling: starts from which some plans of these lengths end on the goal at all."
    )
    size = f"{settings.value_functions} value functions x {settings.starts:,} starts"
    title = f"Table 2 ({settings.edges}; {size}, up to {settings.max_plans} plans)"
    console.print(printed(title, table(pd.concat([rows, pd.DataFrame(shown)]), columns, caption)))
    console.print(_paired("Table 2, paired over value functions: goal reached, points", paired))
    names = [str(name) for name in quality if f"{name} low" in quality]
    columns = {"values": "kind", "level": "level", "qual.": "quality:.2f"}
    columns |= {SHORT.get(name, name): _percent(name) for name in names} | {"ceil.": _percent("ceiling")}
    caption = (
        "values: of Q-learning after so many steps; of value iteration cut short after so many sweeps; true ones"
        " averaged over tiles of that side; of a network trained for so many steps; for a goal so many cells away."
        " qual.: rank correlation with the true ones."
    )
    title = "How wrong the values are, and the goal reached, % of starts"
    once = quality.assign(kind=quality.kind.where(~quality.kind.duplicated(), ""))
    console.print(printed(title, table(once, columns, caption)))
    write_frames(folder, {"table_2": rows, "value_quality": quality})
    pictures = {"figure_1": figures.values_and_stuck(result, settings)}
    write_figures(folder, pictures | {"value_quality": figures.success_against_quality(quality)})
    results = {"task": asdict(settings), "rows": records(rows), **ceilings, "paired": records(paired)}
    return {"simulation_2": results | {"value_quality": records(quality)}}


def _all_settings(settings: PaperSettings, console: Console, folder: Path) -> dict[str, Any]:
    """Both tables under every protocol and scale, with the Markov priors alone."""
    with Progress("protocols and initial values", 16, 16) as progress:
        protocols = under_each(
            PROTOCOLS, settings, lambda each: first_simulation.simulate(each, neural=False).summary(), progress.advance
        )
        scales = under_each(
            SCALES, settings, lambda each: second_simulation.simulate(each, full=False)[0].summary(), progress.advance
        )
    paper_row = {"edges": "paper", **PAPER_BEST, **first_simulation.structure(PAPER_MATRIX)}
    columns: dict[str, Column] = {
        "edges, ties,\nlearn from": lambda row: " ".join(row[list(PROTOCOLS)].dropna()),
        **{SHORT[name]: _percent(name) for name in PAPER_BEST},
        "re-\npeat": "repeat:.2f",
        "turn": "turn:.2f",
        "back": "reverse:.2f",
        "off": _percent("table_distance"),
        "off\nm.": "matrix_distance:.3f",
    }
    caption = "off: root mean square difference from the paper's table, points; off m.: from its matrix."
    shown = table(pd.concat([protocols, pd.DataFrame([paper_row])]), columns, caption)
    console.print(printed(f"Table 1 under every protocol, % of starts ({_amount(settings)})", shown))
    nearest = {
        what: records(protocols.nsmallest(1, f"{what}_distance")[list(PROTOCOLS)])[0] for what in ("table", "matrix")
    }
    for what, best in nearest.items():
        console.print(f"nearest to the paper's {what}: [bold]{replace(settings, **best).protocol}[/bold]")
    columns = {"edges": "edges", "initial\nvalues": "initial_scale:g"}
    columns |= {SHORT[name]: _percent(name) for name in PAPER_REACHED}
    columns |= {"ceiling": _percent("ceiling"), "off": _percent("table_distance"), "95 %": _interval()}
    caption = "off: root mean square difference from the paper's table, points (interval over value functions)."
    shown = table(pd.concat([scales, pd.DataFrame([{"edges": "paper", **PAPER_REACHED}])]), columns, caption)
    console.print(printed("Table 2 under every setting: goal reached, % of starts", shown))
    scale = records(scales.nsmallest(1, "table_distance")[list(SCALES)])[0]
    console.print(
        f"nearest to the paper's Table 2: [bold]{scale['edges']}, values up to {scale['initial_scale']:g}[/bold]"
    )
    write_frames(folder, {"protocols": protocols, "scales": scales})
    results = {"protocols": records(protocols), "nearest": nearest}
    return results | {"scales": records(scales), "nearest_scale": scale}


def _amount(settings: PaperSettings) -> str:
    worlds = "1 world" if settings.worlds == 1 else f"{settings.worlds} worlds"
    return f"{worlds} x {settings.starts:,} starts, {settings.num_plans} plans of {settings.length} moves"


def _paired(title: str, paired: pd.DataFrame) -> Any:
    short = {end: paired[end].str.replace(ANY_PREFIX, ", any", regex=False) for end in ("first", "second")}
    columns: dict[str, Column] = {"planner": "first", "minus": "second", "gain": _percent("mean", "+.1f")}
    columns |= {"95 % interval": _interval("+.1f", " to "), "p": "p_value:.1g"}
    return printed(title, table(paired.assign(**short), columns, align="llrrr"))


def _percent(name: str, form: str = ".1f") -> Callable[[Any], str]:
    """A column of shares, in percent; what is missing is left blank."""
    return lambda row: "" if pd.isna(row[name]) else f"{100 * row[name]:{form}}"


def _interval(form: str = ".1f", between: str = "-") -> Callable[[Any], str]:
    """The interval of shares, in percent."""
    low, high = _percent("low", form), _percent("high", form)
    return lambda row: low(row) and f"{low(row)}{between}{high(row)}"
