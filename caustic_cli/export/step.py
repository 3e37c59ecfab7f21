"""The lens as an exact solid in a STEP file (ISO 10303-21, application protocol 214): entrance plane, exit B-spline, four sides.

The exit surface's poles stand at the Greville abscissae with the control heights as they are, to the last bit; its borders are
B-spline curves with the border's poles.  Each border lies in a plane x = const or y = const, which is a side.  mm.

A shell is described from the corners up: vertices, edge curves from vertex to vertex, loops of edges counter-clockwise around
each face's outward normal, faces, shell, solid; then the product that readers look for.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.export.mesh import refuse_open
from caustic_cli.export.text import CREATED
from caustic_cli.files import atomic_path
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.scene import Scene

HEAD = f"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('{CREATED}'),'2;1');
FILE_NAME('lens','1980-01-01T00:00:00',(''),(''),'caustic {__version__}','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 10303 214 1 1 1 1 }}'));
ENDSEC;
DATA;
"""
TAIL = "ENDSEC;\nEND-ISO-10303-21;\n"
#: mm within which vertices, edges and faces of this solid meet: all are exact.
UNCERTAINTY = 1e-7


class Entities:
    """Numbered entities: `add` returns the reference "#7" of a new one."""

    def __init__(self):
        self.lines: list[str] = []

    def add(self, text: str) -> str:
        self.lines.append(f"#{len(self.lines) + 1}={text};\n")
        return f"#{len(self.lines)}"

    def point(self, p) -> str:
        return self.add(f"CARTESIAN_POINT('',{reals(p)})")

    def direction(self, d) -> str:
        return self.add(f"DIRECTION('',{reals(d)})")

    def vertex(self, p) -> str:
        return self.add(f"VERTEX_POINT('',{self.point(p)})")

    def plane(self, at, normal, along) -> str:
        """A plane through `at` with its normal and x direction."""
        place = self.add(f"AXIS2_PLACEMENT_3D('',{self.point(at)},{self.direction(normal)},{self.direction(along)})")
        return self.add(f"PLANE('',{place})")

    def line(self, a, b) -> str:
        """The straight line through a towards b."""
        step = np.subtract(b, a)
        vector = self.add(f"VECTOR('',{self.direction(step / np.linalg.norm(step))},1.)")
        return self.add(f"LINE('',{self.point(a)},{vector})")

    def edge(self, a: str, b: str, curve: str) -> str:
        return self.add(f"EDGE_CURVE('',{a},{b},{curve},.T.)")

    def face(self, surface: str, edges: list[tuple[str, bool]]) -> str:
        """A face whose outward normal is the surface's, inside a loop of edges, each as it is or reversed."""
        loop = [self.add(f"ORIENTED_EDGE('',*,*,{edge},{'.T.' if forward else '.F.'})") for edge, forward in edges]
        closed = self.add(f"EDGE_LOOP('',({','.join(loop)}))")
        bound = self.add(f"FACE_OUTER_BOUND('',{closed},.T.)")
        return self.add(f"ADVANCED_FACE('',({bound}),{surface},.T.)")


def write_step(path: str | Path, scene: Scene, field: HeightField, heights: Tensor) -> None:
    """Write the solid whole or not at all.  heights: (n, m) mm.

    Raises:
        InputError: the surface reaches the entrance, or the file cannot be written there.
    """
    net = heights.detach().double().cpu().numpy()
    refuse_open(float(net.min()), scene.lens.z_in)
    x, y = (c.numpy() for c in field.control_xy())
    x, y = np.broadcast_arrays(x[:, None], y[None, :])
    out = Entities()
    solid = lens_solid(out, np.stack([x, y, net], -1), field.spaces, scene.lens.z_in)
    _product(out, solid)
    with atomic_path(path) as temporary, open(temporary, "w", encoding="ascii", newline="\n") as file:
        file.write(HEAD)
        file.writelines(out.lines)
        file.write(TAIL)


