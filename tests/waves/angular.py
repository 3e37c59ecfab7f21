"""A wave through a relief once more, by other means: NumPy, exact refraction of a plane wave, and the angular spectrum.

Nothing here is shared with the package.  The field is made on the plane just behind the relief, on which rays have moved hardly at
all, and every plane wave of it goes on with its exact phase, exp(i k_z z): no parabola, no intercepts.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import BSpline


class Relief:
    """z = h(x, y) over [-rx, rx] x [-ry, ry]: control heights (n, m) on open knots over [0, 1]."""

    def __init__(self, heights: np.ndarray, knots, degrees, half):
        self.half = half
        self.spline = [BSpline(np.asarray(t), np.eye(n), p) for t, n, p in zip(knots, heights.shape, degrees, strict=True)]
        self.heights = heights

    def at(self, x: np.ndarray, y: np.ndarray):
        """Height and slopes at scattered points of one shape."""
        u, v = (np.clip(0.5 * (c / r + 1.0), 0.0, 1.0).ravel() for c, r in zip((x, y), self.half, strict=True))
        (bu, bv), (rx, ry) = self.spline, self.half
        a, b = (s.design_matrix(c, s.t, s.k) for s, c in zip((bu, bv), (u, v), strict=True))
        da, db = (BSpline(s.t, np.eye(len(s.c)), s.k).derivative() for s in (bu, bv))
        z = np.asarray((a @ self.heights) * b.toarray()).sum(1)
        zx = ((da(u) @ self.heights) * b.toarray()).sum(1) / (2.0 * rx)
        zy = ((a @ self.heights) * db(v)).sum(1) / (2.0 * ry)
        return (c.reshape(x.shape) for c in (z, zx, zy))


def refracted(zx, zy, index):
    """Directions of light along z that leaves glass at these slopes."""
    norm = np.sqrt(1.0 + zx**2 + zy**2)
    nx, ny, nz = -zx / norm, -zy / norm, 1.0 / norm
    cos_out = np.sqrt(1.0 - index**2 * (1.0 - nz**2))
    gamma = cos_out - index * nz
    return gamma * nx, gamma * ny, index + gamma * nz


def behind(relief: Relief, index: float, plane: float, x: np.ndarray, y: np.ndarray, pupil):
    """Path and amplitude of unit incident irradiance on the plane z = plane, on an even grid x (n,), y (m,)."""
    gx, gy = np.meshgrid(x, y, indexing="ij")
    px, py = gx.copy(), gy.copy()
    for _ in range(12):  # where on the relief the light that comes here left it
        z, zx, zy = relief.at(px, py)
        dx, dy, dz = refracted(zx, zy, index)
        t = (plane - z) / dz
        px, py = gx - t * dx, gy - t * dy
    z, zx, zy = relief.at(px, py)
    t = (plane - z) / refracted(zx, zy, index)[2]
    (xx, xy), (yx, yy) = (np.gradient(p, x, y) for p in (px, py))
    lit = 1.0
    for p, r, step in ((px, pupil[0], x[1] - x[0]), (py, pupil[1], y[1] - y[0])):
        lit = lit * np.clip((r - np.abs(p)) / step + 0.5, 0.0, 1.0)
    return index * z + t, np.sqrt(np.maximum(xx * yy - xy * yx, 0.0)) * lit


def propagated(field: np.ndarray, steps, wavelength: float, distance: float) -> np.ndarray:
    """A field (n, m) of even samples after a distance, by its angular spectrum; waves that would leave the grid sideways are left
    out."""
    k = 2.0 * math.pi / wavelength
    fx, fy = (np.fft.fftfreq(n, d) for n, d in zip(field.shape, steps, strict=True))
    kx, ky = 2.0 * math.pi * fx[:, None], 2.0 * math.pi * fy[None, :]
    kz = np.sqrt(np.maximum(k**2 - kx**2 - ky**2, 0.0))
    reach = [0.5 * n * d for n, d in zip(field.shape, steps, strict=True)]
    held = (np.abs(kx) * distance < kz * reach[0]) & (np.abs(ky) * distance < kz * reach[1])
    return np.fft.ifft2(np.fft.fft2(field) * np.where(held, np.exp(1j * kz * distance), 0.0))


def binned(power: np.ndarray, at, half, count) -> np.ndarray:
    """Power of even samples about points on count pixels over [-half, half], each sample shared among those that it covers."""
    for axis in (0, 1):
        x, n = at[axis], count[axis]
        step, edges = x[1] - x[0], np.linspace(-half[axis], half[axis], n + 1)
        low = np.clip((edges[:, None] - (x[None, :] - 0.5 * step)) / step, 0.0, 1.0)
        share = low[1:] - low[:-1]
        power = share @ power if axis == 0 else power @ share.T
    return power
