"""Writer of 3MF files of the closed solid (3MF Consortium, 3D Manufacturing Format, Core Specification 1.3): a ZIP archive of the
model as XML, in millimetres.

Lengths have the decimals of OBJ files.
"""

from __future__ import annotations

import io
import zipfile
from functools import partial
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from caustic_cli.export import mesh
from caustic_cli.export.obj import DECIMALS
from caustic_cli.export.printing import USUAL, advised, placed
from caustic_cli.export.text import CREATED, rows
from caustic_cli.io.files import MARK, write_bytes

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
MODEL = "3D/3dmodel.model"
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
#: Content types and relation of the package, by the name of the part.
PARTS = {
    "[Content_Types].xml": f'{HEAD}<Types xmlns="{PACKAGE}/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
    "_rels/.rels": f'{HEAD}<Relationships xmlns="{PACKAGE}/relationships">'
    f'<Relationship Target="/{MODEL}" Id="rel0" Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>',
}
#: Date of the parts, so that the same solid is the same file; bytes of a point and two triangles, compressed, about.
DATE, A_POINT = (1980, 1, 1, 0, 0, 0), 45


def write_3mf(
    path: str | Path, *lens: Any, printer: tuple[float, float] = USUAL, orientation: str | None = None, **density: Any
) -> dict[str, Any]:
    """Write the solid atomically; arguments and errors as in `write_ply`.

    Args:
        printer: layers and least steps in their plane, mm; orientation: in which it stands on the plate, of `printing.UPRIGHT`, or
            advised; None for that of the scene.

    Returns:
        the orientation that is advised, see `Orientation.figures`.
    """
    scene, field, heights = lens
    vertices, faces = mesh.closed_mesh(*lens, **density)
    found = advised(scene.lens, field, heights, printer)
    name = found.advised if orientation == "advised" else orientation
    place = None if name is None else placed(name, vertices, scene.lens.cut_from)
    write_mesh(path, vertices, faces, found.words, place)
    return found.figures | {"orientation": name}


def write_mesh(
    path: str | Path, vertices: np.ndarray, faces: np.ndarray, description: str = "", place: np.ndarray | None = None
) -> None:
    """Write vertices (V, 3) mm and triangles (F, 3); place: on the plate, (4, 3), of points as rows."""
    form = f"%.{DECIMALS}f"
    said = f'<metadata name="Description">{escape(description)}</metadata>' if description else ""
    where = "" if place is None else f' transform="{" ".join(f"{v:.12g}" for v in place.ravel())}"'
    model = [
        f'{HEAD}<model unit="millimeter" xmlns="{CORE}"><metadata name="Application">{CREATED}</metadata>{said}'
        '<resources><object id="1" type="model"><mesh><vertices>\n'.encode(),
        *rows(vertices.round(DECIMALS) + 0.0, f'<vertex x="{form}" y="{form}" z="{form}"/>\n'),
        b"</vertices><triangles>\n",
        *rows(faces, '<triangle v1="%d" v2="%d" v3="%d"/>\n'),
        f'</triangles></mesh></object></resources><build><item objectid="1"{where}/></build></model>\n'.encode(),
    ]
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (*PARTS.items(), (MODEL, b"".join(model))):
            part = zipfile.ZipInfo(name, DATE)
            part.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(part, text)
        archive.comment = MARK
    write_bytes(path, held.getvalue())


#: Arguments of the writer beside the density.
MORE = ("printer", "orientation")
#: Densities of files of at most `limit` bytes, the smallest first; and the surface as read from the mesh, with rounded lengths.
choices = partial(mesh.choices, a_point=A_POINT)
readings = partial(mesh.readings, rounded=lambda points: points.round(DECIMALS))
