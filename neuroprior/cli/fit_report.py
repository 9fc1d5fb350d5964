"""The end of a run of `fit`: the prior is saved, and compared with baselines on the held-out plans."""

from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console

from neuroprior._files import versions, write_json, write_whole
from neuroprior.analysis.comparison import Score, baselines, score, unit_name
from neuroprior.cli.fit_recipe import PlansData, PriorModel
from neuroprior.priors import save
from neuroprior.report.document import printed, records, table, write_frames


def report(folder: Path, model: PriorModel, data: PlansData) -> None:
    """Save the prior, compare it with baselines, and print the table.

    Writes the prior's files, `metrics.json`, `metrics.csv` and, for a network, the learning curve.

    Args:
        folder: of the run.
        model: with the fitted prior.
        data: its plans.

    Raises:
        OSError: a file cannot be written.
    """
    console = Console()
    prior, name = model.prior.cpu().eval(), type(model.prior).__name__
    save(prior, folder)
    trained = score(name, prior, data.held_out)
    rows = []
    contexts = data.num_contexts if prior.takes_context else None
    with console.status("fitting baselines") as status:
        show = lambda what: status.update(f"fitting {what}")  # noqa: E731
        for baseline in baselines(data.learned_from, data.chosen_on, contexts, show):
            one = None if baseline.prior is None else score(baseline.model, baseline.prior, data.held_out)
            row = _row(trained, trained) if one is None else _row(one, trained)
            if one is None:  # its tables would be too large
                row = dict.fromkeys(row, None) | {"model": baseline.model}
            rows.append(row | {"how": baseline.how, "validation_bits": baseline.validation_bits})
    frame = pd.DataFrame([*rows, _row(trained, trained) | {"how": "", "validation_bits": None}])
    best = frame.iloc[int(frame.validation_bits.astype(float).argmin())]
    console.print(_table(frame, best.model, data))
    write_json(
        folder / "metrics.json",
        {
            "rows": records(frame),
            "chosen": best.model,
            "unit": unit_name(data.held_out),
            "plans": {
                "training": len(data.learned_from),
                "validation": len(data.chosen_on),
                "held_out": len(data.held_out),
            },
            "curve": model.curve,
            "versions": versions(),
        },
    )
    write_frames(folder, {"metrics": frame})
    if model.curve:
        figure = learning_curve(name, pd.DataFrame(model.curve), best.model, best.validation_bits)
        content = BytesIO()
        figure.savefig(content, format="png", dpi=150)
        write_whole(folder / "learning_curve.png", content.getvalue())
    console.print(f"saved in {folder}; in Python: neuroprior.load({str(folder)!r})", highlight=False, soft_wrap=True)


def learning_curve(name: str, curve: pd.DataFrame, baseline: str, baseline_bits: float) -> Figure:
    """Bits per action on the training and the validation plans against steps, with the best baseline as a line.

    The weights that were kept are marked.

    Args:
        name: the prior's.
        curve: of `PriorModule`: columns step, train_bits and validation_bits.
        baseline: name of the best baseline.
        baseline_bits: its bits per action on the validation plans.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    FigureCanvasAgg(figure)
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
    return {
        "model": one.model,
        "sees": one.inputs,
        "bits_per_action": taken.mean,
        "low": taken.low,
        "high": taken.high,
        "more_than_trained": gap.mean,
        "more_low": gap.low,
        "more_high": gap.high,
        "p_value": gap.p_value,
    }


def _table(frame: pd.DataFrame, chosen: str, data: PlansData) -> Any:
    """The table for the terminal; the best baseline is marked."""
    actions, unit = int(data.held_out.mask().sum()), unit_name(data.held_out)
    trained = frame.index[-1]

    def how(row: Any) -> str:
        return ", ".join(part for part in (row.how, "context" * ("context" in str(row.sees))) if part)

    def bits(row: Any) -> str:
        known = not pd.isna(row.bits_per_action)
        return f"{row.bits_per_action:.4f} ± {row.high - row.bits_per_action:.4f}" if known else ""

    def difference(row: Any) -> str:
        if row.name == trained or pd.isna(row.bits_per_action):
            return ""
        return f"{row.more_than_trained:+.4f} ± {row.more_high - row.more_than_trained:.4f}"

    columns = {
        "model": lambda row: row.model + "*" * (row.model == chosen),
        "settings": how,
        "bits per action": bits,
        "difference": difference,
    }
    caption = (
        f"±: 95 % interval over {unit}. difference: from the last row.\n"
        "*: best on the validation plans, which chose the settings."
    )
    title = f"Bits per action on {len(data.held_out):,} held-out plans ({actions:,} actions)"
    return printed(title, table(frame, columns, caption, align="llrr"))
