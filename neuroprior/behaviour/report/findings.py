"""What a report found: findings with their tests, and the sentences at its top, made of these and no others."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

LEVEL = 0.05
"""A finding is starred where its corrected p-value is below."""

MOST_SENTENCES = 8
"""At the top of a report."""


@dataclass(frozen=True)
class Finding:
    """One feature that was tested.

    A family of features is significant by its p-value, corrected for the families of one question (Holm); a feature is
    where its family is and its own p-value, corrected for the features of the family, is. `p_corrected`, the larger
    of the two, is below `LEVEL` just where both are.

    Attributes:
        id: of the finding, unique in a report.
        family: of the features that were tested together, such as "transitions".
        feature: what was tested, by name.
        effect: its size, in the unit that `sentence` has; None where it is not one number.
        low, high: the 95 % interval of the effect.
        p: of this feature alone.
        p_corrected: for the features of its family, and the families of the question.
        starred: whether `p_corrected` is below `LEVEL`, and there are enough independent units.
        sentence: says it with effect, interval and p.
    """

    id: str
    family: str
    feature: str
    effect: float | None
    low: float | None
    high: float | None
    p: float
    p_corrected: float
    starred: bool
    sentence: str

    def row(self) -> dict[str, Any]:
        """The finding as `results.json` has it: without the sentence."""
        found = asdict(self)
        del found["sentence"]
        return found


@dataclass(frozen=True)
class Sentence:
    """A sentence at the top of a report, and the id of the finding that it says; None for none of them."""

    sentence: str
    finding: str | None = None


def headline(verdicts: Sequence[Sentence], findings: Sequence[Finding]) -> list[Sentence]:
    """The sentences at the top: what was found in all, then every starred finding, the surest first.

    Findings for which there is no room are named in the last sentence.

    Args:
        verdicts: answers of sections, such as which model is best.
        findings: all; those that are starred are said.
    """
    starred = sorted((one for one in findings if one.starred), key=lambda one: one.p_corrected)
    room = max(MOST_SENTENCES - len(verdicts), 1)
    shown, rest = (starred, []) if len(starred) <= room else (starred[: room - 1], starred[room - 1 :])
    said = [*verdicts, *(Sentence(one.sentence, one.id) for one in shown)]
    if rest:
        said.append(Sentence(f"Starred, too: {'; '.join(one.feature for one in rest)}."))
    return said


def p_words(value: float) -> str:
    """A p-value in a sentence: "p = .012", "p < .0001"."""
    if value < 1e-4:
        return "p < .0001"
    return f"p = {value:.2g}".replace("0.", ".", 1)
