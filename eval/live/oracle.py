"""The foraging oracle: the optimal plan in a foraging world, by dynamic programming."""

import torch
from torch import Tensor

from eval.live.foraging import ForagingWorld
from neuroprior._checks import check_sizes
from neuroprior._random import generator_on
from neuroprior.planners.planner import Decision, Planner, join_decisions, random_best
from neuroprior.plans import action_dtype
from neuroprior.worlds.world import World

MOST_ITEMS = 12


class ForagingOracle(Planner):
    """Finds the plan that eats most in a `ForagingWorld`, given the food that is there now (`regrow` is not foreseen).

    Finite-horizon dynamic programming over the cell and the subset of the K items that is left: `L * 2**K * S * A`
    operations for each start, which are counted as model steps. No plan of the same length scores more. At each step it
    takes a random one of the optimal actions.

    Args:
        length: number of actions in a plan, at least 1.
        discount: see `Planner`; the objective is "return".

    Raises:
        ValueError: an argument is out of range. `plan` raises it for another kind of world, a stochastic one, or one
            with more than 12 items.

    Example:
        >>> table = gridworld(5, 5, seed=0)
        >>> world = ForagingWorld(
        ...     table, patches(table, num_seasons=1, radius=1, generator=torch.Generator().manual_seed(0)), period=20
        ... )
        >>> ForagingOracle(length=3).plan(world, world.reset(2, torch.Generator().manual_seed(0))).plan.shape
        torch.Size([2, 3])
    """

    def __init__(self, length: int, discount: float = 1.0) -> None:
        super().__init__("return", discount)
        check_sizes(length=length)
        self.length = length

    def plan(self, world: World, state: Tensor, generator: torch.Generator | None = None) -> Decision:
        if not isinstance(world, ForagingWorld) or world.stochastic or world.num_items > MOST_ITEMS:
            raise ValueError(f"`world` must be a deterministic ForagingWorld of at most {MOST_ITEMS} items")
        world.check_state(state)
        generator = generator_on(generator, state.device)
        work = self.length * 2**world.num_items * world.table.num_states * world.num_actions
        # These operations take less memory than simulator steps elsewhere.
        chunks = self.chunks(state, work // (8 * world.num_actions))
        decision = join_decisions((self._plan(world, chunk, generator) for chunk in chunks), len(state))
        return decision._replace(model_steps=work)

    def _plan(self, world: ForagingWorld, state: Tensor, generator: torch.Generator) -> Decision:
        bits = 2 ** torch.arange(world.num_items, device=state.device)
        there = ((state[:, 2:, None] == world.place).long() * bits[:, None]).sum(1)  # the items in each cell
        arriving = self._arrival_values(world, there)
        row, now, plan = torch.arange(len(state), device=state.device), state, []
        left = (state[:, 2:] < world.num_places).long() @ bits
        for values in reversed(arriving):
            next_values = values[world.table.next_state[now[:, 0]], row[:, None], left[:, None]]
            plan.append(random_best(next_values, generator, world.legal_actions(now)))
            now, _ = world.step(now, plan[-1])
            left = left & ~there[row, now[:, 0]]
        plans = torch.stack(plan, 1)
        score = self.score(world.rollout(state, plans[:, None]).rewards[:, 0], now)
        return Decision(plans.to(action_dtype(world.num_actions)), score, now, 0)

    def _arrival_values(self, world: ForagingWorld, there: Tensor) -> list[Tensor]:
        """The values of arriving in a cell, `[S, B, 2**K]` each: by the last step of a plan, the one before, and so on.

        Sets of items are numbers of K bits: the last dimension is the set that is left; `there [B, S]` is the set that
        lies in each cell.
        """
        table, (batch, cells), discount = world.table, there.shape, float(self.discounts(torch.empty(1))[1])
        items = torch.arange(2**world.num_items, device=there.device)
        start, cell = there.nonzero(as_tuple=True)  # elsewhere nothing is gained
        eaten = items & there[start, cell][:, None]
        gain = ((eaten[..., None] >> torch.arange(world.num_items, device=there.device)) & 1).sum(-1).float()
        after, value, arriving = items & ~eaten, torch.zeros(cells, batch, len(items), device=there.device), []
        acting = value.new_empty(
            cells * world.num_actions, batch * len(items)
        )  # allocating it anew would cost more than filling it
        for _ in range(self.length):
            worth = discount * value
            worth[cell, start] = gain + worth[cell, start].gather(1, after)
            arriving.append(worth)
            # One row per cell: whole rows are copied.
            torch.index_select(worth.flatten(1), 0, table.next_state.flatten(), out=acting)
            if table.legal_table is not None:
                acting.masked_fill_(~table.legal_table.view(-1, 1), -torch.inf)
            torch.amax(acting.view(cells, world.num_actions, batch * len(items)), 1, out=value.flatten(1))
        return arriving
