"""What `python -m eval intentions` does for one world and one seed."""

from typing import Any

import torch

from eval.intentions.grid import IntentionSettings, grid_entries
from eval.intentions.mice import mice_entries
from eval.worlds.runs import Run

LABYRINTH = "labyrinth"
"""The mice's; there a seed is the block of sequences that is held out."""


def intentions_run(run: Run, settings: IntentionSettings) -> dict[str, Any]:
    """Learn priors toward known goals, and observe other agents with them.

    Returns:
        `entries`, of each observer (`kind`, `plans`) and `measure`, and where it was measured (`at`): the log-loss
        (`loss`, nats), accuracy and probability of the true goal after so many "moves" or a share of the "way", or so
        many moves after the goal "switched"; the loss of the "cell" so many moves later; and, in the labyrinth, of
        whether the "water" is reached within so many moves. Of "calibration" the `sums` of each bin.
    """
    generator = torch.Generator().manual_seed(settings.seed * 1_000_003 + run.seed)
    mice = run.world == LABYRINTH
    entries = mice_entries(run.seed, settings.observed) if mice else grid_entries(run.world, settings, generator)
    return run._asdict() | {"entries": list(entries)}
