"""What a world declares about its observations: categories or features."""

from typing import NamedTuple


class Categories(NamedTuple):
    """Observations are integers from 0 to `number` - 1, as of cells."""

    number: int


class Features(NamedTuple):
    """Observations are vectors of `size` floating point numbers."""

    size: int
