"""Both sides of a lens with two free-form ones, or both halves of its mould, and the register between them.

The lens stays in its stock, a plate with two dowel holes beside the lens, which is turned over between the setups about the line
through them, the x axis: (x, y, z) -> (x, -y, -z).  X0 Y0 is the middle of the lens in both, Z0 the face of the stock that lies on
the table, so that the same pins stand at the same X and Y, and the thickness of the stock, which has to be as stated, is the datum
between the sides.  The holes are unequally far from the middle: the stock does not fit the other way round.

The halves of a mould are blocks with the negative of the entrance, as it lies, and of the exit, turned over.  They have flat
backs, whose distance says how far apart they are.  Where they are machined, both are drilled for the same pins, and their faces,
which are flat beside the lens, are held apart by a frame that has the outline of the lens for its window.

Notation
    H       thickness of the stock, mm;  b  z of its lower face, so that Z = z - b for the exit and Z = b + H - z for the entrance
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import AS_CUT, SIDE_BY_SIDE
from caustic_cli.export.milling import FACING, ROTARY, Milling
from caustic_cli.export.part import BLOCK, Part, Register, alone, part_of, turned
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Aperture, Lens, Scene

#: Points along the edge of the lens at which its thickness is compared.
EDGE = 721


def other(path: Path) -> Path:
    """Name of the entrance's file beside that of the exit."""
    return path.with_name(f"{path.stem}-entrance{path.suffix}")


def parts_of(
    format: str, scene: Scene, field: HeightField, heights: Tensor, m: Milling, mould: bool = False, block: float | None = None
) -> tuple[Part, ...]:
    """The parts that a format holds, each in a file: one, or the sides of a lens with two curved ones, the exit first; of one that
    is turned about the axis of a cylinder, whose inner side is there already, the exit alone.

    Args:
        m: see `sides_of`; mould, block: as of `part_of`.

    Raises:
        InputError: as of `part_of` and `sides_of`.
    """
    one = part_of(format, scene, field, heights, mould, block)  # which refuses what contradicts the format
    if scene.lens.entrance is None or m.path == ROTARY or not (mould or format in SIDE_BY_SIDE):
        return (one,)
    if mould:
        return halves_of(one, scene, m if format in AS_CUT else None, block)
    if format in AS_CUT:
        return sides_of(scene, field, heights, m)
    front = entrance_of(scene.lens)
    return replace(one, kind="lens, exit side"), Part(scene, front.field, front.heights + scene.lens.z_in, "lens, entrance side")


def sides_of(scene: Scene, field: HeightField, heights: Tensor, m: Milling) -> tuple[Part, Part]:
    """The exit and the entrance as parts for a machine.

    Args:
        heights: of the exit, (n, m) mm; m: with the height of the stock, H; the radii of the tools, which pass beside the lens; and
            the diameter of the pins.

    Raises:
        InputError: the stock is thinner than the lens.
    """
    lens, heights, front = scene.lens, heights.detach().double().cpu(), entrance_of(scene.lens)
    below, above = front.heights.double() + lens.z_in, heights
    low, high = front.field.least(below, Aperture()), -field.least(-above, Aperture())
    thickness = math.ceil((high - low + 2.0 * FACING) * 10.0 - 1e-6) / 10.0 if m.stock is None else m.stock
    if thickness < high - low:
        raise InputError(f"⟨stock⟩ must be as thick as the lens, {high - low:.6g} mm, got {thickness:g} mm")
    base = low - 0.5 * (thickness - (high - low))
    register = replace(_pinned(lens, m, thickness), rim=_rim(scene, field, above, front.field, below))
    over = turned(front.field, below)
    exit_side = Part(alone(scene, base), field, above, "lens, exit side", False, register)
    return exit_side, Part(alone(scene, -(base + thickness)), *over, "lens, entrance side", True, register)


def halves_of(upper: Part, scene: Scene, m: Milling | None, block: float | None) -> tuple[Part, Part]:
    """The mould of a lens: its half above the exit, turned over, and that below the entrance.

    Args:
        upper: the mould of the exit alone; scene: with the entrance; m: as of `sides_of`, the stock that of a half, or None for
            halves that are not machined; block: least material behind a surface, mm.

    Raises:
        InputError: the sides reach past each other, so that no flat faces fit between them.
    """
    front = entrance_of(scene.lens)
    below = front.heights.double() + scene.lens.z_in
    room = BLOCK * max(scene.lens.size) if block is None else block
    halves = [replace(upper, kind="mould, exit side")]
    halves.append(Part(alone(scene, float(below.min()) - room), front.field, below, "mould, entrance side"))
    if m is None:
        return halves[0], halves[1]
    tops = [m.top(-half.field.least(-half.heights, Aperture()) - half.lens.z_in) for half in halves]
    frame = between_backs(halves) - sum(tops)
    if not frame > 0:
        raise InputError(
            f"⟨mould⟩: the faces of the halves would meet {-frame:.3g} mm too early, since the sides of this lens reach past each"
            " other: a thicker lens (⟨lens.thickness⟩) has room between them; solids such as step need none"
        )
    found = [replace(h, register=replace(_pinned(scene.lens, m, top), frame=frame)) for h, top in zip(halves, tops, strict=True)]
    return found[0], found[1]


def between_backs(sides: Sequence[Part]) -> float:
    """Distance between the flat backs of the halves of a closed mould, mm."""
    return -sum(side.lens.z_in for side in sides)


def registered(sides: Sequence[Part]) -> dict:
    """The register of two sides as figures for JSON; nothing where they have none."""
    found = {} if sides[0].register is None or len(sides) < 2 else sides[0].register.figures
    if len(sides) > 1 and sides[0].kind.startswith("mould"):
        found = found | {"between_backs_mm": between_backs(sides)}
    return {"register": found} if found else {}


def _pinned(lens: Lens, m: Milling, thickness: float) -> Register:
    """A register by pins beside a lens, in a stock of this thickness, mm."""
    beside = 2.0 * max(m.tool_radius, m.rough_radius) + m.pin
    near = math.ceil(10.0 * (lens.opening.reach + beside)) / 10.0
    far = near + 2.0 * m.pin
    return Register(thickness, 2.0 * far + 4.0 * m.pin, lens.size[1] + 2.0 * beside, (near, -far), m.pin)


def _rim(scene: Scene, field: HeightField, above: Tensor, front: HeightField, below: Tensor) -> float:
    """Least thickness at the edge of the aperture, mm."""
    angle = torch.linspace(0.0, 2.0 * math.pi, EDGE, dtype=torch.float64)
    x, y = angle.cos(), angle.sin()
    if not scene.lens.opening.round:
        x, y = (c / torch.maximum(x.abs(), y.abs()) for c in (x, y))
    x, y = (r * c for r, c in zip(scene.lens.half_size, (x, y), strict=True))
    return float((field.at(above, x, y, [(0, 0)])[0] - front.at(below, x, y, [(0, 0)])[0]).min())


def with_stock(m: Milling, part: Part) -> Milling:
    """Parameters for a side, whose stock is that of both."""
    return replace(m, stock=part.register.thickness) if part.register else m
