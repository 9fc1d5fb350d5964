"""Recipes of `fit`: where those that come with the package are, and their sections `data` and `model`."""

from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Literal

import torch
import yaml

from neuroprior.planners import Planner, collect
from neuroprior.plans import Plans, read_plans
from neuroprior.plans.columns import Columns, Missing
from neuroprior.plans.folds import fair_split, longest_cut, num_units, ungrouped
from neuroprior.plans.past_durations import PastDurations
from neuroprior.priors import Prior
from neuroprior.priors.fitting import make_prior
from neuroprior.priors.prior import context_arguments
from neuroprior.training import PlansModule, PriorModule, Settings
from neuroprior.worlds import World

PARTS, LEAST_ACTIONS = 3, 2
"""Parts that plans are split into, and the fewest actions of each."""

FEW_GROUPS, FOLDS = 15, 5
"""Groups below which the comparison is a cross-validation, as a tenth of them would be one; and its folds."""

LONG = 100
"""Two plans or groups are enough if each has so many actions; validation then takes some of the plans, or the end of
the longest.
"""

MOST_INDICES = 2**20
"""Actions or contexts beyond which indices are taken for names that look like numbers."""


def recipes() -> dict[str, Path]:
    """The recipes that come with the package, by name: from the wheel, or from `train/` in a checkout."""
    shipped = Path(str(files("neuroprior.cli"))) / "recipes"
    folder = shipped if shipped.is_dir() else Path(__file__).parents[2] / "train"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def recipe_path(name: str) -> str:
    """The file of a recipe that is given by its path or its name.

    Raises:
        ValueError: there is neither a file nor a recipe of this name, or the file is no YAML.
    """
    known = recipes()
    if not Path(name).is_file() and name not in known:
        raise ValueError(f"config: no file {name!r}, and no recipe of this name; the recipes are {', '.join(known)}")
    path = Path(name) if Path(name).is_file() else known[name]
    try:
        whole = isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict)
    except (yaml.YAMLError, UnicodeDecodeError):
        whole = False
    if not whole:
        raise ValueError(f"config: {name} is no recipe: YAML with sections model, data and trainer is expected")
    return str(path)


class PlansData(PlansModule):
    """Plans to learn from, for early stopping and choices (validation), and for the table at the end (held out).

    Args:
        file: plans to learn from: `.npz`, `.jsonl` or `.csv`, or `minari:` and the name of a Minari dataset.
        num_actions: number of actions, where the file does not say.
        action_names: names of the actions in the order of their numbers, where the file does not say.
        columns: which columns of a CSV file hold what: action, plan, context, group, condition, start, stop, duration,
            event_type; `--columns.action` is short for `--data.columns.action`, and so on.
        missing: what rows without a label do: a gap ends the plan; as label they count as an action; or error.
        merge_repeats: take the same label in successive rows for one action, as in files with a row a frame.
        max_gap: a longer pause between two actions ends the plan, too; in the unit of the starts.
        world: where plans are collected if no file is given, such as `neuroprior.worlds.gridworld`.
        planner: that chooses them, such as `ExhaustivePlanner`.
        num_plans: how many are collected.
        context: the world's observations as context: none, that at the start, or that before each action.
        past_durations: how many of the last actions' durations are a context of each action (features, for gru and
            transformer); 0 for none.
        end: close each plan with a symbol for its end, so that the prior learns how long plans are.
        validation: share of plans (of groups, where there are any) for early stopping and the choice of baselines.
        held_out: share of plans (or groups) for the table at the end; nothing is learned or chosen on them.
        folds: of a cross-validation over groups (over plans without groups), in place of a held-out share: the prior
            and the baselines are fitted once more for each fold, for the table alone, and the prior that is saved
            learns from all plans. null: 5 with fewer than 15 groups, 2 with two plans, else 1, which holds out a share.
        batch_size: plans a step (pieces of plans, where they are longer than a window); null for as many as have about
            2,048 actions.
        window: actions that a step reads of a plan; longer plans are read in windows, the hidden state carried over.
        check_every: steps between two validations; null for two passes through the plans, but at least 10 and at most
            100.
        max_steps: steps of training; null for 1,000 with plans of up to 32 actions, else for 50 passes through the
            plans, but 1,000 to 4,000 steps.
        seed: draws the collected plans, the split and the order of training.
    """

    def __init__(
        self,
        file: str | None = None,
        num_actions: int | None = None,
        action_names: list[str] | None = None,
        columns: Columns | None = None,
        missing: Missing = "gap",
        merge_repeats: bool = False,
        max_gap: float | None = None,
        world: World | None = None,
        planner: Planner | None = None,
        num_plans: int = 10_000,
        context: Literal["plan", "step"] | None = None,
        past_durations: int = 0,
        end: bool = False,
        validation: float = 0.1,
        held_out: float = 0.1,
        folds: int | None = None,
        batch_size: int | None = None,
        window: int = 128,
        check_every: int | None = None,
        max_steps: int | None = None,
        seed: int = 0,
    ) -> None:
        for name, share in (("validation", validation), ("held_out", held_out)):
            if not 0 < share < 1:
                raise ValueError(f"data.{name}: a share between 0 and 1 is expected, not {share}")
        if validation + held_out >= 1:
            raise ValueError(f"data: validation and held_out leave nothing to learn from: {validation} + {held_out}")
        if past_durations < 0:
            raise ValueError(f"data.past_durations: at least 0 is expected, not {past_durations}")
        settings = Settings(max_steps, batch_size, window, check_every=check_every)
        if file is not None:
            self.source = read_plans(
                file,
                num_actions=num_actions,
                action_names=action_names,
                columns=columns,
                missing=missing,
                merge_repeats=merge_repeats,
                max_gap=max_gap,
            )
        elif world is not None and planner is not None:
            generator = torch.Generator().manual_seed(seed)
            self.source = collect(planner, world, num_plans, context=context, generator=generator)
        else:
            raise ValueError("data: give either --data.file, or both --data.world and --data.planner")
        _check_indices("action", self.source.num_actions)
        self.plans = _in_parts(self.source.with_end() if end and self.source.end is None else self.source)
        self.num_contexts = context_arguments(self.plans).get("num_contexts")
        _check_indices("context", self.num_contexts or 0)
        # Seeded anew, so that collected plans are split in the same way when they come from the run's own copy.
        generator = torch.Generator().manual_seed(seed)
        self.folds = _folds(self.plans, folds)
        rest, share = self.plans, validation
        self.held_out = self.plans
        if self.folds == 1:
            rest, self.held_out = fair_split(self.plans, held_out, generator)
            share = validation / (1 - held_out)
        two = num_units(self.plans) == 2 and rest is self.plans
        self.learned_from, self.chosen_on = (_split_two if two else fair_split)(rest, share, generator)
        for name, part in (("validation", self.chosen_on), ("held_out", self.held_out)):
            if int(part.mask().sum()) < LEAST_ACTIONS:
                raise ValueError(
                    f"data.{name}: too few actions are left for it, {int(part.mask().sum())}; more plans are needed"
                )
        self.past_durations: PastDurations | None = None
        if past_durations:
            self.past_durations = past = PastDurations.of(self.learned_from, past_durations)
            self.plans, self.held_out = past.added_to(self.plans), past.added_to(self.held_out)
            self.learned_from, self.chosen_on = past.added_to(self.learned_from), past.added_to(self.chosen_on)
            self.num_contexts = None
        super().__init__(self.learned_from, self.chosen_on, settings, seed)
        self.given = replace(settings, validation=validation)


