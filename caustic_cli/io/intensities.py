"""Reader of tabulated intensity distributions: text of two columns, degrees from the axis and relative intensity, or a photometric
file that is symmetric about its axis."""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from caustic_cli.errors import InputError
from caustic_cli.io.columns import rows_of
from caustic_cli.io.files import naming
from caustic_cli.io.photometry import SUFFIXES, Photometry, parse_photometry
from caustic_cli.scene.sources.distribution import MOST_ANGLES, Distribution

#: Largest file read.
MOST_BYTES = 1 << 24
TABLE = (
    "a .csv of two columns is needed, degrees from +z, ascending from 0, and relative intensity, or a photometric file, .ies or"
    " .ldt"
)
#: Largest difference of the planes of a symmetric photometric file from their mean within one step of the angle, over its peak.
SYMMETRIC = 0.05


def parse_distribution(data: bytes, where: str) -> Distribution:
    """Parse the contents of a file, by the suffix of its name.

    Raises:
        InputError: naming `where`.
    """
    if where.lower().endswith(SUFFIXES):
        return _mean(parse_photometry(data, where), where)
    return _table(data, where)


def _mean(light: Photometry, where: str) -> Distribution:
    """The mean over the planes of a photometric file.

    Raises:
        InputError: they differ.
    """
    values = light.values.mean(0)
    around = sliding_window_view(np.pad(values, 1, mode="edge"), 3)  # an edge may run within one step of the angle
    beyond = np.maximum(light.values - around.max(1), around.min(1) - light.values)
    off = float(beyond.max()) / max(float(values.max()), 1e-300)
    if off > SYMMETRIC:
        raise InputError(
            f"{where}: its planes C differ by {off:.0%} of the peak, and the intensity of a source depends on the angle to its axis"
            " alone; a file that is symmetric about the axis is needed"
        )
    with naming(where):
        return Distribution(tuple(light.angles.tolist()), tuple(values.clip(0.0).tolist()))


def _table(data: bytes, where: str) -> Distribution:
    """Parse text, see `columns`.

    Raises:
        InputError: naming `where` and the line.
    """
    rows: list[tuple[float, float]] = []
    for angle, intensity, line in rows_of(data, where, TABLE, "angles", MOST_ANGLES):
        if not (math.isfinite(angle) and math.isfinite(intensity)):
            raise InputError(f"{line}; {TABLE}")
        rows.append((angle, intensity))
    if not rows:
        raise InputError(f"{where}: has no angles; {TABLE}")
    with naming(where):
        return Distribution(*(tuple(column) for column in zip(*rows, strict=True)))
