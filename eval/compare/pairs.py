"""Priors against one another in the same cells: paired differences, their tests, and what they say in plain words."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.compare.best import best_difference, chosen
from eval.compare.rows import UNIFORM, Array, Cells, Key, Results, Rows, by_world
from neuroprior.analysis.statistics import holm

BEST = "best neural minus best Markov"


class Pair(NamedTuple):
    """Two sets of priors to be compared; of sets of several, the best are."""

    what: str
    first: Sequence[Key]
    second: Sequence[Key]


def paired(cells: Cells, num_plans: Sequence[int]) -> Rows:
    """Differences in the share of the oracle between priors with as many plans, over the seeds that have both.

    What is compared: the best neural with the best Markov prior; each neural with each Markov prior; each saved or
    macro prior with every other; grown with not grown; seeing with not seeing. All else is equal. The best are chosen
    on half of the seeds and compared on the other half, for both halves, so that the choice favours none; their
    intervals and p-values hold whichever are the best: see `best_difference`.

    Returns:
        A row a world, pair and number of plans: the shares of the two (`first_share`, `second_share`; of the best, as
        they were chosen for each seed on the other half), their `difference` with Student's interval (`low`, `high`),
        `p_value` of the two-sided paired t-test, and `p_holm`, corrected for all rows of the world. With a single seed
        there are shares and a difference and nothing else; the best are not chosen then.
    """
    found: Rows = []
    for world, results in by_world(cells).items():
        own = []
        for pair in _pairs(results):
            for number in num_plans:
                gap = difference(results, pair, number)
                if gap is not None:
                    own.append({"world": world} | gap)
        _correct(own, "p_holm")
        found += own
    return found


def _pairs(results: Results) -> Iterator[Pair]:
    keys = results.priors("neural", "markov", "other")
    for like in dict.fromkeys(key[2:] for key in keys):
        neural, markov = ([k for k in keys if (k.kind, k[2:]) == (kind, like)] for kind in ("neural", "markov"))
        if neural and markov:
            yield Pair(BEST, neural, markov)
        yield from (Pair("neural minus Markov", [one], [other]) for one in neural for other in markov)
    for place, key in enumerate(keys):
        for later, other in enumerate(keys):
            alike = other != key and other[2:] == key[2:]
            if key.kind == "other" and alike and (other.kind != "other" or place < later):
                yield Pair("other minus any", [key], [other])
    for key in keys:
        if key.rounds and key._replace(rounds=0) in keys:
            yield Pair("grown minus not", [key], [key._replace(rounds=0)])
    for key in keys:
        if key.sees != "nothing" and key._replace(sees="nothing") in keys:
            yield Pair("seeing minus not", [key], [key._replace(sees="nothing")])


def difference(results: Results, pair: Pair, num_plans: int) -> dict[str, Any] | None:
    """The row of a pair at a number of plans; None where the best would have to be chosen from a single seed."""
    seeds = [
        seed
        for seed in results.entries[pair.first[0]]
        if all(seed in results.entries[key] for key in (*pair.first, *pair.second))
    ]
    choice = max(len(pair.first), len(pair.second)) > 1
    if len(seeds) < 1 + choice:
        return None
    place = results.budgets.index(num_plans)
    sides: list[Array] = []
    names, means = [], []
    for keys in (pair.first, pair.second):
        shares = np.array([[results.entries[key][seed]["share"][place] for seed in seeds] for key in keys])
        best = chosen(shares)
        sides.append(shares)
        names.append(" / ".join(dict.fromkeys(str(keys[one].prior) for one in best)))
        means.append(float(shares[best, np.arange(len(seeds))].mean()))
    first, second = pair.first[0], pair.second[0]
    return {
        "what": pair.what,
        "first": names[0],
        "second": names[1],
        "first_share": means[0],
        "second_share": means[1],
        "sees": " - ".join(dict.fromkeys((first.sees, second.sees))),
        "rounds": " - ".join(dict.fromkeys((str(first.rounds), str(second.rounds)))),
        "num_plans": num_plans,
    } | _tested(*sides)


def _tested(first: Array, second: Array) -> dict[str, Any]:
    number = first.shape[1]
    if number < 2:
        gap = {"difference": float((first - second).mean()), "low": None, "high": None, "p_value": None}
    else:
        gap = dict(zip(("difference", "low", "high", "p_value"), best_difference(first, second), strict=True))
    return gap | {"seeds": number}


def _correct(rows: Rows, name: str) -> None:
    """P-values corrected for the number of rows, under a new name (Holm's procedure)."""
    tested = [row for row in rows if row["p_value"] is not None]
    corrected = holm([row["p_value"] for row in tested])
    for row in rows:
        row[name] = None
    for row, p_value in zip(tested, corrected, strict=True):
        row[name] = float(p_value)


def shown_plans(num_plans: Sequence[int]) -> int:
    """The number of plans for which results are told in words: the one in the middle of those that were asked for."""
    return sorted(num_plans)[len(num_plans) // 2]


def words(cells: Cells, num_plans: Sequence[int]) -> Rows:
    """What the comparison says about each world in a line of plain words.

    The best neural against the best Markov prior of those that see as much and have grown as far; where a world lacks
    one of the kinds, its two learned priors, or the best of them against random plans. The number of plans is the one
    in the middle, not one chosen by its result.

    Returns:
        A row a world, what is seen (`sees`) and number of rounds (`rounds`): the row of the difference, with `p_holm`
        corrected for the number of worlds in which the same was asked, `better` (the name of the better prior where
        `p_holm` is below 0.05, else None), and `words`. Worlds without priors have none.
    """
    number, found = shown_plans(num_plans), []
    for world, results in by_world(cells).items():
        keys = results.priors("neural", "markov", "other")
        for like in dict.fromkeys(key[2:] for key in keys):
            told = ((pair, difference(results, pair, number)) for pair in _headlines(results, like))
            # The first pair that can be compared.
            pair, gap = next(((pair, gap) for pair, gap in told if gap is not None), (None, None))
            if pair is not None and gap is not None:
                found.append((pair, {"world": world} | gap | {"sees": like[0], "rounds": like[1]}))
    for question in {question_of(row) for _, row in found}:
        asked = [(pair, row) for pair, row in found if question_of(row) == question]
        _correct([row for _, row in asked], "p_holm")
        for pair, row in asked:
            clear = row["p_holm"] is not None and row["p_holm"] < 0.05
            row["better"] = (row["first"] if row["difference"] > 0 else row["second"]) if clear else None
            row["words"] = f"{row['world']}: {_sentence(pair, row, len(asked))}"
    return [row for _, row in found]


def question_of(row: Mapping[str, Any]) -> tuple[str, bool]:
    """What is asked of a row of `words`, in every world: of priors that see so much, and that have grown or not."""
    return row["sees"], row["rounds"] > 0


def _headlines(results: Results, like: tuple[str, int]) -> Iterator[Pair]:
    """The pairs to tell of, among priors that see and have grown alike."""
    keys = [key for key in results.priors("neural", "markov", "other") if key[2:] == like]
    neural, markov = ([key for key in keys if key.kind == kind] for kind in ("neural", "markov"))
    if neural and markov:
        yield Pair(BEST, neural, markov)
        yield Pair("neural minus Markov", neural[:1], markov[-1:])
    elif len(keys) == 2:
        yield Pair("learned minus other", keys[:1], keys[1:])
    if UNIFORM in results.entries:
        yield Pair("best learned minus random", keys, [UNIFORM])
        yield Pair("learned minus random", keys[:1], [UNIFORM])


def _sentence(pair: Pair, row: Mapping[str, Any], worlds: int) -> str:
    first, second = _named(pair.first, row["first"]), _named(pair.second, row["second"])
    plans = f"with {row['num_plans']:,} plans" if row["num_plans"] > 1 else "with a single plan"
    if row["p_value"] is None:
        gap = f"{first} minus {second}: {points(row['difference'], True)} points of the oracle {plans}"
        return f"{gap}; a single seed does not tell whether that is chance."
    over = f"{row['seeds']} seeds"
    span = f"{points(row['low'], True)} to {points(row['high'], True)}"
    if row["better"] is None:
        if row["p_value"] < 0.05:
            over += f"; p = {row['p_holm']:.2g} among {worlds} worlds"
        return f"{first} and {second} cannot be told apart {plans} ({span} points, {over})."
    if row["difference"] < 0:
        first, second = second, first
        span = f"{points(-row['high'], True)} to {points(-row['low'], True)}"
    return (
        f"{first} is better than {second} by {points(abs(row['difference']))} points of the oracle {plans}"
        f" ({span}, p = {row['p_holm']:.2g}, {over})."
    )


def _named(keys: Sequence[Key], name: str) -> str:
    """One prior, or the best of several with the names of what was chosen."""
    if len(keys) == 1:
        return "random search" if keys[0] == UNIFORM else name
    kinds = {key.kind for key in keys}
    what = {"neural": "neural prior", "markov": "Markov chain"}.get(kinds.pop() if len(kinds) == 1 else "", "prior")
    return f"the best {what} ({name.replace(' / ', ' or ')})"


def points(share: float, signed: bool = False) -> str:
    """A share of the oracle in points: a tenth, or two digits of what is less."""
    value = 100 * share if abs(share) >= 1e-8 else 0.0
    text = f"{value:.1f}" if abs(value) >= 0.1 or value == 0 else f"{value:.2g}"
    if "e" in text:
        text = f"{value:.6f}".rstrip("0")
    return "+" + text if signed and not text.startswith("-") else text
