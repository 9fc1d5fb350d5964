"""`neuroprior sample`: new plans from a saved prior."""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd
import torch
from jsonargparse.typing import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from neuroprior._files import quote_frame, written_whole
from neuroprior.behaviour.durations.semi_markov import SemiMarkovPrior
from neuroprior.behaviour.recorded_plans import durations_of
from neuroprior.plans import Plans, write_plans
from neuroprior.priors import Prior, load


def sample(
    folder: str,
    num_plans: PositiveInt = 100,
    length: PositiveInt = 20,
    context: str | None = None,
    temperature: PositiveFloat = 1.0,
    seed: NonNegativeInt = 0,
    out: str | None = None,
) -> None:
    """Sample new plans from a saved prior, with the names of its actions.

    Args:
        folder: a saved prior, as `neuroprior fit` writes it.
        num_plans: how many plans.
        length: actions in a plan; a plan of a prior with an end symbol may be shorter.
        context: for a prior with a context index: its name or number, which holds for the whole of each plan.
        temperature: divides the logits; above 1 plans are more varied, below 1 more alike.
        seed: of the random numbers: the same seed gives the same plans.
        out: file to write, `.jsonl`, `.csv` or `.npz`, which is not there yet; JSON lines on standard output by
            default. Of a semi-Markov prior, `.npz` and `.csv` hold durations, too: the latter with a row an event.
    """
    if seed >= 2**63:
        raise ValueError(f"seed: an integer from 0 to 2**63 - 1 is expected, not {seed}")
    if out is not None and Path(out).is_file():
        raise ValueError(f"{out}: is there already; give another name")
    prior = load(folder)
    generator = torch.Generator().manual_seed(seed)
    context_index = _context(prior, context, folder, num_plans)
    plans: Plans
    timed = isinstance(prior, SemiMarkovPrior) and out is not None and Path(out).suffix.lower() in (".npz", ".csv")
    if isinstance(prior, SemiMarkovPrior) and timed:
        plans = prior.sample_plans(num_plans, length, context_index, temperature=temperature, generator=generator)
        plans = plans.without_context()
    else:
        actions = prior.sample(num_plans, length, context_index, temperature=temperature, generator=generator)
        plans = Plans(actions, prior.num_actions, action_names=prior.action_names, end=prior.end)
    if prior.end is not None:
        plans = plans.without_end()
    if out is not None:
        if timed and Path(out).suffix.lower() == ".csv":
            with written_whole(Path(out)) as stream:
                quote_frame(_events(plans)).to_csv(stream, index=False, lineterminator="\n")
        else:
            write_plans(plans, out)
        print(f"wrote {num_plans} plans to {out}")
        return
    with TemporaryDirectory() as place:
        file = Path(place) / "plans.jsonl"
        write_plans(plans, file)
        sys.stdout.write(file.read_text(encoding="utf-8"))


def _events(plans: Plans) -> pd.DataFrame:
    """A frame with a row an action: the number of its plan as the recording, its name, when it began and ended."""
    stop = durations_of(plans).double().cumsum(1)
    plan, step = plans.mask().nonzero().unbind(1)
    actions = plans.actions[plan, step].tolist()
    ends, seconds = stop[plan, step].numpy(), durations_of(plans)[plan, step].double().numpy()
    return pd.DataFrame(
        {
            "recording": (plan + 1).tolist(),
            "behaviour": actions if plans.action_names is None else [plans.action_names[action] for action in actions],
            "start": ends - seconds,
            "stop": ends,
        }
    )


def _context(prior: Prior, name: str | None, folder: str, num_plans: int) -> Tensor | None:
    """The context `[N]` of that name or number."""
    if not prior.takes_context:
        if name is not None:
            raise ValueError(f"context: the prior in {folder} takes none")
        return None
    if prior.num_contexts is None:
        raise ValueError(f"{folder}: it takes features as context; sample it from Python, with Prior.sample")
    names = prior.context_names or ()
    choices = ", ".join(names[:8]) if names else f"0 to {prior.num_contexts - 1}"
    if name is None:
        raise ValueError(f"context: the prior in {folder} takes one; give --context and a name or number ({choices})")
    if name in names:
        index = names.index(name)
    elif name.isdecimal() and int(name) < prior.num_contexts and not names:
        index = int(name)
    else:
        raise ValueError(f"context: {name!r} is not known to the prior in {folder}; it knows {choices}")
    return torch.full((num_plans,), index, dtype=torch.long)
