"""Readers of ray files of light sources: IES TM-25, Zemax binary and LightTools text, recognised by their signatures.

Every count in a file is validated against its size before memory is allocated.  Lengths are converted to mm, wavelengths to nm.
"""

from __future__ import annotations

from caustic_cli.errors import InputError
from caustic_cli.io.rayfiles import lighttools, tm25, zemax
from caustic_cli.scene.sources.rayset import RaySet

__all__ = ["ACCEPTED", "MAX_BYTES", "SUFFIXES", "parse_rays"]

#: Suffixes of ray files.
SUFFIXES = (".tm25ray", ".tm25", ".dat", ".sdf", ".ray", ".txt")
#: Largest file read: 38 million rays of TM-25.
MAX_BYTES = 1 << 30
ACCEPTED = "a ray file is needed: IES TM-25 (.tm25ray), Zemax binary (.dat, .sdf) or LightTools text (.ray, .txt)"
_FORMATS = (tm25, zemax, lighttools)


def parse_rays(data: bytes, where: str) -> RaySet:
    """Parse the contents of a ray file.

    Raises:
        InputError: naming `where`: none of these formats, or invalid.
    """
    for form in _FORMATS:
        if form.begins(data):
            try:
                return form.parse(data)
            except InputError as error:
                raise InputError(f"{where}: {error}") from error
    raise InputError(f"{where}: is not a ray file that can be read; {ACCEPTED}")
