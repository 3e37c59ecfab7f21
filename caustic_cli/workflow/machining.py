"""Simulated machining: the surface that a tool path leaves, and its form deviation from the design."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.io.gcode import LATHE, read_program
from caustic_cli.optics.envelope import Envelope
from caustic_cli.optics.nose_envelope import NoseEnvelope
from caustic_cli.optics.surfaces.cut import CutSurface
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Aperture, Scene

#: Points at which the machined surface is compared with the design.
POINTS = 400_000
#: Oversampling of a wave image, since scallops scatter light beside the screen.
FINER = 1.5
#: Longest move of a rotary axis, rad, that is taken for straight: of 60 mm a nanometre off.
TURN = 3e-4
#: Largest deviation over the size of the part; beyond it, the program is for another part.
FAR = 0.05


def cut_surface(path: Path, scene: Scene, field: HeightField, tool_radius: float | None = None) -> CutSurface:
    """The surface that a program's ball-nose or turning tools leave, in the scene's coordinates.

    Args:
        tool_radius: mm, for a program that does not give it.

    Raises:
        InputError: the program cannot be read, the radius of a tool is unknown, or no tool has a ball nose.
    """
    program, envelopes = read_program(path), list[Envelope | NoseEnvelope]()
    for cut in program.cuts:
        radius = cut.radius or tool_radius
        if cut.kind in ("flat end", "drill"):  # roughing, above the finished surface, and holes beside it
            continue
        if radius is None:
            raise InputError(f"{path}: does not give the radius of its ball-nose tool; ⟨tool_radius⟩ is needed")
        if program.rotary is not None:
            centres = _around(cut.tips, radius, *program.rotary)
            before = centres[:, 2] > program.rotary[1]  # not behind the axis, where a ring has other panels
            before = before[:-1] & before[1:]
            envelopes.append(Envelope(radius, centres[:-1][before], centres[1:][before]))
            continue
        if cut.kind == LATHE:
            envelopes.append(NoseEnvelope(radius, cut.tips))
            continue
        centres = cut.tips + np.array([0.0, 0.0, radius])
        top = math.inf if program.top is None else program.top
        envelopes.append(Envelope(radius, *_near(centres, top + radius), top=top))
    if not envelopes:
        raise InputError(f"{path}: has no ball-nose tool, the only kind that is simulated")
    if program.rotary is not None:
        return CutSurface(tuple(envelopes), field.half_size)
    turned = scene.lens.cut_from < 0 if program.turned is None else program.turned
    zero = scene.lens.z_in if program.zero is None else program.zero
    return CutSurface(tuple(envelopes), field.half_size, -zero if turned else zero, turned)


def _around(tips: np.ndarray, radius: float, along: str, axis: float) -> np.ndarray:
    """Centres (k, 3) of a ball, mm, in the coordinates of the scene, from X, A, Z of its tip around an axis along x or y at
    z = axis: X, Y, Z is x, y, z or y, -x, z there, and at A the tip is at Y = -Z sin A.  Moves of A are divided into short ones."""
    parts = np.maximum(1, np.ceil(np.abs(np.diff(tips[:, 1])) / TURN)).astype(int)
    place = np.concatenate([*(k + np.arange(n) / n for k, n in enumerate(parts)), [len(parts)]])
    x, a, z = (np.interp(place, np.arange(len(tips)), c) for c in tips.T)
    across, height = (z + radius) * np.sin(a), (z + radius) * np.cos(a) + axis
    return np.stack([across, x, height] if along == "y" else [x, -across, height], -1)


def _near(centres: np.ndarray, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Begin and end points (k, 3) mm of the moves below the top of the stock."""
    begin, end = centres[:-1], centres[1:]
    cuts = np.minimum(begin[:, 2], end[:, 2]) < top
    return (begin[cuts], end[cuts]) if cuts.any() else (centres[:1], centres[:1])


def form_deviation(cut: CutSurface, field: HeightField, heights: Tensor, aperture: Aperture) -> dict:
    """Form deviation of a machined surface within an aperture, positive where material is left, for JSON: cut_left_mm and
    cut_gouge_mm, its extrema; cut_rms_mm about the mean; cut_slope_rms and cut_slope_most, of its slope.

    Raises:
        InputError: the program is for another part.
    """
    n = math.isqrt(POINTS)
    line = torch.linspace(-1.0, 1.0, n, dtype=torch.float64) * (1.0 - 1e-9)
    x, y = (c.reshape(-1) for c in torch.meshgrid(line * field.half_size[0], line * field.half_size[1], indexing="ij"))
    inside = aperture.covers(x / field.half_size[0], y / field.half_size[1])
    x, y = x[inside], y[inside]
    z, gx, gy = cut.at(None, x, y)
    nominal, hx, hy = field.at(heights, x, y)
    off = (z - nominal) * (-1.0 if cut.turned else 1.0)
    if float(off.abs().max()) > FAR * max(field.half_size):
        raise InputError(
            f"the program is for another part: its surface is up to {float(off.abs().max()):.3g} mm off; export this lens' own"
        )
    slopes = torch.hypot(gx - hx, gy - hy)
    return {
        "cut_left_mm": float(off.max()),
        "cut_gouge_mm": max(0.0, -float(off.min())),
        "cut_rms_mm": float(off.std()),
        "cut_slope_rms": float(slopes.square().mean().sqrt()),
        "cut_slope_most": float(slopes.max()),
    }
