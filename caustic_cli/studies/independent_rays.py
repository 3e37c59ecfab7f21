"""Independent rays of a source, drawn in NumPy all over its cone or the aperture: no line is shared with `optics/emission`."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from caustic_cli.scene import Scene, Source

#: Rays at a time.
BATCH = 1 << 20
#: Angles by which a table of intensities is summed.
TABLE = 20_001


def emitted(scene: Scene, rays: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Starts and directions (3, N) of independent rays, batch by batch, and what each carries: 1 on average over all of them."""
    source, pupil, lowest = scene.source, scene.pupil, scene.lowest
    (rx, ry), z_in, round_ = pupil.half_size, pupil.z, pupil.round
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
            x, y = (
                ((2 * u - 1) * rx, (2 * v - 1) * ry)
                if not round_
                else (rx * np.sqrt(u) * np.cos(2 * np.pi * v), rx * np.sqrt(u) * np.sin(2 * np.pi * v))
            )
            if source.profile is not None:
                one = _profile(source.profile, x / rx, y / ry) / mean
            yield np.array([x, y, np.full(n, z_in)]) - (1 + (z_in - lowest) / d[2]) * d, d, one
            continue
        cone = source.cone_over((rx, ry), z_in, round_)
        if source.intensity == "lambertian":
            sine = np.sqrt(a) * np.sin(cone)
        elif source.intensity != "uniform":
            angles = np.linspace(0, cone, TABLE)
            sine = np.sin(np.interp(a, *_summed(source.intensity.relative(angles) * np.sin(angles), angles)))
        else:  # even in the cosine, reckoned from 1
            drop = a * 2 * np.sin(cone / 2) ** 2
            sine = np.sqrt(drop * (2 - drop))
        d = np.array([sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b), np.sqrt(1 - sine**2)])
        o = STARTS[source.kind](source, u, v, rng)
        near = d[2] > 1e-6  # from 1 mm or less before the entrance: single precision knows no far origin
        yield o + d * np.where(near, np.maximum((lowest - o[2]) / np.where(near, d[2], 1) - 1, 0), 0), d, one


def _on_points(source: Source, u: np.ndarray, _v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3, N): one of the points each, as often as its power asks for."""
    positions, parts = source.points()
    return positions[rng.choice(len(parts), len(u), p=parts)].T


def _on_disc(source: Source, u: np.ndarray, v: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3, N): even over the ellipse, or by a picture."""
    if source.brightness is not None:
        x, y = np.array(source.frame)[:, None] * _on_picture(source.brightness, len(u), rng)
        return source.points()[0].T + np.array([x, y, 0 * u])
    wide, high = np.sqrt(u) * np.array(source.extent)[:, None]
    return source.points()[0].T + np.array([wide * np.cos(2 * np.pi * v), high * np.sin(2 * np.pi * v), 0 * u])


def _on_picture(light: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(2, N): points of [-1, 1]^2, as many in each pixel as its light asks for."""
    cell = rng.choice(light.size, count, p=light.ravel() / light.sum())
    places = zip(np.unravel_index(cell, light.shape), light.shape, strict=True)
    return np.array([2 * (k + rng.random(count)) / n - 1 for k, n in places])


def _summed(density: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts of a density up to each place, by trapezia, and the places."""
    sums = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(at)))
    return sums / sums[-1], at


#: Where rays of a near source of each kind start, and the kinds of which rays can be drawn.
STARTS = {"point": _on_points, "grid": _on_points, "disc": _on_disc}
KINDS = ("plane", *STARTS)


def _profile(e: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Relative irradiance at points of [-1, 1]^2."""
    i, j = (np.clip((0.5 * (c + 1) * k).astype(int), 0, k - 1) for c, k in zip((x, y), e.shape, strict=True))
    return e[i, j]
