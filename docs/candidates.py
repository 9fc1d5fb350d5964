"""Draws candidates.png, the figure of the README: where random plans lead, and plans sampled from a prior."""

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import torch

from neuroprior import ExhaustivePlanner, GRUPrior, UniformPrior, collect, gridworld

NUM_PLANS, LENGTH = 256, 8
MOVES = torch.tensor([[0, 1], [1, 0], [0, -1], [-1, 0]])  # in the order of the grid's actions: up, right, down, left

generator = torch.Generator().manual_seed(0)
world = gridworld(20, 20, edges="torus", num_worlds=20, seed=0)
plans = collect(ExhaustivePlanner(depth=4), world, 10_000, generator=generator)
assert world.action_names == ("up", "right", "down", "left")

figure, all_axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
titles = {"random plans": UniformPrior(4), "plans sampled from a prior": GRUPrior(4).fit(plans, generator=generator)}
for axes, (name, prior), colour in zip(all_axes, titles.items(), ("#da9f2e", "#e4530f"), strict=True):
    candidates = prior.sample(NUM_PLANS, LENGTH, generator=generator).long()
    cells = torch.cat([torch.zeros(NUM_PLANS, 1, 2, dtype=torch.long), MOVES[candidates].cumsum(1)], 1)
    shifted = cells + 0.25 * (torch.rand(NUM_PLANS, 1, 2, generator=generator) - 0.5)  # paths side by side
    for path in shifted:
        axes.plot(*path.T, color=colour, alpha=0.18, linewidth=1.2)
    axes.scatter(*shifted[:, -1].T, color=colour, s=10, zorder=3)
    axes.plot(0, 0, "o", color="white", markeredgecolor="black", markersize=8, zorder=4)
    different = len(cells[:, -1].unique(dim=0))
    axes.set_title(f"{NUM_PLANS} {name}\nlead to {different} different cells", fontsize=13)
    axes.set(xlim=(-8.5, 8.5), ylim=(-8.5, 8.5), aspect="equal", xticks=[], yticks=[])
figure.savefig("docs/candidates.png", dpi=110)