def lens_solid(out: Entities, poles: np.ndarray, spaces: tuple[SplineSpace, SplineSpace], z_in: float) -> str:
    """The solid under poles (n, m, 3) down to z_in; corners a, b, c, d are numbered counter-clockwise from +z."""
    points = [[out.point(p) for p in row] for row in poles]
    su, sv = spaces
    control = ",".join("(" + ",".join(row) + ")" for row in points)
    exit_surface = out.add(f"B_SPLINE_SURFACE_WITH_KNOTS('',{su.degree},{sv.degree},({control}),.UNSPECIFIED.,.F.,.F.,.F.,"
                           f"{','.join(_knots(su, sv))},.UNSPECIFIED.)")
    ends = (0, 0), (-1, 0), (-1, -1), (0, -1)
    tops = [poles[e] for e in ends]
    feet = [np.array([*p[:2], z_in]) for p in tops]
    top, foot = [out.vertex(p) for p in tops], [out.vertex(p) for p in feet]
    borders = ([row[0] for row in points], su), (points[-1], sv), ([row[-1] for row in points], su), (points[0], sv)
    rim, base, post = [], [], []
    for k, (border, space) in enumerate(borders):
        after = (k + 1) % 4
        start, end = (k, after) if k < 2 else (after, k)  # the curve's own direction: along +x or +y
        curve = out.add(f"B_SPLINE_CURVE_WITH_KNOTS('',{space.degree},({','.join(border)}),.UNSPECIFIED.,.F.,.F.,"
                        f"{','.join(_knots(space))},.UNSPECIFIED.)")
        rim.append((out.edge(top[start], top[end], curve), k < 2))
        base.append((out.edge(foot[k], foot[after], out.line(feet[k], feet[after])), True))
        post.append((out.edge(foot[k], top[k], out.line(feet[k], tops[k])), True))
    outward = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)
    faces = [out.face(exit_surface, rim)]
    for k, normal in enumerate(outward):  # along the foot, up, back along the rim, down
        faces.append(out.face(out.plane(feet[k], normal, (0.0, 0.0, 1.0)),
                              [base[k], post[(k + 1) % 4], _reversed(rim[k]), _reversed(post[k])]))
    faces.append(out.face(out.plane(feet[0], (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)), [_reversed(e) for e in base[::-1]]))
    shell = out.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    return out.add(f"MANIFOLD_SOLID_BREP('lens',{shell})")


def _reversed(edge: tuple[str, bool]) -> tuple[str, bool]:
    return edge[0], not edge[1]


def _product(out: Entities, solid: str) -> None:
    """Units, and the product whose shape the solid is."""
    millimetre = out.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    radian = out.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    steradian = out.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    near = out.add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE({real(UNCERTAINTY)}),{millimetre},'distance_accuracy_value','')")
    context = out.add("(GEOMETRIC_REPRESENTATION_CONTEXT(3)"
                      f"GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({near}))"
                      f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({millimetre},{radian},{steradian}))"
                      "REPRESENTATION_CONTEXT('',''))")
    origin = out.add(f"AXIS2_PLACEMENT_3D('',{out.point((0, 0, 0))},{out.direction((0, 0, 1))},{out.direction((1, 0, 0))})")
    shape = out.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('lens',({origin},{solid}),{context})")
    application = out.add("APPLICATION_CONTEXT('automotive design')")
    out.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{application})")
    discipline = out.add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    product = out.add(f"PRODUCT('lens','lens','',({discipline}))")
    formation = out.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    within = out.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    definition = out.add(f"PRODUCT_DEFINITION('design','',{formation},{within})")
    described = out.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    out.add(f"SHAPE_DEFINITION_REPRESENTATION({described},{shape})")


def _knots(*spaces: SplineSpace) -> Iterator[str]:
    """Multiplicities of every space, then their distinct knots."""
    found = [np.unique(s.knots.numpy(), return_counts=True) for s in spaces]
    yield from (f"({','.join(map(str, counts))})" for _, counts in found)
    yield from (reals(values) for values, _ in found)


def reals(values) -> str:
    """A list of reals: "(0.5,300.,1.E-05)"."""
    return f"({','.join(map(real, values))})"


def real(value: float) -> str:
    """A STEP real with 17 digits: it must hold a decimal point."""
    mantissa, e, exponent = format(float(value), ".17g").partition("e")
    return mantissa + ("" if "." in mantissa else ".") + (f"E{exponent}" if e else "")
