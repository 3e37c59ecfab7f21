"""Independent Monte-Carlo sampling of source rays in NumPy, for verification: it shares no code with `optics/emission`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caustic_cli.scene import Scene, Source

#: Rays at a time.
BATCH = 1 << 20
#: Angles of the quadrature of a tabulated intensity.
TABLE = 20_001


def sample_rays(scene: Scene, rays: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Origins, mm, and directions (3, N) of independent rays in batches, and their weights (N,), whose mean is 1."""
    source, pupil, lowest = scene.source, scene.pupil, scene.lowest
    (rx, ry), z_in, round_ = pupil.half_size, pupil.z, pupil.aperture.round
    if source.profile is not None:
        line = (np.arange(2000) + 0.5) / 1000 - 1
        x, y = np.meshgrid(line, line, indexing="ij")
        within = x * x + y * y <= 1 if round_ else np.ones_like(x, bool)
        mean = _profile(source.profile, x[within], y[within]).mean()
    for first in range(0, rays, BATCH):
        n = min(BATCH, rays - first)
        a, b, u, v = rng.random((4, n))
        one = np.ones(n)
        if source.distant:
            sine = np.sqrt(a) * np.sin(source.half_angle)
            dx, dy = sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b)
            if source.brightness is not None:
                dx, dy = source.frame[0] * _on_picture(source.brightness, n, rng)
            d = np.array([dx, dy, np.sqrt(1 - dx**2 - dy**2)])
            if source.oblique:
                across, d = d[2], _turned(np.array(source.axis), d)
                one = d[2] / (across * source.axis[2])  # the radiance's part that the aperture receives
                one = one / (1.0 if source.brightness is None else one.mean())
            x, y = (
                ((2 * u - 1) * rx, (2 * v - 1) * ry)
                if not round_
                else (rx * np.sqrt(u) * np.cos(2 * np.pi * v), rx * np.sqrt(u) * np.sin(2 * np.pi * v))
            )
            if source.profile is not None:
                one = one * _profile(source.profile, x / rx, y / ry) / mean
            yield np.array([x, y, np.full(n, z_in)]) - (1 + (z_in - lowest) / d[2]) * d, d, one
            continue
        cone = source.cone_over(pupil)
        if source.intensity == "lambertian":
            sine = np.sqrt(a) * np.sin(cone)
        elif source.intensity != "uniform":
            angles = np.linspace(0, cone, TABLE)
            sine = np.sin(np.interp(a, *_summed(source.intensity.relative(angles) * np.sin(angles), angles)))
        else:  # uniform in 1 - cos, without cancellation
            drop = a * 2 * np.sin(cone / 2) ** 2
            sine = np.sqrt(drop * (2 - drop))
        d = np.array([sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b), np.sqrt(1 - sine**2)])
        o = STARTS[source.kind](source, u, v, rng)
        near = d[2] > 1e-6  # start at most 1 mm before the entrance, for single precision
        yield o + d * np.where(near, np.maximum((lowest - o[2]) / np.where(near, d[2], 1) - 1, 0), 0), d, one


def _turned(axis: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Vectors (3, N) turned by the rotation that takes +z to a unit vector, about the line perpendicular to both (Rodrigues)."""
    about = np.cross([0.0, 0.0, 1.0], axis)
    sine, cosine = np.linalg.norm(about), axis[2]
    k = about / sine
    return d * cosine + np.cross(k, d.T).T * sine + np.outer(k, (k @ d) * (1 - cosine))


def _on_points(source: Source, u: np.ndarray, _v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3, N): points drawn with probabilities proportional to their powers."""
    positions, parts = source.points()
    return positions[rng.choice(len(parts), len(u), p=parts)].T


def _on_disc(source: Source, u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3, N): uniform over the ellipse, or distributed by a picture of the radiance."""
    if source.brightness is not None:
        x, y = np.array(source.frame)[:, None] * _on_picture(source.brightness, len(u), rng)
        return source.points()[0].T + np.array([x, y, 0 * u])
    wide, high = np.sqrt(u) * np.array(source.extent)[:, None]
    return source.points()[0].T + np.array([wide * np.cos(2 * np.pi * v), high * np.sin(2 * np.pi * v), 0 * u])


def _on_picture(light: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(2, N): points of [-1, 1]^2 with a density proportional to a picture."""
    cell = rng.choice(light.size, count, p=light.ravel() / light.sum())
    places = zip(np.unravel_index(cell, light.shape), light.shape, strict=True)
    return np.array([2 * (k + rng.random(count)) / n - 1 for k, n in places])


def _summed(density: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cumulative distribution of a density at its nodes, by the trapezoidal rule, and the nodes."""
    sums = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(at)))
    return sums / sums[-1], at


#: Sampling of the origins on a near source, by its kind; kinds of sources that can be sampled.
STARTS = {"point": _on_points, "grid": _on_points, "disc": _on_disc}
KINDS = ("plane", *STARTS)


def _profile(e: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Relative irradiance at points of [-1, 1]^2."""
    i, j = (np.clip((0.5 * (c + 1) * k).astype(int), 0, k - 1) for c, k in zip((x, y), e.shape, strict=True))
    return e[i, j]
