"""The macro-actions of a report on plans: what is told is what `learn_macros` found, in names, and adds up."""

from types import SimpleNamespace

import pytest
import torch

from neuroprior import Plans, learn_macros
from neuroprior.report.macro_section import macro_section
from tests.support.sources import seeded


def test_words_are_told_with_what_they_save():
    words = torch.tensor([[0, 1, 2, 0], [3, 2, 2, 1]])
    plans = Plans(words[torch.randint(2, (300, 5), generator=seeded(0))].flatten(1), 4, action_names=list("abcd"))
    section, files = macro_section(SimpleNamespace(plans=plans))
    rows = files["macros"]
    assert {"a b c a", "d c c b"} <= {row["macro"] for row in rows}
    macros, recoded = learn_macros(plans, 16, "compression")
    assert [row["count"] for row in rows] == [macro.count for macro in macros]
    assert all(row["gain_bits"] > 0 for row in rows)
    # Bits before and after, counted anew: after, the definitions, two of log2(kinds) each, come on top.
    bits = []
    for symbols in (plans.actions, recoded.actions[recoded.mask()]):
        counts = symbols.flatten().long().bincount()
        share = counts[counts > 0] / counts.sum()
        bits.append(float(-(counts[counts > 0] * share.log2()).sum()))
    bits[1] += sum(2 * torch.tensor(4.0 + k).log2().item() for k in range(len(macros)))
    for told in bits:
        assert f"{told / plans.actions.numel():.3f}" in section.text[0]
    assert bits[0] - bits[1] == pytest.approx(sum(macro.gain for macro in macros), rel=1e-4)


def test_where_nothing_repeats_there_is_no_section():
    plans = Plans(torch.randint(20, (10, 4), generator=seeded(0)), 20)
    assert macro_section(SimpleNamespace(plans=plans)) is None
