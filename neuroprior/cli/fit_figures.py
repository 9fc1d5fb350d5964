"""The learning curve of a run."""

from io import BytesIO
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from neuroprior._files import write_whole


def learning_curve(path: Path, name: str, curve: list[dict[str, float]], rival: str, rival_bits: float) -> None:
    """Bits per action in training and on the validation plans against steps; the best count-based prior as a line.

    The weights that were kept are marked.

    Args:
        path: of the PNG.
        name: the prior's.
        curve: of `PriorModule`.
        rival: name of the best count-based prior.
        rival_bits: what it takes on the validation plans.
    """
    figure = Figure(figsize=(7, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    steps = [row["step"] for row in curve]
    axes.plot(steps, [row["train_bits"] for row in curve], color="#9aa5b1", label="training plans", marker=".")
    axes.plot(steps, [row["validation_bits"] for row in curve], color="#0b6e99", label="validation plans", marker="o")
    axes.axhline(rival_bits, color="#c7522a", linestyle="--", label=f"{rival}, validation plans")
    kept = min(curve, key=lambda row: row["validation_bits"])
    axes.plot(kept["step"], kept["validation_bits"], "o", ms=13, mfc="none", color="#0b6e99", label="kept")
    axes.set(xlabel="step", ylabel="bits per action", title=f"Learning curve, {name}")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    content = BytesIO()
    figure.savefig(content, format="png", dpi=150)
    write_whole(path, content.getvalue())
