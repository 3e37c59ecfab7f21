"""Self-contained HTML page with a ray tracer for a lens: `page.html`, `page.css` and `page.js` with the data of lens, light and
screen.

The page holds heights and slopes of the free-form surfaces, and of a curved screen over its tangent plane, on regular grids, and
traces rays in the browser, offline.  Values are quantised to 16 bits between the least and the largest: one quantum of a slope
displaces light by 1/65,535 of the range of all slopes, far less than a pixel.  Light that has more before its screen than one lens
of one index is held as rays (`traced`), and that of a ray file as points with an intensity each (`light_field`): the screen moves
on such a page, the light does not.

Notation
    c[i, j]     codes, i along +x and j along +y; stored as their differences along both axes, modulo 2^16, for compression
    i(theta)    intensity of a near source over its power, 1/sr
    s           |d - a| / 2 sin(theta_c / 2): distance of a ray direction from the axis of its cone, over that of the cone's edge
"""

from __future__ import annotations

import base64
import html
import json
import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from operator import mul
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.export.page.light_field import MOST as MOST_POINTS
from caustic_cli.export.page.light_field import FieldPoint, LightField, light_fields
from caustic_cli.export.page.traced import ITSELF, traced_lights
from caustic_cli.export.page.traced import MOST as MOST_HELD
from caustic_cli.export.surface import SurfaceGrid, sample_grid
from caustic_cli.io.colorimetry import rgb_matrix
from caustic_cli.io.files import CREATED_BY, write_bytes
from caustic_cli.optics.emission.brightness import points_by_brightness
from caustic_cli.optics.resampling import resampled
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Lens, Pupil, Scene, Screen, Source
from caustic_cli.scene.traits import Capability

#: Cells of the grid along its longer side, the finest that fits is used; multiples of COARSEST, by which the page subsamples it.
CELLS = (1024, 768, 512, 384)
#: The same of light that is held as rays (`traced`), of which each point of the source has a grid.
FEWER = (512, 384, 256, 192, 128, 96, 64, 32)
COARSEST = 32
#: Largest size of the page, bytes, for e-mail, and of the grid in it.
MOST, MOST_CLOUD = 5_000_000, 3_400_000
#: Compression level; the highest takes twenty times as long for 2 % of the size.
LEVEL = 6
#: Points along each axis of the shape of a curved screen.
SHAPE = 257
#: Points along each axis of the irradiance and direction of uneven light, of a single source; several share as many.
FRONT = 385
#: Pixels of the page's screen across, at most; a finer target is averaged down to them.
PIXELS = 512
#: Most positions of a source; more are subsampled evenly.
PLACES = 1024
#: Angles of a table of intensities, and points that represent a picture of a source.
ANGLES, BRIGHT = 257, 256
#: Effects that the page simulates; it lists others as left out.
TRACED = frozenset(
    {
        "source-size",
        "entrance",
        "intersection",
        "missed-surface",
        "absorption",
        "fresnel",
        "total-reflection",
        "mirror",
        "screen-shape",
        "screen-tilt",
        "screen-shift",
        "dispersion",
    }
)
#: Additive quasi-random sequence R2 in the unit square, powers of the inverse plastic number (Roberts 2018).
EVEN = (0.7548776662466927, 0.5698402909980532)
PAGE = Capability("interactive page", {})


