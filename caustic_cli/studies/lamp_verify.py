"""Verification of a lamp against Mitsuba 3, as `verify` does of lenses: its own light, drawn by NumPy, through the exported meshes,
and images compared bin by bin.

A target in the far field is seen on a distant plane, which both programs trace.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli.errors import CausticError
from caustic_cli.optics.sampling import stream
from caustic_cli.optics.surfaces.polarfield import PolarField
from caustic_cli.scene.lamp import Chip, Goal, Lamp
from caustic_cli.studies.lamp import lamp_image
from caustic_cli.studies.retrace import BATCHES
from caustic_cli.studies.verify import TURN, Agreement, SceneSurface, choose_variant, compare, follow

#: Surfaces in the order of light, and rays traced at a time.
SURFACES, CHUNK = [SceneSurface(name, False, 0.0) for name in ("inner", "outer", "screen")], 1 << 20


def verify_lamp(
    scene: Path, lamp: Lamp, seen: Goal, field: PolarField, values: Tensor, pixels: tuple[int, int], rays: int, seed: int = 0
) -> Agreement:
    """Trace a lamp here and its exported scene in Mitsuba, with about `rays` rays each, and compare on pixels of its target.

    seen: the target, a plane.

    Raises:
        CausticError: no variant of Mitsuba works on this machine, or no light reaches the target.
    """
    variant = choose_variant()
    import mitsuba as mi  # noqa: PLC0415

    mi.set_log_level(mi.LogLevel.Error)
    world = mi.load_file(str(scene), optimize=False)
    shapes = {shape.id(): shape for shape in world.shapes()}
    rng = np.random.default_rng([seed, 1])
    image, squares = np.zeros((2, *pixels))
    for start in range(0, rays, CHUNK):
        *points, weight = follow(mi, world, shapes, SURFACES, *_emitted(lamp, min(CHUNK, rays - start), rng), rng)
        x, y = (p - middle for p, middle in zip(points, seen.shift, strict=False))
        for total, power in ((image, weight), (squares, weight**2)):
            total += np.histogram2d(x, y, pixels, [(-0.5 * s, 0.5 * s) for s in seen.size], weights=power)[0]
    seeds = [stream(seed, f"verify {k}") for k in range(BATCHES)]
    renders = np.array(
        [lamp_image(lamp, seen, field, values, pixels, rays=max(2, rays // BATCHES), seed=own).image for own in seeds]
    )
    if not (renders.sum() > 0 and image.sum() > 0):
        raise CausticError("no light reaches the target, so there is nothing to verify")
    shift = TURN * seen.distance / min(s / n for s, n in zip(seen.size, pixels, strict=True))
    return compare(renders, image / rays, squares / rays**2, rays, shift, {"mitsuba": mi.__version__, "variant": variant})


def _emitted(lamp: Lamp, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins (3, N) mm on the chips and directions (3, N), see `_of_chip`."""
    origin, direction = _of_chip(lamp.chip, count, rng)
    if lamp.count > 1:
        origin = origin + np.append(lamp.places, np.zeros((lamp.count, 1)), 1)[rng.integers(lamp.count, size=count)].T
    return origin, direction


def _of_chip(chip: Chip, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Origins (3, N) mm on a chip and directions (3, N): by polar angles, independent of `optics.lamp`; of a table by rejection,
    of a ray file its own."""
    if chip.rays is not None:
        at = rng.choice(len(chip.rays.flux), count, p=chip.rays.flux / chip.rays.flux.sum())
        return chip.rays.positions[at].T, chip.rays.directions[at].T
    sine, turn = np.sqrt(rng.uniform(size=count)), 2.0 * math.pi * rng.uniform(size=count)
    if chip.intensity is not None:
        sine, most = np.empty(0), max(chip.intensity.values)
        while len(sine) < count:
            cosine = rng.uniform(size=count)  # uniform in solid angle
            kept = rng.uniform(size=count) * most < chip.intensity.relative(np.arccos(cosine))
            sine = np.concatenate([sine, np.sqrt(1.0 - cosine[kept] ** 2)])
        sine = sine[:count]
    direction = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.sqrt(1.0 - sine * sine)])
    x, y = rng.uniform(-1.0, 1.0, (2, count))
    if chip.shape == "disc":
        radius, around = np.sqrt(rng.uniform(size=count)), 2.0 * math.pi * rng.uniform(size=count)
        x, y = radius * np.cos(around), radius * np.sin(around)
    return np.stack([0.5 * chip.size[0] * x, 0.5 * chip.size[1] * y, np.zeros(count)]), direction
