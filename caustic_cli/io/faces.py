"""Reader of the base surface of a lens from a STEP file (ISO 10303-21): one cylindrical, spherical or B-spline face.

Only its shape counts: it is moved along z so that its vertex is at the thickness of the lens.  Of a sphere or a cylinder the side
whose vertex is nearer to z = 0 is taken, which is the outer side where the centre is below it.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.io import columns
from caustic_cli.io.files import naming
from caustic_cli.io.surfaces import MAX_STEP_BYTES, SPLINE, spline_in, step_text
from caustic_cli.optics.system import freeform_of
from caustic_cli.scene.face import Face
from caustic_cli.scene.lens import Offset

SUFFIXES, MOST_BYTES = (".step", ".stp"), MAX_STEP_BYTES
#: Relative tolerance for the place and the direction of a face.
SAME = 1e-6
_ROUND = re.compile(r"=\s*+(CYLINDRICAL_SURFACE|SPHERICAL_SURFACE)\s*+\(\s*+''\s*+,\s*+#(\d{1,18})\s*+,\s*+([^(),]*+)\)", re.A)
_OTHER = re.compile(r"=\s*+(CONICAL_SURFACE|TOROIDAL_SURFACE|SURFACE_OF_REVOLUTION|SURFACE_OF_LINEAR_EXTRUSION)\b", re.A)
ONE = "must hold one cylindrical, spherical or B-spline face"


def read_face(path: Path) -> Offset:
    """The base surface in a STEP file, of thickness 0, mm.

    Raises:
        InputError: the file cannot be read, or holds none such, or several, or one that is not centred on the z axis.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"⟨lens.base_file⟩ {path}: a STEP file ({', '.join(SUFFIXES)}) with one face is needed")
    with naming(path):
        text = step_text(path)
        found, splines = list(_ROUND.finditer(text)), text.count(SPLINE)
        if len(found) + splines != 1 or _OTHER.search(text):
            other = " and others" if _OTHER.search(text) else ""
            raise InputError(f"{ONE}, got {len(found)} cylindrical or spherical and {splines} of B-splines{other}")
        if splines:
            field, heights = spline_in(text)
            return Face(0.0, surface=freeform_of(field, heights), half_size=field.half_size)
        (kind, place, radius) = found[0].groups()
        return Offset(0.0, _radii(kind, *_placement(text, place), _number(radius)))


def _radii(kind: str, at: np.ndarray, axis: np.ndarray, radius: float) -> tuple[float, float]:
    """Radii of curvature along x and y of a sphere or cylinder of this centre, mm, and unit axis."""
    if not 0.0 < radius < math.inf:
        raise InputError(f"has a face of radius {radius:g} mm; it must be more than 0")
    bent = (0, 1) if kind.startswith("SPHERICAL") else ((0,) if abs(axis[1]) > abs(axis[0]) else (1,))
    if len(bent) == 1 and abs(axis[1 - bent[0]]) < 1.0 - SAME:
        raise InputError("has a cylinder whose axis is neither along x nor along y")
    if any(abs(at[k]) > SAME * radius for k in bent):
        raise InputError(f"has a face whose centre is at x = {at[0]:g}, y = {at[1]:g} mm; it must be on the z axis")
    signed = -radius if abs(at[2] + radius) <= abs(at[2] - radius) else radius
    across, along = (signed if k in bent else math.inf for k in (0, 1))
    return across, along


def _placement(text: str, number: str) -> tuple[np.ndarray, np.ndarray]:
    """Origin, mm, and unit z axis of an AXIS2_PLACEMENT_3D."""
    found = re.search(
        rf"#{number}\s*+=\s*+AXIS2_PLACEMENT_3D\s*+\(\s*+''\s*+,\s*+#(\d{{1,18}})\s*+,\s*+(?:#(\d{{1,18}})|\$)", text, re.A
    )
    if found is None:
        raise InputError("its face has no place")
    axis = np.array([0.0, 0.0, 1.0]) if found[2] is None else _triple(text, "DIRECTION", found[2])
    return _triple(text, "CARTESIAN_POINT", found[1]), axis / np.linalg.norm(axis)


def _triple(text: str, kind: str, number: str) -> np.ndarray:
    """The three numbers of a point or a direction."""
    found = re.search(rf"#{number}\s*+=\s*+{kind}\s*+\(\s*+''\s*+,\s*+\(([^(),]*+),([^(),]*+),([^(),]*+)\)", text, re.A)
    values = np.zeros(3) if found is None else np.array([_number(found[k]) for k in (1, 2, 3)])
    if found is None or (kind == "DIRECTION" and not values.any()):
        raise InputError(f"its face refers to #{number}, which is no {kind.lower().replace('_', ' ')}")
    return values


def _number(text: str) -> float:
    value = columns.number(text)
    if value is None or not math.isfinite(value):
        raise InputError(f"{text.strip()!r} is no number")
    return value
