"""The part to be manufactured and its orientation in a file: a lens, a mirror, or the mould of either.

Notation
    Z           the optical surface, in the scene's coordinates
    below       a lens: material in z_in <= z <= Z, machined from +z
    above       a mirror: material in Z <= z, with a flat back; light comes from -z

A mould is the complement: above the surface of a lens, below that of a mirror.  Material above the surface is rotated for machining
by 180 degrees about the x axis, (x, y, z) -> (x, -y, -z), which does not change the handedness.  The rotated surface is -Z(x, -y),
a spline with the negative control heights in reverse order along y.  Rotated back, a mould has exactly the surface of the lens.

Solids of mirrors remain in the coordinates of the scene, so that a design can start from them; moulds, height maps and G-code
programs are in the orientation of machining.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import AS_CUT, MOULDS, SOLIDS
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen

#: Default least material behind the surface of a mirror or a mould, over its larger side.
BLOCK = 0.2


@dataclass(frozen=True)
class Register:
    """How both sides of a part lie in its stock, or the halves of its mould on their pins, see `export.register`.

    thickness: of the stock; wide, high: of the stock along X and Y; pins: X of their middles, at Y0; pin: their diameter; rim:
    least thickness of the lens at its edge, inf for a mould; frame: of a mould, what separates the faces of its halves; all mm.
    """

    thickness: float
    wide: float
    high: float
    pins: tuple[float, float]
    pin: float
    rim: float = math.inf
    frame: float | None = None

    @property
    def figures(self) -> dict:
        """For JSON."""
        return {
            "stock_mm": [self.wide, self.high, self.thickness],
            "pins_mm": [[x, 0.0] for x in self.pins],
            "pin_diameter_mm": self.pin,
            **({"turned_over_about": "x"} if self.frame is None else {"frame_mm": self.frame}),
        }

    def drills(self, turned: bool) -> bool:
        """Whether the program of a side, turned or not, drills the holes: the first of a lens, and those of both halves."""
        return self.frame is not None or not turned

    def said(self, second: bool) -> list[str]:
        """Comments of a program for a side."""
        where = " and ".join(f"X{x:g} Y0" for x in self.pins)
        if self.frame is not None:
            return [
                f"(register: dowel pins of {self.pin:g} mm at {where} through both halves)",
                f"(frame: {self.frame:.6g} mm between the faces of the halves, with the outline of the lens for its window)",
            ]
        side = (
            "second, the first one on the table: fill it with wax or pitch; the stock is on the pins"
            if second
            else "first; then the stock is turned over about X onto pins in its holes"
        )
        return [f"(register: dowel pins of {self.pin:g} mm at {where} in both setups)", f"(side: {side})"]


@dataclass(frozen=True, eq=False)
class Part:
    """Part in a file.

    scene: with z_in of the lens at the flat face; field, heights: the surface, (n, m) mm; kind: lens, mirror or mould; turned:
    whether it is rotated, the (x, y, z) of the scene being (x, -y, -z) here; register: to the other side, of a lens with two;
    others: surfaces of the other panels of a ring, in their order around the axis (`export.panels`).
    """

    scene: Scene
    field: HeightField
    heights: Tensor
    kind: str
    turned: bool = False
    register: Register | None = None
    others: tuple[tuple[HeightField, Tensor], ...] = ()

    @property
    def face(self) -> str:
        """What lies on the table."""
        return "the flat face" if self.register is None else "the face of the stock"

    @property
    def lens(self) -> Lens:
        """The lens of the scene."""
        return self.scene.lens


def part_of(
    format: str, scene: Scene, field: HeightField, heights: Tensor, mould: bool = False, block: float | None = None
) -> Part:
    """The part for a format.

    Args:
        mould: the negative; block: least material behind the surface of a mirror or a mould, mm.

    Raises:
        InputError: the format does not support moulds, or a block is given for a lens.
    """
    lens, heights = scene.lens, heights.detach().double().cpu()
    kind = "mould" if mould else lens.kind
    if mould and format not in MOULDS:
        raise InputError(f"⟨mould⟩ belongs to ⟨format⟩ {', '.join(MOULDS)}, got {format}")
    if block is not None and kind == "lens":
        raise InputError("⟨block⟩ belongs to mirrors and moulds: a lens ends at its flat entrance")
    if kind == "lens":
        return Part(scene, field, heights, kind)
    room = BLOCK * max(lens.size) if block is None else block
    if (-lens.cut_from if mould else lens.cut_from) > 0:  # the mould of a mirror, with material below its surface as a lens
        return Part(alone(scene, float(heights.min()) - room), field, heights, kind)
    if format not in AS_CUT and not mould:
        back = float(heights.max()) + room if format in SOLIDS else lens.z_in
        return Part(replace(scene, lens=replace(lens, z_in=back)) if format in SOLIDS else scene, field, heights, kind)
    field, heights = turned(field, heights)
    return Part(alone(scene, float(heights.min()) - room), field, heights, kind, True)


def turned(field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
    """The surface rotated by 180 degrees about the x axis: -Z(x, -y), without rounding."""
    u, v = field.spaces
    return HeightField((u, SplineSpace(v.degree, 1.0 - v.knots.flip(0))), field.half_size), -heights.flip(1)


def alone(scene: Scene, base: float) -> Scene:
    """A scene for a solid down to `base`, mm, without a border; its source and screen are placeholders."""
    lens = replace(scene.lens, z_in=base, mirror=False, border=0.0, min_thickness=0.0, entrance=None)
    return Scene(PlaneWave(), lens, Screen(scene.screen.size, base + 1e6, (2, 2)))


def surface_of(part: Part) -> tuple[HeightField, Tensor]:
    """The surface of the part in the coordinates of the scene."""
    return turned(part.field, part.heights) if part.turned else (part.field, torch.as_tensor(part.heights))
