"""The report of `python -m eval compare`: one document of tables and figures."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from eval.compare import figures
from eval.compare.figures import POINTS, Style
from eval.compare.results import AGAINST, BEST, Results, grouped, kind_of
from eval.worlds.runs import across_table, plus_minus, table_by
from neuroprior.behaviour.reporting.document import Column, Document, table
from neuroprior.behaviour.reporting.figures import transition_figure
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table

FRAMES = {name: name for name in ("rows", "paired", "efficiency", "bits", "words", "reasons", "across", "combined")}
FRAMES |= {"growth": "curriculum"}
"""The tables of `Results` that are written to files, by the names of the files."""

HALF = "±: the longer side of the 95 % interval, over seeds."
HOLM = "*: p < 0.05, corrected for all pairs of the world (Holm)."

REASONS = (
    "Every world in which the best neural prior is not significantly better. Where the best chain is near 100 %, little"
    " is left to find. Where networks have no fewer bits than chains, they know no more of the plans' structure. Where"
    " they have fewer, fewer samples are needed; but the best of many samples asks for many different ones, which"
    " likelihood does not."
)
CURVES = (
    "Bands: 95 % intervals over seeds. Thin lines: the other Markov chains. Dotted: the planner that tries all short"
    " plans, at a cost of its own."
)
EFFICIENCY = "How many plans from a prior find as much as the most random ones. The numbers are in the tables below."
CURRICULUM = (
    "A prior learns from the best of all short plans, proposes longer ones, learns from the best of those, and so on."
    " Below the axis: the round, and the number of actions in its plans; each is compared with the best plans of as"
    " many actions. Temperatures are those that are best in the validation worlds. Bands: 95 % intervals over seeds;"
    " thin lines: the other Markov chains."
)
BITS = (
    "Bits per action of the held-out plans of the planner that tries all short ones: the fewer, the better a prior"
    " predicts them. Hollow: without context; filled, below: with the initial or the per-step context. The numbers are"
    " in the tables below."
)
DRAWN = (
    "Candidate plans of some priors from one start, after the last round of the curriculum. Square: the start; dots:"
    " where plans end; green: rewards; grey: walls."
)
TRANSITIONS = (
    "How often each action follows each in plans sampled from a prior after the last round of the curriculum: means"
    " over seeds."
)


def breakable(name: str) -> str:
    """A long name, which may be broken where its words end."""
    return name.replace("_", "_\N{ZERO WIDTH SPACE}")


def document(results: Results, settings: Mapping[str, Any], command: str) -> Document:
    """All that is printed and written of a comparison; the same results and settings give the same document.

    Args:
        results: the tables.
        settings: how the runs were made, by name.
        command: the command line that makes them again.

    Raises:
        ValueError: the runs do not belong together, or lack one of the numbers of plans.
    """
    style = figures.styles([*results.rows["prior"].dropna(), *results.curriculum["prior"]])
    after = "after minus before the curriculum"
    sections = [
        headlines(results),
        reasons(results),
        _figures("Normalised score against candidate plans", CURVES, scores(results, style, False), beside=True),
        _figures("Search efficiency", EFFICIENCY, efficiency(results, style)),
        _figures("What context adds", "", gains(results, style, "with minus without context")),
        _figures("What the horizon curriculum adds", "", gains(results, style, after)),
        _figures("Normalised score after the horizon curriculum", CURVES, scores(results, style, True), beside=True),
        _figures("The horizon curriculum, round by round", CURRICULUM, curriculum(results, style), beside=True),
        _figures("Bits per action of held-out plans", BITS, bits(results, style), beside=True),
        _figures("Plans drawn in the worlds", DRAWN, drawn_plans(results, style), beside=True),
        _figures("Transition matrices", TRANSITIONS, transitions(results), beside=True),
        about_worlds(results),
        Section(
            "Tables, world by world", tables=list(chain.from_iterable(tables_of(results, w) for w in results.worlds))
        ),
    ]
    named = ", ".join(results.worlds) if len(results.worlds) <= 3 else f"{len(results.worlds)} worlds"
    return Document(
        f"Priors compared in {named}",
        lead(results),
        [section for section in sections if section.tables or section.figures],
        {file: getattr(results, name) for file, name in FRAMES.items()},
        settings,
        command,
    )


def _figures(title: str, text: str, boxes: Iterable[FigureBox], beside: bool = False) -> Section:
    return Section(title, [text] if text else [], (), list(boxes), beside)


HOW_CHOSEN = (
    "The best prior of each kind is chosen on half of the seeds and compared on the other half, both ways, so that the"
    " choice does not favour it. Intervals and p-values hold whichever prior is the best of its kind: better is a prior"
    " that is better than every prior of the other kind (paired t-tests over seeds, corrected for the number of priors"
    " by Bonferroni and for the number of worlds by Holm). The number of plans is the median of those that were asked"
    " for."
)
"""How the best prior of each kind is compared with that of the other."""


def lead(results: Results) -> str:
    """In how many worlds the best neural prior is better than the best chain, without context and curriculum."""
    words = results.words
    best = words[(words["what"] == BEST) & (words["context"] == "none") & (words["rounds"] == 0)]
    seeds = f"Seeds: {len({run['seed'] for run in results.runs})}."
    if best.empty:
        others = "; the tables compare the priors in pairs" if len(words) else ""
        return f"Neural priors and Markov chains were not compared{others}. {seeds}"
    better, worse = (int((best["better"] == best[side]).sum()) for side in ("first", "second"))
    return (
        f"With {results.shown:,} candidate plans the best neural prior is significantly better than the best Markov"
        f" chain in {better} of {len(best)} worlds, and significantly worse in {worse} (no context, before the horizon"
        f" curriculum). {seeds}"
    )


def headlines(results: Results) -> Section:
    """The answer: neural priors against Markov chains in every world, and over all worlds."""
    words, tables, boxes = results.words, [], []
    best = words["what"] == BEST
    if len(words):
        pairs = " (" + words["first"] + " - " + words["second"] + ")"
        labels = words["world"].map(breakable) + pairs.where(~best, "")
        columns: dict[str, Column] = {
            "world": "label",
            "context": _context,
            "Markov" if best.all() else "second": lambda row: f"{100 * row['second_share']:.1f}",
            "neural" if best.all() else "first": lambda row: f"{100 * row['first_share']:.1f}",
            "difference": lambda row: _gap(row, isinstance(row["better"], str)),
            "p": "p_value:.2g",
            "Holm p": "p_holm:.2g",
        }
        what = "The best prior of each kind: normalised" if best.any() else "Normalised"
        caption = (
            f"{what} score, % of the optimum, with {results.shown:,} candidate plans,"
            f" and the difference in percentage points. after: after the horizon curriculum. {HALF} Holm p: corrected"
            " for the number of worlds; *: below 0.05."
        )
        tables.append(table(words.assign(label=labels), columns, caption, align="llrrrrr"))
    plain = results.paired.query("what == @BEST and context == 'none' and rounds == '0'")
    if len(plain):
        caption = f"Best neural minus best Markov prior, percentage points, by candidate plans. {HALF} {HOLM}"
        labels = plain["world"].map(breakable)
        tables.append(table_by(plain.assign(world=labels), {"world": "world"}, "num_plans", _gaps(plain), caption))
    for what in AGAINST:
        if len(differences := results.paired[results.paired["what"] == what]):
            caption = f"{what[0].upper() + what[1:]} prior, percentage points, by candidate plans. {HALF} {HOLM}"
            labels = differences["world"].map(breakable)
            of = differences.assign(world=labels, rounds=np.where(differences["rounds"] == "0", "before", "after"))
            names = {"world": "world", "context": "context", "curriculum": "rounds"}
            tables.append(table_by(of, names, "num_plans", _gaps(differences), caption))
    for setting, rows in by_setting(words[best]):
        how = f"{setting} the horizon curriculum"
        caption = f"Best neural minus best Markov prior with {results.shown:,} plans, {how}. Hollow: not significant."
        alt = "; ".join(f"{row['world']} {100 * row['difference']:+.1f}" for _, row in rows.iterrows())
        drawn = figures.gap_figure(rows, ("Markov better", "neural better"))
        boxes.append(FigureBox(drawn, f"{caption} Intervals: 95 %, over seeds.", alt))
    text = [HOW_CHOSEN] if best.any() or not len(words) else []
    if len(across := results.across):
        unit = f"the normalised score, % of the optimum, with {results.shown:,} candidate plans"
        tables += over_worlds(across, {"prior": "prior", "baseline": "baseline"}, ("score", "baseline's"), unit)
    if len(combined := results.combined):
        unit = "the normalised score, % of the optimum; most: the last context that each world offers"
        tables += over_worlds(combined, {"other": "prior", "candidates": "num_plans"}, ("combined", "other's"), unit)
    title = "Neural priors against Markov chains" if text else "Priors in pairs"
    return Section(title, text, tables, boxes)


def over_worlds(
    rows: pd.DataFrame, names: Mapping[str, Column], headings: tuple[str, str], unit: str
) -> Iterator[Table]:
    """An `across_table` for each context and curriculum."""
    for setting, setting_rows in by_setting(rows):
        yield across_table(setting_rows, names, *headings, unit, 100, f", {setting} the curriculum")


def by_setting(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """The rows of each context and curriculum, and in words, such as "no context, before", which they are."""
    for (context, after), setting_rows in grouped(rows.assign(after=rows["rounds"] > 0), ["context", "after"]):
        yield f"{context.replace('none', 'no')} context, {'after' if after else 'before'}", setting_rows


def reasons(results: Results) -> Section:
    """What may explain why networks are not better."""
    columns: dict[str, Column] = {
        "world": lambda row: breakable(row["world"]),
        "context": _context,
        "Markov": lambda row: f"{100 * row['markov_share']:.1f}",
        "neural bits": "neural_bits:.2f",
        "Markov bits": "markov_bits:.2f",
        "ahead early": lambda row: "" if pd.isna(row["early"]) else f"{100 * row['early']:+.1f}",
    }
    caption = (
        f"Markov: normalised score of the best chain with {results.shown:,} plans, % of the optimum. bits: the fewest"
        " per held-out action, before the curriculum. ahead early: by how many percentage points networks are"
        f" significantly better with {results.num_plans[0]:,} plans."
    )
    tables = [table(results.reasons, columns, caption, align="llrrrr")] if len(results.reasons) else []
    return Section("Where networks are not better", [REASONS], tables)


def scores(results: Results, style: Mapping[str, Style], after: bool) -> Iterator[FigureBox]:
    """Normalised scores against the number of plans, a figure a world; before or after the horizon curriculum."""
    about = {run["world"]: run["about"] for run in results.runs}
    for (world,), rows in grouped(results.curves[results.curves["context"] == "none"], ["world"]):
        curves = rows[((rows["rounds"] > 0) == after) | rows["prior"].isna() | (rows["prior"] == "uniform")]
        if curves["prior"].notna().any() and (curves["rounds"].any() or not after):
            drawn = figures.score_figure(curves, _strong_priors(curves[curves["num_plans"] == results.shown]), style)
            yield FigureBox(drawn, "" if after else f"{world}: {about[world]}.", f"normalised scores in {world}")


def efficiency(results: Results, style: Mapping[str, Style]) -> Iterator[FigureBox]:
    """How many plans are needed."""
    rows = results.efficiency.query("prior != 'uniform' and context == 'none' and rounds == 0")
    if len(rows):
        most = int(rows["most"].max())
        high = rows["needed_high"].mask(rows["needed_high"].isna() & rows["needed_low"].notna(), rows["most"])
        estimates = rows.assign(mean=rows["needed"].fillna(np.inf), low=rows["needed_low"], high=high)
        drawn = figures.dots_figure(estimates, style, "candidate plans needed", most)
        caption = f"Plans needed for what random search finds with {most:,}; arrow: more than that. Medians over seeds."
        yield FigureBox(drawn, caption, "plans needed by each prior, by world")


def gains(results: Results, style: Mapping[str, Style], what: str) -> Iterator[FigureBox]:
    """What priors gain by context, or by the horizon curriculum: a figure for each context and curriculum."""
    rows = results.paired[(results.paired["what"] == what) & (results.paired["num_plans"] == results.shown)]
    points = 100 * rows[["difference", "low", "high"]].rename(columns={"difference": "mean"})
    rows = rows[["world", "context"]].assign(prior=rows["first"], after=rows["rounds"] != "0").join(points)
    for (context, after), gap_rows in grouped(rows, ["context", "after"]):
        how = f"{what.capitalize()} (context: {context}{', after' * bool(after and context.endswith(' - none'))})"
        caption = f"{how}, with {results.shown:,} plans. Intervals: 95 %, over seeds."
        yield FigureBox(figures.dots_figure(gap_rows, style, POINTS), caption, how)


def curriculum(results: Results, style: Mapping[str, Style]) -> Iterator[FigureBox]:
    """Curves against rounds of the horizon curriculum, a figure a world and context."""
    for (world, _), curves in grouped(results.curriculum, ["world", "context"]):
        drawn = figures.curriculum_figure(
            curves, _strong_priors(curves[curves["round"] == curves["round"].max()]), style
        )
        caption = f"{curves['num_plans'].iloc[0]:,} candidate plans."
        yield FigureBox(drawn, caption, f"normalised scores in {world} after each round")


def bits(results: Results, style: Mapping[str, Style]) -> Iterator[FigureBox]:
    """Bits of held-out plans, a figure a world."""
    rows = results.bits[(results.bits["rounds"] == 0) & (results.bits["prior"] != "uniform")]
    for (world,), world_rows in grouped(rows, ["world"]):
        yield FigureBox(figures.bits_figure(world_rows, style), "", f"bits per action in {world}")


def drawn_plans(results: Results, style: Mapping[str, Style]) -> Iterator[FigureBox]:
    """Plans drawn in the worlds."""
    for run in results.runs:
        for prior in (run.get("plans") or {"paths": ()})["paths"]:
            drawn = figures.plans_figure(run["plans"], prior, style[prior][0], f"{run['world']}: {prior}")
            yield FigureBox(drawn, "", f"plans of {prior} in {run['world']}")


def transitions(results: Results) -> Iterator[FigureBox]:
    """Transition matrices of plans sampled from the priors: of the best chain, and of all priors that are no chains."""
    rows = results.rows[(results.rows["context"] == "none") & (results.rows["num_plans"] == results.shown)]
    for world in results.worlds:
        runs = [run for run in results.runs if run["world"] == world and run.get("transitions")]
        strong = _strong_priors(rows[(rows["world"] == world) & (rows["prior"] != "uniform")])
        for prior in (prior for prior in (runs[0]["transitions"] if runs else ()) if prior in strong):
            matrices = np.array([run["transitions"][prior] for run in runs if prior in run["transitions"]])
            # An action that never came has a row of zeros in its seed.
            seeds = (matrices.sum(2, keepdims=True) > 0).sum(0)
            mean = np.divide(matrices.sum(0), seeds, out=np.full(matrices.shape[1:], np.nan), where=seeds > 0)
            names = runs[0]["action_names"] or [str(action) for action in range(len(mean))]
            drawn = transition_figure(mean, names, f"{world}: {prior}", small=True)
            yield FigureBox(drawn, "", f"transition matrix of {prior} in {world}")


def about_worlds(results: Results) -> Section:
    """What the worlds are."""
    names = ["world", "length", "num_starts"]
    runs = pd.DataFrame([{name: run[name] for name in names} for run in results.runs])
    frame = runs.groupby(names, sort=False).size().reset_index(name="seeds")
    columns = {"world": "world", "actions": "length", "starts": "num_starts:,", "seeds": "seeds"}
    text = [
        "Plans are learned from in training worlds and searched for in held-out ones. The normalised score is that of a"
        " planner as a share of the optimum from the same starts; 0 is a plan of random moves where rewards can be"
        " negative, else a score of 0."
    ]
    return Section("The worlds", text, [table(frame, columns, "actions: in a plan; starts: of each seed.")])


def tables_of(results: Results, world: str) -> Iterator[Table]:
    """Of a world: normalised scores and their differences, plans needed, bits, optimal starts and times."""
    rows, needed, bits = (
        _label_rows(frame[frame["world"] == world]) for frame in (results.rows, results.efficiency, results.bits)
    )
    caption = f"{world}: normalised score, % of the optimum, by candidate plans. {HALF}"
    for _, row in rows[rows["num_plans"].isna()].iterrows():
        score = plus_minus(row, "oracle_share", 100)
        caption += f" {row['planner'].capitalize()}, {row['model_steps']:,} model steps: {score}."
    rows = rows[rows["num_plans"].notna()]
    scores = [plus_minus(row, "oracle_share", 100) for _, row in rows.iterrows()]
    yield table_by(rows, {"prior": "label"}, "num_plans", scores, caption, world)
    if len(paired := results.paired[results.paired["world"] == world]):
        caption = f"{world}: differences between priors, percentage points, by candidate plans, paired. {HALF} {HOLM}"
        pairs = paired.assign(label=paired.apply(_pair, axis=1))
        yield table_by(pairs, {"first - second": "label"}, "num_plans", _gaps(pairs), caption, world)
    if (needed["prior"] != "uniform").any():
        most = f"{needed['most'].iloc[0]:,}"
        columns: dict[str, Column] = {
            "prior": "label",
            "plans needed": lambda row: _median(row, "needed", f"> {most}"),
            "times fewer": lambda row: _median(row, "factor", "< 1"),
            "reached": lambda row: f"{row['reached']} of {row['seeds']}",
        }
        caption = (
            f"{world}: plans needed for what {most} random ones find; medians over seeds with 95 % intervals (sign"
            " test). times fewer: than random search needs, which is less where it gains nothing by more. reached:"
            f" seeds in which the prior did with {most} plans."
        )
        yield table(needed, columns, caption, world)
    if len(bits := bits[bits["rounds"] == 0]):
        columns = {
            "prior": "label",
            "bits per action": lambda row: plus_minus(row, "bits_per_action", digits=3),
        }
        caption = f"{world}: bits per held-out action"
        if bits["more"].notna().any():
            columns["more"] = lambda row: plus_minus(row, "more", digits=3, sign="+", ends="more_")
            caption += "; more: than the best Markov chain of equal context, paired"
        yield table(bits, columns, f"{caption}.", world)
    caption = f"{world}: optimal in % of the starts, by candidate plans; ms: a decision with {results.shown:,} plans."
    shares = [f"{100 * one:.1f}" for one in rows["at_oracle"]]
    yield table_by(rows, {"prior": "label"}, "num_plans", shares, caption, world, timed=results.shown)


def _gap(row: Any, significant: bool) -> str:
    """A difference in percentage points, with a star where it is significant."""
    return plus_minus(row, "difference", 100, sign="+") + ("*" if significant else " " if row["seeds"] > 1 else "")


def _gaps(rows: pd.DataFrame) -> list[str]:
    return [_gap(row, row["p_holm"] < 0.05) for _, row in rows.iterrows()]


def _label_rows(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows with the names of their priors in tables."""
    context = (", " + rows["context"] + " context").replace(", none context", "")
    return rows.assign(label=rows["prior"] + context + np.where(rows["rounds"] > 0, ", after curriculum", ""))


