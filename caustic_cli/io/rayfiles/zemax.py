"""Reader of Zemax (Ansys OpticStudio) binary source files, `.dat` and `.sdf`: little-endian, numbers of 32 bits.

    offset  0   int identifier (1010, or 8675309 of old), unsigned number of rays, 100 characters of description
          108   float flux of the source, of these rays; wavelength, micrometres; 4 angles
          136   int unit of length: m, in, cm, ft, mm; 9 floats of position, rotation and scale, and 4 more, unused
          192   int ray format: 0 flux alone, 2 with wavelengths; int flux: 0 W, 1 lm; 2 more, unused
          208   rays, one after another: x y z, l m n, flux, and with format 2 the wavelength, micrometres

Like OpticStudio, the reader uses the number of rays, the unit of length and the two formats.
"""

from __future__ import annotations

import struct

import numpy as np

from caustic_cli.errors import InputError
from caustic_cli.io.rayfiles.binary import ray_table
from caustic_cli.scene.sources.rayset import RaySet

IDENTIFIERS = (1010, 8_675_309)
HEADER = 208
#: mm of each unit of length, in the order of the header's numbers for them.
MILLIMETRES = (1000.0, 25.4, 10.0, 304.8, 1.0)
#: Columns of each ray format.
COLUMNS = {0: 7, 2: 8}


def begins(data: bytes) -> bool:
    """Whether the data are of this format, in either byte order."""
    return len(data) >= 4 and any(struct.unpack_from(f"{order}i", data)[0] in IDENTIFIERS for order in "<>")


def parse(data: bytes) -> RaySet:
    """Parse the contents of a file.

    Raises:
        InputError: it is invalid.
    """
    if struct.unpack_from("<i", data)[0] not in IDENTIFIERS:
        raise InputError("has its bytes in big-endian order; Zemax source files are little-endian")
    if len(data) < HEADER:
        raise InputError(f"is cut off: the header of a Zemax source file is {HEADER} bytes, the file {len(data)}")
    (rays,) = struct.unpack_from("<I", data, 4)
    _, ray_set_flux, wavelength = struct.unpack_from("<3f", data, 108)
    (unit,) = struct.unpack_from("<i", data, 136)
    form, luminous = struct.unpack_from("<2i", data, 192)
    if not 0 <= unit < len(MILLIMETRES):
        raise InputError(f"has a unit of length {unit}; 0 (m), 1 (in), 2 (cm), 3 (ft) or 4 (mm) is needed")
    if form not in COLUMNS:
        raise InputError(f"has ray format {form}; 0 (flux) or 2 (flux and wavelength) is needed")
    if luminous not in (0, 1) or (form == 2 and luminous):
        raise InputError(f"has flux type {luminous} with ray format {form}; 0 (W), or 1 (lm) with ray format 0, is needed")
    table = ray_table(data, HEADER, rays, COLUMNS[form])
    wavelengths = 1000.0 * table[:, 7].astype(np.float64) if form == 2 else None
    if form == 0 and wavelength > 0:
        wavelengths = np.full(rays, 1000.0 * wavelength)
    with np.errstate(invalid="ignore"):
        positions = MILLIMETRES[unit] * table[:, 0:3].astype(np.float64)
    total = ray_set_flux if np.isfinite(ray_set_flux) else 0.0
    return RaySet(positions, table[:, 3:6], table[:, 6], total, "lm" if luminous else "W", wavelengths)