def write_page(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    target: np.ndarray | None = None,
    *,
    title: str = "Lens",
    rows: Sequence[tuple[str, str]] = (),
    notes: Sequence[str] = (),
    waves: np.ndarray | None = None,
    waves_xyz: np.ndarray | None = None,
    encoding: str = "srgb",
) -> None:
    """Write the page.

    Args:
        scene: of a plan; effects beyond TRACED should be listed in `notes`.
        heights: (n, m) control heights, mm.
        target: (n_x, n_y) or (3, n_x, n_y) on the scene's screen, any scale; None for a page without it.
        title: of the page; rows: names and figures of a table; notes: sentences below it.  All text is escaped.
        waves: the wave image, like `target`; waves_xyz: its tristimulus values (3, n_x, n_y), for light with colour.
        encoding: of displayed images, srgb or linear.

    Raises:
        InputError: the file cannot be written, or no ray of a ray file meets the lens.
    """
    scene = scene.unfolded
    moves = ITSELF.supports(scene)
    screen, kind = _coarser(scene.screen), scene.lens.kind
    fields = light_fields(replace(scene, screen=screen), MOST_POINTS if moves else MOST_HELD)
    data = {
        "title": title,
        "lens": _lens(scene.lens),
        "screen": _screen(replace(scene, screen=screen)),
        "lights": _lights(scene, fields) if moves else [],
        "still": bool(fields) or not moves,
        "encoding": encoding,
        "target": None if target is None else _coded(_onto(target, screen)),
        "waves": None if waves is None else _coded(_onto(waves, screen)),
        "wavesColour": None if waves_xyz is None else [_coded(_onto(c, screen)) for c in _primaries(scene, waves_xyz)],
    }
    words = {
        "title": html.escape(title),
        "kind": kind,
        "Kind": kind.capitalize(),
        "rows": _table(rows),
        "notes": "".join(f"<p>{html.escape(note)}</p>" for note in (*notes, *(of.words for of in fields.values()))),
    }
    fronts = sum(_length(light["front"]) for light in data["lights"] if light.get("front"))
    for cells in CELLS if moves else FEWER:
        cloud = _cloud(scene, field, heights, cells)
        if not moves:
            room = MOST_CLOUD - _length(cloud) if cells > FEWER[-1] else MOST
            data["lights"] = [_held(scene, field, heights, tuple(cloud["exit"]["z"]["shape"]), fields, room)]
            fronts = sum(map(_length, data["lights"][0]["rays"]))
        if _length(cloud) + fronts <= MOST_CLOUD:
            break
    page = _assembled(words, data | {"cloud": cloud}).encode()
    assert len(page) <= MOST, len(page)
    write_bytes(path, page)


def _lens(lens: Lens) -> dict:
    """What the page needs of a lens or mirror beside its surface."""
    return {
        "size": list(lens.size),
        "zIn": lens.pupil.z,
        "round": lens.opening.round,
        "mirror": lens.mirror,
        "fresnel": ["none", "schlick", "exact"].index(lens.interior.fresnel),
        "absorption": lens.interior.absorption,
    }


def _screen(scene: Scene) -> dict:
    """The screen: x, y and z of its centre, the light's way along x and y for each mm along z, by which it moves with its distance,
    its lowest corner from the centre, its axes, whether its normal is along the light, the focal length of a far one, mm, 0 for
    others, the unit of its lengths, and its shape."""
    screen, (x, y, z) = scene.screen, scene.undeviated
    return {
        "z": screen.z,
        "centre": list(screen.centre[:2]),
        "along": [x / z, y / z],
        "low": [-half for half in screen.half_size],
        "pixel": list(screen.pixel),
        "resolution": list(screen.resolution),
        "axes": [list(axis) for axis in screen.axes],
        "facing": sum(map(mul, scene.undeviated, screen.axes[2])) > 0,
        "focal": abs(screen.z) if screen.far else 0.0,
        "unit": screen.unit,
        "shape": _shape(screen) if screen.curved else None,
    }


def _shape(screen: Screen) -> dict:
    """Heights and slopes of a curved screen over its tangent plane, on a regular grid, borders included, mm and 1."""
    x, y = (np.linspace(-half, half, SHAPE) for half in screen.half_size)
    return _surface(*shape_of(screen).at(x[:, None], y[None, :]))


def _assembled(words: dict[str, str], data: dict) -> str:
    """The page with all files inlined; < is escaped in `data`, so that no text can end its script element."""
    here = resources.files(__name__)
    style, script, page = ((here / f"page.{kind}").read_text("utf-8") for kind in ("css", "js", "html"))
    held = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts = words | {"created": f"{CREATED_BY} {__version__}", "style": style, "script": script, "data": held}
    pieces = page.split("@@")  # text, name, text, ..., text: inserted text is not scanned again
    pieces[1::2] = [parts[name] for name in pieces[1::2]]
    return "".join(pieces)


