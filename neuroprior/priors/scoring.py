"""How probable plans are under a fitted prior, as a table; and whether the prior has learned from them.

`score` needs pandas (`pip install 'neuroprior[report]'`).
"""

import hashlib
import os
from math import log
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroprior._files import read_json, write_json
from neuroprior.plans import Plans
from neuroprior.priors.adaptive import adapt
from neuroprior.priors.learning import plans_for
from neuroprior.priors.matching import match_plans
from neuroprior.priors.prior import Prior
from neuroprior.priors.serialization import MODEL, digest, load

LONG_ENOUGH = 20
"""Actions from which on equal plans are thought to be the same one."""

LEARNED = "learned.json"
"""In the folder of a saved prior: the digests of the plans that it has learned from, at least in part."""


def score(prior: Prior | str | os.PathLike[str], plans: Plans, by: str = "plan", *, past: Plans | None = None) -> Any:
    """The log-likelihood of plans under a prior, summed by plan, by action, or by group.

    Args:
        prior: fitted; or the folder of a saved one, which knows the plans that it has learned from.
        plans: N of them; their actions and contexts are matched by name, where both have names (not in plans with the
            end symbol of the prior, see `match_plans`).
        by: what a row is: "plan", "action", "group", or what else a subclass of `Plans` has for each plan, such as
            "condition".
        past: earlier plans of the same groups, see `bits_after`; None: each plan stands alone.

    Returns:
        A pandas frame: `by`; `plans` and `actions`, how many (of a plan `actions` alone, its number, and its `group`
        and whatever else it has one of); `log_likelihood`, nats; `bits_per_action`. The likelihood of a plan's end,
        where the prior predicts it, counts for the plan, not for an action. With a folder, `training_data` says which
        plans the prior has learned from, at least in part (of a group: how many): their bits are too low.

    Raises:
        ValueError: the prior does not know the actions or contexts, plans have no groups, or see `bits_after`.

    Example:
        >>> plans = Plans(torch.tensor([[0, 1, 2], [2, 1, 0]]), 3, group=torch.tensor([0, 1]))
        >>> score(UniformPrior(3), plans, by="group")["bits_per_action"].round(3).tolist()
        [1.585, 1.585]
    """
    folder = None if isinstance(prior, Prior) else prior
    if isinstance(prior, str | os.PathLike):
        prior = load(prior)
    if not isinstance(prior, Prior):
        raise ValueError(
            "`prior` must be a fitted prior of numbered actions (neuroprior.load gives that of a folder), got"
            f" {type(prior).__name__}"
        )
    if past is not None and not isinstance(past, Plans):
        raise ValueError(f"`past` must be Plans, got {type(past).__name__}.")
    bits = bits_after(prior, match_plans(plans, prior), None if past is None else match_plans(past, prior))
    plans = plans if plans.end is None else plans.without_end()
    learned = None if folder is None else learned_from(Path(folder), plans)
    return scores_by(bits, plans, by, learned)


@torch.no_grad()
def bits_after(prior: Prior, plans: Plans, past: Plans | None = None) -> Tensor:
    """The bits of each action where the counts of a group, an individual, begin with its earlier plans.

    Args:
        prior: fitted; with `past` it learns along a sequence, see `neuroprior.priors.adapt`.
        plans: N of them, with groups; those of a group without earlier plans are scored alone.
        past: earlier plans; groups are the same by name, or by number where there are no names. None: there are none.

    Returns:
        `[N, L]`, float64, on the CPU; 0 beyond a plan's end.

    Raises:
        ValueError: plans without groups, no group in both, or a prior that does not learn along a sequence.
    """
    if past is None:
        return -prior.action_log_probs(plans_for(prior, plans)).double().cpu() / log(2)
    past = past[past.mask().any(1)]
    if plans.group is None or past.group is None:
        raise ValueError("`past` must have groups, as `plans` must: the individuals whose counts go on.")
    groups, earlier = (np.array(_names(each, "group"), dtype=object) for each in (plans, past))
    alone = torch.tensor([name not in set(earlier) for name in groups])
    if alone.all():
        of_plans, of_past = (", ".join(map(str, dict.fromkeys(names))) for names in (groups[:9], earlier[:9]))
        raise ValueError(f"`past` must hold plans of groups of `plans`, such as {of_plans}; got {of_past or 'none'}.")
    bits = torch.zeros(plans.actions.shape, dtype=torch.double)
    bits[alone] = bits_after(prior, plans[alone])
    for name in dict.fromkeys(groups[~alone.numpy()]):
        rows, before = (torch.from_numpy(names == name) for names in (groups, earlier))
        bits[rows] = bits_after(adapt(prior, past[before]), plans[rows])
    return bits


