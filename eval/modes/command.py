"""`python -m eval modes`: how many hidden modes have mice in a labyrinth, which come back, and where they lead."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import product
from pathlib import Path

import pandas as pd
from jsonargparse.typing import NonNegativeInt, PositiveInt

from eval.modes.experiment import (
    FOLDS,
    WITHIN,
    Job,
    ModeSettings,
    described,
    fit_and_infer,
    fitted,
    likelihoods,
    mode_rows,
    node_shares,
    since_water,
)
from eval.modes.figures import maze_figure, since_figure
from eval.worlds import runs
from eval.worlds.labyrinth import DATA, data_digest
from neuroprior import read_plans
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun
from neuroprior.behaviour.analysis.modes import STABLE, mode_table
from neuroprior.behaviour.reporting.document import Column, Document, publish, table, write_figures
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.behaviour.reporting.scores import load_arrays, save_arrays


@claim_out
def modes(
    modes: Sequence[PositiveInt] = (1, 2, 3),
    orders: Sequence[NonNegativeInt] = (1, 2),
    restarts: PositiveInt = 4,
    seed: runs.Seed = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/modes",
) -> None:
    """How many hidden modes have mice in a labyrinth, which come back, and where do they lead?

    Switching priors, given the node, learn from the sequences of mice in five folds. Of those whose modes all come back
    in each fold the likeliest is described. Prints tables; writes them (CSV), results.json, report.html and figures.
    Interrupted, the same command goes on.

    Args:
        modes: numbers of modes.
        orders: of the chains of modes.
        restarts: random starts of each fit.
        seed: of everything random.
        processes: how many priors are fitted at a time; all cores by default.
        dask: address of a Dask scheduler, tcp://host:port, whose workers fit them.
        out: folder for the report and for finished fits.
    """
    runs.check_distinct(modes=modes, orders=orders)
    settings, plans = ModeSettings(restarts, seed), read_plans(DATA)
    jobs = [Job(number, order, fold) for order, number, fold in product(orders, modes, range(FOLDS + 1))]
    run = JobRun(
        partial(fit_and_infer, settings=settings),
        Path(out) / "fits",
        {"command": "modes", "data": data_digest()} | asdict(settings),
        save=save_arrays,
        load=load_arrays,
        suffix=".npz",
    )
    fits = run.do(jobs, processes=processes, dask=dask, title="fits")
    frame = likelihoods(dict(zip(jobs, fits, strict=True)), plans, settings.seed)
    frames, tables, boxes = {"rows": frame}, [_likelihood_table(frame)], list[FigureBox]()
    lead, chosen = "No number of modes has modes that all come back in each fold.", described(frame)
    if chosen is not None:
        prior = fitted(Job(*chosen, FOLDS), settings, plans)
        rows, since = mode_rows(prior, plans), since_water(prior, plans)
        whole = mode_table(prior, plans)
        frames |= {"modes": rows, "since_water": since, "mode_table": whole}
        tables += [_mode_table(rows, whole), _since_table(since)]
        lead = f"With {chosen[0]} modes of order {chosen[1]} all modes come back in each fold."
        caption = (
            "Of each node (the corridor that leads to it): the share of its moves in the mode, of these those that turn"
            f" back, and those from which the water, or home, is reached within {WITHIN} moves. Grey: too few moves."
        )
        boxes.append(FigureBox(maze_figure(node_shares(prior, plans)), caption, "Maps of the modes.", "modes"))
        caption = "The share of the moves in each mode by moves since the water. Bands: 95 % intervals over sequences."
        boxes.append(FigureBox(since_figure(since), caption, "Modes since the last drink.", "since_water"))
    section = Section("Hidden modes of the mice", tables=tables, figures=boxes)
    shown = {"modes": list(modes), "orders": list(orders)} | asdict(settings)
    document = Document("Hidden modes of mice", lead, [section], frames, shown, runs.command_line("modes"))
    publish(document, Path(out))
    write_figures(Path(out), document.figures)


def _likelihood_table(frame: pd.DataFrame) -> Table:
    cells = [f"{row['nats']:.4f} ({row['stable']})" for _, row in frame.iterrows()]
    widest = (frame["high"] - frame["nats"]).max()
    caption = (
        f"95 % intervals over sequences: at most ±{widest:.4f}; rows.csv has each. In brackets: modes that come back,"
        f" whose posterior correlates by {STABLE} or more with that of a mode of the prior of each fold."
    )
    title = "Nats per held-out move, given the node, by number of modes"
    return runs.table_by(frame, {"order": "order"}, "modes", cells, caption, title)


def _mode_table(rows: pd.DataFrame, whole: pd.DataFrame) -> Table:
    cells = [runs.plus_minus(row, "mean", 100).replace(" ", "") for _, row in rows.iterrows()]
    wide = rows.assign(cell=cells).pivot(index="mode", columns="what", values="cell").reset_index().merge(whole)
    columns: dict[str, Column] = {"mode": "mode", "moves": "moves", "dwell": "dwell:.1f", "turns": "turns"}
    columns |= {"water": "water", "home": "home", "enters": "enters", "leaves": "leaves"}
    caption = (
        "%, ±: 95 % intervals over sequences. moves: in the mode; of these turns: those that turn back; water, home:"
        f" from which it is reached within {WITHIN} moves. dwell: mean moves until the mode ends; enters, leaves: the"
        " commonest nodes there."
    )
    return table(wide, columns, caption, "What each mode does", "rrrrrrll")


def _since_table(since: pd.DataFrame) -> Table:
    cells = [runs.plus_minus(row, "share", 100, digits=0).replace(" ", "") for _, row in since.iterrows()]
    caption = "%, ±: 95 % intervals over sequences. Columns: from so many moves to those of the next."
    return runs.table_by(since, {"mode": "mode"}, "from", cells, caption, "Moves in each mode since the water")
