"""The foraging oracle: the best of all plans where food is eaten, by dynamic programming."""

import torch
from torch import Tensor

from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, in_chunks, random_best
from neuroprior.plans import action_dtype
from neuroprior.worlds.foraging import ForagingWorld
from neuroprior.worlds.world import World

MOST_ITEMS = 12


class ForagingOracle(Planner):
    """Finds the plan of so many actions that eats most in a `ForagingWorld`; what is yet to grow it does not know.

    Finite-horizon dynamic programming over the cell and which of the K items are left: `L * 2**K * S * A` operations
    for each start, which are counted as model steps. No planner whose plans are as long scores more. At each step
    it takes a random one of the best actions.

    Args:
        length: number of actions in a plan, at least 1.
        discount: see `Planner`; the objective is "return".

    Raises:
        ValueError: an argument is out of range. `plan` raises it for another world, or one with chance or more than
            `MOST_ITEMS` items.
    """

    def __init__(self, length: int, discount: float = 1.0) -> None:
        super().__init__("return", discount)
        check_sizes(length=length)
        self.length = length

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if not isinstance(world, ForagingWorld) or world.stochastic or world.num_items > MOST_ITEMS:
            raise ValueError(f"world: a ForagingWorld without chance, of at most {MOST_ITEMS} items, is expected")
        world.check_state(state)
        generator = generator_on(generator, state.device)
        work = self.length * 2**world.num_items * world.table.num_states * world.num_actions
        # Of its numbers, which take less memory than steps elsewhere, a good many are kept together.
        room = work // (8 * world.num_actions)
        decision = in_chunks(lambda some: self._plan(world, some, generator), state, room)
        return decision._replace(model_steps=work)

    def _plan(self, world: ForagingWorld, state: Tensor, generator: torch.Generator) -> Decision:
        bits = 2 ** torch.arange(world.num_items, device=state.device)
        there = ((state[:, 2:, None] == world.place).long() * bits[:, None]).sum(1)  # which items lie in each cell
        arriving = self._arriving(world, there)
        row, now, plan = torch.arange(len(state), device=state.device), state, []
        left = (state[:, 2:] < world.num_places).long() @ bits
        for values in reversed(arriving):
            found = values[world.table.next_state[now[:, 0]], row[:, None], left[:, None]]
            plan.append(random_best(found, generator, world.legal_actions(now)))
            now, _ = world.step(now, plan[-1])
            left = left & ~there[row, now[:, 0]]
        plans = torch.stack(plan, 1)
        score = self.score(world.rollout(state, plans[:, None]).rewards[:, 0], now)
        return Decision(plans.to(action_dtype(world.num_actions)), score, now, 0)

    def _arriving(self, world: ForagingWorld, there: Tensor) -> list[Tensor]:
        """What arriving in a cell is worth, `[S, B, 2**K]` each: as the last step of a plan, the one before, and so on.

        The last dimension is which items are left, as a number; `there [B, S]` is which lie in each cell.
        """
        table, (batch, cells) = world.table, there.shape
        items = torch.arange(2**world.num_items, device=there.device)
        start, cell = there.nonzero(as_tuple=True)  # where nothing lies nothing is gained
        found = items & there[start, cell][:, None]
        gain = ((found[..., None] >> torch.arange(world.num_items, device=there.device)) & 1).sum(-1).float()
        after, value, arriving = items & ~found, torch.zeros(cells, batch, len(items), device=there.device), []
        acting = value.new_empty(cells * world.num_actions, batch * len(items))  # new memory would cost more than this
        for _ in range(self.length):
            worth = self.discount * value
            worth[cell, start] = gain + worth[cell, start].gather(1, after)
            arriving.append(worth)
            # A row a cell: whole rows are copied.
            torch.index_select(worth.flatten(1), 0, table.next_state.flatten(), out=acting)
            if table.legal_table is not None:
                acting.masked_fill_(~table.legal_table.view(-1, 1), -torch.inf)
            torch.amax(acting.view(cells, world.num_actions, batch * len(items)), 1, out=value.flatten(1))
        return arriving
