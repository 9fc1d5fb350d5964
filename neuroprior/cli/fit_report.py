"""The end of a run: the prior is saved, and compared with count-based ones on the held-out plans."""

from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from neuroprior import save
from neuroprior._files import versions, write_csv, write_json
from neuroprior.analysis.comparison import Score, baselines, score, unit_name
from neuroprior.cli.fit_data import PlansData
from neuroprior.cli.fit_figures import learning_curve
from neuroprior.cli.fit_model import PriorModel


def report(folder: Path, model: PriorModel, data: PlansData) -> None:
    """Save the model, compare it, print the table, and write `metrics.json`, `metrics.csv` and the learning curve."""
    console = Console()
    prior, name = model.prior.cpu().eval(), type(model.prior).__name__
    save(prior, folder)
    trained = score(name, prior, data.held_out)
    rows, chosen = [], None
    with console.status("fitting count-based priors") as status:
        contexts = data.num_contexts if prior.takes_context else None
        progress = lambda what: status.update(f"fitting {what}")  # noqa: E731
        for baseline in baselines(data.learned_from, data.chosen_on, contexts, progress):
            more = {"how": baseline.how, "validation_bits": baseline.validation_bits}
            if baseline.prior is None:
                rows.append(dict.fromkeys(_row(trained, trained), None) | {"model": baseline.model} | more)
                continue
            one = score(baseline.model, baseline.prior, data.held_out)
            rows.append(_row(one, trained) | more)
            if chosen is None or baseline.validation_bits < chosen[0]:
                chosen = baseline.validation_bits, one
    assert chosen is not None
    best = chosen[1]
    rows.append(_row(trained, trained) | {"how": "", "validation_bits": None})
    console.print(_table(rows, best.model, data))
    console.print(_sentence(trained, best), highlight=False)
    write_json(
        folder / "metrics.json",
        {
            "rows": rows,
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
    write_csv(folder / "metrics.csv", rows)
    if model.curve:
        learning_curve(folder / "learning_curve.png", name, model.curve, best.model, chosen[0])
    console.print(
        f"saved in {folder}; neuroprior.load({str(folder)!r}) gives the prior back", highlight=False, soft_wrap=True
    )


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


def _table(rows: list[dict[str, Any]], chosen: str, data: PlansData) -> Table:
    actions, unit = int(data.held_out.mask().sum()), unit_name(data.held_out)
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title=f"Bits per action on {len(data.held_out):,} held-out plans ({actions:,} actions)",
        caption=f"± : 95 % interval over {unit}. more: bits more than the trained prior takes, paired by {unit}.\n"
        "*: the fewest bits on the validation plans, on which order and back-off were chosen.",
    )
    for number, heading in enumerate(("model", "how", "bits per action", "more")):
        table.add_column(heading, justify="left" if number < 2 else "right", no_wrap=number != 1)
    for row in rows:
        if row is rows[-1]:
            table.add_section()
        if row["bits_per_action"] is None:
            table.add_row(row["model"], row["how"])
            continue
        more = "" if row is rows[-1] else _plus_minus(row, "more_than_trained", "more_high", "+.4f")
        how = ", ".join(part for part in (row["how"], "sees context" * ("context" in row["sees"])) if part)
        name = row["model"] + "*" * (row["model"] == chosen)
        table.add_row(name, how, _plus_minus(row, "bits_per_action", "high", ".4f"), more)
    return table


def _plus_minus(row: dict[str, Any], mean: str, high: str, form: str) -> str:
    return f"{row[mean]:{form}} ± {row[high] - row[mean]:.4f}"


def _sentence(trained: Score, best: Score) -> str:
    gap = best.minus(trained)
    what = f"{trained.model} and the best count-based prior, {best.model},"
    # What rounds to nothing is nothing, however narrow the interval.
    if gap.low <= 0 <= gap.high or abs(gap.mean) < 0.00005:
        return f"{what} cannot be told apart ({gap.mean:+.4f} bits an action, {gap.low:+.4f} to {gap.high:+.4f})."
    better = "takes fewer bits than" if gap.mean > 0 else "takes more bits than"
    low, high = sorted((abs(gap.low), abs(gap.high)))
    return (
        f"{trained.model} {better} the best count-based prior, {best.model}:"
        f" {abs(gap.mean):.4f} an action ({low:.4f} to {high:.4f})."
    )
