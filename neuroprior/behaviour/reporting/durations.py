"""The section on durations: how long actions take, by which law, and whether that predicts the next action."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from neuroprior._statistics import LEVEL, holm, ratio_difference
from neuroprior.behaviour.analysis.comparison import ACTIONS, DURATIONS, Score, score_bits, too_few, unit_name
from neuroprior.behaviour.analysis.lags import MAX_FOLDS, actions_in_a_row, bits_after, bits_held_out, bits_of_shares
from neuroprior.behaviour.durations.duration_model import DurationModel
from neuroprior.behaviour.durations.laws import resolution
from neuroprior.behaviour.durations.survival import duration_survival
from neuroprior.behaviour.recorded_plans import RecordedPlans, action_names, durations_of
from neuroprior.behaviour.reporting import figures
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.findings import gain_finding
from neuroprior.behaviour.reporting.page import FigureBox, Section
from neuroprior.behaviour.reporting.part import LISTED, Part, p_text, without_verdict
from neuroprior.behaviour.reporting.scores import Evaluation
from neuroprior.behaviour.reporting.survival import survival_figure, survival_findings, survival_table
from neuroprior.plans import BLOCKS, FEWEST_UNITS, divisible, folds, in_parts
from neuroprior.plans.folds import FOLDS, num_units

CLASSES = 3
"""Classes of the last duration: short, medium and long for its action."""

MOST_ACTIONS = 500
"""Kinds of actions up to which the next one is counted after each with each class of duration."""

MOST_BINS = 30

LEAST = 5e-4
"""Bits; gains below this are 0 in three digits, and not starred."""


def duration_section(evaluation: Evaluation) -> Part | None:
    """How long actions take, and whether that predicts the next action; None where no plan has durations."""
    plans = evaluation.plans
    if plans.durations is None or not bool((plans.durations[plans.mask()] > 0).any()):
        return None
    if len(plans) == 1:
        plans = in_parts(plans, min(BLOCKS, int(plans.mask().sum())))
    timed = plans.mask() & ~durations_of(plans).isnan()
    model = DurationModel(plans.num_actions).fit(evaluation.plans)
    gains = _held_out_gains(plans, timed)
    frame = _action_rows(plans, timed, model, gains)
    laws = _laws(plans, timed, model, gains)
    dwell = dwell_times(plans, model)
    following = _next_rows(evaluation, plans, timed)
    over = unit_name(plans, timed)
    bounds = f"±: 95 % intervals over {over}."
    of_all = f" The {LISTED} commonest of {len(frame)}." if len(frame) > LISTED else ""
    columns: dict[str, Column] = {
        "behaviour": "behaviour",
        "known": "known:,",
        "unkn.": "unknown:,",
        "25 %": "quartile_1:.3g",
        "median": "median:.3g",
        "75 %": "quartile_3:.3g",
        "mean": "mean:.3g",
        "law": "law",
        "gain": _gain,
    }
    caption = (
        "Dwell times in the unit of the file. law: of durations above 0, chosen by held-out likelihood (of all: too few"
        " for a law of its own). gain: of this"
        f" over an exponential law, nats per held-out duration. {bounds}{of_all}"
    )
    tables = [table(frame[:LISTED], columns, caption, "Durations", "lrrrrrrlr")]
    shown: dict[str, Column] = {"laws": "what", "nats per duration": _gain}
    caption = "Over exponential laws of each behaviour, and over laws of the line above: durations may depend on the"
    caption += f" next behaviour, too, where that predicts them better. {bounds}"
    tables.append(table(laws, shown, caption, "Laws of durations", "lr"))
    too_few_units = too_few(evaluation.plans)
    if len(following):
        shown = {"model": "model", "without": "without:.4f", "with": "with:.4f", "gain": _gain}
        caption = f"Bits per held-out behaviour without and with the last duration known. {bounds}"
        if not too_few_units:
            shown["p"] = lambda row: p_text(row.p_corrected) + "*" * row.significant
            caption += " p: of a gain, corrected for the models (Holm). *: p < 0.05."
        tables.append(table(following, shown, caption, "Whether durations predict the next behaviour"))
    text = [
        "Exponential laws are those of a process without memory, in which a long stay says nothing of when it ends."
        " Where another law predicts durations better, behaviours have typical lengths, or bursts and pauses.",
        "Whether durations predict the next behaviour: a chain of order 1 with back-off, and the same with how long the"
        f" last behaviour took, in {CLASSES} classes by its own terciles in the training sequences. Where the gain is"
        " above 0, durations carry information that a model of behaviours alone does not have.",
        *([without_verdict(too_few_units)] if too_few_units else []),
    ]
    caption = "Density of the logarithm of durations above 0 (bars), and of the law that was fitted (line)."
    boxes = [FigureBox(figures.dwell_figure(dwell), caption, "Dwell times of the behaviours with their laws.", "dwell")]
    survival = duration_survival(evaluation.plans, generator=torch.Generator().manual_seed(0))
    frames = {"durations": frame, "duration_laws": laws, "next_by_duration": following, "dwell": dwell}
    frames |= {"survival": survival.frame(), "survival_tests": survival.medians()}
    tables.append(survival_table(survival, too_few_units))
    caption = "The share of bouts that last longer; bouts that were cut off count as long as they were seen."
    caption += f" Bands: 95 % intervals over {over}."
    boxes.append(FigureBox(survival_figure(frames["survival"]), caption, "Survival of bouts.", "survival"))
    unit = evaluation.recordings.unit if evaluation.recordings is not None else ""
    findings = survival_findings(survival, too_few_units, unit)
    for row in following.rename(columns={"gain": "bits"}).to_dict("records"):
        family, what = "next behaviour by duration", f"How long the last behaviour took ({row['model']})"
        findings.append(gain_finding(family, f"{family}, {row['model']}", what, row))
    return Part(Section("Durations", text, tables, boxes), frames, findings=findings)


def _parts(plans: RecordedPlans, timed: Tensor) -> Iterator[tuple[RecordedPlans, Tensor]]:
    """The training plans, and the numbers of the held-out ones, of each fold whose training plans have durations."""
    plans = divisible(plans)
    number = num_units(plans)
    for training, held_out in folds(plans, min(FOLDS, number)) if number >= FEWEST_UNITS else []:
        if bool(((durations_of(plans) > 0) & timed)[training].any()):
            yield plans[training], held_out


def _held_out_gains(plans: RecordedPlans, timed: Tensor) -> dict[str, Tensor]:
    """`[N, L]`, nats: what the law of each action gains over an exponential one, and laws of transitions over that.

    NaN where there is no held-out duration above 0.
    """
    all_gains = {what: torch.full(timed.shape, torch.nan, dtype=torch.double) for what in ("law", "transition")}
    above = timed & (durations_of(plans) > 0)
    for training, held_out in _parts(plans, timed):
        test_plans, timed_steps = plans[held_out], above[held_out]
        # Each action as a plan of its own has no next action: its law is that of the action.
        times = durations_of(test_plans)[timed_steps][:, None]
        alone = RecordedPlans(test_plans.actions[timed_steps][:, None], plans.num_actions, durations=times)
        model = DurationModel(plans.num_actions).fit(training)
        plain = DurationModel(plans.num_actions, ["exponential"], transitions=False).fit(training)
        log_probs = model.log_prob(alone)[:, 0]
        gains = {
            "law": log_probs - plain.log_prob(alone)[:, 0],
            "transition": model.log_prob(test_plans)[timed_steps] - log_probs,
        }
        for what, gain in gains.items():
            all_gains[what][held_out] = all_gains[what][held_out].masked_scatter(timed_steps, gain)
    return all_gains


def _mean_over_units(values: Tensor, plans: RecordedPlans, mask: Tensor) -> dict[str, float]:
    """The mean of `values [N, L]` where they are finite and in `mask`, with its interval over independent units."""
    mask = mask & values.isfinite()
    nothing = {"gain": np.nan, "low": np.nan, "high": np.nan, "p_value": np.nan, "units": 0}
    if int(mask.sum()) < FEWEST_UNITS:
        return nothing
    score = score_bits("", "", values.nan_to_num(0, 0, 0), plans, mask)
    gain, low, high, p_value = ratio_difference(score.bits, score.actions)
    return {"gain": gain, "low": low, "high": high, "p_value": p_value, "units": len(score.bits)}


def _action_rows(plans: RecordedPlans, timed: Tensor, model: DurationModel, gains: dict[str, Tensor]) -> pd.DataFrame:
    """A row an action, the commonest first: its durations, their law, and what this gains over an exponential one."""
    names, taken = action_names(plans), plans.mask()
    laws = model.table()
    times = pd.DataFrame({"behaviour": plans.actions[timed].tolist(), "time": durations_of(plans)[timed].tolist()})
    groups = times.groupby("behaviour")["time"]
    summary = groups.describe(percentiles=[0.25, 0.5, 0.75]).reindex(range(plans.num_actions))
    number = plans.actions[taken].long().bincount(minlength=plans.num_actions)
    rows = []
    for action in number.argsort(descending=True, stable=True).tolist():
        if not number[action]:
            continue
        stats, law = summary.loc[action], laws[action]
        count = 0 if np.isnan(stats["count"]) else int(stats["count"])
        row = {"behaviour": names[action], "known": count, "unknown": int(number[action]) - count, "zero": law.zero}
        row |= {"quartile_1": stats["25%"], "median": stats["50%"], "quartile_3": stats["75%"], "mean": stats["mean"]}
        row |= {"law": law.law if law.number else "of all"}
        row |= {"parameters": ", ".join(f"{name} {value:.4g}" for name, value in law.parameters.items())}
        rows.append(row | _mean_over_units(gains["law"], plans, timed & (plans.actions == action)))
    return pd.DataFrame(rows)


def _laws(plans: RecordedPlans, timed: Tensor, model: DurationModel, gains: dict[str, Tensor]) -> pd.DataFrame:
    """What laws of actions gain over exponential ones, and laws of transitions over those of actions."""
    number = len({row.action for row in model.table() if row.next_action is not None})
    names = {
        "law": "the law of each behaviour",
        "transition": f"and of each transition (in {number} of {plans.num_actions} behaviours)",
    }
    return pd.DataFrame([{"what": name} | _mean_over_units(gains[what], plans, timed) for what, name in names.items()])


def _next_rows(evaluation: Evaluation, plans: RecordedPlans, timed: Tensor) -> pd.DataFrame:
    """Bits per action with and without the last duration known: of a chain, and of networks that took them."""
    rows = []
    if plans.num_actions <= MOST_ACTIONS:
        bits, mask = chain_bits(plans, timed)
        if int(mask.sum()) >= FEWEST_UNITS:
            scores = [score_bits("", "", one, plans, mask) for one in bits]
            rows.append({"model": "markov-1"} | _compare(*scores))
    for model in evaluation.models:
        plain = next((one for one in evaluation.models if (one.name, one.inputs) == (model.name, ACTIONS)), None)
        if model.inputs == DURATIONS and plain is not None:
            rows.append({"model": model.name} | _compare(plain.score, model.score))
    frame = pd.DataFrame(rows)
    if rows:  # a loss, or a gain that is 0 in three digits, is none that was looked for
        frame["p_corrected"] = holm(frame["p_value"].where(frame["gain"] >= LEAST, 1.0))
        frame["significant"] = (frame["p_corrected"] < LEVEL) & (not too_few(evaluation.plans))
    return frame


def _compare(without: Score, with_duration: Score) -> dict[str, Any]:
    gain, low, high, p_value = without.minus(with_duration)
    bits = {"without": without.bits_per_action().mean, "with": with_duration.bits_per_action().mean}
    return bits | {"gain": gain, "low": low, "high": high, "p_value": p_value, "units": len(with_duration.bits)}


def chain_bits(plans: RecordedPlans, timed: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """The held-out bits of each action under a chain of order 1, and under one that knows the last duration.

    The second counts the actions after each action with each class of its duration, and backs off to the first as the
    chains of `how_far_back` do.

    Args:
        plans: N of them, with durations.
        timed: `[N, L]` bool: where durations are known.

    Returns:
        Both `[N, L]`, float64; and where they have values: after a known duration, if others can be learned from.
    """
    actions, step, unit = actions_in_a_row(plans)
    fold, last, mask = unit % MAX_FOLDS, np.roll(actions, 1), plans.mask().cpu()
    time = np.roll(durations_of(plans).masked_fill(~timed, torch.nan).cpu()[mask].double().numpy(), 1)
    after_known = (step > 0) & ~np.isnan(time)
    without = bits_after(last, actions, fold, bits_of_shares(actions, fold, plans.num_actions), step > 0)
    knowing, scored = without.copy(), np.zeros_like(after_known)
    for number in np.unique(fold):
        training, held_out = after_known & (fold != number), after_known & (fold == number)
        if not training.any():
            continue
        times = pd.Series(time[training]).groupby(last[training])
        edges = times.quantile(np.arange(1, CLASSES) / CLASSES).unstack().reindex(range(plans.num_actions))
        classes = (time[:, None] > edges.to_numpy()[last]).sum(1)
        knowing[held_out] = bits_held_out(last * CLASSES + classes, actions, training, held_out, without)
        scored |= held_out
    whole = torch.zeros(3, *mask.shape, dtype=torch.double)
    whole[:, mask] = torch.from_numpy(np.stack([without, knowing, scored]))
    return (whole[0], whole[1]), whole[2] > 0


def dwell_times(plans: RecordedPlans, model: DurationModel) -> pd.DataFrame:
    """Histograms of durations above 0 with the fitted laws: the table that `dwell_figure` draws.

    Args:
        plans: with durations.
        model: fitted to them.

    Returns:
        A row a bin, the commonest actions first: `action`, `number` of its known durations above 0, `zero` (the share
        of durations of 0), `law`, `low` and `high` (the edges), `density` and `fitted`: shares by unit of the natural
        logarithm, of the durations and of the law.
    """
    positive = plans.mask() & (durations_of(plans) > 0)
    times, actions = durations_of(plans)[positive].double(), plans.actions[positive].long()
    step, rows, names, laws = resolution(times), [], action_names(plans), model.table()
    count = actions.bincount(minlength=plans.num_actions)
    for action in count.argsort(descending=True, stable=True).tolist():
        if not count[action]:
            continue
        action_times = times[actions == action]
        edges = torch.from_numpy(_bins(action_times.numpy(), step))
        share = torch.histogram(action_times, edges)[0] / len(action_times)
        width = edges.log().diff()
        zero = laws[action].zero
        fitted = model.cdf(action, edges).diff() / max(1 - zero, 1e-12)
        law = laws[action].law if laws[action].number else f"{laws[action].law}, of all"
        columns = {"low": edges[:-1], "high": edges[1:], "density": share / width, "fitted": fitted / width}
        row = {"behaviour": names[action], "number": len(action_times), "zero": zero, "law": law}
        rows.append(pd.DataFrame({what: column.numpy() for what, column in columns.items()}).assign(**row))
    frame = pd.concat(rows, ignore_index=True)
    return frame[["behaviour", "number", "zero", "law", "low", "high", "density", "fitted"]]


def _bins(times: Any, step: float) -> Any:
    """Edges on a logarithmic axis; of rounded times, between their values."""
    low, high = times.min() / 1.02, times.max() * 1.02
    edges = np.geomspace(low, high, min(MOST_BINS, 4 + int(2 * len(times) ** (1 / 3))))
    if step:
        edges = np.unique(np.maximum(np.floor(edges / step), 0) + 0.5) * step
        edges = np.append(edges, edges[-1] + step) if edges[-1] < times.max() else edges
        edges = np.append(edges[0] - step, edges) if edges[0] > times.min() else edges
    return edges


def _gain(row: Any) -> str:
    """A gain with its interval."""
    return "" if pd.isna(row["gain"]) else f"{row['gain']:+.3f}±{row['high'] - row['gain']:.3f}"
