"""The sections of a report on plans: each makes its tables, as pandas frames and as text, and its figures."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any

import pandas as pd
import torch
from torch import Tensor

from neuroprior._statistics import ENOUGH_UNITS, LEVEL, interval_words, p_words
from neuroprior.behaviour.analysis.comparison import ACTIONS, never_occur, never_taken, too_few, unit_name, units
from neuroprior.behaviour.analysis.drift import by_group, by_plan, by_position
from neuroprior.behaviour.analysis.lags import how_far_back
from neuroprior.behaviour.analysis.motifs import motifs
from neuroprior.behaviour.analysis.rate_drift import rate_drift
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, group_names
from neuroprior.behaviour.reporting import figures
from neuroprior.behaviour.reporting.conditions import condition_section
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.durations import duration_section
from neuroprior.behaviour.reporting.findings import Finding, gain_finding
from neuroprior.behaviour.reporting.individuals import individual_section
from neuroprior.behaviour.reporting.modes import mode_section
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.behaviour.reporting.part import LISTED, Part, p_text, without_verdict
from neuroprior.behaviour.reporting.recordings import recording_section
from neuroprior.behaviour.reporting.scores import Evaluation
from neuroprior.behaviour.reporting.transitions import transition_section
from neuroprior.plans import Plans, constant_context, has_patterns
from neuroprior.plans.columns import listed

LISTED_LAGS = (1, 2, 3, 4, 6, 8, 12, 16, 20)
BEGINNING = 5  # actions of a plan that do not count in drift


def file_section(evaluation: Evaluation) -> Part:
    """What was read: how many plans of which kind, the commonest of their actions, and the plans over time."""
    plans, frame = evaluation.plans, behaviour_frame(evaluation.plans)
    columns = {"sequences": "sequences:,", "behaviours": "behaviours:,", "shortest": "shortest", "longest": "longest"}
    columns |= {"kinds": "kinds", "subjects": "subjects", "context": "context"}
    columns |= {"conditions": "conditions"} if plans.condition is not None else {}
    notes = "".join(f"{note[:1].upper()}{note[1:]}. " for note in plans.notes).strip()
    align = "rrrrrrl" + "r" * (len(columns) - 7)
    described = table(pd.DataFrame([describe(plans)]), columns, notes, "The study", align)
    counted: dict[str, Column] = {
        "behaviour": "behaviour",
        "count": "count:,",
        "%": lambda row: f"{100 * row.share:.1f}",
        "sequences": "sequences:,",
    }
    if plans.durations is not None:
        counted |= {"median duration": "median_duration:.3g"}
    caption = f"The {LISTED} commonest of {len(frame)}." if len(frame) > LISTED else ""
    never = never_occur(plans.actions[plans.mask()].unique().cpu().numpy(), plans.num_actions, plans.action_names)
    caption = f"{caption} {never[:1].upper()}{never[1:]}.".strip() if never else caption
    tables, boxes = [described, table(frame[:LISTED], counted, caption, "Behaviours")], []
    if len(frame):
        caption = "Each row a sequence, each colour a behaviour" + (", by subject" if plans.group is not None else "")
        caption += (" and condition" if plans.condition is not None else "") + "."
        alt = "The sequences as rows of coloured strips over time."
        boxes = [FigureBox(figures.ethogram_figure(plans), caption, alt, "ethogram")]
    return Part(Section("The study", tables=tables, figures=boxes), {"behaviours": frame})


def behaviour_frame(plans: RecordedPlans) -> pd.DataFrame:
    """How often each behaviour occurs, in how many sequences, and its median duration; the commonest first."""
    mask = plans.mask()
    plan = mask.nonzero()[:, 0]
    data = {"behaviour": plans.actions[mask].tolist(), "sequence": plan.tolist()}
    data["duration"] = [None] * len(plan) if plans.durations is None else plans.durations[mask].tolist()
    groups = pd.DataFrame(data).astype({"duration": "float64"}).groupby("behaviour")
    frame = groups.agg(
        count=("sequence", "size"), sequences=("sequence", "nunique"), median_duration=("duration", "median")
    )
    names = action_names(plans)
    frame.insert(0, "behaviour", [names[action] for action in frame.index])
    frame.insert(2, "share", frame["count"] / max(len(plan), 1))
    frame = frame.sort_values("count", ascending=False, kind="stable").reset_index(drop=True)
    return frame if plans.durations is not None else frame.drop(columns="median_duration")


def describe(plans: RecordedPlans) -> dict[str, Any]:
    """How many plans there are, of which lengths, with which context."""
    lengths = plans.mask().sum(1)
    context = "none"
    if plans.context is not None:
        kind = "features" if plans.context.is_floating_point() else f"{_num_contexts(plans)} contexts"
        kind = "patterns" if has_patterns(plans.context) else kind
        context = f"{kind}, {'at each step' if constant_context(plans) is None else 'once a sequence'}"
    return {
        "sequences": len(plans),
        "behaviours": int(lengths.sum()),
        "shortest": int(lengths.min()),
        "longest": int(lengths.max()),
        "kinds": plans.num_actions,
        "subjects": 0 if plans.group is None else len(plans.group.unique()),
        "context": context,
        "conditions": 0 if plans.condition is None else len(plans.condition.unique()),
        "durations": plans.durations is not None,
        "notes": list(plans.notes),
    }


def score_section(evaluation: Evaluation) -> Part | None:
    """The main table; None where no model was scored yet."""
    if evaluation.reference is None:
        return None
    scores = evaluation.table()
    more = scores["more_high"] - scores["more"]
    learned, saved = evaluation.settings.get("training data", {}), "priors" in evaluation.settings
    columns: Mapping[str, Column] = {
        "model": lambda row: f"{row.model} (training data)" if row.model in learned else str(row.model),
        **({"input": _input} if scores["input"].nunique() > 1 else {}),
        "nats": "nats_per_behaviour:.4f",
        "bits per\nbehaviour": lambda row: f"{row.bits_per_behaviour:.4f}±{row.high - row.bits_per_behaviour:.4f}",
        "perpl.": "perplexity:.3f",
        "more bits": lambda row: "" if pd.isna(row.more) else f"{row.more:+.4f}±{more[row.name]:.4f}",
    }
    caption = (
        f"{'' if saved else 'On held-out behaviours. '}±: 95 % intervals over {evaluation.unit}. more bits: the"
        f" difference from {evaluation.reference[1]}, paired."
    )
    never = never_taken(evaluation.plans) if any(model.name == "uniform" for model in evaluation.models) else ""
    caption += f" {never[:1].upper()}{never[1:]}." if never else ""
    if learned:
        same = "; ".join(
            f"{number:,} of {len(evaluation.scored):,} sequences for {name}" for name, number in learned.items()
        )
        caption += f" Training data: sequences that the prior has learned from, at least in part ({same})."
    held_out = "" if saved else " for behaviours that it has not learned from"
    text = [
        f"The bits of each model{held_out}: the fewer, the more of the structure it predicts; a nat is 1.44 bits."
        " Perplexity (perpl.) is the number of equally likely behaviours that would take as many bits.",
        "Order, back-off and smoothing of count-based models were chosen within the training sequences. The reference"
        " is the model with the fewest bits on the same sequences, which favours it a little; differences are not"
        " corrected for the number of models.",
    ]
    text = text[:1] if saved else text
    text += _untrained(evaluation)
    text.append(without_verdict(evaluation.too_few) or "A difference whose interval holds 0 is not significant.")
    caption_of_figure = f"Bits per {'' if saved else 'held-out '}behaviour, 95 % intervals over {evaluation.unit}."
    best = evaluation.best
    alt = f"Bits per behaviour of each model, the fewest {best.cost:.3f} of {best.label}."
    box = FigureBox(figures.score_figure(scores), caption_of_figure, alt, "scores")
    title = "Scores" if saved else "Held-out scores"
    shown = table(scores, columns, caption, align="l" * (len(columns) - 4) + "rrrr")
    return Part(Section(title, text, [shown], [box]), {"scores": scores})


def _untrained(evaluation: Evaluation) -> list[str]:
    """Sentences on the networks that promised too little to be trained."""
    if not evaluation.promises:
        return []
    names = listed([f"{name.replace(',', '')} ({max(bits, 0):.4f})" for name, bits in evaluation.promises.items()])
    return [
        "Networks are trained where a tenth of their training, in the first fold, promises enough to be kept. Not"
        f" trained, with the bits per behaviour that they promised at most: {names}. After the first that promises too"
        " little no other is tried; `--effort full` trains all."
    ]


def lag_section(evaluation: Evaluation) -> Part | None:
    """How far back structure reaches."""
    try:
        result = how_far_back(evaluation.plans, skip=evaluation.settings["skip"])
    except ValueError:  # fewer than two plans with successive actions
        result = None
    if result is None and not len(evaluation.gains):
        return None
    frames, tables, boxes = {"how_far_back": pd.DataFrame(), "lags": evaluation.gains}, list[Table](), list[FigureBox]()
    text = [
        "Gain: how much the behaviour k steps back improves predictions beyond all nearer ones. A Markov chain that"
        " knows k behaviours is compared with one that knows k - 1, on behaviours of those whose others it learned"
        " from."
    ]
    findings, verdicts = list[Finding](), list[str]()
    if result is not None:
        frame = frames["how_far_back"] = result.frame()
        for row in frame.to_dict("records"):
            findings.append(gain_finding("lags", f"lag {row['lag']}", f"The behaviour {row['lag']} back", row))
        reach = 0 if result.few else result.reach
        if reach:  # the last lag that adds is said with the verdict, before the others
            last = findings.pop(reach - 1)
            findings.insert(0, replace(last, sentence=f"{result.verdict} {last.sentence}"))
        verdicts = [] if result.few or reach else [result.verdict]
        text += [without_verdict(result.few) or result.verdict]
        columns: dict[str, Column] = {
            "lag": "lag",
            "bits": "bits:.4f",
            "95 % interval": lambda row: interval_words(row.low, row.high, ".4f"),
            "p": lambda row: p_text(row.p_corrected) + "*" * row.significant,
        }
        caption = f"Bits that the behaviour k steps back adds, over {result.unit}."
        caption += "" if result.few else " p: corrected for the lags. *: p < 0.05."
        tables.append(table(frame, _drop_p(columns, result.few), caption, "How far back"))
    if len(evaluation.gains):
        lags = evaluation.gains.assign(
            curve=figures.lag_names(evaluation.gains), cell=evaluation.gains["bits"].map("{:.4f}".format)
        )
        wide = lags.pivot(index="lag", columns="curve", values="cell")[lags["curve"].unique()]
        wide = wide[wide.index.isin(LISTED_LAGS)].reset_index()
        names = {name.replace(", ", "\n").replace("with context", "+ context"): name for name in wide.columns}
        text.append(
            "Longer lags, in held-out sequences of the first fold alone: of chains, and of a GRU that was trained on"
            " pieces of sequences. Where the gain of the chain ends before that of the GRU, longer histories matter"
            " but occur too seldom to be counted; below 0, splitting the counts loses more than the older behaviour"
            " adds."
        )
        tables.append(table(wide, names, "Bits. Not tested: one fold is too little.", "Gain by lag"))
        over = f"intervals over {unit_name(evaluation.first_fold)} of one fold"
        caption = f"Bits that the behaviour k steps back adds; {over}."
        boxes = [FigureBox(figures.lag_figure(evaluation.gains), caption, "Gain by lag.", "lags")]
    return Part(Section("How far back", text, tables, boxes), frames, verdicts, findings)


def motif_section(evaluation: Evaluation) -> Part | None:
    """Over-represented sequences."""
    plans, names = evaluation.plans, action_names(evaluation.plans)
    frame = pd.DataFrame(
        {"sequence": " ".join(names[action] for action in one.actions)}
        | {key: value for key, value in asdict(one).items() if key != "actions"}
        for one in motifs(plans, top=LISTED)
        if one.corrected < LEVEL
    ).rename(columns={"corrected": "p_corrected"})
    columns: Mapping[str, Column] = {
        "sequence": "sequence",
        "count": "count:,",
        "expected": "expected:,.1f",
        "ratio": "ratio:.2f",
        "95 % interval": lambda row: interval_words(row.low, row.high, ".2f"),
        "p": lambda row: p_text(row.p_corrected),
    }
    few = too_few(plans)
    text = [
        "Sequences of three to six behaviours that occur more (or less) often than their parts predict: than under a"
        " chain fitted to how often the sequence without its first, and without its last behaviour occurs. All"
        " sequences are taken to be of one chain: where subjects differ, sequences of some of them are"
        " over-represented, too. One such sequence makes others over-represented that share its beginning.",
        *([] if len(frame) else ["There are none (p < 0.05, corrected for all sequences)."]),
        *([without_verdict(few)] if few else []),
    ]
    tables, boxes = [], []
    if len(frame):
        p = "Listed by" if few else "p:"
        caption = f"Against a chain of order n - 2. {p} Fisher's exact test, corrected for all (Holm)."
        tables = [table(frame, _drop_p(columns, few), caption)]
        alt = "Over-represented sequences: " + "; ".join(frame["sequence"][:5])
        boxes = [FigureBox(figures.motif_figure(frame), "Times as often as expected.", alt, "motifs")]
    return Part(Section("Over-represented sequences", text, tables, boxes, folded=True), {"motifs": frame})


def drift_section(evaluation: Evaluation) -> Part | None:
    """Whether plans get easier or harder to predict, within and between them."""
    # The best model whose bits are those of the plans' own actions; of one that predicts ends, too, there are more.
    ranked = sorted(evaluation.models, key=lambda model: model.cost)
    model = next((one for one in ranked if one.bits.shape == evaluation.scored.actions.shape), None)
    if model is None or int(evaluation.mask.sum(1).max()) < 2:
        return None
    mask = _late_actions(evaluation)
    scored = evaluation.scored, model.bits, mask
    within, plans, groups = by_position(*scored), by_plan(*scored), by_group(*scored)
    numbers = list(groups.groups)
    names = dict(zip(numbers, group_names(evaluation.scored, torch.tensor(numbers)), strict=True))
    rows = [("place", f"part {n} of {len(within.parts)}", *one) for n, one in enumerate(within.parts, 1)]
    rows += [("subject", names[number], *one) for number, one in groups.groups.items()]
    drift = pd.DataFrame(rows, columns=["what", "name", "bits", "low", "high"])
    by_sequence = pd.DataFrame({"group": plans.group.tolist(), "bits": plans.bits.tolist()})
    by_sequence = by_sequence.assign(index=by_sequence.groupby("group").cumcount() + 1)
    tests: list[dict[str, Any]] = [{"test": "change over a sequence, bits"} | within.trend._asdict()]
    if plans.trend is not None:
        tests.append({"test": f"rank correlation from {plans.item[:-1]} to {plans.item[:-1]}"} | plans.trend._asdict())
    if groups.p_value is not None:
        tests.append({"test": "subjects are alike (Kruskal and Wallis)", "p_value": groups.p_value})
    tests_frame = pd.DataFrame(tests, columns=["test", "mean", "low", "high", "p_value"])
    text = [
        "Bits per held-out behaviour of the best model: where behaviour changes, sequences get harder (or easier) to"
        " predict.",
        (
            f"The first {BEGINNING} behaviours of each sequence do not count here: little stands before them."
            if mask is not evaluation.mask
            else "Sequences are too short to leave out their first behaviours. Little stands before these, so that they"
            " cost more, which alone is a change over a sequence."
        ),
        *(["The only sequence was cut into parts, which stand for sequences."] * bool(evaluation.settings.get("cut"))),
        *([without_verdict(evaluation.too_few)] if evaluation.too_few else []),
    ]
    columns: Mapping[str, Column] = {
        "test": "test",
        "estimate": "mean:+.3f",
        "95 % interval": lambda row: interval_words(row.low, row.high, "+.3f"),
        "p": "p_value:.2g",
    }
    caption = f"Bits of {model.label}; intervals over {evaluation.unit}."
    tables = [table(tests_frame, _drop_p(columns, evaluation.too_few), caption)]
    caption = (
        f"Bits per behaviour of {model.label}. Intervals (95 %) over {evaluation.unit}; of subjects, over sequences."
    )
    alt = "Bits per behaviour by place, sequence and subject."
    box = FigureBox(figures.drift_figure(drift, by_sequence), caption, alt, "drift")
    frames = {"drift": drift, "drift_tests": tests_frame, "rate_drift": pd.DataFrame()}
    with suppress(ValueError):  # a single recording
        rates = _rates(evaluation)
        frames["rate_drift"] = rates
        tables.append(_rate_table(rates, evaluation))
        return Part(Section("Drift", text, tables, [box]), frames, findings=_rate_findings(rates))
    return Part(Section("Drift", text, tables, [box]), frames)


def _late_actions(evaluation: Evaluation) -> Tensor:
    """The held-out actions that have a history, bool `[N, L]`; all of them where these are less than half."""
    late = evaluation.mask.clone()
    late[:, :BEGINNING] = False
    enough = 2 * int(late.sum()) >= int(evaluation.mask.sum())
    return late if enough and len(units(evaluation.scored, late)[late].unique()) > 1 else evaluation.mask


def _rates(evaluation: Evaluation) -> pd.DataFrame:
    """How the rate of each behaviour changes, starred where it does; by watched time, too, where that is known."""
    timed = evaluation.recordings is not None and evaluation.recordings.events["start"].notna().any()
    source = evaluation.recordings if timed and evaluation.recordings is not None else evaluation.plans
    result = rate_drift(source)
    frame = result.frame()
    starred = (frame["p_corrected"] < LEVEL) & (result.num_units >= ENOUGH_UNITS) & (not too_few(evaluation.plans))
    if timed:
        columns = {"times": "by_time", "low": "by_time_low", "high": "by_time_high"}
        by_time = rate_drift(source, "time").frame().rename(columns=columns)
        frame = frame.merge(by_time[["behaviour", *columns.values()]], on="behaviour", how="left")
    return frame.assign(unit=result.unit, significant=starred)


def _rate_table(rates: pd.DataFrame, evaluation: Evaluation) -> Table:
    columns: dict[str, Column] = {
        "behaviour": "behaviour",
        "bouts": "bouts:,",
        "end / beginning": "times:.3g",
        "95 % interval": lambda row: interval_words(row.low, row.high, ".3g"),
        "p": lambda row: p_text(row.p_corrected) + "*" * row.significant,
    }
    caption = (
        f"Share of all bouts at the end of a recording, divided by that at its beginning; intervals over"
        f" {rates['unit'].iloc[0]}."
    )
    caption += "" if evaluation.too_few else " p: corrected (Holm). *: p < 0.05."
    if "by_time" in rates:
        caption += " By watched time: the same of the number of bouts by time."
        columns["by watched time"] = lambda row: (
            "" if pd.isna(row.by_time) else f"{row.by_time:.3g} ({row.by_time_low:.3g} to {row.by_time_high:.3g})"
        )
    return table(rates[:LISTED], _drop_p(columns, evaluation.too_few), caption, "Change of each behaviour")


def _rate_findings(rates: pd.DataFrame) -> list[Finding]:
    findings = []
    for row in rates.to_dict("records"):
        name, times, low, high, corrected = (row[what] for what in ("behaviour", "times", "low", "high", "p_corrected"))
        sentence = (
            f"From the beginning to the end of a recording the share of {name} {'falls' if times < 1 else 'rises'} to"
            f" {times:.3g} times, 95 % interval {low:.3g} to {high:.3g}; {p_words(corrected)}."
        )
        estimate = (times, low, high, float(row["p_value"]), float(corrected))
        feature, starred = f"drift of {name}", bool(row["significant"])
        findings.append(Finding(f"drift: {name}", "drift", feature, *estimate, starred, sentence))
    return findings


SECTIONS: dict[str, Callable[[Evaluation], Part | None]] = {
    "file": file_section,
    "recordings": recording_section,
    "conditions": condition_section,
    "transitions": transition_section,
    "durations": duration_section,
    "lags": lag_section,
    "scores": score_section,
    "individuals": individual_section,
    "drift": drift_section,
    "modes": mode_section,
    "motifs": motif_section,
}
"""By name, in the order of the page."""


OF_MODELS = ("scores", "lags", "drift")
"""Sections that say more with each model; durations do where models take these as an input."""


def _drop_p(columns: Mapping[str, Column], few: str) -> Mapping[str, Column]:
    """The columns of a table, without p-values where there are too few independent units."""
    return {name: column for name, column in columns.items() if name != "p" or not few}


def _num_contexts(plans: Plans) -> int | None:
    """The number of context indices; None without."""
    if plans.context is None or plans.context.is_floating_point() or not plans.context.numel():
        return None
    return int(plans.context.max()) + 1


def _input(row: Any) -> str:
    """The input of a model, short enough for a terminal."""
    return str(row["input"]).replace(f"{ACTIONS} and ", "+ ")
