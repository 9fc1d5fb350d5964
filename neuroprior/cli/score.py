"""`neuroprior score`: how probable plans are under a saved prior."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console

from neuroprior._folders import claim, claim_out
from neuroprior.behaviour.analysis.comparison import score_bits, too_few, unit_name
from neuroprior.behaviour.durations.past_durations import PastDurations
from neuroprior.behaviour.recorded_plans import RecordedPlans, group_names
from neuroprior.behaviour.reporting.document import printed, table, write_frames
from neuroprior.behaviour.reporting.options import ReadOptions, is_recording, name_files
from neuroprior.plans.columns import listed
from neuroprior.priors import load
from neuroprior.priors.matching import learned_names, match_plans, numbered_note, taken_note, with_contexts_of
from neuroprior.priors.scoring import LONG_ENOUGH, are_among, bits_after, learned_from, plan_digests, scores_by

UNITS = ("plan", "group", "condition")
"""What has a table of its own, if the plans have it."""

MOST_ROWS = 20
"""Rows that are printed; the CSV files have all."""


@claim_out
def score(
    folder: str,
    files: list[str],
    out: str = "runs/score",
    past: list[str] | None = None,
    reading: ReadOptions = ReadOptions(),  # noqa: B008
) -> None:
    """Score plans under a saved prior: log-likelihood and bits per action, of each plan and each group.

    A prior predicts the plans that it has learned from better than new ones; those of them that are scored are marked.

    Args:
        folder: a saved prior, as `neuroprior fit` writes it.
        files: of behaviour (see `neuroprior.behaviour.read`), or of plans: `.npz`, `.jsonl`, or `minari:` and the name
            of a Minari dataset.
        past: files of what the same subjects did before; a prior that learns along a sequence begins with it.
        out: folder for `plans.csv` and, where there are any, `groups.csv` and `conditions.csv`.
        reading: how files are read.
    """
    prior, place = load(folder), Path(out)
    action_names, durations = learned_names(prior), PastDurations.load(Path(folder))

    def read(paths: list[str]) -> tuple[RecordedPlans, RecordedPlans, list[str]]:
        """The plans of files, the same as the prior numbers them, and notes."""
        tabular = is_recording(paths)
        # Numbers in a table are the prior's own; its names make sure that there are as many.
        plans = replace(reading, action_names=reading.action_names or (action_names if tabular else None)).read(paths)
        plans = plans if plans.end is None else plans.without_end()
        plans, notes = with_contexts_of(prior, plans, tabular)
        matched = match_plans(plans, prior, folder)
        return plans, matched if durations is None else durations.added_to(matched), notes

    if past is not None and (twice := {Path(one).resolve() for one in files} & {Path(one).resolve() for one in past}):
        raise ValueError(f"`past` must hold other files than those that are scored, got {min(twice)}.")
    plans, matched, notes = read(files)
    earlier = None
    if past is not None:
        before, earlier, more = read(past)
        notes += [f"{name_files(past)}: {note}" for note in (*before.notes, *more, *_on_past(plans, before))]
    units = [by for by in UNITS if by == "plan" or getattr(plans, by) is not None]
    with claim(place) as claimed:
        claimed.check(f"{by}s.csv" for by in units)
    bits = bits_after(prior, matched, earlier)
    whole = score_bits(folder, "", bits, matched).bits_per_action()
    learned = learned_from(Path(folder), plans)
    frames = {f"{by}s": scores_by(bits, plans, by, learned) for by in units}
    name = "groups" if "groups" in frames else "plans"
    frame = frames[name]
    first = {name[:-1]: name[:-1]} | ({"plans": "plans:,"} if name == "groups" else {})
    first |= {"recording": "recording"} if "recording" in frame else {}
    numbers = {
        "actions": "actions:,",
        "log-likelihood (nats)": "log_likelihood:.2f",
        "bits per action": "bits_per_action:.4f",
    }
    caption = f"the first {MOST_ROWS} of {len(frame):,}; all are in the CSV file. " if len(frame) > MOST_ROWS else ""
    if any(learned):
        caption += (
            f"Training data: {sum(learned):,} of {len(learned):,} plans are plans that it has learned from, at least in"
            " part."
        )
    notes = [*plans.notes, *notes]
    if plans.action_names and reading.action_names is None and prior.action_names is None:
        notes.append(f"{numbered_note('actions', plans.action_names)}; --action_names orders them")
    if plans.action_names is None and action_names is not None:
        notes.append(taken_note("actions", action_names))
    console = Console(markup=False, emoji=False)
    for note in notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    after = "" if past is None else f" after {name_files(past)}"
    console.print(
        printed(f"{name_files(files)}{after} under {folder}", table(frame.head(MOST_ROWS), first | numbers, caption))
    )
    interval = f"95 % interval {whole.low:.4f} to {whole.high:.4f} over {unit_name(plans)}"
    few = too_few(plans)
    console.print(f"{whole.mean:.4f} bits per action, {interval}{few and f'; {few}'}", highlight=False)
    write_frames(place, frames)
    console.print(
        f"tables: {', '.join(str(place / f'{name}.csv') for name in frames)}", highlight=False, soft_wrap=True
    )


def _on_past(plans: RecordedPlans, before: RecordedPlans) -> list[str]:
    """Return notes on sequences that are scored after themselves, and on subjects without a past."""
    notes = []
    if again := sum(are_among(plans, {*plan_digests(before)}, LONG_ENOUGH)):
        notes.append(f"{again:,} of {len(plans):,} scored plans are in it, too: their bits are too low")
    if plans.group is not None and before.group is not None:
        subjects, past_subjects = (
            set(group_names(each, group)) for each, group in ((plans, plans.group), (before, before.group))
        )
        if alone := sorted(subjects - past_subjects):
            notes.append(f"{len(alone)} of {len(subjects)} subjects are not in it, and scored alone: {listed(alone)}")
    return notes
