"""Long sequences of many kinds of action: hidden conditions, and text."""

import re
from dataclasses import dataclass
from math import log
from pydoc_data import topics
from string import ascii_lowercase, digits

import torch
from torch import Tensor

from neuroprior import Plans

LENGTH = 1000
"""Actions of each sequence."""

KINDS, CONDITIONS, SWITCH = 57, 6, 0.02
"""Kinds of action and hidden conditions of the switching chain, and how often another condition is drawn."""

CHARACTERS = ascii_lowercase + digits + " .,:;'\"()_-=*`"
"""Kinds of characters in texts; others are left out."""


@dataclass(frozen=True)
class Sequences:
    """Sequences to learn from, and others to predict.

    Attributes:
        name: of tables.
        training, test: the sequences.
        entropy: bits per action that the test sequences have under their source; None: it is not known.
    """

    name: str
    training: Plans
    test: Plans
    entropy: float | None = None


def sequences(number: int, generator: torch.Generator) -> list[Sequences]:
    """So many sequences of each kind to learn from, and half as many to predict; none of either, if `number` is 0."""
    if not number:
        return []
    held_out, parts = -(-number // 2), text(generator)
    if number + held_out > len(parts):
        raise ValueError(f"`num_sequences` must be at most {len(parts) * 2 // 3}, got {number}")
    table = switching_chain(generator)
    (learned, _), (test, log_probs) = (draw(table, size, generator) for size in (number, held_out))
    return [
        Sequences(f"switching, {KINDS} kinds", learned, test, -float(log_probs.mean()) / log(2)),
        Sequences(f"text, {len(CHARACTERS)} kinds", parts[:number], parts[number : number + held_out]),
    ]


def switching_chain(generator: torch.Generator) -> Tensor:
    """`[CONDITIONS, KINDS, KINDS]`: the probability of each action after each other one, in each condition."""
    shared, of_condition = (
        torch.randn(KINDS, KINDS, generator=generator),
        torch.randn(CONDITIONS, KINDS, KINDS, generator=generator),
    )
    return (shared + 2 * of_condition).double().softmax(-1)


def draw(table: Tensor, number: int, generator: torch.Generator) -> tuple[Plans, Tensor]:
    """Sequences of chains with a hidden condition, and the log-probability `[N, L]` of each action given those before.

    Before each action but the first another condition is drawn with probability `SWITCH`; the first action and the
    first condition are drawn evenly. Probabilities of conditions, given the actions so far, follow from Bayes' rule
    (the forward algorithm: Rabiner 1989).

    Args:
        table: `[C, A, A]`, of `switching_chain`.
        number: of sequences.
        generator: draws them.
    """
    conditions, kinds, _ = table.shape
    actions, log_probs = torch.zeros(number, LENGTH, dtype=torch.long), torch.zeros(number, LENGTH, dtype=torch.double)
    condition = torch.randint(conditions, (number,), generator=generator)
    actions[:, 0] = torch.randint(kinds, (number,), generator=generator)
    log_probs[:, 0] = -log(kinds)
    belief = torch.full((number, conditions), 1 / conditions, dtype=torch.double)
    for t in range(1, LENGTH):
        other = torch.randint(conditions, (number,), generator=generator)
        condition = torch.where(torch.rand(number, generator=generator) < SWITCH, other, condition)
        actions[:, t] = torch.multinomial(table[condition, actions[:, t - 1]], 1, generator=generator)[:, 0]
        belief = (1 - SWITCH) * belief + SWITCH / conditions
        joint = belief * table[:, actions[:, t - 1], actions[:, t]].T
        log_probs[:, t] = joint.sum(1).log()
        belief = joint / joint.sum(1, keepdim=True)
    return Plans(actions, kinds), log_probs


def text(generator: torch.Generator) -> Plans:
    """Python's own documentation (`pydoc_data`), in lower case: parts of `LENGTH` characters, shuffled."""
    whole = re.sub(r"\s+", " ", " ".join(topics.topics.values()).lower())
    number_of = {character: number for number, character in enumerate(CHARACTERS)}
    numbers = torch.tensor([number_of[character] for character in whole if character in number_of])
    parts = numbers[: len(numbers) // LENGTH * LENGTH].view(-1, LENGTH)
    order = torch.randperm(len(parts), generator=generator)
    return Plans(parts[order], len(CHARACTERS), action_names=tuple(CHARACTERS))