class PriorModel(PriorModule):
    """The prior to be trained.

    Args:
        prior: its class, such as `GRUPrior`; its other arguments go below it (`--model.prior.hidden_size 128`). The
            number of actions and of contexts come from the plans.
        use_context: whether it takes the context of the plans, where they have one.
        learning_rate: of AdamW, after the first tenth of the steps; it falls to 0 with half a cosine.
        weight_decay: of AdamW.
        data: the plans.

    Raises:
        ValueError: the prior cannot take the context of the plans, or an argument is out of range.
    """

    prior: Prior

    def __init__(
        self,
        prior: Callable[[int], Prior],
        use_context: bool = True,
        learning_rate: float = 5e-3,
        weight_decay: float = 0.01,
        data: PlansData | None = None,
    ) -> None:
        assert data is not None
        try:
            made = make_prior(data.plans, prior, use_context)
        except TypeError as error:
            if "unexpected keyword" not in str(error) or data.plans.context is None:
                raise
            wanted = "context_size, for features" if "context_size" in str(error) else "num_contexts, for indices"
            raise ValueError(
                f"model.prior: it cannot take the context of these plans (it has no {wanted}); use --model.use_context"
                " false, or another prior"
            ) from error
        if made.takes_context:
            made.past_durations = data.past_durations
        super().__init__(made, learning_rate, weight_decay, data.seed)


def _in_parts(plans: Plans) -> Plans:
    """Plans that can be split in three, or in two folds; a single group is dropped, so that its plans can be split."""
    units, what = num_units(plans), _what(plans)
    if units == 1:
        if plans.group is not None:
            return _in_parts(ungrouped(plans))
        units, what = int(plans.mask().sum()), "actions"
    if units < PARTS and not (units == 2 and _fewest_actions(plans) >= LONG):
        long = f", or 2 of at least {LONG} actions" if what != "actions" else ""
        raise ValueError(
            f"data: {units} {what} cannot be split in three, to learn from, for validation and held out;"
            f" at least {PARTS} {what} are needed{long}"
        )
    return plans


def _fewest_actions(plans: Plans) -> int:
    """Actions of the group with the fewest, or of the plan where there are no groups."""
    unit = torch.arange(len(plans)) if plans.group is None else plans.group.unique(return_inverse=True)[1].cpu()
    return int(unit.bincount(plans.mask().sum(1).cpu()).min())


def _split_two(plans: Plans, share: float, generator: torch.Generator) -> tuple[Plans, Plans]:
    """Two plans or groups, to learn from and for validation: one of them would be half, so that less is held out.

    Of many plans some are held out, see `fair_split`; of two the end of the longer.
    """
    plans = ungrouped(plans[plans.mask().any(1)])
    return fair_split(plans, share, generator) if len(plans) > 2 else longest_cut(plans, share)


def _what(plans: Plans) -> str:
    """What `num_units` counts."""
    return "plans" if plans.group is None else "groups"


def _folds(plans: Plans, wanted: int | None) -> int:
    """How many folds; 1: a share of the plans is held out."""
    units = num_units(plans)
    if wanted is None:
        few = units == 2 or (plans.group is not None and units < FEW_GROUPS)
        return min(FOLDS, units) if few else 1
    if not 1 <= wanted <= units:
        raise ValueError(f"data.folds: from 1 to the number of {_what(plans)}, {units}, is expected, not {wanted}")
    return wanted


def _check_indices(what: str, number: int) -> None:
    if number > MOST_INDICES:
        raise ValueError(f"data: {what} indices go up to {number - 1}; number them from 0, or write them as names")
