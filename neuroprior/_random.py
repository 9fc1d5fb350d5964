"""Random generators: every random function draws from the one it is given, never from torch's global state."""

import torch
from torch import Tensor


def generator_on(generator: torch.Generator | None, device: torch.device | str) -> torch.Generator:
    """The generator to draw from on `device`.

    Args:
        generator: the caller's generator. None gives a new one, seeded from the operating system.
        device: where the numbers will be drawn.

    Returns:
        `generator` itself where it is on the same kind of device; else one on `device` that is seeded by a draw from
        it, so that a CPU generator makes a GPU's draws reproducible too.

    Raises:
        ValueError: it is no generator, but a seed, say.
    """
    device = torch.device(device)
    if generator is None:
        fresh = torch.Generator(device)
        fresh.seed()
        return fresh
    if not isinstance(generator, torch.Generator):
        raise ValueError(
            f"`generator` must be a torch.Generator, such as torch.Generator().manual_seed(0), got {generator!r}"
        )
    if generator.device.type == device.type:
        return generator
    return torch.Generator(device).manual_seed(draw_seed(generator))


def draw_seed(generator: torch.Generator) -> int:
    """An integer seed in [0, 2**62), drawn from `generator`, for code that takes seeds only."""
    return int(torch.randint(2**62, (), generator=generator, device=generator.device))


def gumbel(location: Tensor, generator: torch.Generator) -> Tensor:
    """Gumbel variables at these locations: of logarithms of probabilities, the greatest is at i with probability i."""
    uniform = torch.rand(location.shape, generator=generator, device=location.device, dtype=location.dtype)
    return location - torch.log(-torch.log(uniform.clamp(min=torch.finfo(location.dtype).tiny)))
