"""The table of rays at the end of a binary ray file."""

from __future__ import annotations

import numpy as np

from caustic_cli.errors import InputError


def ray_table(data: bytes, start: int, rays: int, columns: int) -> np.ndarray:
    """The rays of a file, little-endian floats of 32 bits from offset `start` to its end: (rays, columns).

    Raises:
        InputError: there are none, or the file has another length.
    """
    if rays == 0:
        raise InputError("holds no rays; at least one is needed")
    size = start + 4 * columns * rays
    if size != len(data):
        raise InputError(f"is {len(data):,} bytes, but its header and {rays:,} rays of {columns} columns are {size:,}")
    return np.frombuffer(data, dtype="<f4", offset=start).reshape(rays, columns)
