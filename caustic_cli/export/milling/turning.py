"""Programs for diamond turning with a slow or fast tool servo: X, C and Z of a round-nosed tool along a spiral to the axis.

The part turns about its axis, Z0 its flat face on the chuck.  X and Z are of the lowest point of the nose, C in degrees; axes are
as of ISO 841, as if the tool moved around the part: at C it is over x = X cos C, y = X sin C, and cuts towards larger C.  C is not
reduced to one turn.  Blocks are in inverse time (G93), at a constant speed of C: what a feed means for C beside X and Z differs
between controls.

Notation
    e           (cos C, sin C), the direction of X in the part;  rho  position along it, mm, negative beyond the axis
    R           radius of the nose, an arc in the plane of e and Z (no rake)
    T(X, C)     height of the nose's centre: max over rho of Z(rho e) + sqrt(R^2 - (X - rho)^2)
    g, b        slopes along e, and backwards, against the cut
    alpha       clearance angle of a conical flank

The edge lies in the plane of e and Z, so that the envelope of its sections is the cut surface, and T, the dilation of the section
by the nose, compensates for it exactly, the sections being all different.  Where the nose does not fit a hollow, material is left.
The flank behind the edge is a cone; it stays off the surface if b / sqrt(1 + g^2) < tan(alpha) at the edge, and if no chord
backwards is steeper, which is tested up to BEHIND.

A rectangular part is cut out of a round blank, for an edge that is interrupted breaks.  Beyond its rectangle the surface continues
that of the nearest point, whose slopes fade within a knot span.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.milling import Milling
from caustic_cli.export.milling.offset import shape_of
from caustic_cli.export.milling.paths import batches, with_heights
from caustic_cli.export.milling.writer import figures_of
from caustic_cli.export.part import Part
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.surfaces.heightfield import HeightField

#: First moves of a turn, at least; samples of a knot span for the point of contact, at most so many; most iterations to it.
A_TURN, A_SPAN, MOST, STEPS = 64, 4, 129, 8
#: Tolerance of moves over the height of cusps: with the slope sqrt(2 t k) at their ends, for a curvature k along the turn far below
#: that of the nose, an eighth of that of cusps or less.
PATH_PART = 0.25
#: Parts of a move at which it is compared beside its middle: at a corner of the part the surface bends within a fraction of a span.
PROBES = (0.25, 0.75)
#: Points at a time.
AT_A_TIME = 1 << 19
#: Factor for slopes between samples; radii and angles at which slopes are sampled; lengths of chords, mm.
BETWEEN, RADII, ANGLES, BEHIND = 1.2, 160, 720, (0.03, 0.1, 0.3, 1.0)
#: Digits of X and Z, and of C in degrees.
DIGITS, DEGREES = 6, 5
#: Rapid feed, mm/min, where a dialect needs one.
RAPID = 1000.0


@dataclass(frozen=True, eq=False)
class Blank:
    """The surface over the whole plane."""

    field: HeightField
    #: (n, m) mm.
    heights: Tensor

    @property
    def span(self) -> float:
        """The smaller knot span, mm."""
        return min(2.0 * r / (len(s.breaks) - 1) for s, r in zip(self.field.spaces, self.field.half_size, strict=True))

    def __call__(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights, mm, and slopes at points (N,) mm."""
        rx, ry = self.field.half_size
        cx, cy = np.clip(x, -rx, rx), np.clip(y, -ry, ry)
        z, gx, gy = (t.numpy() for t in self.field.evaluate(self.heights, torch.from_numpy(cx), torch.from_numpy(cy)))
        out = np.flatnonzero((cx != x) | (cy != y))
        if len(out):
            found = self._beyond(*(c[out] for c in (x, y, cx, cy, z, gx, gy)))
            for own, new in zip((z, gx, gy), found, strict=True):
                own[out] = new
        return z, gx, gy

    def _beyond(self, x, y, cx, cy, z, gx, gy) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """z(c) + exp(-|e| / L) g(c) . e for points c + e beyond the rectangle, and its slopes."""
        (twist,) = self.field.at(self.heights, torch.from_numpy(cx), torch.from_numpy(cy), ((1, 1),))
        hxy = twist.numpy()
        ex, ey = x - cx, y - cy
        far, rise = np.hypot(ex, ey), gx * ex + gy * ey
        w = np.exp(-far / self.span)
        off = rise * w / (self.span * far)
        zx = np.where(ex == 0.0, gx + w * hxy * ey, w * gx - off * ex)
        zy = np.where(ey == 0.0, gy + w * hxy * ex, w * gy - off * ey)
        return z + w * rise, zx, zy


