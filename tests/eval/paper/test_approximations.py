"""Approximations of values over coordinates: tiles and networks."""

import pytest
import torch

from eval.paper.values import network_approximation, tile_approximation
from neuroprior.planners import value_iteration
from neuroprior.worlds import gridworld
from tests.support.sources import seeded


@pytest.fixture(scope="module")
def peak():
    """The true values of a goal in a grid, and the coordinates of its cells."""
    world = gridworld(10, 12)
    return value_iteration(world, goal=66), world.coordinates(torch.arange(120))


def rms(approximation, values):
    return float((approximation - values).square().mean().sqrt())


def test_tiles_of_one_cell_are_exact(peak):
    values, coordinates = peak
    for num_tilings in (1, 3):
        torch.testing.assert_close(tile_approximation(values, coordinates, 1, num_tilings), values)


def test_one_tiling_takes_the_mean_of_each_tile(peak):
    values, coordinates = peak
    blocks = values.view(5, 2, 6, 2)
    means = blocks.mean((1, 3), keepdim=True).expand_as(blocks).reshape(1, 120)
    torch.testing.assert_close(tile_approximation(values, coordinates, 2), means)
    torch.testing.assert_close(tile_approximation(values, coordinates + 7.5, 2), means)
    torch.testing.assert_close(tile_approximation(values, coordinates, 100), values.mean().expand(1, 120))


def test_more_tilings_and_smaller_tiles_come_closer(peak):
    values, coordinates = peak
    by_tilings = [rms(tile_approximation(values, coordinates, 4, n), values) for n in (1, 2, 4)]
    assert by_tilings[0] > by_tilings[1] > by_tilings[2] > 0
    by_size = [rms(tile_approximation(values, coordinates, size), values) for size in (8, 4, 2)]
    assert by_size[0] > by_size[1] > by_size[2] > 0
    # Tilings that are linear combinations of earlier ones change nothing.
    dependent = tile_approximation(values, coordinates, 4, 8)
    torch.testing.assert_close(dependent, tile_approximation(values, coordinates, 4, 4))


def test_functions_are_fitted_each_by_itself(peak):
    values, coordinates = peak
    several = torch.cat([values, -3 * values, torch.rand(1, 120, generator=seeded(0)).double()])
    together = tile_approximation(several, coordinates, 3, 3)
    for one, approximation in zip(several, together, strict=True):
        torch.testing.assert_close(tile_approximation(one[None], coordinates, 3, 3)[0], approximation)


def test_networks_come_closer_with_more_steps(peak):
    values, coordinates = peak
    errors = [
        rms(network_approximation(values, coordinates, steps=steps, generator=seeded(0)), values)
        for steps in (1, 30, 300)
    ]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.02 < rms(values.mean(), values)


def test_networks_learn_independently_and_again(peak):
    values, coordinates = peak
    twice, other_units = values.expand(2, -1), torch.cat([values, 100 * values + 7])
    with torch.no_grad():
        first = network_approximation(twice, coordinates, steps=20, generator=seeded(0))
        again = network_approximation(twice, coordinates, steps=20, generator=seeded(0))
        scaled = network_approximation(other_units, coordinates, steps=20, generator=seeded(0))
    assert torch.equal(first, again)
    assert not first.requires_grad
    assert not torch.allclose(first[0], first[1], atol=1e-4)
    torch.testing.assert_close(scaled[0], first[0])
    torch.testing.assert_close(scaled[1], 100 * first[1] + 7, rtol=1e-4, atol=1e-4)


def test_constant_values_and_coordinates_are_fitted():
    coordinates = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]])
    for approximation in (
        tile_approximation(torch.full((1, 3), 4.0), coordinates, 1.5),
        network_approximation(torch.full((1, 3), 4.0), coordinates, steps=3),
    ):
        torch.testing.assert_close(approximation, torch.full((1, 3), 4.0))


GRID = gridworld(3, 3)
PLACES = GRID.coordinates(torch.arange(9))


@pytest.mark.parametrize(
    ("values", "coordinates", "message"),
    [
        (torch.zeros(9), PLACES, r"`values` must be shape \[K, S\], got \[9\]"),
        (torch.zeros(0, 9), PLACES, "`values` must be shape"),
        (torch.zeros(1, 9, dtype=torch.long), PLACES, "`values` must be floating point, got torch.int64"),
        (torch.zeros(1, 8), PLACES, r"`coordinates` must be shape \[S, D\] with S = 8, got \[9, 2\]"),
        (torch.zeros(1, 9), PLACES[:, :0], "`coordinates` must be shape"),
        (torch.zeros(1, 9).fill_(float("nan")), PLACES, r"`values\[0, 0\]` must be a finite number, got nan"),
        (torch.zeros(1, 9), torch.inf * (PLACES + 1.0), r"`coordinates\[0, 0\]` must be a finite number, got inf"),
    ],
)
def test_bad_values_and_coordinates_are_refused(values, coordinates, message):
    with pytest.raises(ValueError, match=f"^{message}"):
        tile_approximation(values, coordinates, 1)
    with pytest.raises(ValueError, match=f"^{message}"):
        network_approximation(values, coordinates)


@pytest.mark.parametrize("wrong", [{"tile_size": 0}, {"tile_size": float("inf")}, {"num_tilings": 0}], ids=str)
def test_bad_tiles_are_refused(wrong):
    with pytest.raises(ValueError, match=f"^`{next(iter(wrong))}` must be "):
        tile_approximation(torch.zeros(1, 9), PLACES, **({"tile_size": 1} | wrong))


@pytest.mark.parametrize("name", ["hidden_size", "steps", "learning_rate"])
def test_bad_networks_are_refused(name):
    with pytest.raises(ValueError, match=f"^`{name}` must be .*, got 0"):
        network_approximation(torch.zeros(1, 9), PLACES, **{name: 0})
