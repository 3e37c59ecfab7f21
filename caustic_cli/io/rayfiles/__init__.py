"""Ray files of light sources: IES TM-25, Zemax binary and LightTools text, told apart by what they begin with.

Every count in a file is checked against the file's size before anything is allocated for it.  Lengths become mm, wavelengths nm.
"""

from __future__ import annotations

import stat
from pathlib import Path

from caustic_cli.errors import InputError
from caustic_cli.io.rayfiles import lighttools, tm25, zemax
from caustic_cli.scene.sources.rayset import RaySet

__all__ = ["ACCEPTED", "MAX_BYTES", "SUFFIXES", "parse_rays", "read_bytes"]

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


def read_bytes(path: Path, most: int, accepted: str) -> bytes:
    """All of a regular file of at most `most` bytes.

    Raises:
        InputError: there is none, it is empty, too large or cannot be read; `accepted` says what is.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode):
            kind = "a directory" if stat.S_ISDIR(found.st_mode) else "not a regular file"
            raise InputError(f"{path}: is {kind}; {accepted}")
        if not 0 < found.st_size <= most:
            size = "empty" if found.st_size == 0 else f"{found.st_size:,} bytes; at most {most:,} are read"
            raise InputError(f"{path}: is {size}; {accepted}")
        with open(path, "rb") as file:
            data = file.read(most + 1)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {accepted}") from error
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error}); {accepted}") from error
    if len(data) > most:
        raise InputError(f"{path}: grew beyond {most:,} bytes while it was read; {accepted}")
    return data
