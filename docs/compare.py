"""Draws compare.png from compare.csv: the best network minus the best chain, with 64 candidates."""

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

DOCS = Path(__file__).parent
COLOURS = {"none": "#7a7a7a", "initial": "#da9f2e", "per-step": "#e4530f"}

with open(DOCS / "compare.csv", newline="", encoding="utf-8") as file:
    rows = [
        row
        for row in csv.DictReader(file)
        if (row["first"], row["second"], row["candidates"]) == ("best network", "best chain", "64")
    ]
names = list(dict.fromkeys((row["world"], row["context"]) for row in rows))

figure, all_axes = plt.subplots(1, 2, figsize=(9, 6), sharey=True, sharex=True, layout="constrained")
titles = {"before": "before the curriculum", "after": "after it"}
for axes, (curriculum, title) in zip(all_axes, titles.items(), strict=True):
    axes.axvline(0, color="black", linewidth=0.8)
    for row in (row for row in rows if row["curriculum"] == curriculum):
        colour = COLOURS[row["context"]]
        axes.errorbar(
            float(row["difference"]),
            names.index((row["world"], row["context"])),
            xerr=float(row["half_interval"]),
            fmt="o",
            color=colour,
            markerfacecolor=colour if row["mark"] == "*" else "white",
            markersize=5,
        )
    axes.set(title=title, xlabel="network minus chain, points")
    axes.grid(axis="x", alpha=0.3)
all_axes[0].set_yticks(range(len(names)), [f"{world}, {context}" for world, context in names], fontsize=8)
all_axes[0].invert_yaxis()
figure.savefig(DOCS / "compare.png", dpi=110)
