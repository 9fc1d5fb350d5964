"""The findings of `python -m eval compare` in one table, and why networks are no better where they are not."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eval.compare.pairs import BEST, points, shown_plans
from eval.compare.rows import Key, Rows
from neuroprior.report.page import Section, Table, breakable

CEILING = 0.98
"""Where the best Markov chain reaches this share of the oracle, little is left to find."""

AS_MANY_BITS = 0.01
"""Bits per action that do not count."""


def summary_table(words: Rows, num_plans: Sequence[int]) -> Table | None:
    """The best neural against the best Markov prior in every world, by what they see and whether they have grown."""
    number = shown_plans(num_plans)
    cells = []
    for row in _best(words):
        neural, markov = (100 * row[f"{side}_share"] for side in ("first", "second"))
        gap = f"{round(100 * row['difference'], 1) + 0:+.1f}"  # no minus before 0.0
        if row["low"] is not None:
            half = max(row["high"] - row["difference"], row["difference"] - row["low"])
            gap += f" ±{100 * half:.1f}{' ' if row['better'] is None else '*'}"
        world, sees = _where(row)
        cells.append([breakable(world), sees, f"{markov:.1f}", f"{neural:.1f}", gap])
    if not cells:
        return None
    headings = ("world", "sees", "Markov", "neural", "difference")
    caption = (
        f"The best prior of each kind: % of the oracle with {number:,} plans, and neural minus Markov in points. ±: the"
        " longer side of the 95 % interval. *: p < 0.05, corrected for the number of priors and of worlds."
    )
    return Table(headings, cells, caption, "llrrr")


def reasons(words: Rows, bits: Rows, paired: Rows, num_plans: Sequence[int]) -> Rows:
    """Why the best neural prior is not better, wherever it is not.

    Returns:
        A row a world, what is seen and number of rounds: the best chain's share of the oracle (`markov_share`), the
        fewest bits per action of a network and of a chain before growth, when they learned from plans like those that
        the bits are told of (`neural_bits`, `markov_bits`), by how much networks are ahead with the fewest plans, where
        that is no chance (`early`), and `words`.
    """
    number, fewest = shown_plans(num_plans), min(num_plans)
    found = []
    for row in _best(words):
        if row["better"] == row["first"]:
            continue
        own = {name: row[name] for name in ("world", "sees", "rounds")}
        own["markov_share"] = row["second_share"]
        own |= {f"{kind}_bits": _bits(bits, row, kind) for kind in ("neural", "markov")}
        early = [
            one["difference"]
            for one in paired
            if (one["world"], one["what"], one["sees"], one["num_plans"]) == (row["world"], BEST, row["sees"], fewest)
            and one["rounds"] == str(row["rounds"])
            and fewest < number
            and one["difference"] > 0
            and one["p_holm"] is not None
            and one["p_holm"] < 0.05
        ]
        own["early"] = early[0] if early else None
        near = own["markov_share"] >= CEILING and row["better"] is None
        found.append(own | {"words": _little_left(own, number) if near else _why(own, number, fewest)})
    return found


def reasons_in_words(found: Rows) -> Iterator[str]:
    """The reasons, one by one."""
    for one in found:
        world, sees = _where(one)
        yield f"{world} ({sees}): {one['words']}."


def reasons_section(found: Rows) -> Section | None:
    """Why networks are not better, line by line."""
    if not found:
        return None
    text = (
        "What can be learned from chosen plans sets a limit to every prior; what is left to find, to every planner. The"
        " likelier a prior holds the plans that are chosen, the fewer of its samples are needed; but the best of many"
        " samples asks for many different ones, which likelihood does not."
    )
    return Section("Where networks are not better, and why", [text, *reasons_in_words(found)])


def _little_left(own: Mapping[str, Any], number: int) -> str:
    share = 100 * own["markov_share"]
    return f"little is left to find: with {number:,} plans the best chain reaches {share:.1f} % of the oracle"


def _why(own: Mapping[str, Any], number: int, fewest: int) -> str:
    neural, markov = own["neural_bits"], own["markov_bits"]
    if neural is None or markov is None:
        return "no plans to tell bits of"
    told = f"{neural:.2f} bits an action against {markov:.2f}{', before growth' * bool(own['rounds'])}"
    if neural > markov - AS_MANY_BITS:
        return f"networks tell held-out plans no better than chains do ({told}): they know no more of their structure"
    better = f"networks tell held-out plans better ({told})"
    if own["early"] is not None:
        ahead = f"and are ahead by {points(own['early'])} points with {fewest:,} plans"
        return f"{better}, {ahead}; with {number:,} chains may make up for it by trying more different ones"
    return f"{better}; the best of {number:,} is no better for it, for which they would have to differ, too"


def _where(row: Mapping[str, Any]) -> tuple[str, str]:
    """The world, and what is seen by priors that have grown or not."""
    return row["world"], row["sees"] + ", grown" * bool(row["rounds"])


def _best(words: Rows) -> Iterator[Mapping[str, Any]]:
    return (row for row in words if row["what"] == BEST)


def _bits(bits: Rows, row: Mapping[str, Any], kind: str) -> float | None:
    """The fewest bits of priors of a kind before growth, in the world of `row` and seeing as much."""
    own = (one for one in bits if (one["world"], one["sees"], one["rounds"]) == (row["world"], row["sees"], 0))
    keys = ((Key("sampling", one["prior"], one["sees"], 0), one["bits_per_action"]) for one in own)
    return min((told for key, told in keys if key.kind == kind), default=None)
