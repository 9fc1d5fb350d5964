"""A section of a report on plans with its tables, and what sections share: names, texts of p-values, limits."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import networkx as nx
import pandas as pd
from torch import Tensor

from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.page import Section
from neuroprior.plans import Plans

LISTED = 12
"""Rows that are shown of a table; its file has all."""

SIGNIFICANT = 0.05


class Part(NamedTuple):
    """A section, its tables of results by name, what it answers in a sentence each, all that it tested, and graphs."""

    section: Section
    frames: dict[str, pd.DataFrame]
    verdicts: Sequence[str] = ()
    findings: Sequence[Finding] = ()
    graphs: Mapping[str, nx.DiGraph] = {}


def action_names(plans: Plans) -> list[str]:
    """Names of the actions; their numbers where they have none."""
    return list(plans.action_names or map(str, range(plans.num_actions)))


def group_names(plans: Plans, groups: Tensor) -> list[str]:
    """Names of these groups; their numbers where they have none."""
    return [plans.group_names[g] if plans.group_names else f"group {g}" for g in groups.tolist()]


def p_text(value: float) -> str:
    """A p-value in a table."""
    return f"{value:.1g}" if value else "<1e-300"


def without_verdict(few: str) -> str:
    """What a section says where there are too few independent units; "" where there are enough."""
    return few and f"{few}: here are numbers and intervals, and no more is claimed."