class NoseOffset:
    """Heights of a round nose above a blank, see T of the module; slope: the steepest, by which points of contact are bounded."""

    def __init__(self, blank: Blank, radius: float, slope: float):
        self.blank, self.radius = blank, radius
        steep = BETWEEN * slope
        self.reach = min(0.99, 1e-3 + steep / math.sqrt(1.0 + steep * steep)) * radius
        count = min(MOST, max(9, 2 * math.ceil(self.reach * A_SPAN / blank.span) + 1))
        self.offsets = np.linspace(-self.reach, self.reach, count)

    def __call__(self, x: np.ndarray, c: np.ndarray) -> np.ndarray:
        """Heights (N,) mm of the lowest point for X (N,) mm and C (N,) radians."""
        n = max(1, AT_A_TIME // len(self.offsets))
        return np.concatenate([self._heights(x[k : k + n], c[k : k + n]) for k in range(0, len(x), n)]) - self.radius

    def _at(self, x: np.ndarray, c: np.ndarray, off: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height of the centre for contact at X + off, and its derivative by off."""
        z, gx, gy = self.blank((x + off) * np.cos(c), (x + off) * np.sin(c))
        root = np.sqrt(self.radius**2 - off * off)
        return z + root, gx * np.cos(c) + gy * np.sin(c) - off / root

    def _heights(self, x: np.ndarray, c: np.ndarray) -> np.ndarray:
        wide = [np.repeat(v, len(self.offsets)) for v in (x, c)]
        value, rise = (v.reshape(len(x), -1) for v in self._at(*wide, np.tile(self.offsets, len(x))))
        best, row = value.argmax(1), np.arange(len(x))
        highest = value[row, best]
        up = rise[row, best] > 0.0  # the contact is on the side to which it rises
        low = np.clip(np.where(up, best, best - 1), 0, len(self.offsets) - 2)
        a, b, fa, fb = self.offsets[low], self.offsets[low + 1], rise[row, low], rise[row, low + 1]
        for _ in range(STEPS):  # regula falsi, Illinois
            with np.errstate(divide="ignore", invalid="ignore"):
                middle = (a * fb - b * fa) / (fb - fa)
            middle = np.where((fa > 0) & (fb < 0), np.clip(middle, a, b), 0.5 * (a + b))
            f, fm = self._at(x, c, middle)
            highest, right = np.maximum(highest, f), fm > 0
            a, b, fa, fb = (
                np.where(right, middle, a),
                np.where(right, b, middle),
                np.where(right, fm, 0.5 * fa),
                np.where(right, 0.5 * fb, fm),
            )
        return highest


def spiral(turns: int, feed: float) -> Iterator[np.ndarray]:
    """X, mm, and C, radians, at both ends of each turn (2, 2), to the axis by `feed` mm a turn, and a turn there."""
    for k in range(turns):
        yield np.array([[(turns - k) * feed, 2.0 * math.pi * k], [(turns - k - 1) * feed, 2.0 * math.pi * (k + 1)]])
    yield 2.0 * math.pi * np.array([[0.0, turns], [0.0, turns + 1]])


def motion(blank: Blank, radius: float) -> dict[str, float]:
    """Within a radius: needed, the clearance angle, degrees; speed and acceleration, of Z by C, mm a radian and its square; nose,
    the angle of the edge in use beside its lowest point, degrees."""
    r, c = (radius * (np.arange(RADII) + 0.5) / RADII, np.linspace(0.0, 2.0 * math.pi, ANGLES, endpoint=False))
    x, y = (np.outer(r, f(c)).ravel() for f in (np.cos, np.sin))
    ex, ey = (np.tile(f(c), RADII) for f in (np.cos, np.sin))
    z, gx, gy = blank(x, y)
    along, back = gx * ex + gy * ey, gx * ey - gy * ex
    steepest = float((back / np.sqrt(1.0 + along * along)).max())
    for t in BEHIND:
        steepest = max(steepest, float((blank(x + t * ey, y - t * ex)[0] - z).max()) / t)
    rings, step = z.reshape(RADII, ANGLES), c[1]
    return {
        "needed": math.degrees(math.atan(max(0.0, steepest))),
        "nose": math.degrees(math.atan(float(np.abs(along).max()))),
        "speed": float(np.abs(np.diff(rings, axis=1)).max() / step),
        "acceleration": float(np.abs(np.roll(rings, 1, 1) - 2.0 * rings + np.roll(rings, -1, 1)).max() / step**2),
    }


def write_turning(path: str | Path, part: Part, m: Milling, tolerance: float | None, unit: float, simple: bool) -> dict:
    """Write the program atomically.

    Args:
        tolerance: of moves, mm; unit: of the program, mm; simple: no G0.

    Returns:
        figures: as of a mill, and turns, blank_mm, the diameter of the blank, clearance_needed_deg, z_speed_mm_s,
        z_acceleration_m_s2.

    Raises:
        InputError: the flank would cut in, or the stock is below the surface.
    """
    blank = Blank(part.field, part.heights.detach().double().cpu() - part.lens.z_in)
    _low, high, slope, concave = shape_of(blank.field, blank.heights)
    offset, clear = NoseOffset(blank, m.tool_radius, slope), part.lens.opening.reach
    feed = m.step(concave, slope)
    outer = clear + offset.reach + feed
    turns, speed = math.ceil(outer / feed), 2.0 * math.pi * m.revolutions / 60.0
    feed = outer / turns
    scallop, moved, top = m.scallop_of(feed, concave, slope), motion(blank, clear), m.top(high)
    if moved["needed"] >= m.clearance:
        raise InputError(
            f"⟨clearance⟩ must exceed {moved['needed']:.3g} degrees, the steepest slope behind the edge, got {m.clearance:g}: its"
            " flank would cut into the part; a tool of more clearance or a flatter lens (⟨max_slope⟩, a longer ⟨throw⟩) is needed"
        )
    tolerance = PATH_PART * scallop if tolerance is None else tolerance
    with atomic_file(path) as file:
        out = _LatheWriter(file, m, unit, simple, top, *_digits(tolerance / unit, moved["needed"], outer / unit))
        out.say(*_head(part, m, moved, 2.0 * outer, top, feed, scallop, tolerance))
        move = min(2.0 * math.pi / A_TURN, 0.5 * blank.span / outer)
        for line in batches(spiral(turns, feed), move):
            out.cut(with_heights(line, offset, move, tolerance, PROBES))
        out.end()
    minutes = (turns + 1) / m.revolutions
    return figures_of(out, minutes, m.tool_radius, feed, scallop, tolerance, top) | {
        "turns": turns + 1,
        "blank_mm": 2.0 * outer,
        "clearance_needed_deg": moved["needed"],
        "z_speed_mm_s": moved["speed"] * speed,
        "z_acceleration_m_s2": 1e-3 * moved["acceleration"] * speed**2,
    }


def _digits(tolerance: float, needed: float, radius: float) -> tuple[int, int]:
    """Decimals of X and Z, and of C in degrees, whose rounding is a tenth of a tolerance; needed: steepest slope, degrees."""
    slope = math.tan(math.radians(needed)) + 1e-12
    lengths, angles = -math.log10(tolerance), -math.log10(math.degrees(tolerance / (slope * radius)))
    return max(DIGITS, math.ceil(lengths) + 1), max(DEGREES, math.ceil(angles) + 1)


@dataclass
class _LatheWriter:
    """Writes blocks and counts lines and length, mm; digits of X and Z in the unit of the program, and of C."""

    file: Any
    m: Milling
    unit: float
    simple: bool
    top: float
    digits: int
    degrees: int
    lines: int = 0
    length: float = 0.0
    at: np.ndarray | None = None

    def say(self, *rows: str) -> None:
        self.file.write("".join(f"{row}\n" for row in rows).encode("ascii"))
        self.lines += len(rows)

    def _rapid(self, words: str) -> None:
        self.say(f"G1 {words} F{RAPID / self.unit:.6g}" if self.simple else f"G0 {words}")

    def _away(self) -> None:
        self._rapid(f"Z{(self.top + self.m.safe_height) / self.unit:.4f}")

    def _begin(self, x: float, z: float) -> None:
        self.say(f"{'G21' if self.unit == 1.0 else 'G20'} G90 G18 G94")
        self._away()
        self._rapid(f"X{x / self.unit:.{self.digits}f} C0")
        self.say(f"G1 Z{z / self.unit:.{self.digits}f} F{self.m.plunge / self.unit:.6g}", "G93")

    def cut(self, points: np.ndarray) -> None:
        """Blocks to points (m, 3) of X, mm, C, radians, and Z, mm, beyond the last one."""
        if self.at is None:
            self._begin(points[0, 0], points[0, 2])
            self.at = points[0]
        steps = np.diff(points, axis=0, prepend=self.at[None])
        points, steps = points[steps[:, 1] > 0], steps[steps[:, 1] > 0]
        x, c, z = points[:, 0] / self.unit, np.degrees(points[:, 1]), points[:, 2] / self.unit
        form = f"G1 X%.{self.digits}f C%.{self.degrees}f Z%.{self.digits}f F%.6g"
        rows = zip(x.tolist(), c.tolist(), z.tolist(), (2.0 * math.pi * self.m.revolutions / steps[:, 1]).tolist(), strict=True)
        self.say(*(form % row for row in rows))
        self.length += float(np.hypot(np.hypot(steps[:, 0], points[:, 0] * steps[:, 1]), steps[:, 2]).sum())
        self.at = points[-1]

    def end(self) -> None:
        """Move away."""
        self.say("G94")
        self._away()
        self.say("M30")


def _head(
    part: Part, m: Milling, moved: dict[str, float], blank: float, top: float, feed: float, scallop: float, tolerance: float
) -> list[str]:
    """Header comments."""
    cut = "" if part.lens.opening.round else f", the part of {part.lens.size[0]:g} x {part.lens.size[1]:g} mm is cut out of it"
    inches = m.dialect.endswith("inch")
    return [
        f"({CREATED})",
        f"(part: {part.kind})",
        f"(turned: {'yes, the x, y, z of the scene is x, -y, -z here' if part.turned else 'no'})",
        f"(Z0: {part.lens.z_in:.17g} mm is its z in the other formats; {part.face}, on the chuck)",
        *([] if part.register is None else part.register.said(part.turned)),
        "(X0: the axis of the part and of the spindle; X is a radius; X Z are of the lowest point of the nose)",
        "(C: as if the tool moved around the part: it is over x = X cos C, y = X sin C, and cuts towards larger C)",
        f"(blank: round, {blank:.6g} mm wide{cut}; top at Z{top:g})",
        f"(tool: round nose, radius {m.tool_radius:.17g} mm, no rake; used {moved['nose']:.3g} degrees to either side)",
        f"(clearance: more than {moved['needed']:.3g} degrees are needed, {m.clearance:g} are given)",
        f"(turning: {feed:.6g} mm a turn, cusps up to {scallop:.3g} mm, moves within {tolerance:.3g} mm)",
        f"(speed: {m.revolutions:g} turns a minute)",
        f"(units: {'inches' if inches else 'mm'} and degrees; G93: F is 1 over the minutes of a block; comments in mm)",
    ]
