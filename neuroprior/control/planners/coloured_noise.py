"""Gaussian noise in time with a power-law spectrum."""

from functools import lru_cache
from math import sqrt

import torch
from torch import Tensor

from neuroprior.control.worlds.continuous_world import check_positive


def check_noise(std: float, noise_beta: float) -> None:
    """Raise ValueError unless these are a standard deviation, and an exponent of a spectrum."""
    check_positive(std=std)
    check_positive(zero=True, noise_beta=noise_beta)


def coloured_noise(shape: tuple[int, ...], beta: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise whose power at frequency f is proportional to `f ** -beta` along dimension -2.

    At `beta` 0 the entries are independent and have variance 1. Else a plan has variance 1 about its own average over
    time, and that average varies, too, with the power of the lowest frequency: with a large `beta` by up to 1/2 in
    addition (Timmer & König 1995, with the lowest frequency 1 / L; the scale is that of the reference implementation of
    iCEM).

    Args:
        shape: `[..., L, D]`.
        beta: at least 0: 0 white noise, 1 pink, 2 red.
        generator: source of randomness; the noise is on its device.

    Example:
        >>> coloured_noise((4, 20), beta=2.0, generator=torch.Generator().manual_seed(0)).shape
        torch.Size([4, 20])
    """
    white = torch.randn(shape, generator=generator, device=generator.device)
    length = shape[-2]
    if beta == 0 or length == 1:
        return white
    return colouring(length, float(beta)).to(white) @ white


@lru_cache(maxsize=64)
def colouring(length: int, beta: float) -> Tensor:
    """The matrix `[L, L]` that makes coloured noise of white noise, float64; L at least 2."""
    frequencies = torch.fft.rfftfreq(length, dtype=torch.float64).clamp(min=1 / length)
    amplitudes = frequencies ** (-beta / 2)
    # A real and an imaginary part of each frequency, but no imaginary part of the average and of f = 1/2, whose real
    # parts have all their power.
    middle = (length - 1) // 2
    waves = torch.zeros(length, len(amplitudes), dtype=torch.complex128)
    real = torch.arange(len(amplitudes))
    waves[real, real] = amplitudes * (torch.where((real == 0) | (2 * real == length), sqrt(2), 1.0) + 0j)
    waves[len(real) + torch.arange(middle), 1 + torch.arange(middle)] = amplitudes[1 : middle + 1] * 1j
    in_time = torch.fft.irfft(waves, length)
    within = (in_time - in_time.mean(1, keepdim=True)).square().sum(0).mean().sqrt()
    colours: Tensor = in_time.T / within
    return colours
