"""Writer of Zemax OpticStudio Grid Sag files (`.DAT`) of a surface, with exact derivatives.

    ! comments
    nx ny delx dely unitflag xdec ydec      unitflag 0 is mm; the grid is centred
    z dz/dx dz/dy d2z/dxdy nodata           nx ny lines: the first is at (-x, +y), x varies fastest, y descends

z is the sag from the vertex (0, 0) of the surface.  Base radius infinity, conic 0, bicubic interpolation: Hermite patches with
exact derivatives reproduce a bicubic lens to rounding if every knot is a grid line, as by default for equispaced knots.  With
zero derivatives OpticStudio uses finite differences, with an error of 0.05 mm and more on the screen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import reading
from caustic_cli.export.reading import Readings
from caustic_cli.export.surface import STEPS_PER_SPAN, Sampling, SurfaceGrid, counts_of, sample_grid, samplings
from caustic_cli.export.text import CREATED, real, rows
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.traits import TRAITS

#: Least number of points along an axis in OpticStudio.
LEAST = 5
#: Significant digits of heights and derivatives, for a relative error of 1e-12, and typical bytes of a row.
DIGITS = 12
A_ROW = 4 * (DIGITS + 6) + 3


def write_zemax(path: str | Path, scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> None:
    """Write the grid atomically.

    Args:
        heights: (n, m) control heights, mm.
        samples: density of points, always equispaced; None for `STEPS_PER_SPAN`.

    Raises:
        InputError: fewer than `LEAST` or too many points, or the file cannot be written there.
    """
    grid = _grid(field, heights, samples)
    nx, ny = grid.shape
    vertex = float(field.at(heights, *torch.zeros(2, 1, dtype=torch.float64), [(0, 0)])[0])
    columns = grid.z - vertex, grid.zx, grid.zy, grid.zxy
    table = np.stack([c[:, ::-1].T.ravel() for c in columns], -1)
    lens, behind = scene.lens, "the flat entrance"
    entrance = lens.z_in
    if lens.entrance is not None:
        front, behind = entrance_of(lens), "that of the entrance, which has a file of its own"
        entrance += float(front.field.at(front.heights, *torch.zeros(2, 1, dtype=torch.float64), [(0, 0)])[0])
    head = [
        f"! {CREATED}",
        "! Grid Sag, mm; base radius infinity, conic 0; interpolation bicubic",
        f"! vertex {real(vertex - entrance)} mm behind {behind}, index {real(lens.index)}, {_seen(scene.screen, vertex)}",
        *(f"! {words(scene)}" for trait, words in BESIDE.items() if TRAITS[trait].found_in(scene)),
        f"{nx} {ny} {real((grid.x[-1] - grid.x[0]) / (nx - 1))} {real((grid.y[-1] - grid.y[0]) / (ny - 1))} 0 0 0",
        "",
    ]
    with atomic_file(path) as file:
        file.write("\r\n".join(head).encode())
        file.writelines(rows(table, f"{f'%.{DIGITS}g ' * 4}0\r\n"))


def _seen(screen: Screen, vertex: float) -> str:
    """Where the light of a surface with this vertex, mm, is seen."""
    if screen.far:
        return f"picture in the far field (afocal image space): direction cosines are its lengths over {real(abs(screen.z))}"
    return f"screen {real(screen.z - vertex)} mm behind the vertex"


def _turns(tilt: Sequence[float]) -> str:
    """The rotations of a screen about its centre, as `scene.screen.tilted` takes them, in words."""
    turns = [*zip("z", tilt[2:], strict=False), *zip("xy", tilt, strict=False)]
    return ", then ".join(f"the fixed {axis} axis by {real(angle)} degrees" for axis, angle in turns if angle)


def _round_lenslets(scene: Scene) -> str:
    cells = scene.lens.cells
    centres = " ".join(f"({real(x)}, {real(y)})" for x, y in cells.centres)
    return f"opaque but for circles of radius {real(cells.radius)} mm (a user-defined aperture) about {centres}"


#: What belongs to a scene with a trait and is not in the file.
BESIDE: dict[str, Callable[[Scene], str]] = {
    "tilted light": lambda s: f"light along ({', '.join(map(real, s.source.axis))}), a unit vector",
    "shifted screen": lambda s: f"screen decentred by x {real(s.screen.shift[0])} mm, y {real(s.screen.shift[1])} mm",
    "tilted screen": lambda s: f"screen tilted about {_turns(s.screen.tilt)}",
    "curved screen": lambda s: f"the screen is {s.screen.shape_words()}, which this file does not contain",
    "folded axis": lambda s: "along the axis, which flat mirrors fold, that this file does not contain",
    "other elements": lambda s: "among other elements that this file does not contain",
    "circular aperture": lambda s: f"circular aperture of radius {real(s.lens.half_size[0])} mm",
    "gradient index": lambda s: f"the index varies, which this file does not contain: {s.lens.gradient.words(s.lens.index)}",
    "round lenslets": _round_lenslets,
}


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float) -> list[dict]:
    """Densities of files of at most `limit` bytes, the smallest first."""
    return [{"samples": s} for s in samplings(field.spaces, limit / A_ROW, LEAST)]


def readings(scene: Scene, field: HeightField, heights: Tensor, samples: Sampling | None = None) -> Readings:
    """The surface as read from the grid, whose numbers are rounded by less than a float32 resolves."""
    grid = _grid(field, heights, samples)
    return {"error": lambda: reading.of_patches(grid, grid.z, grid.zx, grid.zy, grid.zxy)}


def _grid(field: HeightField, heights: Tensor, samples: Sampling | None) -> SurfaceGrid:
    nx, ny = (
        (max(LEAST, n) for n in counts_of(field.spaces, STEPS_PER_SPAN)) if samples is None else counts_of(field.spaces, samples)
    )
    if min(nx, ny) < LEAST:
        raise InputError(f"⟨samples⟩ of a zemax grid must be at least {LEAST} along each axis, got {nx} x {ny}")
    return sample_grid(field, heights, (nx, ny))
