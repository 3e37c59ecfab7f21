"""Ray files of light sources: IES TM-25, Zemax binary and LightTools text, told apart by what they begin with.

Every count in a file is checked against the file's size before anything is allocated for it.  Lengths become mm, wavelengths nm.
"""

from __future__ import annotations

from caustic_cli.errors import InputError
from caustic_cli.io.rayfiles import lighttools, tm25, zemax
from caustic_cli.scene.sources.rayset import RaySet

__all__ = ["ACCEPTED", "MAX_BYTES", "SUFFIXES", "parse_rays"]

#: Suffixes by which a file is taken for one of rays.
SUFFIXES = (".tm25ray", ".tm25", ".dat", ".sdf", ".ray", ".txt")
#: Largest file read: 38 million rays of TM-25.
MAX_BYTES = 1 << 30
ACCEPTED = "a ray file is needed: IES TM-25 (.tm25ray), Zemax binary (.dat, .sdf) or LightTools text (.ray, .txt)"
_FORMATS = (tm25, zemax, lighttools)


def parse_rays(data: bytes, where: str) -> RaySet:
    """The rays in a file's bytes.

    Raises:
        InputError: naming `where`: it is none of these formats, or breaks its own.
    """
    for form in _FORMATS:
        if form.begins(data):
            try:
                return form.parse(data)
            except InputError as error:
                raise InputError(f"{where}: {error}") from error
    raise InputError(f"{where}: is not a ray file that can be read; {ACCEPTED}")
