"""The section on hidden modes: how many there are, which come back in other plans, and what each does."""

from dataclasses import replace

import pandas as pd
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from neuroprior._statistics import LEVEL
from neuroprior.behaviour.analysis.drift import by_position
from neuroprior.behaviour.analysis.modes import (
    STABLE,
    ModeChoice,
    choose_modes,
    mode_frame,
    mode_names,
    mode_plans,
    mode_table,
    mode_transitions,
)
from neuroprior.behaviour.analysis.motifs import motifs
from neuroprior.behaviour.recorded_plans import action_names
from neuroprior.behaviour.reporting import figures
from neuroprior.behaviour.reporting.conditions import condition_section
from neuroprior.behaviour.reporting.document import Column, table
from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.fits import counted
from neuroprior.behaviour.reporting.page import FigureBox, Section, Table
from neuroprior.behaviour.reporting.part import Part, p_text
from neuroprior.behaviour.reporting.scores import Evaluation
from neuroprior.plans import BLOCKS, Plans, in_parts
from neuroprior.priors import SwitchingPrior
from neuroprior.priors.learning import plans_for

MOST_MOTIFS = 3
"""Sequences that are listed of each mode."""


def mode_section(evaluation: Evaluation) -> Part | None:
    """Hidden modes; None where no numbers of them are given."""
    numbers = evaluation.settings.get("modes")
    if not numbers:
        return None
    plans = divided = evaluation.plans
    cut = bool(evaluation.settings.get("cut"))
    if cut:
        divided = in_parts(plans, min(BLOCKS, max(int(plans.mask().sum()) // 2, 1)))
    mask = counted(divided, evaluation.settings["skip"], cut)
    choice = choose_modes(divided, numbers, mask=mask, generator=torch.Generator().manual_seed(0))
    prior, stable = choice.prior, choice.stable().tolist()
    tables, boxes, frames = [choice_table(choice)], list[FigureBox](), {"modes": choice.frame()}
    text = [
        "A prior with hidden modes: each is a Markov chain of its own, which persists, and switches with a probability"
        " that may depend on the context. Chosen are the fewest modes whose held-out bits are within one standard error"
        " of the fewest bits."
    ]
    if choice.chosen == 1:
        text.append("One mode predicts these sequences as well as more do: there is no sign of hidden modes.")
        return Part(Section("Hidden modes", text, tables), frames)
    names = mode_names(choice.chosen)
    again = [name for name, one in zip(names, stable, strict=True) if one]
    text.append(
        f"Modes that come back in the priors of all folds: {', '.join(again) or 'none'}. Others may predict, but are"
        " accidents of the sequences that they were learned from, and should not be given names."
    )
    described = mode_table(prior, plans).assign(stable=["yes" if one else "no" for one in stable])
    columns: dict[str, Column] = {
        "mode": "mode",
        "comes\nback": "stable",
        "%": lambda row: f"{100 * row['share']:.1f}",
        "dwell": "dwell:.1f",
        "visits": "visits:.1f",
        "behaviours": "behaviours",
    }
    columns |= {side: side for side in ("enters", "leaves") if side in described}
    caption = (
        "%: of the behaviours. dwell: behaviours in the mode for each end of it, visits: of a sequence, both expected."
        " behaviours: those that it takes more often than all modes together, with their shares in the mode."
        + " enters, leaves: the commonest contexts."
        * ("enters" in described)
    )
    align = "rlrrr" + "l" * (len(columns) - 5)
    tables.append(table(described, columns, caption, "What each mode does", align))
    typical = _typical_sequences(prior, plans)
    if len(typical):
        shown: dict[str, Column] = {"mode": "mode", "sequence": "sequence", "count": "count:,", "ratio": "ratio:.2f"}
        shown |= {} if evaluation.too_few else {"p": lambda row: p_text(row["p_corrected"])}
        caption = "Within a mode, against a chain of order n - 2; ratio: times as often as expected."
        caption += (
            "" if evaluation.too_few else " p: Fisher's exact test, corrected for all sequences of a mode (Holm)."
        )
        tables.append(
            table(typical, shown, caption, "Over-represented sequences of each mode", "rl" + "r" * (len(shown) - 2))
        )
    path_plans = mode_plans(prior, plans)
    caption = "Each row a sequence, each colour the most probable mode."
    boxes.append(
        FigureBox(figures.ethogram_figure(path_plans), caption, "Modes as coloured strips over time.", "mode_ethogram")
    )
    occupied = _occupancy(prior, plans)
    caption = (
        f"The share of the behaviours in each mode, by tenths of the sequences. 95 % intervals over {evaluation.unit}."
    )
    boxes.append(
        FigureBox(figures.occupancy_figure(occupied), caption, "Shares of the modes over time.", "mode_occupancy")
    )
    counts = mode_transitions(prior, plans)
    pooled = _shares(counts.sum(0))
    each = torch.stack([_shares(one) for one in counts])
    figure = figures.group_transition_figure(
        each, pooled, action_names(plans), names, torch.zeros_like(each, dtype=torch.bool)
    )
    caption = (
        "Each mode's probabilities of the next behaviour (column) after the last one (row), less those of all"
        " behaviours."
    )
    boxes.append(FigureBox(figure, caption, "Differences of the modes' transitions.", "mode_transitions"))
    frames |= {
        "mode_table": described,
        "mode_motifs": typical,
        "mode_occupancy": occupied,
        "mode_actions": mode_frame(prior, plans),
    }
    findings: list[Finding] = []
    if path_plans.condition is not None:
        by_condition = condition_section(replace(evaluation, plans=path_plans))
        assert by_condition is not None
        text.append(f"Modes by condition. {by_condition.section.text[0]}")
        tables += [
            replace(one, title=f"Modes: {one.title[:1].lower()}{one.title[1:]}") for one in by_condition.section.tables
        ]
        boxes += [replace(box, name=f"mode_{box.name}") for box in by_condition.section.figures]
        frames |= {f"mode_{name}": frame for name, frame in by_condition.frames.items()}
        findings = [
            replace(one, id=f"modes: {one.id}", family=f"modes: {one.family}", feature=f"{one.feature} (modes)")
            for one in by_condition.findings
        ]
    return Part(Section("Hidden modes", text, tables, boxes), frames, findings=findings)


def choice_table(choice: ModeChoice) -> Table:
    """What speaks for each number of modes."""
    columns: dict[str, Column] = {
        "modes": "modes",
        "bits per behaviour": "bits:.3f",
        "more": "more:.4f",
        "error": "error:.4f",
    }
    columns |= {"come back": "stable", "": lambda row: "chosen" if row["chosen"] else ""}
    caption = (
        f"Held-out bits in {len(choice.stability[choice.chosen])} folds. more: than the best, with the standard error"
        f" of this, paired. come back: modes whose posterior correlates by {STABLE} or more with that of a mode of each"
        " fold."
    )
    return table(choice.frame(), columns, caption, "Hidden modes", "rrrrrl")


def _typical_sequences(prior: SwitchingPrior, plans: Plans) -> pd.DataFrame:
    """The most over-represented sequences within each mode of the most probable path."""
    path, mask, names = mode_plans(prior, plans).actions, plans.mask(), action_names(plans)
    new = torch.ones_like(mask)
    new[:, 1:] = path[:, 1:] != path[:, :-1]
    start = new[mask].nonzero()[:, 0]
    sizes = torch.cat([start, torch.tensor([int(mask.sum())])]).diff()
    runs = pad_sequence(plans.actions[mask].split(sizes.tolist()), batch_first=True)
    plan = mask.nonzero()[:, 0][start]
    group = plan if plans.group is None else plans.group[plan]
    every, mode, rows = Plans(runs, plans.num_actions, sizes, group=group), path[mask][start], []
    for k in range(prior.num_modes):
        mode_runs = every[mode == k]
        mode_motifs = motifs(mode_runs) if len(mode_runs) else []
        over = [one for one in mode_motifs if one.ratio > 1 and one.corrected < LEVEL]
        for one in over[:MOST_MOTIFS]:
            sequence = " ".join(names[action] for action in one.actions)
            rows.append((k + 1, sequence, one.count, one.expected, one.ratio, one.corrected))
    return pd.DataFrame(rows, columns=["mode", "sequence", "count", "expected", "ratio", "p_corrected"])


def _occupancy(prior: SwitchingPrior, plans: Plans) -> pd.DataFrame:
    """The share of each mode in each tenth of the plans, with its interval."""
    smoothed = prior.posterior(plans_for(prior, plans)).smoothed.cpu()
    rows = []
    for k, name in enumerate(mode_names(prior.num_modes)):
        parts = by_position(plans, smoothed[..., k], plans.mask()).parts
        rows += [(name, number, *interval[:3]) for number, interval in enumerate(parts, 1)]
    return pd.DataFrame(rows, columns=["mode", "part", "share", "low", "high"])


def _shares(counts: Tensor) -> Tensor:
    """Rows that sum to one; NaN where nothing was counted."""
    return counts / counts.sum(-1, keepdim=True)
