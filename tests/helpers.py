"""What tests share: the picture they design for, a design that ends where it begins, and fewer combinations."""

import ast
import re
from collections.abc import Sequence
from itertools import combinations, product
from types import SimpleNamespace

import numpy as np
import torch
from PIL import Image

from caustic_cli.optics.frames import Pose
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.gradient.medium import GradientMedium
from caustic_cli.optics.surfaces import Plane
from caustic_cli.optics.system import ENTRANCE, EXIT, Element, System
from caustic_cli.scene import Scene
from caustic_cli.scene.sources.base import looked_up


def write_blob(name: str = "blob.png", size: int = 24, centre: tuple[float, float] = (8, 9), width: float = 30.0) -> None:
    """A grey picture with a smooth bright spot: `size` x `size` 8-bit codes, 40 to 240; centre: column and row."""
    y, x = np.mgrid[:size, :size]
    spot = np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / width)
    Image.fromarray((40 + 200 * spot).astype(np.uint8)).save(name)


def begun(project, *_) -> SimpleNamespace:
    """In place of `workflow.design._run`: what was begun, without an iteration."""
    figures = {"lost": {}, "image": "", "reason": "", "project": str(project.path)}
    return SimpleNamespace(
        project=project, scene=None, field=None, heights=None, target=None, state=SimpleNamespace(heights=None), figures=figures
    )


def between_planes(scene: Scene, values: torch.Tensor) -> System:
    """A plate with control values (n, m, layers) of its index, its sides planes instead of height fields."""
    lens = scene.lens
    index = SplineIndex(values, lens.half_size, lens.offset.thickness - lens.z_in)
    inside = GradientMedium(lens.index, gradient=index)
    front = Element(ENTRANCE, Plane(), lens.opening, behind=inside, pose=Pose((0.0, 0.0, lens.z_in)))
    back = Element(EXIT, Plane(), lens.opening, pose=Pose((0.0, 0.0, lens.offset.thickness)))
    return System((scene.source,), (front, back), (scene.screen,), scene.light)


def pairwise(*lists: Sequence) -> list[tuple]:
    """Rows with one value of each list, few of them, so that any two values of two lists meet in some row.

    For parameters that may disturb one another in twos, not in threes.  Each row begins with a pair that is still missing and, list
    by list, takes the value that meets most others for the first time: the same rows every time, 12 for four lists of 3, not 81.
    """
    columns = [range(len(one)) for one in lists]
    missing = {((i, a), (j, b)) for (i, one), (j, other) in combinations(enumerate(columns), 2) for a, b in product(one, other)}
    rows: list[tuple] = []
    while missing:
        row = dict(min(missing))
        for k, column in enumerate(columns):
            if k not in row:
                met = [sum(tuple(sorted((own, (k, c)))) in missing for own in row.items()) for c in column]
                row[k] = met.index(max(met))
        missing -= {*combinations(sorted(row.items()), 2)}
        rows.append(tuple(one[row[k]] for k, one in enumerate(lists)))
    return rows


def looked_up_in(profile):
    """A profile (a, b), constant per cell, as the function of u and v that a sampler takes."""
    return lambda u, v: looked_up(profile.numpy(), 2.0 * u - 1.0, 2.0 * v - 1.0)


# STEP


def read_step(path):
    """Entities by number, as text: enough of ISO 10303-21 for a test."""
    text = path.read_text()
    assert text.startswith("ISO-10303-21;\nHEADER;") and text.endswith("ENDSEC;\nEND-ISO-10303-21;\n")
    return {int(n): body for n, body in re.findall(r"^#(\d+)=(.*);$", text, re.M)}


def arguments(body):
    """The arguments of an entity as nested tuples of numbers, references and words."""
    text = re.sub(r"\.(\w+)\.", r"'\1'", body[body.index("(") :])
    text = re.sub(r"#(\d+)", r"'#\1'", text.replace("$", "None").replace("*", "None"))
    return ast.literal_eval(text.replace(")", ",)").replace("(,)", "()").replace(",,)", ",)"))


def edges_of(entities):
    """The number of edges of a closed shell: each is used once each way, and the corners of every loop follow one another."""
    assert {int(r) for body in entities.values() for r in re.findall(r"#(\d+)", body)} <= set(entities)
    uses = []
    for loop in (arguments(b)[1] for b in entities.values() if b.startswith("EDGE_LOOP")):
        ends = []
        for oriented in loop:
            *_, edge, way = arguments(entities[int(oriented[1:])])
            _, a, b, _, _ = arguments(entities[int(edge[1:])])
            uses.append((edge, way))
            ends.append((a, b) if way == "T" else (b, a))
        assert all(e[1] == n[0] for e, n in zip(ends, ends[1:] + ends[:1], strict=True))
    edges = {edge for edge, _ in uses}
    assert len(uses) == len(set(uses)) == 2 * len(edges)
    return len(edges)


def step_in_opencascade(path):
    """The surfaces of the faces of a valid solid, and a function that returns its volume, where cadquery-ocp is installed."""
    from OCP.BRep import BRep_Tool  # noqa: PLC0415
    from OCP.BRepCheck import BRepCheck_Analyzer  # noqa: PLC0415
    from OCP.BRepGProp import BRepGProp  # noqa: PLC0415
    from OCP.GProp import GProp_GProps  # noqa: PLC0415
    from OCP.STEPControl import STEPControl_Reader  # noqa: PLC0415
    from OCP.TopAbs import TopAbs_FACE, TopAbs_ShapeEnum  # noqa: PLC0415
    from OCP.TopExp import TopExp_Explorer  # noqa: PLC0415
    from OCP.TopoDS import TopoDS  # noqa: PLC0415

    reader = STEPControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    shape = reader.OneShape()
    assert BRepCheck_Analyzer(shape).IsValid() and shape.ShapeType() == TopAbs_ShapeEnum.TopAbs_SOLID
    explorer, surfaces = TopExp_Explorer(shape, TopAbs_FACE), []
    while explorer.More():
        face = getattr(TopoDS, "Face_s", None) or TopoDS.Face
        surfaces.append(BRep_Tool.Surface_s(face(explorer.Current())))
        explorer.Next()

    def volume():
        found = GProp_GProps()
        BRepGProp.VolumePropertiesGK_s(shape, found, 1e-6)
        return found.Mass()

    return surfaces, volume
