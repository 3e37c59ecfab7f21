"""Polygon Objects of OpticStudio (`.pob`): a solid of triangles for its non-sequential mode.

    ! comment
    V number x y z                      vertices, numbered from 1, lens units (mm)
    T one two three is_reflective face  triangles; 0 refracts, and faces are numbered for coatings

The object is a volume ("Is Volume?" other than 0), and its material that of its row in the editor.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from caustic_cli.export.lamp import Part, merged
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import atomic_file


def write_pob(path: Path, parts: Sequence[Part], names: Sequence[str]) -> None:
    """Write a closed solid atomically; its parts are face groups of these names, numbered from 0."""
    points, triangles = merged(parts)
    group = np.repeat(np.arange(len(parts)), [len(faces) for _, faces, _ in parts])
    with atomic_file(path) as file:
        listed = ", ".join(f"{k} {name}" for k, name in enumerate(names))
        file.write(f"! {CREATED}; unit mm; faces: {listed}\n".encode("ascii"))
        file.writelines(rows(np.column_stack([np.arange(1, len(points) + 1), points]), "V %d %.12g %.12g %.12g\n"))
        file.writelines(rows(np.column_stack([triangles + 1, group]), "T %d %d %d 0 %d\n"))
