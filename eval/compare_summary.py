"""The findings of `python -m eval compare` in one table, and why networks are no better where they are not."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eval.compare_pairs import BEST, points, shown_plans
from eval.compare_rows import Key, Rows
from eval.page import Section, Table

CEILING = 0.98
"""Where the best Markov chain reaches this share of the oracle, little is left to find."""

AS_MANY_BITS = 0.01
"""Bits per action that do not count."""


def summary_table(words: Rows, rows: Rows, num_plans: Sequence[int]) -> Table | None:
    """The best neural against the best Markov prior in every world, by what they see and whether they have grown."""
    number = shown_plans(num_plans)
    cells = []
    for row in _best(words):
        markov, neural = (100 * _share(rows, row, kind, number) for kind in ("markov", "neural"))
        gap = f"{100 * row['difference']:+.1f}"
        if row["low"] is not None:
            half = max(row["high"] - row["difference"], row["difference"] - row["low"])
            gap += f" ±{100 * half:.1f}{' ' if row['better'] is None else '*'}"
        cells.append([*_where(row), f"{markov:.1f}", f"{neural:.1f}", gap])
    if not cells:
        return None
    headings = ("world", "sees", "Markov", "neural", "difference")
    caption = (
        f"The best prior of each kind: % of the oracle with {number:,} plans, and neural minus Markov in points. ±: the"
        " longer side of the 95 % interval. *: p < 0.05, corrected for the number of priors and of worlds."
    )
    return Table(headings, cells, caption, "llrrr")


def reasons(words: Rows, rows: Rows, bits: Rows, paired: Rows, num_plans: Sequence[int]) -> Rows:
    """Why the best neural prior is not better, wherever it is not.

    Returns:
        A row a world, what is seen and number of rounds: the best chain's share of the oracle (`markov_share`), the
        fewest bits per action of a network and of a chain (`neural_bits`, `markov_bits`), by how much networks are
        ahead with the fewest plans (`early`), and `words`.
    """
    number, fewest = shown_plans(num_plans), min(num_plans)
    found = []
    for row in _best(words):
        if row["better"] == row["first"]:
            continue
        own = {name: row[name] for name in ("world", "sees", "rounds")}
        own["markov_share"] = _share(rows, row, "markov", number)
        own |= {f"{kind}_bits": _bits(bits, row, kind) for kind in ("neural", "markov")}
        early = [
            one
            for one in paired
            if (one["world"], one["what"], one["sees"], one["num_plans"]) == (row["world"], BEST, row["sees"], fewest)
            and one["rounds"] == str(row["rounds"])
        ]
        own["early"] = early[0]["difference"] if early and (early[0]["low"] or 0) > 0 else None
        found.append(own | {"words": _why(own, number, fewest)})
    return found


def reasons_in_words(found: Rows) -> Iterator[str]:
    """The reasons, one by one."""
    for one in found:
        world, sees = one["world"], one["sees"] + ", grown" * bool(one["rounds"])
        yield f"{world} ({sees}): {one['words']}."


def reasons_section(found: Rows) -> Section | None:
    """Why networks are not better, as a table."""
    if not found:
        return None
    rows = [[*_where(one), one["words"]] for one in found]
    text = [
        "What can be learned from chosen plans sets a limit to every prior; what is left to find, to every planner. The"
        " likelier a prior holds the plans that are chosen, the fewer of its samples are needed; but the best of many"
        " samples asks for many different ones, which likelihood does not."
    ]
    return Section("Where networks are not better, and why", text, [Table(("world", "sees", "why"), rows, "", "lll")])


def _why(own: Mapping[str, Any], number: int, fewest: int) -> str:
    share, neural, markov = own["markov_share"], own["neural_bits"], own["markov_bits"]
    if share >= CEILING:
        return f"little is left to find: with {number:,} plans the best chain reaches {100 * share:.1f} % of the oracle"
    if neural is None or markov is None:
        return "no plans to tell bits of"
    told = f"{neural:.2f} bits an action against {markov:.2f}"
    if neural > markov - AS_MANY_BITS:
        return f"networks tell held-out plans no better than chains do ({told}): they know no more of their structure"
    better = f"networks tell held-out plans better ({told})"
    if own["early"] is not None:
        ahead = f"and are ahead by {points(own['early'])} points with {fewest:,} plans"
        return f"{better}, {ahead}; with {number:,}, trying more different ones makes up for it"
    return f"{better}, which does not make the best of {number:,} better: these have to differ, too"


def _where(row: Mapping[str, Any]) -> tuple[str, str]:
    """The world, broken where its words end where it has to be, and what is seen by priors that have grown or not."""
    return row["world"].replace("_", "_\N{ZERO WIDTH SPACE}"), row["sees"] + ", grown" * bool(row["rounds"])


def _best(words: Rows) -> Iterator[Mapping[str, Any]]:
    return (row for row in words if row["what"] == BEST)


def _own(rows: Rows, row: Mapping[str, Any], kind: str) -> Iterator[Mapping[str, Any]]:
    """The rows of a kind of priors in the world of `row`, which see and have grown like it."""
    like = ("world", "sees", "rounds")
    for one in rows:
        alike = all(one[name] == row[name] for name in like)
        if alike and Key("sampling", one["prior"], one["sees"], one["rounds"]).kind == kind:
            yield one


def _share(rows: Rows, row: Mapping[str, Any], kind: str, number: int) -> float:
    return max(one["oracle_share"] for one in _own(rows, row, kind) if one["num_plans"] == number)


def _bits(bits: Rows, row: Mapping[str, Any], kind: str) -> float | None:
    return min((one["bits_per_action"] for one in _own(bits, row, kind)), default=None)
