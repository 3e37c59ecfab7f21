"""Independent Monte-Carlo sampling of source rays in NumPy, for verification.

It shares no code with `optics/emission`, save for types of sources from outside the program, which it cannot know.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from caustic_cli.optics.emission import rays_of
from caustic_cli.scene import Pupil, Scene, Source

#: Rays at a time.
BATCH = 1 << 20
#: Angles of the quadrature of a tabulated intensity.
TABLE = 20_001


def sample_rays(scene: Scene, rays: int, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Origins, mm, and directions (3, N) of independent rays in batches, and their weights (N,), whose mean is 1."""
    sampled = _sampling(scene)
    for first in range(0, rays, BATCH):
        yield sampled(scene, min(BATCH, rays - first), rng)


def _sampling(scene: Scene) -> Callable[[Scene, int, np.random.Generator], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """How the rays of a scene's source are sampled: those of a type that is not known here by its own emission."""
    source = scene.source
    if source.rays is not None:
        return _of_file
    if source.beam is not None:
        return _of_beam
    if source.kind not in KINDS:
        return _of_emission
    return _from_infinity if source.distant else _from_nearby


def _from_infinity(scene: Scene, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of a source at infinity."""
    source, pupil = scene.source, scene.pupil
    (rx, ry), one = pupil.half_size, np.ones(n)
    a, b, u, v = rng.random((4, n))
    sine = np.sqrt(a) * np.sin(source.half_angle)
    dx, dy = sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b)
    if source.brightness is not None:
        dx, dy = source.frame[0] * _on_picture(source.brightness, n, rng)
    d = np.array([dx, dy, np.sqrt(1 - dx**2 - dy**2)])
    if source.oblique:
        across, d = d[2], _turned(np.array(source.axis), d)
        one = d[2] / (across * source.axis[2])  # the radiance's part that the aperture receives
        one = one / (1.0 if source.brightness is None else one.mean())
    x, y = pupil.aperture.spread(u, v)
    if source.profile is not None:
        one = one * _profile(source.profile, x / rx, y / ry) / _mean(source.profile, pupil)
    return _before(scene, x, y, d), d, one


def _from_nearby(scene: Scene, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of points and discs nearby, all over their cone."""
    source = scene.source
    a, b, u, v = rng.random((4, n))
    cone = source.cone_over(scene.pupil)
    if source.intensity == "lambertian":
        sine = np.sqrt(a) * np.sin(cone)
    elif source.intensity != "uniform":
        angles = np.linspace(0, cone, TABLE)
        sine = np.sin(np.interp(a, *_summed(source.intensity.relative(angles) * np.sin(angles), angles)))
    else:  # uniform in 1 - cos, without cancellation
        drop = a * 2 * np.sin(cone / 2) ** 2
        sine = np.sqrt(drop * (2 - drop))
    d = np.array([sine * np.cos(2 * np.pi * b), sine * np.sin(2 * np.pi * b), np.sqrt(1 - sine**2)])
    return _onwards(scene, STARTS[source.kind](source, u, v, rng), d), d, np.ones(n)


def _of_file(scene: Scene, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays of a file, drawn with probabilities proportional to their flux."""
    turned, (origin,) = scene.source.turned, scene.source.origin[None, :]
    chosen = rng.choice(turned.count, n, p=turned.flux / turned.flux.sum())
    d = turned.directions[chosen].T
    ahead = np.where(d[2] > 0, 1.0, 0.0)
    return _onwards(scene, (turned.positions[chosen] + origin).T, d), d, ahead


def _of_beam(scene: Scene, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays normal to the wavefronts of a laser beam, weighted by its irradiance on the pupil."""
    source, pupil = scene.source, scene.pupil
    x, y = pupil.aperture.spread(*rng.random((2, n)))
    sines = np.zeros((2, n))
    if source.brightness is not None:
        sines = np.array(source.frame)[:, None] * _on_picture(source.brightness, n, rng)
    found = source.beam(x, y, pupil, *sines)
    d = np.array([np.broadcast_to(c, n) for c in found.directions])
    return _before(scene, x, y, d), d, found.irradiance / source.passed(pupil)


def _of_emission(scene: Scene, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays as the program itself samples them, at random."""
    parts = [state.expanded() for state in rays_of(scene, "uniform", n, int(rng.integers(1 << 30))).chunks()]
    columns = zip(*((*s.origin[:2], *s.direction, s.power) for s in parts), strict=True)
    x, y, *d, power = (np.concatenate([c.numpy() for c in column]) for column in columns)
    return _before(scene, x, y, np.array(d)), np.array(d), power * len(power)


def _before(scene: Scene, x: np.ndarray, y: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Points of rays through points of the pupil, 1 mm before all of the lens: (3, N)."""
    z = scene.pupil.z
    return np.array([x, y, np.full(len(x), z)]) - (1 + (z - scene.lowest) / d[2]) * d


def _onwards(scene: Scene, o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Points of rays from o, at most 1 mm before the lens, for single precision: (3, N)."""
    near = d[2] > 1e-6
    return o + d * np.where(near, np.maximum((scene.lowest - o[2]) / np.where(near, d[2], 1) - 1, 0), 0)


def _mean(profile: np.ndarray, pupil: Pupil) -> float:
    """Mean of a relative irradiance over the aperture."""
    line = (np.arange(2000) + 0.5) / 1000 - 1
    x, y = np.meshgrid(line, line, indexing="ij")
    within = pupil.aperture.covers(x, y)
    return _profile(profile, x[within], y[within]).mean()


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
