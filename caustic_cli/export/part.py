"""Which solid is made, and how it lies in a file: a lens, a mirror, or the mould of either.

Notation
    Z           the optical surface, in the scene's coordinates
    below       the material of a lens fills z_in <= z <= Z: the tool comes from +z, as the file has it
    above       that of a mirror fills Z <= z: light comes from below, and its back is flat

A mould is the complement: above the surface of a lens, below that of a mirror.  What lies above is turned about the x axis by half
a turn for the machine, (x, y, z) -> (x, -y, -z), so that it lies below: a rotation, which makes no mirror image.  The turned
surface is -Z(x, -y), a spline of the negative control heights in the opposite order along y.  A mould turned back and pressed onto
the lens meets it everywhere, since both are the same surface.

Solids of mirrors stay in the scene's coordinates, which a design can begin from again; moulds, height maps and programs for mills
are as they are cut.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export import AS_CUT, FORMATS, MOULDS, ONE_INDEX, SOLIDS
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Lens, PlaneWave, Scene, Screen

#: Least material behind the surface of a mirror or a mould, in parts of its larger side, unless said.
BLOCK = 0.2


@dataclass(frozen=True, eq=False)
class Part:
    """What a file holds.

    scene: with the lens' z_in at the flat face; field, heights: the surface, (n, m) mm; kind: lens, mirror or mould; turned:
    whether the scene's (x, y, z) is (x, -y, -z) here.
    """

    scene: Scene
    field: HeightField
    heights: Tensor
    kind: str
    turned: bool = False

    @property
    def lens(self) -> Lens:
        """Of the scene."""
        return self.scene.lens


def part_of(
    format: str, scene: Scene, field: HeightField, heights: Tensor, mould: bool = False, block: float | None = None
) -> Part:
    """The part that a format is to hold.

    Args:
        mould: the negative; block: least material behind the surface of a mirror or a mould, mm.

    Raises:
        InputError: a format that holds no moulds, or a block for what has its own flat face.
    """
    lens, heights = scene.lens, heights.detach().double().cpu()
    kind = "mould" if mould else "mirror" if lens.mirror else "lens"
    if lens.gradient is not None and format in ONE_INDEX:
        shapes = ", ".join(name for name in FORMATS if name not in ONE_INDEX)
        raise InputError(f"⟨format⟩ {format} holds one index, and this lens' varies; {shapes} hold its shape alone")
    if mould and format not in MOULDS:
        raise InputError(f"⟨mould⟩ belongs to ⟨format⟩ {', '.join(MOULDS)}, got {format}")
    if block is not None and kind == "lens":
        raise InputError("⟨block⟩ belongs to mirrors and moulds: a lens ends at its flat entrance")
    if kind == "lens":
        return Part(scene, field, heights, kind)
    room = BLOCK * max(lens.size) if block is None else block
    above = lens.mirror != mould
    if not above:  # the mould of a mirror
        return Part(_alone(scene, float(heights.min()) - room), field, heights, kind)
    if format not in AS_CUT and not mould:
        back = float(heights.max()) + room if format in SOLIDS else lens.z_in
        return Part(replace(scene, lens=replace(lens, z_in=back)) if format in SOLIDS else scene, field, heights, kind)
    field, heights = turned(field, heights)
    return Part(_alone(scene, float(heights.min()) - room), field, heights, kind, True)


def turned(field: HeightField, heights: Tensor) -> tuple[HeightField, Tensor]:
    """The surface turned about the x axis by half a turn: -Z(x, -y).  The heights are exactly the negative ones."""
    u, v = field.spaces
    return HeightField((u, SplineSpace(v.degree, 1.0 - v.knots.flip(0))), field.half_size), -heights.flip(1)


def _alone(scene: Scene, base: float) -> Scene:
    """A scene with a solid down to `base`, mm, and no border; nothing else in it means anything."""
    lens = replace(scene.lens, z_in=base, mirror=False, border=0.0, min_thickness=0.0)
    return Scene(PlaneWave(), lens, Screen(scene.screen.size, base + 1e6, (2, 2)))


def surface_of(part: Part) -> tuple[HeightField, Tensor]:
    """The part's surface in the scene's coordinates again."""
    return turned(part.field, part.heights) if part.turned else (part.field, torch.as_tensor(part.heights))
