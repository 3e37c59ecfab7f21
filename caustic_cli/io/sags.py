"""Reader of the sag of a curved screen: heights on a regular grid, a 2-D `.npy` or a TIFF of 32-bit floats."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from caustic_cli.errors import InputError
from caustic_cli.io.arrays import open_npy
from caustic_cli.io.files import naming, read_bytes
from caustic_cli.io.picture import undecoded
from caustic_cli.scene.screen import MAX_SAGS
from caustic_cli.schema.checks import LENGTH

#: Bytes of a file: MAX_SAGS by MAX_SAGS heights of 8 bytes, and its header.
MOST_BYTES = (1 << 27) + (1 << 16)
ACCEPTED = f"heights in mm, 4 to {MAX_SAGS} along each axis, are needed: a 2-D .npy [i, j] or a .tif of 32-bit floats"


def read_sags(path: Path) -> tuple[bytes, np.ndarray]:
    """The bytes of a file and the heights in it, (a, b) float64 mm, [i, j] with i along +x and j along +y.

    Raises:
        InputError: the file cannot be read, or holds no such heights.
    """
    data = read_bytes(path, MOST_BYTES, ACCEPTED)
    if path.suffix.lower() == ".npy":
        with open_npy(path, ACCEPTED) as stored:
            _check(stored.shape, stored.dtype.kind in "fiu")
            values = stored.read_reals()
    else:
        with naming(path):
            values = _floats(data)
    with naming(path):
        if not (np.abs(values) <= LENGTH).all():
            raise InputError(f"must hold finite heights within +-{LENGTH:g} mm; {ACCEPTED}")
    return data, values


def _floats(data: bytes) -> np.ndarray:
    try:
        with Image.open(io.BytesIO(data), formats=("TIFF",)) as image:
            _check(image.size, image.mode == "F")
            return np.ascontiguousarray(np.asarray(image, dtype=np.float64)[::-1].T)
    except InputError:
        raise
    except Exception as error:  # a damaged file may cause any exception in a decoder
        raise InputError(f"{undecoded(error, 'a TIFF')}; {ACCEPTED}") from error


def _check(shape: tuple[int, ...], real: bool) -> None:
    if not real or len(shape) != 2 or not 4 <= min(shape) <= max(shape) <= MAX_SAGS:
        raise InputError(f"holds {' x '.join(map(str, shape))} values{'' if real else ' that are no heights'}; {ACCEPTED}")
