"""The end of a run of `fit`: the prior is saved, and compared with baselines on the held-out plans."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure
from rich.console import Console

from neuroprior._files import versions, write_json
from neuroprior.behaviour.analysis.comparison import Score, baselines, never_taken, score, too_few, unit_name
from neuroprior.behaviour.reporting.document import printed, records, table, write_figures, write_frames
from neuroprior.cli.fit_data import Parts
from neuroprior.cli.fit_folds import TRAINED, cross_validated
from neuroprior.priors import CombinedPrior, Prior
from neuroprior.priors.fitting import name_of
from neuroprior.priors.scoring import keep_learned
from neuroprior.priors.serialization import model_bytes, write_model


def report(
    folder: Path,
    prior: Prior,
    curve: list[dict[str, float]],
    data: Parts,
    fresh: Prior,
    settings: Mapping[str, Any],
) -> None:
    """Save the prior, compare it with baselines, and print the table.

    Writes the prior's files, `past_durations.json` where it takes durations, `metrics.json`, `metrics.csv` and, for a
    network, the learning curve.

    Args:
        folder: of the run.
        prior: trained.
        curve: of its training; empty where it was not trained step by step.
        data: the plans.
        fresh: the prior before training, for a cross-validation.
        settings: of its `fit` there.
    """
    console = Console(markup=False, emoji=False)
    prior, name = prior.cpu().eval(), name_of(prior)
    model, parts = model_bytes(prior), (data.learned_from, data.chosen_on)
    many = data.folds > 1
    held_out = None if many else data.held_out
    keep_learned(folder, *parts, model=model, held_out=held_out, plans=data.plans)
    if data.past_durations is not None and prior.takes_context:
        data.past_durations.save(folder)
    write_model(model, folder)  # last: it is the run's own if this is kept beside it
    contexts = data.num_contexts if prior.takes_context else None
    scores: dict[str, Score] = {}
    if many:
        console.print(
            f"cross-validation: {name} and the baselines are fitted {data.folds} times more, each time without some of"
            f" the {unit_name(data.plans)}; with --folds 1 a share of them is held out instead",
            highlight=False,
        )
        scores = cross_validated(folder, fresh, settings, data, contexts)
    trained = replace(scores.pop(TRAINED), model=name) if many else score(name, prior, data.held_out)
    rows = []
    with console.status("fitting baselines") as status:
        show = lambda what: status.update(f"fitting {what}")  # noqa: E731
        for baseline in baselines(data.learned_from, data.chosen_on, contexts, show):
            # There is no prior where its tables would be too large.
            if not many and baseline.prior is not None:
                scores[baseline.model] = score(baseline.model, baseline.prior, data.held_out)
            one = scores.get(baseline.model)
            row = _row(one, trained) if one else {"model": baseline.model}
            rows.append(row | {"how": baseline.how, "validation_bits": baseline.validation_bits})
    how = prior.summary() if isinstance(prior, CombinedPrior) else ""
    last = _row(trained, trained) | {"how": how, "validation_bits": None}
    frame = pd.DataFrame([*rows, last], columns=list(last))
    best = frame.iloc[int(frame.validation_bits.astype(float).argmin())]
    console.print(_table(frame, best.model, data))
    divided = {"training": data.learned_from, "validation": data.chosen_on, "held_out": data.held_out}
    results = {"rows": records(frame), "chosen": best.model, "unit": unit_name(data.held_out), "folds": data.folds}
    results |= {"plans": {subset: len(plans) for subset, plans in divided.items()}, "curve": curve}
    write_json(folder / "metrics.json", results | {"versions": versions()})
    write_frames(folder, {"metrics": frame})
    if curve:
        figure = learning_curve(name, pd.DataFrame(curve), best.model, best.validation_bits)
        write_figures(folder, {"learning_curve": figure})
    console.print(f"saved in {folder}; in Python: neuroprior.load({str(folder)!r})", highlight=False, soft_wrap=True)


def learning_curve(name: str, curve: pd.DataFrame, baseline: str, baseline_bits: float) -> Figure:
    """Bits per action on the training and the validation plans against steps, with the best baseline as a line.

    The weights that were kept are marked.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(curve.step, curve.train_bits, color="#9aa5b1", label="training plans", marker=".")
    axes.plot(curve.step, curve.validation_bits, color="#0b6e99", label="validation plans", marker="o")
    axes.axhline(baseline_bits, color="#c7522a", linestyle="--", label=f"{baseline}, validation plans")
    kept = curve.iloc[int(curve.validation_bits.argmin())]
    axes.plot(kept.step, kept.validation_bits, "o", ms=13, mfc="none", color="#0b6e99", label="kept")
    axes.set(xlabel="step", ylabel="bits per action", title=f"Learning curve, {name}")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _row(one: Score, trained: Score) -> dict[str, Any]:
    taken, gap = one.bits_per_action(), one.minus(trained)
    row = {"model": one.model, "context": one.inputs, "bits_per_action": taken.mean, "low": taken.low}
    row |= {"high": taken.high, "more_than_trained": gap.mean, "more_low": gap.low, "more_high": gap.high}
    return row | {"p_value": gap.p_value}


def _table(frame: pd.DataFrame, chosen: str, data: Parts) -> Any:
    """The table for the terminal; the best baseline is marked."""
    actions, unit = int(data.held_out.mask().sum()), unit_name(data.held_out)
    trained, few = frame.index[-1], too_few(data.held_out)

    def plus_minus(row: Any, mean: str, high: str, sign: str = "") -> str:
        return "" if pd.isna(row[mean]) else f"{row[mean]:{sign}.4f} ± {row[high] - row[mean]:.4f}"

    columns = {
        "model": lambda row: row.model + "*" * (row.model == chosen and not few),
        "settings": lambda row: ", ".join(filter(None, (row.how, "context" * ("context" in str(row.context))))),
        "bits per action": lambda row: plus_minus(row, "bits_per_action", "high"),
        "difference": lambda row: "" if row.name == trained else plus_minus(row, "more_than_trained", "more_high", "+"),
    }
    is_worse = ((frame.model == "uniform") & (frame.more_high < 0)).any()
    worse = f"{frame.model[trained]} predicts these plans worse than uniform does." if is_worse else ""
    best = f"{few}." if few else "*: best on the validation plans, which chose the settings."
    caption = "\n".join(
        filter(
            None,
            [f"±: 95 % interval over {unit}. difference: from the last row.", best, worse, never_taken(data.plans)],
        )
    )
    title = f"Bits per action on {len(data.held_out):,} held-out plans ({actions:,} actions)"
    title += f", {data.folds} folds" if data.folds > 1 else ""
    return printed(title, table(frame, columns, caption, align="llrr"))