def scores_by(bits: Tensor, plans: Plans, by: str, learned: list[bool] | None = None) -> Any:
    """The frame of `score` from the bits `[N, L]`, or `[N, L + 1]` with those of a plan's end, of each action.

    `learned` says which of the N plans the prior has learned from.
    """
    import pandas as pd

    units = ("plan", "action", *_units_of(plans))
    if by not in units:
        raise ValueError(f"`by` must be one of {', '.join(units)}, got {by!r}")
    if by in units[2:] and getattr(plans, by) is None:
        raise ValueError(f"by: the plans have no {by}")
    mask = plans.mask()
    if by == "action":
        names = plans.action_names or tuple(map(str, range(plans.num_actions)))
        data = {"action": plans.actions[mask].tolist(), "plan": mask.nonzero()[:, 0].tolist()}
        frame = pd.DataFrame(data | {"bits": bits[:, : plans.max_length][mask].tolist()}).groupby("action")
        scores = frame.agg(plans=("plan", "nunique"), actions=("plan", "size"), bits=("bits", "sum")).reset_index()
        scores["action"] = [names[action] for action in scores["action"]]
    else:
        numbers = {"training_data": learned} if learned is not None else {}
        numbers |= {"actions": mask.sum(1).tolist(), "bits": bits.sum(1).tolist()}
        scores = plan_frame(plans).assign(**numbers)
        if by != "plan":
            sums = scores.groupby(by, sort=False, as_index=False)
            scores = sums.agg(plans=("plan", "size"), **{name: (name, "sum") for name in numbers})
    scores["log_likelihood"] = -log(2) * scores["bits"]
    scores["bits_per_action"] = scores["bits"] / scores["actions"].where(scores["actions"] > 0)
    return scores.drop(columns="bits")


def plan_frame(plans: Plans) -> Any:
    """A pandas frame with a row a plan: its number `plan`, its `group` and whatever else it has one of, by name."""
    import pandas as pd

    columns = {what: _names(plans, what) for what in _units_of(plans) if getattr(plans, what) is not None}
    return pd.DataFrame({"plan": range(len(plans))} | columns)


def _units_of(plans: Plans) -> list[str]:
    """What each plan can have one of."""
    return [what for what in plans.PER_PLAN if what != "lengths"]


def _names(plans: Plans, what: str) -> list[Any]:
    """The group of each plan, say, by name where it has one."""
    values, names = getattr(plans, what), getattr(plans, f"{what}_names", None)
    numbers = values.tolist() if isinstance(values, Tensor) else values
    return [number if names is None else names[number] for number in numbers]


def plan_digests(plans: Plans) -> list[str]:
    """A digest of the actions of each plan without its end, by their names if they have any: equal for equal plans."""
    plans = plans if plans.end is None else plans.without_end()
    names = plans.action_names or tuple(map(str, range(plans.num_actions)))
    rows = zip(plans.actions.tolist(), plans.mask().sum(1).tolist(), strict=True)
    texts = ("\0".join(names[action] for action in row[:length]) for row, length in rows)
    return [hashlib.sha256(text.encode()).hexdigest()[:16] for text in texts]


def keep_learned(
    folder: Path, *parts: Plans, model: bytes | None = None, held_out: Plans | None = None, plans: Plans | None = None
) -> None:
    """Write down, in the folder of a saved prior, which plans it has learned from.

    Args:
        folder: of the prior.
        parts: what it has learned from.
        model: its file, which is written to the folder next; None: the one that is there.
        held_out: what it has not learned from.
        plans: those that all this was taken from; of a plan that was cut, and so is in no part, a part was learned.
    """
    learned = {one for subset in parts for one in plan_digests(subset)}
    if plans is not None:
        learned |= {*plan_digests(plans)} - {*(() if held_out is None else plan_digests(held_out))}
    model = (folder / MODEL).read_bytes() if model is None else model
    write_json(folder / LEARNED, {"model": digest(model), "plans": sorted(learned)})


def is_learned(folder: Path) -> bool:
    """Whether the prior in a folder is that of `keep_learned`; else there is none, or another one was saved there.

    Raises:
        ValueError: the file is damaged.
    """
    return _read_learned(folder) is not None


def learned_from(folder: Path, plans: Plans) -> list[bool]:
    """Which plans the prior saved in a folder has learned from, at least in part; none where it is not known.

    Plans are known by their actions; those without any are never among them.

    Raises:
        ValueError: the file is damaged.
    """
    return are_among(plans, _read_learned(folder) or set())


def _read_learned(folder: Path) -> set[str] | None:
    """The digests of the plans that the prior in a folder has learned from; None where they are not known."""
    place = folder / LEARNED
    if not place.is_file():
        return None
    content = read_json(place)
    digests = content.get("plans") if isinstance(content, dict) else None
    if not isinstance(digests, list) or not all(isinstance(one, str) for one in digests):
        raise ValueError(f"{place}: damaged; it does not say which plans were learned from")
    model = folder / MODEL
    return set(digests) if model.is_file() and digest(model.read_bytes()) == content.get("model") else None


def are_among(plans: Plans, digests: set[str], least: int = 1) -> list[bool]:
    """Which plans, of at least so many actions, are among those with these digests."""
    long = (plans.mask().sum(1) >= least).tolist()
    return [counts and digest in digests for digest, counts in zip(plan_digests(plans), long, strict=True)]
