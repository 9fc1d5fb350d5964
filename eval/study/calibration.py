"""`python -m eval calibration`: do tests hold 5 % and intervals cover 95 %, in studies of many designs?"""

from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveInt

from eval.study.command import Batch
from neuroprior._folders import claim_out
from neuroprior._jobs import JobRun
from neuroprior._statistics import LEVEL
from neuroprior.behaviour import (
    RecordedPlans,
    action_bits,
    by_group,
    by_plan,
    by_position,
    compare_conditions,
    duration_survival,
    how_far_back,
    individual_types,
    motifs,
    rate_drift,
    score,
    share_interval,
    transitions,
)
from neuroprior.behaviour.reporting.document import Document, publish, table
from neuroprior.behaviour.reporting.page import Section, Table
from neuroprior.priors import MarkovPrior

BEHAVIOURS = 4
SESSIONS = 2
LENGTH = 60
"""Behaviours in the longest sessions."""

BURN_IN = 40
"""Behaviours before the session begins, so that none drifts."""

SPREAD = 0.25
"""Standard deviation, over subjects, of the logits of transitions and of the logarithms of durations."""

ORDER_2_SPREAD = 0.6
"""Standard deviation of the logits of what follows two behaviours, where the source is of order 2."""

STAY = 0.95
"""The probability that a hidden mode goes on."""

MODE_ODDS = 2.0
"""Logarithm of how much commoner two of the behaviours are in one of two modes."""

EFFECT = 1.0
"""Logarithm of how much commoner, and how much longer, behaviour 1 is after behaviour 0 under a treatment."""

TOGETHER = 20
"""Studies of one job."""

MANY, REPEATED = 150, 40
"""Subjects of the studies whose estimates are taken for the truth, and how many such studies there are."""


@dataclass(frozen=True)
class Design:
    """How a study is drawn.

    Attributes:
        subjects: how many; a third is treated, rounded up.
        spread: see `SPREAD`.
        ratio: the longest sessions of a subject are so many times as long as the shortest.
        treated_ratio: sessions of treated subjects are shorter by so many times.
        repeats: the probability that a behaviour is repeated.
        order_2, modes: whether what is done next depends on two behaviours, or on a hidden mode.
    """

    subjects: int = 12
    spread: float = SPREAD
    ratio: float = 1.0
    treated_ratio: float = 1.0
    repeats: float = 0.0
    order_2: bool = False
    modes: bool = False


DESIGNS = {
    "6 subjects": Design(6),
    "12 subjects": Design(),
    "40 subjects": Design(40),
    "12 equal subjects": Design(spread=0.0),
    "sessions differ tenfold": Design(ratio=10.0),
    "groups differ tenfold": Design(18, treated_ratio=10.0),
    "90 % repeats": Design(repeats=0.9),
    "order 2": Design(order_2=True),
    "hidden modes": Design(modes=True),
}


