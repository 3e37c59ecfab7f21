"""Files beside a scene for Mitsuba 3, and materials: meshes, pictures of light as portable float maps, black, glass and mirrors.

A float map is `Pf`, its width and height, -1.0 for little-endian, and its rows of float32 (P. Debevec, Portable FloatMap Image
Format); Mitsuba takes the first of them for the highest v.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from caustic_cli.export.ply import write_mesh
from caustic_cli.export.text import real
from caustic_cli.io.files import write_bytes

#: A perfect absorber, and a perfect mirror with a black back.
BLACK = '<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>'
MIRRORED = f'<bsdf type="twosided"><bsdf type="conductor"><string name="material" value="none"/></bsdf>{BLACK}</bsdf>'


def beside(path: str | Path, name: str, suffix: str = ".ply") -> Path:
    """The file of a part of a scene."""
    return Path(path).with_name(f"{Path(path).stem}-{name}{suffix}")


def file_of(path: Path, name: str, suffix: str = ".ply") -> str:
    """Reference to the file of a part."""
    return f'<string name="filename" value={quoteattr(beside(path, name, suffix).name)}/>'


@dataclass(frozen=True)
class Meshes:
    """The mesh files beside a scene at a path, each of which is written once, also for several scenes."""

    path: Path
    written: set[str] = field(default_factory=set)

    def write(self, name: str, vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray | None = None) -> str:
        """Write the mesh of a part, as `ply.write_mesh`; the reference to it."""
        if name not in self.written:
            write_mesh(beside(self.path, name), vertices, faces, normals)
            self.written.add(name)
        return file_of(self.path, name)


def dielectric(index: float, roughness: float = 0.0) -> str:
    """Glass with microfacets of slopes of this standard deviation along either axis: Beckmann's alpha is sqrt(2) times that."""
    around = f'<float name="int_ior" value="{real(index)}"/><float name="ext_ior" value="1"/>'
    if not roughness:
        return f'<bsdf type="dielectric">{around}</bsdf>'
    facets = f'<string name="distribution" value="beckmann"/><float name="alpha" value="{real(math.sqrt(2.0) * roughness)}"/>'
    return f'<bsdf type="roughdielectric">{around}{facets}</bsdf>'


def picture(path: Path, name: str, key: str, values: np.ndarray, smooth: bool = False) -> str:
    """A texture of values (a, b), [i, j] with i along +u and j along +v, after writing its file; smooth: linear between the
    middles of its cells; key: of the parameter that it is."""
    rows = np.ascontiguousarray(values.T[::-1], "<f4")
    head = f"Pf\n{values.shape[0]} {values.shape[1]}\n-1.0\n"
    write_bytes(beside(path, name, ".pfm"), head.encode() + rows.tobytes())
    return (
        f'<texture type="bitmap" name="{key}">{file_of(path, name, ".pfm")}<boolean name="raw" value="true"/>'
        f'<string name="filter_type" value="{"bilinear" if smooth else "nearest"}"/>'
        '<string name="wrap_mode" value="clamp"/></texture>'
    )
