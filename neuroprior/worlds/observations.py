"""What a world observes, as it declares it: nothing is guessed from a dtype."""

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from neuroprior._checks import check_range, is_integer


class Categories(NamedTuple):
    """An index: one of `number` kinds without an order, such as the cell of a grid.

    Attributes:
        number: how many kinds there are; `observe` gives integers `[N]` from 0 to `number` - 1.

    Example:
        >>> gridworld(5, 5, seed=0).observation
        Categories(number=25)
    """

    number: int


class Features(NamedTuple):
    """Real numbers, such as coordinates or pixels.

    Attributes:
        size: how many; `observe` gives `[N, size]`, floating point, integers or truth values.

    Example:
        >>> maze(7, 7, view=1, seed=0).observation
        Features(size=8)
    """

    size: int


class Patterns(NamedTuple):
    """Several indices at once: which of its patterns are active in a state.

    Attributes:
        number: how many; `observe` gives integers `[N, number]`.

    Example:
        >>> from neuroprior.puzzles import sliding_tiles
        >>> sliding_tiles(shape=(3, 3)).observation.number
        69
    """

    number: int


Observation: TypeAlias = Categories | Features | Patterns


def as_context(observation: Observation, observed: Tensor, num_states: int) -> Tensor:
    """What was observed in N states as a context for priors: `[N]` integers, `[N, C]` floating point or `[N, F]`.

    Args:
        observation: what the world declares.
        observed: what `observe` returned.
        num_states: N.

    Raises:
        ValueError: it is not what was declared.
    """
    shape = [num_states] if isinstance(observation, Categories) else [num_states, observation[0]]
    discrete = not isinstance(observation, Features)
    if not isinstance(observed, Tensor) or list(observed.shape) != shape or (discrete and not is_integer(observed)):
        got = f"{observed.dtype} {list(observed.shape)}" if isinstance(observed, Tensor) else type(observed).__name__
        kind = "integers of shape " if discrete else ""
        raise ValueError(f"`observe` must give {kind}{shape}, as the world declares {observation}, got {got}")
    if isinstance(observation, Categories) and observed.device.type == "cpu":  # a GPU would be waited for
        check_range("observe", observed, observation.number, "categories")
    return observed if discrete or observed.is_floating_point() else observed.to(torch.get_default_dtype())
