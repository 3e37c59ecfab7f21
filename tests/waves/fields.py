"""What the tests of light as a wave have in common: closed forms on pixels, and the transform of a field that is given directly."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.special import fresnel

from caustic_cli.optics.waves.propagation import TURN, cells, pixel_edges, power_on_pixels, ramp
from caustic_cli.optics.waves.sampling import Sampling

GAUSS = np.polynomial.legendre.leggauss(8)


def middles(low: float, high: float, count: int) -> np.ndarray:
    """Of so many even cells."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def mean_over(function, low: float, high: float, count: int, parts: int = 1) -> np.ndarray:
    """Mean of a function of arrays over each of `count` even cells, by Gauss' rule on `parts` of each."""
    width = (high - low) / (count * parts)
    at = middles(low, high, count * parts)[:, None] + 0.5 * width * GAUSS[0]
    return (function(at) @ GAUSS[1] / 2.0).reshape(count, parts).mean(1)


def mean_around(function, half: float, count: int) -> np.ndarray:
    """Mean of a function of the distance from the middle over each of count x count even cells on [-half, half]^2."""
    width, n = 2.0 * half / count, len(GAUSS[0])
    at = (middles(-half, half, count)[:, None] + 0.5 * width * GAUSS[0]).reshape(-1)
    rho = np.linspace(0.0, 1.5 * half, 4000)
    values = CubicSpline(rho, function(rho))(np.hypot(at[:, None], at[None, :])).reshape(count, n, count, n)
    return np.einsum("iajb,a,b->ij", values, GAUSS[1], GAUSS[1]) / 4.0


def disc(x: np.ndarray, y: np.ndarray, radius: float, fine: int = 16) -> np.ndarray:
    """Part of each even cell about points x (n,) and y (m,) that lies within a circle: (n, m)."""
    dx, dy = x[1] - x[0], y[1] - y[0]
    part = np.clip((radius - np.hypot(*np.meshgrid(x, y, indexing="ij"))) / min(dx, dy) + 0.5, 0.0, 1.0)
    i, j = np.nonzero(
        (np.hypot(*np.meshgrid(x, y, indexing="ij")) > radius - dx - dy)
        & (np.hypot(*np.meshgrid(x, y, indexing="ij")) < radius + dx + dy)
    )
    a = (np.arange(fine) + 0.5) / fine - 0.5
    inside = (x[i][:, None, None] + dx * a[:, None]) ** 2 + (y[j][:, None, None] + dy * a[None, :]) ** 2 <= radius**2
    part[i, j] = inside.mean((1, 2))
    return part


def slit(x: np.ndarray, half: float, wavelength: float, distance: float) -> np.ndarray:
    """Fresnel's pattern of a slit of half width `half`, in parts of the incident irradiance."""
    scale = np.sqrt(2.0 / (wavelength * distance))
    (s1, c1), (s2, c2) = fresnel(scale * (x + half)), fresnel(scale * (x - half))
    return 0.5 * ((c1 - c2) ** 2 + (s1 - s2) ** 2)


class Given:
    """A field given directly on a rectangle of half widths `half`, its screen, and the transform between.

    screen: half widths on the screen, mm; resolution: pixels.
    """

    def __init__(self, half, screen, resolution, distance: float, wavelength: float, finer: float = 1.0, watched=None):
        self.half, self.screen, self.resolution, self.wavelength = half, screen, resolution, wavelength
        pixel = tuple(2.0 * s / n for s, n in zip(screen, resolution, strict=True))
        watched = watched or screen
        self.sampling = s = Sampling.of(
            (tuple(-h for h in half), tuple(half)),
            (tuple(-w for w in watched), tuple(watched)),
            pixel,
            distance,
            (wavelength,),
            finer,
        )
        self.x, self.y = (s.low[k] + s.step[k] * (np.arange(s.count[k]) + 0.5) for k in (0, 1))
        first, spacing = s.first(wavelength), s.spacing(wavelength)
        self.masks = [
            cells(pixel_edges(-screen[k], pixel[k], resolution[k], first[k], spacing[k], s.padded[k]), s.padded[k]) for k in (0, 1)
        ]
        #: Area of a cell over that of a pixel: by it power of unit incident irradiance becomes irradiance.
        self.scale = 1.0 / (pixel[0] * pixel[1])

    def polar(self, path: np.ndarray, amplitude: np.ndarray, dtype=torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
        """Phase with the kernel's, and root of the power of each cell, of unit irradiance where amplitude is 1."""
        s, cpu = self.sampling, torch.device("cpu")
        kernel = ramp(s, self.wavelength, 0, cpu)[:, None] + ramp(s, self.wavelength, 1, cpu)[None, :]
        path, amplitude = (np.broadcast_to(c, s.count).copy() for c in (path, amplitude))
        phase = torch.remainder(TURN / self.wavelength * torch.from_numpy(path) + kernel, TURN)
        return phase.to(dtype), (torch.from_numpy(amplitude) * math.sqrt(s.step[0] * s.step[1])).to(dtype)

    def power(self, path, amplitude, dtype=torch.float64) -> np.ndarray:
        """Irradiance on the pixels of unit incident irradiance."""
        masks = [m.to(dtype) for m in self.masks]
        return (power_on_pixels(*self.polar(path, amplitude, dtype), self.sampling.padded, *masks) * self.scale).double().numpy()
