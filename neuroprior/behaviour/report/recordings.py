"""The section on recordings: the time budget, and how well observers agree."""

import numpy as np
import pandas as pd

from neuroprior._statistics import mean_interval
from neuroprior.behaviour.recordings import Recordings
from neuroprior.behaviour.report.document import Column, table
from neuroprior.behaviour.report.page import Section
from neuroprior.behaviour.report.part import LISTED, Part
from neuroprior.behaviour.report.scores import Evaluation


def recording_section(found: Evaluation) -> Part | None:
    """Return the time budget of the recordings, and the agreement of observers; None where no times are known."""
    recordings = found.recordings
    if recordings is None or recordings.events["stop"].isna().all():
        return None
    frames, budget = {}, time_budget(recordings)
    frames["time_budget"] = budget
    percent: dict[str, Column] = {
        "behaviour": "behaviour",
        "% of the time": lambda row: f"{100 * row.share:.1f}",
        "95 % interval": lambda row: "" if np.isnan(row.low) else f"{100 * row.low:.1f} to {100 * row.high:.1f}",
        "subjects": "subjects",
    }
    if budget["level"].ne("").any():
        percent = {str(recordings.factors[0]): "level", **percent}
    unknown = int(recordings.events["stop"].isna().sum())
    caption = "Share of the watched time, mean over subjects." + (
        f" Of {unknown:,} events the end is not known: they take no time here." if unknown else ""
    )
    tables = [table(budget, percent, caption, "Time budget")]
    if "observer" in recordings.events:
        agreement = recordings.agreement()
        frames["agreement"] = agreement
        columns: dict[str, Column] = {
            "observers": lambda row: f"{row['first']}, {row['second']}",
            "behaviour": "behaviour",
            "kappa": "kappa:.2f",
            "% agreed": lambda row: f"{100 * row.agreement:.1f}",
        }
        caption = "Cohen's kappa over the time that both watched; models are fitted to the sequences of one observer."
        tables.append(table(agreement[:LISTED], columns, caption, "Agreement of observers"))
    return Part(Section("Recordings", tables=tables), frames)


def time_budget(recordings: Recordings) -> pd.DataFrame:
    """Return the share of the watched time that each behaviour takes, by the levels of the only factor.

    Returns:
        A frame with the columns `level` ("" without one factor), `behaviour, share, low, high, subjects`: means over
        subjects, with Student's 95 % interval (NaN for a single subject); the longest behaviour of each level first.
    """
    kept = recordings.of_one_observer()
    factor = kept.factors[0] if len(kept.factors) == 1 else None
    rows = []
    for level, part in kept.by_level(factor):
        shares = part.time_budget()
        for behaviour in shares.mean().sort_values(ascending=False).index:
            values = shares[behaviour].dropna().to_numpy()
            whole = mean_interval(values) if len(values) > 1 else (float(values.mean()), np.nan, np.nan)
            rows.append((level, behaviour, whole[0], whole[1], whole[2], len(values)))
    return pd.DataFrame(rows, columns=["level", "behaviour", "share", "low", "high", "subjects"])
