"""Photometric files of type C: IES LM-63-2019 (.ies) and EULUMDAT (.ldt; A. Stockmar, 1990), written and read.

Both hold intensities (planes, angles) at C and gamma, degrees.  EULUMDAT's are candela per 1000 lm of the lamps, those of LM-63
candela for the lumens per lamp that the file names.  Dimensions are of the luminous opening: metres in LM-63, millimetres in
EULUMDAT.

Both are text of a few fields.  No library reads and writes them here: `eulumdat` of PyPI is compiled from Rust, and a machine for
which it has no wheel could not install this program.  Other readers are the oracle in tests.

LM-63 repeats the plane 0 at 360 degrees where there is no symmetry, EULUMDAT does not.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.io.files import CREATED_BY, read_bytes, write_bytes

#: Largest file read, bytes, and most angles along either axis.
MOST_BYTES, MOST_ANGLES = 1 << 24, 2000
#: Longest line of LM-63, characters.
LINE = 120
#: LM-63-2019's code of a file made by a computer simulation.
SIMULATED = "1.00010"
#: Symmetries of EULUMDAT, Isym, by the first and the last plane of a file of LM-63 that has it: about the axis, about the plane
#: 0 - 180, about 90 - 270, and about both.
FOLDS = {1: (0.0, 0.0), 2: (0.0, 180.0), 3: (90.0, 270.0), 4: (0.0, 90.0)}
#: Suffixes of the files.
SUFFIXES = (".ies", ".ldt")
ACCEPTED = "a photometric file of type C, IES LM-63 or EULUMDAT, is needed"


class Photometry(NamedTuple):
    """A photometric file.

    planes (P,), angles (G,): C and gamma, degrees; values: (P, G) candela for `lumens` of the lamp; diameter, height: of the
    luminous opening, mm.
    """

    planes: np.ndarray
    angles: np.ndarray
    values: np.ndarray
    lumens: float = 1000.0
    name: str = "lamp"
    diameter: float = 0.0
    height: float = 0.0

    def intensity(self, directions: np.ndarray) -> np.ndarray:
        """Intensities, cd, in unit directions (N, 3), gamma being counted from +z and C from +x towards +y: linear in both angles,
        0 beyond those of the file."""
        from scipy.interpolate import RegularGridInterpolator  # noqa: PLC0415 - before torch is loaded it would delay refusals

        x, y, z = directions.T
        gamma, plane = np.degrees(np.arctan2(np.hypot(x, y), z)), np.degrees(np.arctan2(y, x)) % 360.0
        around = np.concatenate([self.planes - 360.0, self.planes, self.planes + 360.0])
        values = np.concatenate([self.values] * 3)
        found = RegularGridInterpolator((around, self.angles), values, bounds_error=False, fill_value=0.0)
        return found(np.stack([plane, gamma], 1))


def write_ies(path: Path, light: Photometry) -> None:
    """Write LM-63-2019, with symmetry none.

    The opening is a circle, by the negative width and length of the standard.
    """
    planes, values = np.append(light.planes, 360.0), np.concatenate([light.values, light.values[:1]])
    across = 0.0 - light.diameter / 1e3
    size = [across, across, light.height / 1e3]
    head = [
        "IES:LM-63-2019",
        f"[TEST] {light.name}",
        "[TESTLAB] computed by ray tracing",
        "[ISSUEDATE] not issued",
        f"[MANUFAC] {CREATED_BY} {__version__}",
        f"[LUMINAIRE] {light.name}",
        "TILT=NONE",
        " ".join(["1", _text(light.lumens), "1", str(len(light.angles)), str(len(planes)), "1", "2", *map(_text, size)]),
        f"1 {SIMULATED} 0",
    ]
    lines = [*head, *_wrapped(light.angles), *_wrapped(planes)]
    for row in values:
        lines += _wrapped(row)
    write_bytes(path, ("\r\n".join(lines) + "\r\n").encode("ascii"))


def write_ldt(path: Path, light: Photometry) -> None:
    """Write EULUMDAT, with symmetry none (Isym 0), as a point source (Ityp 3) with a round opening.

    Direct ratios, which room tables need, are 0.
    """
    flux = _flux(light)
    down = _flux(light._replace(values=np.where(light.angles <= 90.0, light.values, 0.0)))
    fields = [
        f"{CREATED_BY} {__version__}",
        "3",
        "0",
        str(len(light.planes)),
        _text(light.planes[1] - light.planes[0]),
        str(len(light.angles)),
        _text(light.angles[1] - light.angles[0]),
        "computed by ray tracing",
        light.name[:78],
        light.name[:26],
        path.stem[:8],
        "not issued",
        _text(light.diameter),
        "0",  # width: round
        _text(light.height),
        _text(light.diameter),
        "0",
        *[_text(light.height)] * 4,
        _text(100.0 * down / flux if flux > 0 else 0.0),
        _text(100.0 * flux / light.lumens),
        "1",
        "0",
        "1",  # one set of lamps
        "1",
        "LED",
        _text(light.lumens),
        "-",
        "-",
        "0",
        *["0"] * 10,
        *map(_text, light.planes),
        *map(_text, light.angles),
        *map(_text, (1000.0 / light.lumens * light.values).reshape(-1)),
    ]
    write_bytes(path, ("\r\n".join(fields) + "\r\n").encode("latin-1", "replace"))


def read_photometry(path: Path) -> Photometry:
    """Read a file of either format, by its first line; planes that it leaves out by symmetry are added.

    Raises:
        InputError: it is damaged, too large or of another type.
    """
    return parse_photometry(read_bytes(path, MOST_BYTES, ACCEPTED), f"{path}")


def parse_photometry(data: bytes, where: str) -> Photometry:
    """Read the contents of a file.

    Raises:
        InputError: as `read_photometry`, naming `where`.
    """
    text = data.decode("latin-1")
    try:
        return _ies(text) if text.startswith("IES") else _ldt(text.splitlines())
    except (ValueError, IndexError) as error:
        why = f"{error}" if isinstance(error, InputError) else "a number is missing or damaged"
        raise InputError(f"{where}: {why}; {ACCEPTED}") from error


def _ies(text: str) -> Photometry:
    before, found, after = text.partition("TILT=")
    if not found or not after.startswith("NONE"):
        raise InputError("has no TILT=NONE")
    named = re.search(r"\[LUMINAIRE\] *(.*?) *\r?\n", before)
    numbers = [float(word) for word in after[4:].replace(",", " ").split()]
    _, lumens, factor, angles, planes, kind, unit, width, _, height = numbers[:10]
    if kind != 1:
        raise InputError("is not of type C")
    n, m = _counted(angles, planes)
    body = np.array(numbers[13:])
    if len(body) < n + m + n * m:
        raise InputError("ends early")
    gamma, plane, values = body[:n], body[n : n + m], factor * numbers[10] * body[n + m : n + m + n * m].reshape(m, n)
    scale = 1000.0 if unit == 2 else 304.8
    name = named.group(1) if named else "lamp"
    light = _checked(Photometry(plane, gamma, values, lumens, name, abs(width) * scale, height * scale))
    ends = (float(plane[0]), float(plane[-1]))
    fold = next((k for k, limits in FOLDS.items() if ends == limits), 0)
    light = _unfolded(light, fold, _mirrored(plane, fold)) if fold else light
    if light.planes[-1] == 360.0:
        light = light._replace(planes=light.planes[:-1], values=light.values[:-1])
    return light if lumens > 0 else light._replace(lumens=_flux(light))  # absolute photometry


def _ldt(lines: Sequence[str]) -> Photometry:
    words = [line.strip().replace(",", ".") for line in lines]
    symmetry = int(words[2])
    m, n = _counted(float(words[3]), float(words[5]))
    if symmetry not in (0, *FOLDS):
        raise InputError(f"has the symmetry {symmetry}, which is none of the format")
    sets = int(words[25])
    at = 26 + 6 * sets + 10
    lumens = float(words[28])
    stored = {0: m, 1: 1, 2: m // 2 + 1, 3: m // 2 + 1, 4: m // 4 + 1}[symmetry]
    numbers = np.array([float(word) for word in words[at : at + m + n + stored * n]])
    if len(numbers) < m + n + stored * n:
        raise InputError("ends early")
    planes, values = numbers[:m], lumens / 1000.0 * numbers[m + n :].reshape(stored, n)
    held = planes[:stored]
    if symmetry == 3:  # from C 270 over 0 to 90: mirrored, from 90 to 270
        held, values = planes[m // 4 : m // 4 + stored], values[::-1]
    size = float(words[12]), float(words[14])
    light = _checked(Photometry(held, numbers[m : m + n], values, lumens, words[8], *size))
    return _unfolded(light, symmetry, planes) if symmetry else light


def _counted(one: float, other: float) -> tuple[int, int]:
    """Numbers of planes and of angles.

    Raises:
        InputError: there are none, or too many.
    """
    if not (min(one, other) >= 1 and max(one, other) <= MOST_ANGLES):
        raise InputError(f"has {one:g} and {other:g} planes and angles, and at most {MOST_ANGLES} are read")
    return int(one), int(other)


def _folded(plane: np.ndarray, symmetry: int) -> np.ndarray:
    """The planes among those that a file of this symmetry stores that are equal to these."""
    plane = plane % 360.0
    if symmetry == 1:
        return 0.0 * plane
    if symmetry == 3:
        return np.where((plane >= 90.0) & (plane <= 270.0), plane, (180.0 - plane) % 360.0)
    plane = np.minimum(plane, 360.0 - plane)
    return plane if symmetry == 2 else np.minimum(plane, 180.0 - plane)


def _mirrored(planes: np.ndarray, symmetry: int) -> np.ndarray:
    """All planes of a file that stores these."""
    if symmetry == 1:
        return 90.0 * np.arange(4)
    copies = {2: (planes, -planes), 3: (planes, 180.0 - planes), 4: (planes, -planes, 180.0 - planes, 180.0 + planes)}
    return np.unique(np.concatenate(copies[symmetry]) % 360.0)


def _unfolded(light: Photometry, symmetry: int, planes: np.ndarray) -> Photometry:
    """The light in all planes."""
    at = _folded(planes, symmetry)
    rows = [np.interp(at, light.planes, column) for column in light.values.T]
    return light._replace(planes=planes, values=np.stack(rows, 1))


def _checked(light: Photometry) -> Photometry:
    for name, values in (("C", light.planes), ("gamma", light.angles)):
        if not np.isfinite(values).all() or (np.diff(values) <= 0).any():
            raise InputError(f"has angles {name} that do not ascend")
    if not np.isfinite(light.values).all():
        raise InputError("has intensities that are not finite")
    return light


def _flux(light: Photometry) -> float:
    """Flux of equispaced planes, by the solid angles of cells half a step about each angle, lm."""
    gamma = np.radians(light.angles)
    edges = np.concatenate([gamma[:1], 0.5 * (gamma[1:] + gamma[:-1]), gamma[-1:]])
    return float((light.values * -np.diff(np.cos(edges))).sum() * 2.0 * math.pi / len(light.planes))


def _text(number: float) -> str:
    """A number of at most 12 characters, as EULUMDAT allows, with six digits or more."""
    return f"{number:.7g}" if abs(number) >= 1e-3 or number == 0 else f"{number:.7f}"


def _wrapped(numbers: Iterable[float]) -> list[str]:
    """Numbers as lines of at most LINE characters."""
    lines = [""]
    for word in map(_text, numbers):
        if len(lines[-1]) + 1 + len(word) > LINE:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".lstrip()
    return lines
