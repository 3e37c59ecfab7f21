"""The light that meets a lens' exit surface: of a source's middle, through the flat entrance and the glass.

Notation
    p = (x, y, z)   a point of the exit surface; o = (x_0, y_0, z_0) the source, h its distance before the entrance
    s               tangents of the ray's direction from the source, (d_x, d_y) / d_z; q = |s|
    f               power on the exit surface, seen along z, per area

A ray of tangent q crosses the entrance at h q from the axis through the source and the glass under it by t q', with
q' = q / sqrt(n^2 (1 + q^2) - q^2) by Snell; t is the height of p above the entrance.  So the point p is reached by the q with
h q + t q' = |(x - x_0, y - y_0)|, unless that has to come in by the lens' sides, and
f = I(q) (1 - R(q)) (1 + q^2)^(-3/2) |d(s_x, s_y) / d(x, y)|.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.inverse.target import overlap
from caustic_cli.optics.emission.measured import irradiance
from caustic_cli.optics.interface import reflectance
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.distribution import relative

#: Newton steps for q; its function is concave, so from the greater of two lower bounds each step stays below the root.
STEPS = 40


def incident(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """Power per area, seen along z, in the cells between corners x (n + 1,), y (m + 1,), (n, m), and the unit directions inside
    the glass at the corners, three (n + 1, m + 1) arrays (None for along z); z: heights of the surface there, mm.

    Near light is in parts of the source's intensity times its solid angle, any other in a unit of its own.

    Raises:
        InputError: the source stands behind the entrance.
    """
    light, directions = _square(scene, x, y, z)
    return (light * _part_within(x, y, scene.lens.half_size[0]) if scene.lens.round else light), directions


def on_entrance(scene: Scene, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """The same in air, on the plane of the entrance: as if the lens there had the index 1 and no thickness."""
    air = replace(scene, lens=replace(scene.lens, index=1.0 + 1e-9, glass=None, fresnel="none", front=None), second=None)
    return incident(air, x, y, np.full((len(x), len(y)), scene.lens.z_in))


def _part_within(x: np.ndarray, y: np.ndarray, radius: float, parts: int = 8) -> np.ndarray:
    """Part of each cell between corners x, y that lies within a circle, from parts x parts points of it."""
    fine = [np.linspace(c[0], c[-1], 2 * parts * (len(c) - 1) + 1)[1::2] for c in (x, y)]
    inside = (fine[0][:, None] ** 2 + fine[1][None, :] ** 2 <= radius**2).astype(float)
    return inside.reshape(len(x) - 1, parts, len(y) - 1, parts).mean((1, 3))


def _square(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, tuple | None]:
    """The same over the whole rectangle."""
    source, lens, shape = scene.source, scene.lens, (len(x) - 1, len(y) - 1)
    if source.distant:
        profile = source.profile
        if profile is None:
            return np.ones(shape), None
        for axis in (0, 1):  # the profile's cells, averaged over these
            covers = overlap(np.linspace(0.0, 1.0, profile.shape[axis] + 1), np.linspace(0.0, 1.0, shape[axis] + 1))
            profile = covers @ profile if axis == 0 else (covers @ profile.T).T
        return profile, None
    x0, y0, z0 = source.centre
    h, t, n = lens.z_in - z0, z - lens.z_in, lens.inside
    if h <= 0:
        raise InputError(
            f"⟨source.file⟩: its rays meet at z = {z0:.4g} mm, not before the lens, where a first surface by transport"
            " needs a source; ⟨start⟩ offset needs none"
        )
    dx, dy = x[:, None] - x0, y[None, :] - y0
    rho = np.hypot(dx, dy)
    q = np.maximum(rho / (h + t / n), (rho - t / math.sqrt((n - 1.0) * (n + 1.0))) / h)
    for _ in range(STEPS):
        root = np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * q)
        step = (rho - h * q - t * q / root) / (h + t * n * n / root**3)
        q = q + step
        if (np.abs(step) <= 1e-14 * q).all():
            break
    root = np.sqrt(n * n + (n - 1.0) * (n + 1.0) * q * q)
    ratio = 1.0 / (h + t / root)  # q / rho
    sx, sy = dx * ratio, dy * ratio
    gx, gy = np.gradient(sx, x, y), np.gradient(sy, x, y)
    cosine = 1.0 / np.sqrt(1.0 + q * q)
    inside = root * cosine / n
    power = np.abs(gx[0] * gy[1] - gx[1] * gy[0]) * cosine**3
    if lens.fresnel != "none":
        power *= 1.0 - reflectance("exact", cosine, inside, 1.0 / n)
    power *= relative(source.intensity, q)
    cone = min(source.cone_over(lens.half_size, lens.z_in, lens.round), 1.57079)
    through = [np.abs(c0 + h * s) <= r * (1 + 1e-9) for c0, s, r in zip((x0, y0), (sx, sy), lens.half_size, strict=True)]
    power = np.where((q <= math.tan(cone) * (1 + 1e-9)) & through[0] & through[1], power, 0.0)
    light = irradiance(scene, x, y, float(z.mean()))
    if light is None:
        light = 0.25 * (power[1:, 1:] + power[:-1, 1:] + power[1:, :-1] + power[:-1, :-1])
    return light, (sx * cosine / n, sy * cosine / n, inside)
