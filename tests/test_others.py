"""The evaluation of other programs' lenses agrees with the program's own render of the same surface."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_export import make

from caustic_cli.export.obj import write_obj
from caustic_cli.scene import Screen
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.retrace import retrace

sys.path.append(str(Path(__file__).parent / "benchmarks"))
from others import Sheet, expose, grid, read_lens, read_obj

RAYS, PIXELS = 2.5e5, 12


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A lens as .obj, with its own render: the file, the image, and its light."""
    scene, field, heights = make(control=(8, 8), relief=0.01)
    scene = replace(scene, screen=Screen((30.0, 30.0), 300.0, (PIXELS, PIXELS)))
    path = tmp_path_factory.mktemp("others") / "lens.obj"
    write_obj(path, scene, field, heights, samples=(161, 161))
    exposure, figures = retrace(scene, field, heights, None, rays=int(RAYS))
    return path, exposure.image.numpy(), figures["on_screen"] + figures["lost"]["fresnel"]


@pytest.mark.parametrize("smooth", [False, True])
def test_verdict_is_that_of_the_own_render(rendered, smooth):
    path, own, light = rendered
    image, seen = expose(read_lens(path), smooth, RAYS, PIXELS)
    assert own.std() > 0.1 * own.mean()
    assert relative_rms(image, own) < (0.01 if smooth else 0.04)  # noise of both is 0.005; facets blur, less on finer meshes
    assert seen == pytest.approx(light, abs=1e-3)
    assert image.sum() == pytest.approx(own.sum(), abs=1e-3)


def test_units_and_directions(rendered, tmp_path):
    """A file in other units, upside down, with its curved face towards -z, as a polygon file with normals: the same lens."""
    path, own, _ = rendered
    vertices, faces = read_obj(path)
    lines = [f"v {x / 10 + 3} {y / 10} {-z / 10}" for x, y, z in vertices] + ["vn 0 0 1"]
    lines += ["f " + " ".join(f"{n + 1}//1" for n in face[::-1]) for face in faces]
    (tmp_path / "other.obj").write_text("\n".join(lines))
    image, _ = expose(read_lens(tmp_path / "other.obj", 10.0), True, RAYS, PIXELS)
    assert relative_rms(image, own) < 0.01


def test_sheet_without_a_solid(rendered):
    """Heights of a grid are the same surface as its triangles in a file, whichever way they are wound."""
    lens = read_lens(rendered[0])
    side = np.unique(lens.vertices[:, 0])
    order = np.lexsort((lens.vertices[:, 1], lens.vertices[:, 0]))
    sheet = grid(lens.vertices[order, 2].reshape(len(side), -1))
    image, _ = expose(Sheet(sheet.vertices, sheet.faces[:, ::-1]), True, RAYS, PIXELS)
    assert relative_rms(image, expose(lens, True, RAYS, PIXELS)[0]) < 0.01