def draw_study(design: Design, effect: bool, seed: int) -> RecordedPlans:
    """Return two sessions of each subject, in turn, as sequences with durations, subjects and conditions."""
    random = np.random.default_rng(seed)
    size, number = BEHAVIOURS, design.subjects
    usual = np.random.default_rng(1)  # the same in all studies
    logits = usual.standard_normal((size, size)) * 0.7
    of_two = usual.standard_normal((size, size, size)) * ORDER_2_SPREAD * design.order_2
    logits = logits + design.spread * random.standard_normal((number, size, size))
    treated = random.permutation(number) < -(-number // 3)
    logits[:, 0, 1] += EFFECT * effect * treated
    shape = (number, SESSIONS, LENGTH)
    actions = np.zeros(shape, np.int64)
    drawn, repeated = random.random((2, number, SESSIONS, LENGTH + BURN_IN))
    mode = random.random(shape[:2]) < 0.5
    favoured = np.where(np.arange(size) < size // 2, MODE_ODDS, 0.0) * design.modes
    subject = np.arange(number)[:, None]
    last = before = random.integers(size, size=shape[:2])
    for step in range(-BURN_IN, LENGTH):
        mode ^= random.random(shape[:2]) > STAY
        odds = logits[subject, last] + of_two[before, last] + np.where(mode[..., None], favoured, favoured[::-1])
        chances = np.exp(odds).cumsum(-1)
        chosen = (chances < drawn[..., step, None] * chances[..., -1:]).sum(-1)
        before, last = last, np.where(repeated[..., step] < design.repeats, last, chosen)
        if step >= 0:
            actions[..., step] = last
    lengths = LENGTH * design.ratio ** -random.random(shape[:2])
    lengths = np.ceil(lengths / np.where(treated, design.treated_ratio, 1.0)[:, None]).clip(min=2).astype(np.int64)
    medians = np.exp(design.spread * random.standard_normal((number, 1, size)) + np.arange(size) / 4)
    medians[treated, :, 1] *= np.exp(EFFECT * effect)
    durations = np.take_along_axis(np.broadcast_to(medians, (number, SESSIONS, size)), actions, -1)
    durations = durations * np.exp(0.5 * random.standard_normal(shape))
    within = np.arange(LENGTH) < lengths[..., None]
    return RecordedPlans(
        torch.from_numpy(np.where(within, actions, 0)).flatten(0, 1),
        size,
        lengths=torch.from_numpy(lengths).flatten(),
        group=torch.arange(number).repeat_interleave(SESSIONS),
        condition=torch.from_numpy(treated).long().repeat_interleave(SESSIONS),
        condition_names=("saline", "drug"),
        durations=torch.from_numpy(np.where(within, durations, 0.0)).flatten(0, 1).float(),
    )


@lru_cache
def fixed_chain(order: int) -> MarkovPrior:
    """Return a chain whose bits are scored: it has learned from another study."""
    return MarkovPrior(BEHAVIOURS, order).fit(draw_study(Design(100), False, 10**6))


def p_values(plans: RecordedPlans, permutations: int, generator: torch.Generator) -> dict[str, float]:
    """Return the p-value of each test: of its smallest corrected one, where it has several."""
    bits, mask = action_bits(fixed_chain(1), plans), plans.mask()
    after_first = mask & (torch.arange(LENGTH) > 0)  # which is harder to predict
    within, between = (
        transitions(plans, permutations, generator),
        transitions(plans, permutations, generator, by="condition"),
    )
    conditions = compare_conditions(plans, permutations, generator)
    survival = duration_survival(plans, permutations, generator)
    apart = bits.masked_fill(~mask, 0).sum(1).div(mask.sum(1))
    by_test = {
        "transitions, of subjects": within.p_value,
        "transitions, of conditions": between.p_value,
        "transitions, any cell": _least(between.cell_p_values),
        **{f"conditions, {name}": corrected for name, (_, corrected) in conditions.tests.items()},
        "conditions, any": conditions.p_value,
        "survival, any": min((corrected for _, corrected in survival.tests.values()), default=np.nan),
        "motifs": min((one.corrected for one in motifs(plans, (3,))), default=np.nan),
        "drift, any": float(np.nanmin(rate_drift(plans).corrected)),
        "trend in sequences": by_position(plans, bits, after_first).trend.p_value,
        "lag 2": float(how_far_back(plans, 2).corrected[1]),
        "types": 0.0 if plans.group is not None and individual_types(plans, generator).number > 1 else 1.0,
    }
    if (order := by_plan(plans, bits, mask).trend) is not None:
        by_test["trend over sequences"] = order.p_value
    if (differ := by_group(plans, bits, mask).p_value) is not None and bool(apart.isfinite().all()):
        by_test["bits, of subjects"] = differ
    return by_test


def intervals(plans: RecordedPlans, permutations: int, generator: torch.Generator) -> dict[str, tuple[float, ...]]:
    """Return estimates, each with the ends of its interval."""
    prior, mask = fixed_chain(1), plans.mask()
    bits, after_first = action_bits(prior, plans), mask & (torch.arange(LENGTH) > 0)
    within, conditions = transitions(plans, 1, generator), compare_conditions(plans, permutations, generator)
    between = transitions(plans, 1, generator, by="condition")
    estimates = {f"transition 0 to {to}": _cell(within, 0, to) for to in (1, 3)}
    estimates["transition 0 to 1, treated"] = _cell(between, 2, 1)
    for family, feature in (("behaviours", (1,)), ("transitions", (0, 1)), ("durations", (1,))):
        for one in conditions.families:
            at = [place for place, parts in enumerate(one.features.tolist()) if tuple(parts) == feature]
            if one.name == family and at:
                estimates[f"difference, {family}"] = tuple(one.difference[:, at[0]].tolist())
                estimates[f"treated, {family}"] = tuple(
                    float(ends[1, at[0]]) for ends in (one.means, one.low, one.high)
                )
    survival = duration_survival(plans, permutations, generator)
    if "1" in survival.ratios:
        estimates["survival, times as long"] = tuple(survival.ratios["1"])
    curve = survival.curves["1", "saline"]
    late = int(np.searchsorted(curve.time, 1.5)) - 1
    estimates["survival after 1.5 s"] = (float(curve.survival[late]), float(curve.low[late]), float(curve.high[late]))
    for motif in motifs(plans, (3,)):
        if motif.actions in ((0, 1, 2), (1, 1, 1)):
            estimates["motif " + " ".join(map(str, motif.actions))] = (motif.ratio, motif.low, motif.high)
    drift = rate_drift(plans)
    estimates["drift of behaviour 0"] = drift.changes[list(drift.behaviours).index("0")][:3]
    chain_score = score("chain", prior, plans)
    estimates["bits of a chain"] = chain_score.bits_per_action()[:3]
    estimates["bits less than another's"] = chain_score.minus(score("shares", fixed_chain(0), plans))[:3]
    estimates["trend in sequences"] = by_position(plans, bits, after_first).trend[:3]
    return estimates


def _cell(result: Any, group: int, to: int) -> tuple[float, ...]:
    probs = torch.cat([result.probs()[None], result.group_probs()])
    return tuple(float(values[group, 0, to]) for values in (probs, result.low, result.high))


def _least(values: torch.Tensor) -> float:
    finite = values[~values.isnan()]
    return float(finite.min()) if len(finite) else np.nan


@claim_out
def calibration(
    studies: PositiveInt = 1000,
    permutations: PositiveInt = 199,
    seed: NonNegativeInt = 0,
    processes: PositiveInt | None = None,
    dask: str | None = None,
    out: str = "runs/calibration",
) -> None:
    """Whether tests hold 5 % and intervals cover 95 %, in simulated studies of many designs.

    Args:
        studies: of each design, as many without an effect of the treatment as with one; rounded up to a multiple of 20.
        permutations: random ones of each test.
        seed: of the first study; the others follow.
        processes: how many run at a time; all cores by default.
        dask: address of a Dask scheduler; None: this machine.
        out: folder for tables (CSV), `results.json` and `report.html`.
    """
    numbers = {"studies": studies, "permutations": permutations, "seed": seed}
    truths = JobRun(true_values, Path(out) / "jobs", {"truth": [MANY, REPEATED]})
    of_truth = [Batch(design, effect, 0) for design in DESIGNS for effect in (False, True)]
    truth = dict(zip(of_truth, truths.do(of_truth, processes=processes, dask=dask, title="true values"), strict=True))
    run = JobRun(
        partial(calibrated, permutations, seed), Path(out) / "jobs", {"permutations": permutations, "seed": seed}
    )
    jobs = [
        Batch(design, effect, number)
        for number in range(-(-studies // TOGETHER))
        for design in DESIGNS
        for effect in (False, True)
    ]
    results = run.do(jobs, processes=processes, dask=dask, title="studies")
    rows = []
    for job, job_results in zip(jobs, results, strict=True):
        for kind, name, *values in job_results:
            labels = {"design": job.design, "effect": job.effect, "kind": kind, "name": name}
            if kind == "test":
                rows.append(labels | {"hit": values[0] is not None and values[0] <= LEVEL})
            elif (true := truth[Batch(job.design, job.effect, 0)].get(name)) is not None:
                rows.append(labels | {"hit": values[1] is None or values[2] is None or values[1] <= true <= values[2]})
    frame = pd.DataFrame(rows).groupby(["kind", "name", "effect", "design"], sort=False)["hit"].agg(["sum", "size"])
    shares = [share_interval(int(hits), int(size)) for hits, size in frame.to_numpy()]
    columns = {"studies": frame["size"].to_numpy(), "share": [one.mean for one in shares]}
    columns |= {"low": [one.low for one in shares], "high": [one.high for one in shares]}
    result = pd.DataFrame(columns, index=frame.index).reset_index()
    sections = [
        Section("Tests without an effect", tables=[_table(result, "test", False)]),
        Section("Tests with an effect", tables=[_table(result, "test", True)]),
        Section("Intervals without an effect", tables=[_table(result, "interval", False)]),
        Section("Intervals with an effect", tables=[_table(result, "interval", True)]),
    ]
    about = f"{studies} studies of each design, without and with an effect"
    publish(Document("Calibration", about, sections, {"shares": result}, numbers, keys={"shares": "rows"}), Path(out))


def true_values(batch: Batch) -> dict[str, float]:
    """Return the mean estimates of studies of many subjects."""
    design = Design(**vars(DESIGNS[batch.design]) | {"subjects": MANY})
    estimates = []
    for number in range(REPEATED):
        plans = draw_study(design, batch.effect, 10**7 + number)
        values = intervals(plans, 1, torch.Generator().manual_seed(number))
        estimates.append({name: estimate for name, (estimate, *_) in values.items()})
    return {str(name): float(mean) for name, mean in pd.DataFrame(estimates).mean().items()}


def calibrated(permutations: int, seed: int, batch: Batch) -> list[tuple[Any, ...]]:
    """Return the p-values and the intervals of each study of a batch."""
    rows: list[tuple[Any, ...]] = []
    for number in range(batch.number * TOGETHER, (batch.number + 1) * TOGETHER):
        plans = draw_study(DESIGNS[batch.design], batch.effect, seed + number)
        generator = torch.Generator().manual_seed(number)
        rows += [("test", name, value) for name, value in p_values(plans, permutations, generator).items()]
        rows += [("interval", name, *values) for name, values in intervals(plans, 1, generator).items()]
    return rows


def _table(result: pd.DataFrame, kind: str, effect: bool) -> Table:
    """The shares of one kind in %: a row for each test or interval, a column for each design."""
    chosen = result[(result["kind"] == kind) & (result["effect"] == effect)]
    rows = [
        {kind: name} | dict(zip(of_name["design"], map(_share, of_name.itertuples()), strict=True))
        for name, of_name in chosen.groupby("name", sort=False)
    ]
    columns: dict[str, Any] = dict(zip([kind, *DESIGNS], [kind, *DESIGNS], strict=True))
    about = "p ≤ .05" if kind == "test" else "intervals that hold the true value"
    caption = f"Share of studies, in %: {about}. !: more than 5 % of alarms, or less than 95 % covered, beyond chance."
    return table(pd.DataFrame(rows).fillna(""), columns, caption, align="l" + "r" * len(DESIGNS))


def _share(row: Any) -> str:
    """The share in %, marked where its own interval lies on the wrong side of what was promised."""
    broken = row.low > LEVEL if row.kind == "test" else row.high < 1 - LEVEL
    return f"{100 * row.share:.1f}{'!' if broken and (row.kind == 'interval' or not row.effect) else ''}"
