"""Every world of the comparison observes what it declares."""

import pytest

from eval.worlds.suite import TASKS
from tests.support.sources import seeded

SLOW = ("cube", "minigrid_door_key", "minigrid_four_rooms", "minigrid_multi_room")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in TASKS]
)
def test_worlds_observe_what_they_declare(name):
    """In all worlds of a seed, in each split: else no prior could be given the observation as context."""
    if "minigrid" in name:
        pytest.importorskip("minigrid")
    task = TASKS[name]
    for world in task.worlds(0):
        states = world.reset(7, seeded(0))
        if task.observation is not None:
            assert len(world.context(states)) == 7