def _context(row: Any) -> str:
    return f"{row['context']}{', after' if row['rounds'] else ''}"


def _pair(row: Any) -> str:
    # Which priors are the best may differ with the number of plans.
    pair = (
        str(row["what"]).replace("minus", "-")
        if row["what"] in (BEST, *AGAINST)
        else f"{row['first']} - {row['second']}"
    )
    pair = str(row["first"]) if row["first"] == row["second"] else pair
    context = "" if row["context"] == "none" else f", context {row['context']}"
    after = f", rounds {row['rounds']}" if "-" in row["rounds"] else ", after curriculum"
    return f"{pair}{context}{'' if row['rounds'] == '0' else after}"


def _median(row: Any, name: str, beyond: str) -> str:
    """A median with its interval; `beyond` stands for what is missing."""
    median, *ends = [
        beyond if pd.isna(value) else f"{value:,.0f}" if value >= 10 else f"{value:.2g}"
        for value in (row[name], row[f"{name}_low"], row[f"{name}_high"])
    ]
    # With fewer than 6 seeds there is no interval; else one of its ends is known where the median is.
    return f"{median} ({ends[0]} to {ends[1]})" if median != beyond and ends != [beyond] * 2 else median


def _strong_priors(rows: pd.DataFrame) -> list[str]:
    """The priors of rows to be drawn with a band: all but the chains that are not the best."""
    ends = rows[rows["prior"].notna()].drop_duplicates("prior", keep="last").set_index("prior")["oracle_share"]
    chains = ends[[kind_of(prior) == "markov" for prior in ends.index]]
    return [prior for prior in ends.index if prior not in chains.index or prior == chains.idxmax()]
