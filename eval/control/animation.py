"""A moving picture of a planner in a task."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from eval.control.tasks import TASKS, Condition
from neuroprior._files import written_whole
from neuroprior.control import ContinuousWorld, PlanarArm, VectorPlanner, control

MILLISECONDS = 50
"""That a picture is shown."""


def animate(
    task: str, condition: Condition, planner: VectorPlanner, steps: int, path: Path, generator: torch.Generator
) -> None:
    """Write a GIF of a run of a planner in a task.

    Raises:
        ValueError: the task has no picture, or there is no OpenGL to draw it with.
    """
    world = TASKS[task].make(condition)
    done = control(planner, world, world.reset(1, generator), steps, generator)
    frames = [Image.fromarray(frame) for frame in pictures(world, done.states[0])]
    with written_whole(path, "wb") as file:
        frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=MILLISECONDS, loop=0, optimize=True
        )


def pictures(world: ContinuousWorld, states: Tensor) -> list[NDArray[np.uint8]]:
    """Pictures `[H, W, 3]` of `states [T, ...]`.

    Raises:
        ValueError: see `animate`.
    """
    if isinstance(world, PlanarArm):
        return [_arm_picture(world, joints) for joints in world.joints(states)]
    render = getattr(world, "render", None)
    if render is None:
        raise ValueError("animation: the arm, or a task with a method `render`, is expected")
    return list(render(states).numpy())


def _arm_picture(world: PlanarArm, joints: Tensor) -> NDArray[np.uint8]:
    figure = Figure(figsize=(3, 3), dpi=80)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1), aspect="equal")
    axes.axis("off")
    for x, y, radius in world.obstacles.tolist():
        axes.add_patch(Circle((x, y), radius, color="#c9ced6"))
    axes.plot(*world.goal.tolist(), "x", color="#d9731a", markersize=9, markeredgewidth=2.5)
    axes.plot(*joints.T.tolist(), "-o", color="#3079d8", linewidth=4, markersize=6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