def _table(rows: Sequence[tuple[str, str]]) -> str:
    return "".join(f"<tr><th scope=row>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in rows)


def _cloud(scene: Scene, field: HeightField, heights: Tensor, cells: int) -> dict:
    """The exit surface, and the entrance surface if it is free-form, on a regular grid over the aperture."""
    lens = scene.lens
    counts = tuple(COARSEST * max(1, round(cells * w / max(lens.size) / COARSEST)) + 1 for w in lens.size)
    exit = sample_grid(field, heights, counts)
    entrance = None if lens.entrance is None else entrance_grid(lens, counts)
    return {
        "exit": _surface(exit.z, exit.zx, exit.zy),
        "entrance": None if entrance is None else _surface(lens.z_in + entrance.z, entrance.zx, entrance.zy),
    }


def entrance_grid(lens: Lens, counts: tuple[int, int]) -> SurfaceGrid:
    """A free-form entrance on a regular grid of points (n, m) over the aperture, its heights measured from z_in, mm."""
    front = entrance_of(lens)
    return sample_grid(front.field, front.heights, counts)


def _surface(z: np.ndarray, zx: np.ndarray, zy: np.ndarray) -> dict:
    """Heights and slopes (n, m) of a surface."""
    return {"z": _coded(z), "zx": _coded(zx), "zy": _coded(zy)}


def _length(held: dict) -> int:
    """Bytes of all grids in nested parts of the page's data."""
    return len(held["data"]) if "data" in held else sum(_length(part) for part in held.values() if isinstance(part, dict))


def _front(source: Source, pupil: Pupil, points: int) -> dict | None:
    """Irradiance over its mean of uneven light from infinity, and the sines along x and y of its directions to its axis, on a
    regular grid of so many points along each axis of the pupil; None for a plane wave of uniform irradiance."""
    if not source.uneven:
        return None
    x, y = (np.linspace(-r, r, points) for r in pupil.half_size)
    x, y = x[:, None], y[None, :]
    lit = np.broadcast_to(source.irradiance(x, y, pupil) / source.passed(pupil), (points, points))
    if source.beam is None:
        return _surface(lit, *np.zeros((2, points, points)))
    directions = source.beam(x, y, pupil).directions[:2]
    return _surface(lit, *(np.broadcast_to(d, lit.shape) - axis for d, axis in zip(directions, source.axis[:2], strict=True)))


def _coarser(screen: Screen) -> Screen:
    """The screen with at most PIXELS pixels across."""
    factor = max(1.0, max(screen.resolution) / PIXELS)
    nx, ny = (max(1, round(n / factor)) for n in screen.resolution)
    return replace(screen, resolution=(nx, ny))


def _onto(image: np.ndarray, screen: Screen) -> np.ndarray:
    """An image summed over colours, resampled to the pixels of a screen of the same size."""
    grey = image.sum(0) if image.ndim == 3 else image
    return resampled(grey, screen.resolution) * (grey.size / math.prod(screen.resolution))


def _coded(values: np.ndarray) -> dict:
    """Quantise and compress values (n, m): differences of codes, low bytes, then high bytes, deflate, base64."""
    low, high = float(values.min()), float(values.max())
    span = (high - low) or 1.0
    codes = np.rint((values - low) * (65535.0 / span)).astype(np.int64)
    steps = np.diff(np.diff(codes, axis=1, prepend=0), axis=0, prepend=0).astype(np.uint16)
    deflated = zlib.compress((steps & 255).astype(np.uint8).tobytes() + (steps >> 8).astype(np.uint8).tobytes(), LEVEL)
    return {"shape": list(values.shape), "low": low, "step": span / 65535.0, "data": base64.b64encode(deflated).decode()}


def _primaries(scene: Scene, xyz: np.ndarray) -> np.ndarray:
    """Linear R, G, B of sRGB, of any sign, of tristimulus values (3, ...), in which the light of the sources is grey."""
    assert scene.white is not None
    return np.tensordot(rgb_matrix(scene.white), xyz, 1)


def _lights(scene: Scene, fields: Mapping[int, LightField]) -> list[dict]:
    """The sources, and the points of ray files: fraction of the total power of each, and its refractive indices, each with its
    weight and, where the colour differs, linear R, G, B by its power."""
    lights = []
    for k, one in enumerate(scene.by_source):
        bands = [band for band in scene.bands if band.member in (None, k)]
        total = math.fsum(band.weight for band in bands)
        indices = {}
        for index in dict.fromkeys(band.scene.lens.inside for band in bands):
            same = [band for band in bands if band.scene.lens.inside == index]
            weights = np.array([band.weight for band in same])
            colours = [band.colour for band in same if band.colour is not None and scene.white is not None]
            mean = _primaries(scene, weights @ np.array(colours) / weights.sum()).tolist() if colours else None
            indices[index] = (weights.sum() / total, mean)
        points = round(FRONT / math.sqrt(len(scene.by_source)))
        shared = {"indices": [[index, *of] for index, of in indices.items()]}
        for part, light in map(_point, fields[k].points) if k in fields else [(1.0, _source(one, one.source, points))]:
            lights.append({"weight": scene.source.fractions[k] * part, **shared, **light})
    return lights


def _point(point: FieldPoint) -> tuple[float, dict]:
    """A point of a ray file, as a fraction of its power and a near source of uniform intensity whose irradiance is uneven."""
    even = float(point.intensity.mean())
    x, y, z = point.position
    light = {"extent": [0.0, 0.0], "picture": None, "chord": 2.0, "cut": False, "intensity": [even / point.part] * 2}
    front = _surface(point.intensity / even, *np.zeros((2, *point.intensity.shape)))
    return point.part, {"near": True, "places": [[x, y, z - point.pupil.z, 1.0]], **light, "front": front}


def _held(
    scene: Scene, field: HeightField, heights: Tensor, counts: tuple[int, int], fields: Mapping[int, LightField], room: int
) -> dict:
    """All light as rays behind the last surface, see `traced`, as a source that the page takes to its screen; or as much of it as
    is more than `room`, bytes."""
    pupil, lens = scene.pupil.half_size, scene.lens.half_size
    more = math.prod(pupil) / math.prod(lens)  # power per area of the lens' rectangle, over which the page has the grid
    rays = []
    for one in traced_lights(scene, field, heights, counts, fields):
        colour = one.band.colour
        rays.append(
            {
                "part": one.part * more,
                "z": one.z,
                "ahead": one.ahead,
                "colour": None if colour is None or scene.white is None else _primaries(scene, np.array(colour)).tolist(),
                **{name: _coded(grid) for name, grid in one.grids.items()},
            }
        )
        room -= _length(rays[-1])
        if room < 0:
            break
    still = {"near": False, "places": [[0.0, 0.0, 0.0, 1.0]], "extent": [0.0, 0.0], "axis": [0.0, 0.0, 1.0], "indices": []}
    return {"weight": 1.0, **still, "rays": rays}


def _source(scene: Scene, source: Source, points: int) -> dict:
    """Positions relative to the centre of the entrance, mm, with their weights; half sizes; the axis of light from infinity; the
    cone and i(theta) as a function of s."""
    if source.distant:
        wide = math.sin(source.half_angle)
        extent = [wide, wide] if source.beam is None else list(source.frame)
        front = _front(source, scene.lens.pupil, points)
        light = {"extent": extent, "axis": list(source.axis), "picture": _picture(source), "front": front}
        return {"near": False, "places": [[0.0, 0.0, 0.0, 1.0]], **light}
    (places, parts), lens = source.points(), scene.lens
    if len(places) > PLACES:
        kept = np.linspace(0, len(places) - 1, PLACES).round().astype(int)
        places, parts = places[kept], parts[kept] / parts[kept].sum()
    cone = source.cone_over(lens.pupil)
    angles = 2.0 * np.arcsin(np.linspace(0.0, 1.0, ANGLES) * math.sin(0.5 * cone))
    return {
        "near": True,
        "places": [[x, y, z - lens.pupil.z, float(part)] for (x, y, z), part in zip(places.tolist(), parts, strict=True)],
        "extent": list(source.frame if source.brightness is not None else source.extent),
        "picture": _picture(source),
        "chord": 2.0 * math.sin(0.5 * cone),
        "cut": source.cone is not None,
        "intensity": [float(f"{v:.7g}") for v in _intensity(source, angles, cone)],
    }


def _intensity(source: Source, angles: np.ndarray, cone: float) -> np.ndarray:
    """i(theta), 1/sr, at angles from the axis, rad, within the cone."""
    if isinstance(source.intensity, str):
        lambertian = source.intensity == "lambertian"
        whole = math.pi * (math.sin(cone) ** 2 if lambertian else 4.0 * math.sin(0.5 * cone) ** 2)
        return (np.cos(angles) if lambertian else np.ones_like(angles)) / whole
    return source.intensity.relative(angles) / source.intensity.flux(cone)


def _picture(source: Source) -> list[list[float]] | None:
    """Points of [-1, 1]^2 with a density proportional to the radiance; None for a uniform ellipse."""
    if source.brightness is None:
        return None
    a, b = (torch.from_numpy(np.arange(1, BRIGHT + 1) * step % 1.0) for step in EVEN)
    x, y = points_by_brightness(source.brightness, a, b)
    return torch.stack([x, y], -1).tolist()
