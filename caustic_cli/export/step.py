"""Writer of STEP files (ISO 10303-21, application protocol 214) of the solid: plane or B-spline entrance, B-spline exit, four
sides; or of a mirror, with material above its surface up to z_in.

Other lenses and mirrors are separate solids, see `bodies`.

The poles of the exit surface are the control heights at the Greville abscissae; its edges are B-spline curves with the border
poles, in the planes x = const or y = const of the sides.  For a round lens the same surface is trimmed by a cylinder, along an
interpolated curve.  A border for the mount is a flange, as in `mesh`.  Lengths are mm.

Unless the exact spline is requested, lengths are rounded as far as light does not notice (`surface.decimals_for`), and surfaces may
be approximated on fewer knots (`approximation`).

The boundary representation is written bottom-up: vertices, edge curves, edge loops counter-clockwise about the outward normal of
each face, faces, shell, solid; then the product.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.export.approximation import on_fewer_knots
from caustic_cli.export.bodies import bodies
from caustic_cli.export.mesh import FLANGE, closed_mesh, refuse_open
from caustic_cli.export.reading import Readings, of_poles
from caustic_cli.export.surface import STEPS_PER_SPAN, control_points, decimals_for, knot_lines, on_lines
from caustic_cli.export.text import CREATED
from caustic_cli.io.files import atomic_file
from caustic_cli.optics.frames import Pose, rotate_to_global, to_global
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import entrance_of, freeform_of
from caustic_cli.scene import Aperture, CircularAperture, Lens, Scene
from caustic_cli.schema import checks

HEAD = f"""ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('{CREATED}'),'2;1');
FILE_NAME('lens','1980-01-01T00:00:00',(''),(''),'caustic {__version__}','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 10303 214 1 1 1 1 }}'));
ENDSEC;
DATA;
"""
TAIL = "ENDSEC;\nEND-ISO-10303-21;\n"
#: Tolerance within which vertices, edges and faces of the solid coincide, mm.
UNCERTAINTY = 1e-7
#: Fractions of the poles of a surface to choose from, in this order.
PARTS = [2.0 ** (-k / 2) for k in range(12, -1, -1)]
#: UNCERTAINTY for the interpolated rim of a round lens, and most points on half of it.
ROUND_UNCERTAINTY, MOST_ON_RIM = 1e-6, 1 << 15


class Entities:
    """Numbered STEP entities: `add` returns the reference "#7" of a new one.

    up: -1 to reflect z; outward normals remain outward, and loops are reversed.
    decimals: of points; None for all digits.
    """

    def __init__(self, up: float = 1.0, decimals: int | None = None):
        self.lines: list[str] = []
        self.up = float(up)
        self.decimals = decimals
        self.pose = Pose()  # of the solid that is being described

    def add(self, text: str) -> str:
        self.lines.append(f"#{len(self.lines) + 1}={text};\n")
        return f"#{len(self.lines)}"

    def point(self, p) -> str:
        at = to_global(self.pose, (p[0], p[1], self.up * p[2] + 0.0), 0.0)
        return self.add(f"CARTESIAN_POINT('',{reals(at, self.decimals)})")

    def direction(self, d) -> str:
        return self.add(f"DIRECTION('',{reals(rotate_to_global(self.pose, (d[0], d[1], self.up * d[2] + 0.0)))})")

    def placement(self, at, normal, along) -> str:
        return self.add(f"AXIS2_PLACEMENT_3D('',{self.point(at)},{self.direction(normal)},{self.direction(along)})")

    def plane(self, at, normal, along) -> str:
        """A plane through `at` with its normal and x direction."""
        return self.add(f"PLANE('',{self.placement(at, normal, along)})")

    def line(self, a, b) -> str:
        """The straight line through a towards b."""
        step = np.subtract(b, a)
        vector = self.add(f"VECTOR('',{self.direction(step / np.linalg.norm(step))},1.)")
        return self.add(f"LINE('',{self.point(a)},{vector})")

    def curve(self, degree: int, points: list[str], knots: np.ndarray) -> str:
        return self.add(
            f"B_SPLINE_CURVE_WITH_KNOTS('',{degree},({','.join(points)}),.UNSPECIFIED.,.F.,.F.,"
            f"{','.join(knot_lists(knots))},.UNSPECIFIED.)"
        )

    def edge(self, a: str, b: str, curve: str) -> str:
        return self.add(f"EDGE_CURVE('',{a},{b},{curve},.T.)")

    def bound(self, edges: list[tuple[str, bool]], outer: bool = True) -> str:
        """A loop of edges, each as it is or reversed."""
        edges = edges if self.up > 0 else turned(edges)
        loop = [self.add(f"ORIENTED_EDGE('',*,*,{edge},{'.T.' if forward else '.F.'})") for edge, forward in edges]
        closed = self.add(f"EDGE_LOOP('',({','.join(loop)}))")
        return self.add(f"FACE_{'OUTER_' if outer else ''}BOUND('',{closed},.T.)")

    def face(self, surface: str, *bounds: str, along: bool = True) -> str:
        """A face inside the first bound and outside the others, whose outward normal is that of the surface, or opposite unless
        `along`."""
        return self.add(f"ADVANCED_FACE('',({','.join(bounds)}),{surface},{'.T.' if along else '.F.'})")


@dataclass(frozen=True)
class Loop:
    """Corners (mm) and their vertices, counter-clockwise from +z, the edges between them with their orientation, and their curves,
    of a ring."""

    corners: list[np.ndarray]
    vertices: list[str]
    edges: list[tuple[str, bool]]
    curves: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Solid:
    """Solid between the entrance of a lens and an exit, field and heights (n, m) mm, at `pose`."""

    lens: Lens
    field: HeightField
    heights: Tensor
    pose: Pose

    @property
    def sides(self) -> list[tuple[HeightField, Tensor]]:
        """The B-spline surfaces, the exit first."""
        if self.lens.entrance is None:
            return [(self.field, self.heights)]
        front = entrance_of(self.lens)
        return [(self.field, self.heights), (front.field, front.heights)]

    def with_sides(self, exit: tuple[HeightField, Tensor], *entrance: tuple[HeightField, Tensor]) -> Solid:
        """The solid with other surfaces."""
        fronts = [freeform_of(*side) for side in entrance]
        return replace(self, lens=replace(self.lens, entrance=fronts[0]) if fronts else self.lens, field=exit[0], heights=exit[1])


def write_step(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    tolerance: float | None = None,
    poles: float = 1.0,
) -> None:
    """Write the solid atomically.

    Args:
        heights: (n, m) mm.
        tolerance: largest measured deviation of a surface, mm, reached with as few knots as possible; 0 for the exact spline; None
            for lengths that are rounded as far as light does not notice.
        poles: fraction of the poles of the free-form lens, without a tolerance: its surfaces are approximated on fewer knots.

    Raises:
        InputError: the surface reaches the entrance, or the file cannot be written there.
    """
    solids, decimals = _solids(scene, field, heights, tolerance, poles)
    if scene.lens.entrance is None:
        refuse_open(float(solids[0].heights.min()), solids[0].lens.z_in)
    if scene.lens.entrance is not None or scene.elements:
        closed_mesh(scene, field, heights)  # raises an error if it is not a solid
    out, found = Entities(scene.lens.cut_from, decimals), []
    for solid in solids:
        out.pose = solid.pose
        found.append(lens_solid(out, solid.lens, solid.field, solid.heights))
    out.pose = Pose()
    digit = 0.0 if decimals is None else 10.0 ** (1 - decimals)
    product(out, found, max(digit, *(OUTLINES[body.aperture].uncertainty for body in (scene.lens, *scene.elements))))
    with atomic_file(path, "ascii") as file:
        file.write(HEAD)
        file.writelines(out.lines)
        file.write(TAIL)


def choices(scene: Scene, field: HeightField, heights: Tensor, limit: float) -> list[dict]:
    """Fractions of the poles of files of at most `limit` bytes, the smallest first: all poles, as a solid for CAD is expected to
    have, if they fit; the smallest fraction of all where none does."""
    solids, decimals = _solids(scene, field, heights, None, 1.0)
    sizes = [math.prod(f.shape) * _bytes(f, h, decimals or 0) for solid in solids for f, h in solid.sides]
    own = sum(sizes[: len(solids[0].sides)])
    fits = [part for part in reversed(PARTS) if part * own + sum(sizes) - own <= limit]
    return [{"poles": part} for part in reversed(fits) if fits[0] < 1.0 or part == 1.0] or [{"poles": PARTS[0]}]


def readings(scene: Scene, field: HeightField, heights: Tensor, tolerance: float | None = None, poles: float = 1.0) -> Readings:
    """The surface as read from the poles, rounded as they are."""
    solids, decimals = _solids(scene, field, heights, tolerance, poles)
    (exit, net), *fronts = solids[0].sides
    written = [h if decimals is None else torch.from_numpy(h.numpy().round(decimals)) for h in (net, *(h for _, h in fronts))]
    front = freeform_of(fronts[0][0], written[1]) if fronts else None
    return {"error": lambda: of_poles(exit, scene.lens.cut_from * written[0], front)}


def _solids(
    scene: Scene, field: HeightField, heights: Tensor, tolerance: float | None, poles: float
) -> tuple[list[Solid], int | None]:
    """The solids, those of a mirror reflected in z, with surfaces on as many knots as asked, and the decimals of lengths, None for
    all; arguments as in `write_step`."""
    if tolerance is not None:
        checks.number("⟨tolerance⟩", tolerance, 0.0)
    up = scene.lens.cut_from  # a mirror is built upside down and reflected in z
    heights, lens = up * heights.detach().double().cpu(), replace(scene.lens, z_in=up * scene.lens.z_in)
    solids = [Solid(lens, field, heights, Pose()), *(Solid(b.lens, b.field, b.heights, b.pose) for b in bodies(scene))]
    if tolerance == 0:
        return solids, None
    apart = min(2.0 * r / n for solid in solids for f, _ in solid.sides for r, n in zip(f.half_size, f.shape, strict=True))
    decimals = decimals_for(apart, tolerance)
    if tolerance is None:
        most = [math.ceil(poles * math.prod(f.shape)) for f, _ in solids[0].sides]
        fewer = [on_fewer_knots(*side, n) for side, n in zip(solids[0].sides, most, strict=True)]
        return [solids[0].with_sides(*fewer), *solids[1:]], decimals
    return [solid.with_sides(*(_within(*side, tolerance, decimals) for side in solid.sides)) for solid in solids], decimals


def _within(field: HeightField, heights: Tensor, tolerance: float, decimals: int) -> tuple[HeightField, Tensor]:
    """A surface on the fewest knots of PARTS with rounded poles within the tolerance, mm; on all of its own if none suffices."""
    for part in PARTS:
        fewer, net = on_fewer_knots(field, heights, math.ceil(part * math.prod(field.shape)))
        read = of_poles(fewer, torch.from_numpy(net.numpy().round(decimals)))
        if read.largest_deviation(field, heights) <= tolerance:
            break
    return fewer, net


def _bytes(field: HeightField, heights: Tensor, decimals: int) -> int:
    """Upper bound of the bytes of a pole and its reference."""
    widest = (field.half_size[0], field.half_size[1], float(heights.abs().max()))
    return len("#1234567=CARTESIAN_POINT('',(,,));\n#1234567,") + sum(len(f"{-w:.{decimals}f}") for w in widest)


def _spline_surface(out: Entities, field: HeightField, poles: np.ndarray) -> tuple[str, list[list[str]]]:
    """The surface with poles (n, m, 3), and its points."""
    su, sv = field.spaces
    points = [[out.point(p) for p in row] for row in poles]
    control = ",".join("(" + ",".join(row) + ")" for row in points)
    surface = out.add(
        f"B_SPLINE_SURFACE_WITH_KNOTS('',{su.degree},{sv.degree},({control}),.UNSPECIFIED.,.F.,.F.,.F.,"
        f"{','.join(knot_lists(su.knots.numpy(), sv.knots.numpy()))},.UNSPECIFIED.)"
    )
    return surface, points


def lens_solid(out: Entities, lens: Lens, field: HeightField, heights: Tensor) -> str:
    """The solid under a surface, heights (n, m) mm."""
    outline, z_in = OUTLINES[lens.aperture], lens.z_in
    exit_surface, rim, lowest = _trimmed(out, outline, field, heights)
    faces, upper = [out.face(exit_surface, out.bound(rim.edges), along=out.up > 0)], rim
    if lens.entrance is not None:
        front = entrance_of(lens)
        entrance, foot, _ = _trimmed(out, outline, front.field, front.heights + z_in)
        faces += outline.walls(out, lens.opening, rim, foot)
        faces.append(out.face(entrance, out.bound(turned(foot.edges)), along=False))
        return closed(out, faces)
    wide = lens.opening.grown(lens.border)
    if lens.border > 0:
        high = z_in + FLANGE * (lowest - z_in)
        inner, upper = outline.flat(out, lens.opening, high), outline.flat(out, wide, high)
        faces += outline.walls(out, lens.opening, rim, inner)
        flange = out.plane((0.0, 0.0, high), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
        faces.append(out.face(flange, out.bound(upper.edges), out.bound(turned(inner.edges), False)))
    foot = outline.flat(out, wide, z_in)
    faces += outline.walls(out, wide, upper, foot)
    entrance = out.plane((0.0, 0.0, z_in), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
    faces.append(out.face(entrance, out.bound(turned(foot.edges))))
    return closed(out, faces)


def _trimmed(out: Entities, outline: Polygon, field: HeightField, heights: Tensor) -> tuple[str, Loop, float]:
    """A B-spline surface, its border, and the least height there, mm."""
    surface, points = _spline_surface(out, field, poles := control_points(field, heights.numpy()))
    return surface, *outline.rim(out, field, heights, poles, points)


def closed(out: Entities, faces: list[str]) -> str:
    """The solid between faces."""
    shell = out.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    return out.add(f"MANIFOLD_SOLID_BREP('lens',{shell})")


class Polygon:
    """Edges and sides of a solid with a rectangular outline."""

    uncertainty = UNCERTAINTY
    #: Outward normals of the sides, from that at -y on, counter-clockwise.
    outward = (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)

    def rim(
        self, out: Entities, field: HeightField, heights: Tensor, poles: np.ndarray, points: list[list[str]]
    ) -> tuple[Loop, float]:
        """Border of a surface within the outline, and its least height, mm: curves of the border poles, and the least of the points
        of the default grid."""
        su, sv = field.spaces
        corners = [poles[0, 0], poles[-1, 0], poles[-1, -1], poles[0, -1]]
        vertices = [out.add(f"VERTEX_POINT('',{out.point(p)})") for p in corners]
        borders = ([row[0] for row in points], su), (points[-1], sv), ([row[-1] for row in points], su), (points[0], sv)
        edges = []
        for k, (border, space) in enumerate(borders):
            start, end = (k, (k + 1) % 4) if k < 2 else ((k + 1) % 4, k)  # the curve's own direction: along +x or +y
            curve = out.curve(space.degree, border, space.knots.numpy())
            edges.append((out.edge(vertices[start], vertices[end], curve), k < 2))
        (u, v), ends = (knot_lines(space, STEPS_PER_SPAN) for space in field.spaces), torch.tensor([0.0, 1.0], dtype=torch.float64)
        lowest = min(float(on_lines(field, heights, lines).z.min()) for lines in ((u, ends), (ends, v)))
        return Loop(corners, vertices, edges), lowest

    def flat(self, out: Entities, aperture: Aperture, z: float) -> Loop:
        """The outline of an aperture at z."""
        corners = [np.array([*p, z]) for p in self._corners(aperture)]
        vertices = [out.add(f"VERTEX_POINT('',{out.point(p)})") for p in corners]
        curves = self._curves(out, aperture, corners)
        edges = [(out.edge(a, b, c), True) for a, b, c in zip(vertices, vertices[1:] + vertices[:1], curves, strict=True)]
        return Loop(corners, vertices, edges)

    def _corners(self, aperture: Aperture) -> list[tuple[float, float]]:
        rx, ry = aperture.half_size
        return [(-rx, -ry), (rx, -ry), (rx, ry), (-rx, ry)]

    def _curves(self, out: Entities, aperture: Aperture, corners: list[np.ndarray]) -> list[str]:
        return [out.line(a, b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]

    def walls(self, out: Entities, aperture: Aperture, upper: Loop, lower: Loop) -> list[str]:
        """Vertical faces between two loops over the outline of an aperture."""
        return walls(out, self._sides(out, aperture, lower), upper, lower)

    def _sides(self, out: Entities, aperture: Aperture, lower: Loop) -> Iterator[str]:
        """The surfaces of the sides."""
        yield from (out.plane(at, normal, (0.0, 0.0, 1.0)) for at, normal in zip(lower.corners, self.outward, strict=True))


class Circle(Polygon):
    """Edges and sides of a solid with a circular outline: two halves of a cylinder."""

    uncertainty = ROUND_UNCERTAINTY

    def rim(
        self, out: Entities, field: HeightField, heights: Tensor, poles: np.ndarray, points: list[list[str]]
    ) -> tuple[Loop, float]:
        """As of a polygon: two interpolating cubic curves within ROUND_UNCERTAINTY / 10."""
        radius = field.half_size[0]

        def on(t: np.ndarray) -> np.ndarray:
            x, y = radius * np.cos(t), radius * np.sin(t)
            z = field.at(heights, *map(torch.from_numpy, (x, y)), [(0, 0)])[0].numpy()
            return np.stack([x, y, z], -1)

        return ring(out, on, 8 * max(field.shape))

    def _corners(self, aperture: Aperture) -> list[tuple[float, float]]:
        return [(aperture.half_size[0], 0.0), (-aperture.half_size[0], 0.0)]

    def _curves(self, out: Entities, aperture: Aperture, corners: list[np.ndarray]) -> list[str]:
        place = out.placement((0, 0, corners[0][2]), (0, 0, out.up), (1, 0, 0))  # orientation of the edges
        return [out.add(f"CIRCLE('',{place},{real(aperture.half_size[0])})")] * 2

    def _sides(self, out: Entities, aperture: Aperture, lower: Loop) -> Iterator[str]:
        place = out.placement((0, 0, lower.corners[0][2]), (0, 0, 1), (1, 0, 0))
        cylinder = out.add(f"CYLINDRICAL_SURFACE('',{place},{real(aperture.half_size[0])})")
        yield from (cylinder, cylinder)


def ring(out: Entities, on: Callable[[np.ndarray], np.ndarray], count: int) -> tuple[Loop, float]:
    """A closed curve as two interpolating cubic splines within ROUND_UNCERTAINTY / 10, and the least height of their poles, mm.

    on: points (N, 3) mm at angles t (N,), 0 to 2 pi, counter-clockwise from +z; count: points of each at first.
    """
    off = np.inf
    while off > 0.1 * ROUND_UNCERTAINTY and count <= MOST_ON_RIM:
        lines = [np.linspace(k * np.pi, (k + 1) * np.pi, count + 1) for k in (0, 1)]
        curves = [make_interp_spline(t, on(t)) for t in lines]
        middle = [(0.5 * (t[1:] + t[:-1])) for t in lines]
        off = max(float(np.abs(c(t) - on(t)).max()) for c, t in zip(curves, middle, strict=True))
        count *= 2
    corners = [on(np.array([0.0]))[0], on(np.array([np.pi]))[0]]
    vertices = [out.add(f"VERTEX_POINT('',{out.point(p)})") for p in corners]
    drawn = tuple(out.curve(3, [out.point(p) for p in c.c], c.t) for c in curves)
    edges = [(out.edge(vertices[k], vertices[1 - k], curve), True) for k, curve in enumerate(drawn)]
    return Loop(corners, vertices, edges, drawn), min(float(c.c[:, 2].min()) for c in curves)


def walls(out: Entities, sides: Iterable[str], upper: Loop, lower: Loop, along: bool = True) -> list[str]:
    """Vertical faces of these surfaces between two loops with as many corners; along: as of `Entities.face`."""
    posts = [
        (out.edge(a, b, out.line(p, q)), True)
        for a, b, p, q in zip(lower.vertices, upper.vertices, lower.corners, upper.corners, strict=True)
    ]
    faces = []
    for k, (surface, post) in enumerate(zip(sides, posts, strict=True)):
        back = turned([upper.edges[k]]) + turned([post])  # along the foot, up, back along the top, down
        bound = [lower.edges[k], posts[(k + 1) % len(posts)], *back]
        faces.append(out.face(surface, out.bound(bound if along else turned(bound)), along=along))
    return faces


#: Outlines of solids by the name of the aperture.
OUTLINES = {Aperture.name: Polygon(), CircularAperture.name: Circle()}


def turned(edges: list[tuple[str, bool]]) -> list[tuple[str, bool]]:
    """A loop the other way round."""
    return [(edge, not forward) for edge, forward in edges[::-1]]


def product(out: Entities, solids: list[str], uncertainty: float) -> None:
    """Write units, and the product with the shape of the solids."""
    millimetre = out.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    radian = out.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    steradian = out.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    near = out.add(f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE({real(uncertainty)}),{millimetre},'distance_accuracy_value','')")
    context = out.add(
        "(GEOMETRIC_REPRESENTATION_CONTEXT(3)"
        f"GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({near}))"
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({millimetre},{radian},{steradian}))"
        "REPRESENTATION_CONTEXT('',''))"
    )
    origin = out.placement((0, 0, 0), (0, 0, out.up), (1, 0, 0))  # axes of the file
    shape = out.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('lens',({origin},{','.join(solids)}),{context})")
    application = out.add("APPLICATION_CONTEXT('automotive design')")
    out.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{application})")
    discipline = out.add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
    product = out.add(f"PRODUCT('lens','lens','',({discipline}))")
    formation = out.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
    within = out.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
    definition = out.add(f"PRODUCT_DEFINITION('design','',{formation},{within})")
    described = out.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
    out.add(f"SHAPE_DEFINITION_REPRESENTATION({described},{shape})")


def knot_lists(*vectors: np.ndarray) -> Iterator[str]:
    """Multiplicities of every knot vector, then their distinct knots."""
    found = [np.unique(t, return_counts=True) for t in vectors]
    yield from (f"({','.join(map(str, counts))})" for _, counts in found)
    yield from (reals(values) for values, _ in found)


def reals(values, decimals: int | None = None) -> str:
    """A list of reals: "(0.5,300.,1.E-05)", or rounded."""
    return f"({','.join(map(real, values) if decimals is None else (rounded(v, decimals) for v in values))})"


def real(value: float) -> str:
    """A STEP real with 17 digits: it must hold a decimal point."""
    mantissa, e, exponent = format(float(value), ".17g").partition("e")
    return mantissa + ("" if "." in mantissa else ".") + (f"E{exponent}" if e else "")


def rounded(value: float, decimals: int) -> str:
    """A STEP real with at most this number of decimals: "0.5", "300."."""
    return f"{round(float(value), decimals) + 0.0:#.{decimals}f}".rstrip("0")
