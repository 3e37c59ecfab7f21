"""The first surface of a design by transport: what lights the exit surface, and the heights that send it onto the picture.

Notation
    p = (x, y, z)   a point of the exit surface; o = (x_0, y_0, z_0) the source, h its distance before the entrance
    s               tangents of the ray's direction from the source, (d_x, d_y) / d_z; q = |s|
    f               power on the exit surface, seen along z, per area

A ray of tangent q crosses the entrance at h q from the axis through the source and the glass under it by t q', with
q' = q / sqrt(n^2 (1 + q^2) - q^2) by Snell; t is the height of p above the entrance.  So the point p is reached by the q with
h q + t q' = |(x - x_0, y - y_0)|, and f = I(q) (1 - R(q)) (1 + q^2)^(-3/2) |d(s_x, s_y) / d(x, y)|.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.inverse import start
from caustic_cli.inverse.target import overlap
from caustic_cli.inverse.transport import corners
from caustic_cli.optics.emission.measured import irradiance
from caustic_cli.optics.interface import reflectance
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.distribution import relative

#: Source cells along the lens' longer side: a picture of 250 x 250 pixels is resolved, and they are cheap.
CELLS = 256
#: Newton steps for q; its function is concave, so from the greater of two lower bounds each step stays below the root.
STEPS = 40
#: How much higher a net may be than the surface it was interpolated from.
OVERSHOOT = 2.0
#: Surfaces solved for in turn where the light depends on the surface it meets.
PASSES = 2


def first_surface(scene: Scene, target: np.ndarray, field: HeightField, cells: int = CELLS) -> Tensor:
    """Control heights (n, m) mm float64 of a lens that throws the picture, from the light of the source's centre.

    Args:
        scene: source, lens and screen.
        target: (n_x, n_y) irradiance on its screen.
        field: spline spaces of the heights.
        cells: source cells along the lens' longer side.

    Raises:
        InputError: the picture is out of reach of refraction.
    """
    lens, half = scene.lens, scene.lens.half_size
    shape = tuple(max(3, round(cells * r / max(half))) for r in half)  # four corners carry a cubic
    x, y = corners(shape[0], half[0]), corners(shape[1], half[1])
    z = lens.offset.thickness + lens.offset.sag(x[:, None], y[None, :])
    mean, found = float(z.mean()), None
    for _ in range(1 if scene.source.distant else PASSES):
        light, directions = _light(scene, x, y, z, shape)
        if lens.round:
            light = light * _part_within(x, y, half[0])
        found = start.surface(light, target, half, scene.screen.half_size, lens.bend, scene.screen.z, mean, directions,
                              centre=scene.screen.shift, start=None if found is None else found.transport.potential)
        z = found.heights
    spline = RectBivariateSpline(x, y, z)
    at = [torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces]
    values = torch.from_numpy(spline(*(c.numpy() for c in field.control_xy())))
    net = at[0] @ values @ at[1].T
    # Through points, a spline of high degree over knots that repeat overshoots; one that has them as its net never does.
    return net if float(net.max() - net.min()) <= OVERSHOOT * float(values.max() - values.min()) else values


def _part_within(x: np.ndarray, y: np.ndarray, radius: float, parts: int = 8) -> np.ndarray:
    """Part of each cell between corners x, y that lies within a circle, from parts x parts points of it."""
    fine = [np.linspace(c[0], c[-1], 2 * parts * (len(c) - 1) + 1)[1::2] for c in (x, y)]
    inside = (fine[0][:, None] ** 2 + fine[1][None, :] ** 2 <= radius**2).astype(float)
    return inside.reshape(len(x) - 1, parts, len(y) - 1, parts).mean((1, 3))


def _light(scene: Scene, x: np.ndarray, y: np.ndarray, z: np.ndarray, shape) -> tuple[np.ndarray, tuple | None]:
    """Power in the cells between corners x, y, and the unit directions inside the glass there (None for along z)."""
    source, lens = scene.source, scene.lens
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
        raise InputError(f"[source] file: its rays meet at z = {z0:.4g} mm, not before the lens, where a first surface by transport"
                         " needs a source; --start offset needs none")
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
    power = np.where(q <= math.tan(cone) * (1 + 1e-9), power, 0.0)
    light = irradiance(scene, x, y, float(z.mean()))
    if light is None:
        light = 0.25 * (power[1:, 1:] + power[:-1, 1:] + power[1:, :-1] + power[:-1, :-1])
    return light, (sx * cosine / n, sy * cosine / n, inside)
