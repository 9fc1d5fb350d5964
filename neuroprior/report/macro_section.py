"""The section of a report on plans about macro-actions: sequences that could be taken as one action."""

from typing import TYPE_CHECKING, Any

import torch

from neuroprior import learn_macros
from neuroprior.report.page import Section, Table
from neuroprior.report.statistics import action_names

if TYPE_CHECKING:
    from neuroprior.report.study import Report

MOST = 16
"""Macro-actions."""

TITLE = "Macro-actions"


def macro_section(report: "Report") -> tuple[Section, dict[str, list[dict[str, Any]]]] | None:
    """What the plans repeat, by how much shorter they are told with it; None where nothing makes them shorter."""
    plans, names = report.plans, action_names(report.plans)
    macros, _ = learn_macros(plans, MOST, "compression")
    if not macros:
        return None
    rows = [
        {
            "macro": " ".join(names[action] for action in macro.actions),
            "actions": len(macro.actions),
            "count": macro.count,
            "gain_bits": macro.gain,
        }
        for macro in macros
    ]
    counts = plans.actions[plans.mask()].long().bincount().double()
    before = float(-torch.special.xlogy(counts, counts / counts.sum()).sum()) / torch.log(torch.tensor(2.0)).item()
    total = float(counts.sum())
    after = before - sum(macro.gain for macro in macros)
    text = [
        "Sequences taken as one action. Again and again the two actions (or macro-actions) that follow one another are"
        " made one wherever they do, whose union shortens the plans most, each coded by its frequency. So coded, an"
        f" action takes {before / total:.3f} bits; with these {len(macros)} macro-actions {after / total:.3f}, which"
        " includes telling what they stand for. Earlier ones may be parts of later ones."
    ]
    cells = [[row["macro"], f"{row['count']:,}", f"{row['gain_bits']:,.0f}"] for row in rows]
    caption = "In the order in which they were found; count: how often each was put in then; gain: bits saved then."
    return Section(TITLE, text, [Table(("macro-action", "count", "gain"), cells, caption)]), {"macros": rows}
