"""A section of a report on plans with its tables, and what sections share: names, texts of p-values, limits."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import networkx as nx
import pandas as pd

from neuroprior.behaviour.reporting.findings import Finding
from neuroprior.behaviour.reporting.page import Section

LISTED = 12
"""Rows that are shown of a table; its file has all."""


class Part(NamedTuple):
    """A section, its tables of results by name, what it answers in a sentence each, all that it tested, and graphs."""

    section: Section
    frames: dict[str, pd.DataFrame]
    verdicts: Sequence[str] = ()
    findings: Sequence[Finding] = ()
    graphs: Mapping[str, nx.DiGraph] = {}


def p_text(value: float) -> str:
    """A p-value in a table."""
    return f"{value:.1g}" if value else "<1e-300"


def without_verdict(few: str) -> str:
    """What a section says where there are too few independent units; "" where there are enough."""
    return few and f"{few}: here are numbers and intervals, and no more is claimed."
