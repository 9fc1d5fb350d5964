"""Small seeded sources that the cases share."""

from collections.abc import Sequence
from typing import Any, Literal

import torch

from neuroprior.behaviour.recorded_plans import RecordedPlans
from neuroprior.plans import Plans
from tests.support.sources import seeded


def behaviour(
    num: int = 24,
    longest: int = 14,
    num_actions: int = 3,
    context: Literal["plan", "step", "features"] | None = None,
    seed: int = 0,
    **more: Any,
) -> Plans:
    """Plans of unequal lengths whose actions depend on the last two and on the context: one of three, or features.

    There are six groups of unlike sizes.
    """
    generator = seeded(seed)
    table = 1.5 * torch.randn(3, num_actions, num_actions, num_actions, generator=seeded(100))
    place = torch.randint(3, (num, longest), generator=generator)
    place = place if context in ("step", "features") else place[:, :1].expand(-1, longest)
    seen = place if context is not None else torch.zeros_like(place)
    actions = torch.randint(num_actions, (num, longest), generator=generator)
    for t in range(2, longest):
        probs = table[seen[:, t], actions[:, t - 2], actions[:, t - 1]].softmax(-1)
        actions[:, t] = torch.multinomial(probs, 1, generator=generator)[:, 0]
    lengths = torch.randint(2, longest + 1, (num,), generator=generator)
    given = {None: None, "plan": place[:, 0], "step": place, "features": torch.stack([place / 2, 1 - place], -1)}
    group = torch.arange(num).sqrt().long().clamp(max=5)
    return Plans(actions, num_actions, lengths, context=given[context], group=group, **more)


def timed(num: int = 24, longest: int = 14, seed: int = 0, names: Sequence[str] = ("eat", "groom", "rest")) -> Plans:
    """The same with durations of unlike laws; one is not known, and action 0 takes longer before action 1."""
    plans = behaviour(num, longest, len(names), seed=seed, action_names=names)
    generator, actions = seeded(seed + 1), plans.actions.long()
    normal, uniform = torch.randn(actions.shape, generator=generator), torch.rand(actions.shape, generator=generator)
    times = torch.where(actions == 1, (0.5 * normal + 0.3).exp(), -2 * uniform.log() * (1 + actions))
    times[:, :-1] *= 1 + 2 * ((actions[:, :-1] == 0) & (actions[:, 1:] == 1))
    times[0, 1], times[-1, 0] = torch.nan, 0
    more = {"durations": times, "recording": [f"session {number}" for number in range(num)]}
    condition = (plans.group % 2).long()
    return RecordedPlans(
        plans.actions, len(names), plans.lengths, names, group=plans.group, condition=condition,
        condition_names=("control", "treated"), group_names=[f"mouse {number}" for number in range(1, 7)], **more
    )  # fmt: skip
