"""State values to plan by, right or wrong: Q-learning, approximations over coordinates, exact reach.

The ways in which a planner's values can be wrong (Hyvärinen, second simulation), and what gives them:

- learned or computed incompletely: `q_learning(world, goal).amax(-1)`, `value_iteration(world, goal=goal, sweeps=5)`;
- the rewards changed after learning: `value_iteration(world, goal=old_goal)`, used where another goal holds;
- generalised: `tile_approximation` or `network_approximation` of the true values over coordinates.

With a goal, the reward is 1 for reaching it and 0 otherwise, whatever rewards the world has. A cell at distance d then
has the value discount ** (d - 1), and the goal itself 1 / discount: a planner that maximises the value of the final
cell must prefer the goal to the cells beside it. Put 0 there (`values[:, goal] = 0`) where the reward of reaching the
goal is counted separately.
"""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from neuroprior._checks import check_count, check_sizes, is_number
from neuroprior._random import generator_on
from neuroprior.planners.exact import check_goal
from neuroprior.worlds.tabular import TabularWorld


@torch.no_grad()
def q_learning(
    world: TabularWorld,
    goal: int,
    *,
    num_agents: int = 1,
    steps: int = 10_000,
    step_size: float = 0.5,
    discount: float = 0.9,
    initial_scale: float = 0.01,
    epsilon: float = 0.0,
    generator: torch.Generator | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Tensor:
    """Action values that independent agents learn while they search for a goal (Hyvärinen, second simulation).

    An agent starts in a random cell and takes the action of the highest value; on reaching the goal it restarts in a
    random cell. With `epsilon` 0, its random initial values are the only source of exploration. The update is
    Q-learning's (Watkins & Dayan 1992); reaching the goal is terminal. State values are the result's `.amax(-1)`.

    Args:
        world: gives the transitions and the legal actions; its own rewards are not used (see the module).
        goal: the goal's cell.
        num_agents: number of independent agents, N.
        steps: steps that each agent takes.
        step_size: how far a value moves towards its target, above 0 and at most 1.
        discount: the factor for a reward one step later, between 0 and 1 exclusive.
        initial_scale: initial values are uniform between 0 and this.
        epsilon: probability of an action drawn uniformly from the legal ones. With 0, values need not converge.
        generator: draws initial values, starts and restarts (uniform over all cells but the goal), and breaks ties
            between actions of equal value.
        progress: called after every step with the number of steps done and `steps`.

    Returns:
        `[N, S, A]` float64: the value of each action; -inf where it is not legal, 1 / discount in the goal.

    Raises:
        ValueError: an argument is out of range, or the goal is the only cell.

    Example:
        >>> world = gridworld(5, 5, seed=0)
        >>> q_learning(world, goal=24, steps=1000, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([1, 25, 4])
    """
    goal = check_goal(world, goal)
    _require(world.num_states > 1, "world", "a cell that is not the goal", "the goal alone")
    check_sizes(num_agents=num_agents)
    check_count("steps", steps, 0)
    _require(is_number(step_size) and 0 < step_size <= 1, "step_size", "a number above 0 and at most 1", step_size)
    _require(is_number(discount) and 0 < discount < 1, "discount", "a number above 0 and below 1", discount)
    _require(
        is_number(initial_scale) and 0 <= initial_scale < math.inf,
        "initial_scale",
        "a finite number, at least 0,",
        initial_scale,
    )
    _require(is_number(epsilon) and 0 <= epsilon <= 1, "epsilon", "a share between 0 and 1", epsilon)
    generator = generator_on(generator, world.device)
    device, size = world.device, (num_agents, world.num_states, world.num_actions)
    values = torch.rand(size, generator=generator, device=device, dtype=torch.float64) * initial_scale
    values[:, goal] = 1 / discount
    values.masked_fill_(~world.legal_actions(torch.arange(world.num_states, device=device)), -torch.inf)
    agent = torch.arange(num_agents, device=device)
    cell = _other_cells(goal, world.num_states, num_agents, generator)
    for step in range(steps):
        q_values = values[agent, cell]
        action = _choose(q_values, epsilon, generator)
        after, _ = world.step(cell, action, generator)
        # The value of the goal is 1 / discount, so that the target of reaching it is the reward, 1.
        values[agent, cell, action] = q_values[agent, action].lerp(discount * values[agent, after].amax(1), step_size)
        cell = torch.where(after == goal, _other_cells(goal, world.num_states, num_agents, generator), after)
        if progress is not None:
            progress(step + 1, steps)
    return values


def _choose(values: Tensor, epsilon: float, generator: torch.Generator) -> Tensor:
    """An action `[N]` of the largest value in each row `[N, A]`; with probability `epsilon`, any legal one."""
    candidate = values == values.amax(1, keepdim=True)
    if epsilon > 0:
        explore = torch.rand(len(values), 1, generator=generator, device=values.device) < epsilon
        candidate |= explore & (values > -torch.inf)
    return candidate.float().multinomial(1, generator=generator)[:, 0]


def _other_cells(goal: int, num_states: int, number: int, generator: torch.Generator) -> Tensor:
    """Cells `[number]`, uniform over all but the goal."""
    cell = torch.randint(num_states - 1, (number,), generator=generator, device=generator.device)
    return cell + (cell >= goal)


def can_reach(world: TabularWorld, state: Tensor, goal: int, length: int, *, within: bool = False) -> Tensor:
    """Which starts can reach the goal at all: the upper bound for all planners, by dynamic programming in the table.

    Args:
        world: gives the transitions and the legal actions.
        state: integers `[B]`: the states to start from.
        goal: the goal's cell. A plan may pass through it and go on.
        length: number of steps, 0 or more.
        within: False: some plan of exactly `length` steps ends on the goal. True: some plan is on the goal after at
            most `length` steps; a start on the goal is, after 0.

    Returns:
        `[B]` bool.

    Raises:
        ValueError: an argument is out of range, or the world is stochastic.

    Example:
        >>> can_reach(gridworld(5, 5, seed=0), torch.tensor([0, 23]), goal=24, length=1).tolist()
        [False, True]
    """
    world.check_state(state)
    goal = check_goal(world, goal)
    _require(not world.stochastic, "world", "a deterministic one", "a stochastic one")
    check_count("length", length, 0)
    cells = torch.arange(world.num_states, device=world.device)
    ends, legal = cells == goal, world.legal_actions(cells)
    for _ in range(length):
        one_more = (ends[world.next_state] & legal).any(1)
        ends = ends | one_more if within else one_more
    return ends[world.cell(state)]


@torch.no_grad()
def tile_approximation(values: Tensor, coordinates: Tensor, tile_size: float, num_tilings: int = 1) -> Tensor:
    """The least-squares approximation of given values by a linear function of tile features.

    Args:
        values: floating point `[K, S]`: K functions, each approximated by itself.
        coordinates: numbers `[S, D]`: where the S cells are, as from `GridWorld.coordinates`.
        tile_size: side of a tile, in units of the coordinates. The first tiling starts at their least values.
        num_tilings: number of tilings, each shifted by tile_size / num_tilings along every axis from the last. One
            tiling gives each cell the mean of its tile.

    Returns:
        Approximate values `[K, S]`, of the dtype of `values`. Time grows as S times the square of the number of tiles.

    Raises:
        ValueError: a shape, dtype or number is wrong.

    Example:
        >>> values, coordinates = torch.arange(4.0)[None], torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]])
        >>> tile_approximation(values, coordinates, tile_size=2.0).tolist()
        [[1.5, 1.5, 1.5, 1.5]]
    """
    _check_fit(values, coordinates)
    _require(is_number(tile_size) and 0 < tile_size < math.inf, "tile_size", "a positive, finite number", tile_size)
    check_sizes(num_tilings=num_tilings)
    place = (coordinates - coordinates.amin(0)).double().cpu() / tile_size
    tilings = [(place + tiling / num_tilings).floor() for tiling in range(num_tilings)]
    tiles = [torch.unique(tiling, dim=0, return_inverse=True)[1] for tiling in tilings]
    active = torch.cat([torch.nn.functional.one_hot(tile) for tile in tiles], 1).double()
    # Tilings are linearly dependent, which a GPU's lstsq does not allow, and a cut-off near rounding would miss.
    weights = torch.linalg.lstsq(active, values.double().cpu().T, rcond=1e-9, driver="gelsd").solution
    return torch.mm(active, weights).T.to(values)


@torch.enable_grad()
def network_approximation(
    values: Tensor,
    coordinates: Tensor,
    *,
    hidden_size: int = 32,
    steps: int = 500,
    learning_rate: float = 0.01,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Approximations of given values by small neural networks (two hidden layers of tanh units), in float32 by Adam.

    Args:
        values: floating point `[K, S]`: K functions, each approximated by a network of its own; all learn at once.
        coordinates: numbers `[S, D]`: where the S cells are, as from `GridWorld.coordinates`.
        hidden_size: units in a hidden layer.
        steps: gradient steps on the mean squared error over all cells; after few, values are smooth and wrong.
        learning_rate: of Adam.
        generator: draws the initial weights; the same seed gives the same approximation.

    Returns:
        Approximate values `[K, S]`, of the dtype of `values`.

    Raises:
        ValueError: a shape, dtype or number is wrong.

    Example:
        >>> values, coordinates = torch.arange(4.0)[None], torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]])
        >>> network_approximation(values, coordinates, steps=10, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([1, 4])
    """
    _check_fit(values, coordinates)
    check_sizes(hidden_size=hidden_size, steps=steps)
    finite = is_number(learning_rate) and 0 < learning_rate < math.inf
    _require(finite, "learning_rate", "a positive, finite number", learning_rate)
    generator = generator_on(generator, values.device)
    target, mean, scale = _standardise(values.detach())
    inputs = _standardise(coordinates.to(values.device).T)[0].T.expand(len(values), -1, -1)
    weights = []  # [K, 1 + inputs, outputs] a layer, the bias first
    for fan_in, fan_out in itertools.pairwise((inputs.shape[-1], hidden_size, hidden_size, 1)):
        uniform = torch.rand(len(values), 1 + fan_in, fan_out, generator=generator, device=values.device)
        weights.append(((2 * uniform - 1) / math.sqrt(fan_in)).requires_grad_())
    optimizer = torch.optim.Adam(weights, lr=learning_rate)
    for _ in range(steps):
        # A sum over networks: the gradient, and so the learning, of each is then its own.
        loss = (_network(weights, inputs) - target).square().mean(1).sum()
        for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
            weight.grad = gradient
        optimizer.step()
    return (_network(weights, inputs).detach() * scale + mean).to(values)


def _network(weights: list[Tensor], inputs: Tensor) -> Tensor:
    """Outputs `[K, S]` of K networks for inputs `[K, S, D]`."""
    for layer, weight in enumerate(weights):
        inputs = torch.baddbmm(weight[:, :1], inputs.tanh() if layer else inputs, weight[:, 1:])
    return inputs[..., 0]


def _standardise(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Each row with mean 0 and standard deviation 1, float32; the means and deviations that were, `[N, 1]`."""
    rows = rows.double()
    mean, scale = rows.mean(1, keepdim=True), rows.std(1, correction=0, keepdim=True).clamp(min=1e-12)
    return ((rows - mean) / scale).float(), mean, scale


def _require(holds: bool, name: str, wanted: str, value: object) -> None:
    if not holds:
        raise ValueError(f"`{name}` must be {wanted}, got {value!r}")


def _check_fit(values: Tensor, coordinates: Tensor) -> None:
    _require(values.is_floating_point(), "values", "floating point", values.dtype)
    _require(values.dim() == 2 and 0 not in values.shape, "values", "shape [K, S]", list(values.shape))
    fits = coordinates.dim() == 2 and coordinates.shape[0] == values.shape[1] and coordinates.shape[1] > 0
    _require(fits, "coordinates", f"shape [S, D] with S = {values.shape[1]}", list(coordinates.shape))
    for name, tensor in (("values", values), ("coordinates", coordinates)):
        for where in (~tensor.isfinite()).nonzero().tolist()[:1]:
            raise ValueError(f"`{name}{where}` must be a finite number, got {tensor[tuple(where)]}")
