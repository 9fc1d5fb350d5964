"""What a report found: findings with their tests, and the sentences at its top, made of these and no others."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from neuroprior._statistics import p_words

MOST_SENTENCES = 8
"""At the top of a report."""


@dataclass(frozen=True)
class Finding:
    """One feature that was tested.

    A family of features is significant by its p-value, corrected for the families of one question; a feature is
    where its family is and its own p-value, corrected for the features of the family, is. `p_corrected`, the larger
    of the two, is below `LEVEL` just where both are.

    Attributes:
        id: of the finding, unique in a report.
        family: of the features that were tested together, such as "transitions".
        feature: what was tested, by name.
        effect: its size, in the unit that `sentence` has; None where it is not one number.
        low, high: the 95 % interval of the effect.
        p_value: of this feature alone.
        p_corrected: for the features of its family, and the families of the question.
        significant: whether `p_corrected` is below `LEVEL`, and there are enough independent units.
        sentence: says it with effect, interval and p.
    """

    id: str
    family: str
    feature: str
    effect: float | None
    low: float | None
    high: float | None
    p_value: float
    p_corrected: float
    significant: bool
    sentence: str

    def row(self) -> dict[str, Any]:
        """The finding as `results.json` has it: without the sentence."""
        row = asdict(self)
        del row["sentence"]
        return row


def gain_finding(family: str, feature: str, what: str, row: Mapping[Any, Any]) -> Finding:
    """The finding that `what` adds bits: of a row with `bits, low, high, p_value, p_corrected, significant`."""
    bits, low, high, p, corrected = (float(row[name]) for name in ("bits", "low", "high", "p_value", "p_corrected"))
    sentence = (
        f"{what} adds {bits:.2g} bits to the prediction of the next one, 95 % interval {low:.2g} to {high:.2g};"
        f" {p_words(corrected)}."
    )
    return Finding(feature, family, feature, bits, low, high, p, corrected, bool(row["significant"]), sentence)


@dataclass(frozen=True)
class Sentence:
    """A sentence at the top of a report, and the id of the finding that it says; None for none of them."""

    sentence: str
    finding: str | None = None


def headline(verdicts: Sequence[str], sections: Sequence[Sequence[Finding]]) -> list[Sentence]:
    """The sentences at the top: verdicts, then every starred finding in the order of the page.

    Where there is no room for all, the last findings of the sections with most are named in one sentence.

    Args:
        verdicts: answers of sections, such as which model is best.
        sections: the findings of each section, the weightiest first; those that are starred are said.
    """
    starred = [[one for one in findings if one.significant] for findings in sections]
    places = [(rank, number) for number, section in enumerate(starred) for rank in range(len(section))]
    room = max(MOST_SENTENCES - len(verdicts), 2)
    kept = sorted(places)[: room if len(places) <= room else room - 1]
    said = [Sentence(verdict) for verdict in verdicts]
    for rank, number in sorted(kept, key=lambda place: place[::-1]):
        one = starred[number][rank]
        said.append(Sentence(one.sentence, one.id))
    if rest := sorted({*places} - {*kept}, key=lambda place: place[::-1]):
        said.append(Sentence(f"Starred, too: {'; '.join(starred[number][rank].feature for rank, number in rest)}."))
    return said
