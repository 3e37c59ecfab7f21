"""Both sides of a lens with two free-form ones, each in the coordinates of its setup, and the register between them.

The lens stays in its stock, a plate with two dowel holes beside the lens, which is turned over between the setups about the line
through them, the x axis: (x, y, z) -> (x, -y, -z).  X0 Y0 is the middle of the lens in both, Z0 the face of the stock that lies on
the table, so that the same pins stand at the same X and Y, and the thickness of the stock, which has to be as stated, is the datum
between the sides.  The holes are unequally far from the middle: the stock does not fit the other way round.

Notation
    H       thickness of the stock, mm;  b  z of its lower face, so that Z = z - b for the exit and Z = b + H - z for the entrance
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.milling import FACING, Milling
from caustic_cli.export.part import Part, Register, alone, turned
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of
from caustic_cli.scene import Aperture, Scene

#: Points along the edge of the lens at which its thickness is compared.
EDGE = 721


def other(path: Path) -> Path:
    """Name of the entrance's file beside that of the exit."""
    return path.with_name(f"{path.stem}-entrance{path.suffix}")


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
    beside = 2.0 * max(m.tool_radius, m.rough_radius) + m.pin
    near = math.ceil(10.0 * (lens.opening.reach + beside)) / 10.0
    far = near + 2.0 * m.pin
    size = 2.0 * far + 4.0 * m.pin, lens.size[1] + 2.0 * beside
    register = Register(thickness, *size, (near, -far), m.pin, _rim(scene, field, above, front.field, below))
    over = turned(front.field, below)
    exit_side = Part(alone(scene, base), field, above, "lens, exit side", False, register)
    return exit_side, Part(alone(scene, -(base + thickness)), *over, "lens, entrance side", True, register)


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
