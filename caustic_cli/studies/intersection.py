"""Accuracy and cost of ray-surface intersection: triangle mesh and Newton's method (thesis 4.3.3, 6.3).

Notation
    o, d        a ray's start and unit direction inside the lens, mm
    Z           the B-spline surface; T the mesh, every knot span cut in n_u = n_v parts
    t, t*       distance to the intersection by a method, and to the exact one
    t-error     |t - t*|, mm
    z-error     |o_z + t d_z - Z| at the intersection, mm; for the mesh |T - Z|

t* comes from float64 Newton hits by two more steps with f(t) = o_z + t d_z - Z in extended precision; where that leaves |f| is
the reference's own error.  The thesis finds order 2 in n_u for both errors (eq. 4.3.21 and fig. 6.2.14).

Times are of one evaluation with new heights, as in every iteration of a design: for the mesh vertices, bounding boxes and search,
for Newton the polynomials of the spans and the iteration.  Work that depends on the rays alone is done before.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from caustic_cli import __version__
from caustic_cli.errors import CausticError
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.intersection import Method, Status, find
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import System
from caustic_cli.optics.trace import Tracer
from caustic_cli.scene import Points, Scene
from caustic_cli.schema import checks
from caustic_cli.studies.fit import Order, order
from caustic_cli.studies.measurement import busy_warning
from caustic_cli.studies.report import Study, draw_front, legend_beside, plain_ticks, spread, styles

#: Table D.3, its lengths in mm: half width of the lens, radius of the sphere, depth of the source, half-angle of its cone (rad).
HALF, RADIUS, DEPTH, CONE, NET, DEGREE, RAYS = 5.0, 9.0, 6.0, 0.8, 15, 3, 25_000
#: Default number of timing rounds.
REPEATS = 9
#: Most cells of the mesh along an axis, and most knot-span rectangles that are searched linearly.
MOST_CELLS, MOST_FLAT = 1600, 4096
#: n_u of meshes that give the initial guess for Newton's method.
COARSE = (1, 2, 4, 8)
#: Suffix of series whose boxes are searched linearly.
FLAT = ", flat boxes"
#: Distance of the point source that replaces a plane wave, in lens widths.
AWAY = 5.0
#: t-errors, mm, that the advice compares, and the one at which Newton and the mesh are.
ROUGH, FINE, EQUAL = 1e-4, 1e-9, 1e-6

COLUMNS = {
    "series": "method: mesh, with a bounding-box hierarchy of knot-span rectangles; mesh, flat boxes, with a linear search over"
    " them; newton; mesh+newton, which starts from the intersection with the mesh",
    "n_u": "cells of the mesh per knot span along each axis",
    "rays": "rays in all",
    "hits": "rays found to intersect the surface",
    "strayed": "rays that only this method or only the reference finds to intersect it; errors are over the others",
    "error": "mean t-error, mm",
    "t_max": "maximum t-error, mm",
    "z_mean": "mean z-error, mm",
    "z_max": "maximum z-error, mm",
    "seconds": "wall time of one evaluation with new heights, s; median of the repeats",
    "seconds_min": "shortest of them, s",
    "seconds_max": "longest of them, s",
}
#: Curves whose order is fitted: what they are called, and their column.
FITTED = {"mean z-error": "z_mean", "mean t-error": "error", "maximum z-error": "z_max", "maximum t-error": "t_max"}


@dataclass(frozen=True, eq=False)
class Case:
    """A surface with heights (n, m) mm, rays that intersect it, and a description of their source."""

    field: HeightField
    heights: Tensor
    rays: RayState
    source: str


def table_d3(rays: int | None = None, seed: int = 0) -> Case:
    """The scene of table D.3: a point source in the glass, 6 mm below the crest of a sphere of 9 mm, no entrance surface.

    The cone of half-angle 0.8 rad is sampled at random, evenly over its solid angle.
    """
    field = HeightField((SplineSpace.uniform(NET, DEGREE),) * 2, (HALF, HALF))
    x, y = field.control_xy()
    heights = torch.sqrt(RADIUS**2 - x[:, None] ** 2 - y**2) - RADIUS
    generator = torch.Generator().manual_seed(seed)
    a, b = torch.rand(2, rays or RAYS, generator=generator, dtype=torch.float64)
    w = 2.0 * math.sin(CONE / 2.0) ** 2 * a  # 1 - cos of the angle to the axis
    sine, zero = torch.sqrt(w * (2.0 - w)), torch.zeros_like(w)
    direction = sine * torch.cos(2 * math.pi * b), sine * torch.sin(2 * math.pi * b), 1.0 - w
    rays = RayState((zero, zero, -DEPTH), direction, torch.full_like(w, 1.0 / len(w)))
    return Case(field, heights, rays, f"table D.3: a point {DEPTH:g} mm below the surface, cone {CONE:g} rad")


def of_lens(scene: Scene, field: HeightField, heights: Tensor, rays: int | None = None, seed: int = 0) -> Case:
    """A lens and the rays of its source that enter it; a plane wave, whose intersections are trivial, is replaced by a point
    source.

    Raises:
        CausticError: no ray enters the lens.
    """
    source = scene.source.label
    if scene.source.collimated:
        away = AWAY * max(scene.lens.size)
        scene = replace(scene, source=Points(((0.0, 0.0, scene.pupil.z - away),)))
        source = f"a point on the axis, {away:g} mm before the lens, as rays along z need no search"
    sampler = rays_of(scene, "uniform", rays or RAYS, seed)
    entered = Tracer(System.of(scene, field), next(iter(sampler.chunks(sampler.count)))).start.counted_from(0.0)
    inside = entered.power > 0
    if not bool(inside.any()):
        raise CausticError("no ray enters the lens, so there is nothing to intersect; check source position and cone")
    origin, direction = (
        tuple(c[inside].contiguous() if isinstance(c, Tensor) else c for c in v) for v in (entered.origin, entered.direction)
    )
    rays = RayState(origin, direction, entered.power[inside].contiguous())
    return Case(field, heights.detach().double().cpu(), rays, source)


def exact_heights(field: HeightField, heights: Tensor, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Z at points x, y (N,) mm in NumPy's longdouble, 64 bits of mantissa on x86: (N,) mm."""
    (i, bu), (j, bv) = (_exact_basis(s, 0.5 * (c / r + 1.0)) for s, c, r in zip(field.spaces, (x, y), field.half_size, strict=True))
    h, total = heights.numpy().astype(np.longdouble), np.zeros_like(x)
    for k, b in enumerate(bu):
        row = sum(c * h[i + k, j + n] for n, c in enumerate(bv))
        total = total + b * row
    return total


def _exact_basis(space: SplineSpace, u: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """First non-zero basis function at u (N,), and the p + 1 values, (N,) each, by the triangular scheme of `bspline`."""
    u, t = np.clip(u, 0.0, 1.0), space.knots.numpy().astype(np.longdouble)
    span = space.span(torch.from_numpy(u.astype(np.float64))).numpy()
    values = [np.ones_like(u)]
    for degree in range(1, space.degree + 1):
        saved = np.zeros_like(u)
        for r in range(degree):
            right, left = t[span + r + 1] - u, u - t[span + 1 - degree + r]
            part = values[r] / (right + left)
            values[r], saved = saved + right * part, left * part
        values.append(saved)
    return span - space.degree, values


def reference(case: Case) -> tuple[np.ndarray, np.ndarray, float]:
    """t* (N,) longdouble mm, which rays intersect (N,), and the largest residual |f|, mm.

    Raises:
        CausticError: no ray meets the surface.
    """
    t, status = find(case.field, case.heights, case.rays.origin, case.rays.direction)
    hit = (status == Status.HIT).numpy()
    if not hit.any():
        raise CausticError("no ray meets the surface, so there are no hits to study")
    (x, y, _), (dx, dy, dz) = case.rays.origin, case.rays.direction
    _, zx, zy = case.field.at(case.heights, x + t * dx, y + t * dy)
    cosine = torch.where(status == Status.HIT, dz - zx * dx - zy * dy, torch.ones_like(t)).numpy()
    t = t.numpy().astype(np.longdouble)
    for _ in range(2):
        t = t - _above(case, t) / cosine
    return t, hit, float(np.abs(_above(case, t)[hit]).max())


def _above(case: Case, t: np.ndarray) -> np.ndarray:
    """f(t) (N,), mm: height of the rays above the surface at t (N,) longdouble."""
    x, y, dx, dy, dz = (c.numpy().astype(np.longdouble) for c in (*case.rays.origin[:2], *case.rays.direction))
    return np.asarray(case.rays.origin[2]) + t * dz - exact_heights(case.field, case.heights, x + t * dx, y + t * dy)


def settings_of(field: HeightField, most: int | None = None) -> list[tuple[str, int | None]]:
    """(series, n_u) of all settings: n_u = 1, 2, 4, .. up to `most`, or a limit by memory."""
    spans = [len(s.breaks) - 1 for s in field.spaces]
    most = most or max(COARSE[2], min(128, MOST_CELLS // max(spans)))
    parts = [2**k for k in range(int(math.log2(most)) + 1)]
    flat = parts if spans[0] * spans[1] <= MOST_FLAT else []
    return [
        *(("mesh", n) for n in parts),
        *((f"mesh{FLAT}", n) for n in flat),
        ("newton", None),
        *(("mesh+newton", n) for n in COARSE),
    ]


def run_intersection(
    case: Case,
    *,
    seed: int = 0,
    repeats: int | None = None,
    most: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Study:
    """Measure all methods on the rays of a case, alternately.  Errors are reproducible, times are not.

    Args:
        seed: of the rays, for the metadata.
        repeats: timed rounds, None for REPEATS.
        most: largest n_u, a power of 2; None for 128, less for a lens with many knot spans.
        progress: called with (evaluations done, in total) after each.
    """
    repeats = checks.whole("⟨repeats⟩", REPEATS if repeats is None else repeats, 1, 1000)
    truth, hit, residual = reference(case)
    rows = _measured(case, settings_of(case.field, most), repeats, truth, hit, progress)
    mesh = [row for row in rows if row["series"] == "mesh"]
    parts = [row["n_u"] for row in mesh]
    orders = {f"mesh, {name}": order(parts, [row[column] for row in mesh]) for name, column in FITTED.items()}
    newton, at_equal = next(row for row in rows if row["series"] == "newton"), seconds_at(mesh, EQUAL)
    about = {
        "version": __version__,
        "source": case.source,
        "seed": seed,
        "repeats": repeats,
        "rays": case.rays.count,
        "control": list(case.field.shape),
        "degree": [s.degree for s in case.field.spaces],
        "dtype": "float64",
        "device": "cpu",
        "threads": torch.get_num_threads(),
        "reference": "newton in float64, two steps in longdouble",
        "reference_bits": int(np.finfo(np.longdouble).nmant) + 1,
        "reference_error": residual,
        "reference_hits": int(hit.sum()),
        "equal_error": EQUAL,
        "mesh_seconds": at_equal,
        "newton_times_as_fast": None if at_equal is None else at_equal / newton["seconds"],
    }
    return Study(
        "intersection",
        COLUMNS,
        rows,
        orders,
        _advice(rows, about["newton_times_as_fast"]) + busy_warning(rows),
        about,
        "n_u",
        PLOTS,
    )


def _measured(
    case: Case,
    settings: list[tuple[str, int | None]],
    repeats: int,
    truth: np.ndarray,
    hit: np.ndarray,
    progress: Callable[[int, int], None] | None,
) -> list[dict]:
    """A row for each setting, with its errors and its times."""
    prepared = backend_for("cpu").finder(case.field, case.rays.origin, case.rays.direction)
    rows, times, done = [], [[] for _ in settings], 0
    for k in range(-1, repeats):  # the first round is for the errors and warms the machine up
        for i, (series, n) in enumerate(settings):
            start = time.perf_counter()
            t, status = _evaluate(case, prepared, series, n)
            times[i].append(time.perf_counter() - start)
            if k < 0:
                rows.append({"series": series, "n_u": n, **_errors(case, t, status, truth, hit)})
            done += 1
            if progress is not None:
                progress(done, len(settings) * (1 + repeats))
    for row, (_, *seconds) in zip(rows, times, strict=True):
        row |= {"seconds": statistics.median(seconds), "seconds_min": min(seconds), "seconds_max": max(seconds)}
    return rows


def _evaluate(case: Case, prepared: Callable, series: str, n: int | None) -> tuple[Tensor, Tensor]:
    """t (N,) and status (N,) of one setting; for Newton's method the rays are prepared, as in a design."""
    if n is None:
        return prepared(case.heights)
    method = Method(series.removesuffix(FLAT), (n, n), not series.endswith(FLAT))
    return find(case.field, case.heights, case.rays.origin, case.rays.direction, method)


def _errors(case: Case, t: Tensor, status: Tensor, truth: np.ndarray, hit: np.ndarray) -> dict:
    """Intersections and errors of one setting, over the rays that it and the reference find to intersect the surface."""
    found = (status == Status.HIT).numpy()
    both = found & hit
    t = np.where(both, t.numpy(), truth).astype(np.longdouble)
    off, above = np.abs(t - truth)[both], np.abs(_above(case, t))[both]
    if not both.any():
        off = above = np.zeros(1)
    return {
        "rays": len(t),
        "hits": int(found.sum()),
        "strayed": int((found != hit).sum()),
        "error": float(off.mean()),
        "t_max": float(off.max()),
        "z_mean": float(above.mean()),
        "z_max": float(above.max()),
    }


def seconds_at(rows: list[dict], error: float) -> float | None:
    """Time at which a series of falling errors reaches `error`, between settings by a power law; None beyond them."""
    for a, b in pairwise(rows):
        if a["error"] >= error >= b["error"] > 0 and a["error"] > b["error"]:
            part = math.log(a["error"] / error) / math.log(a["error"] / b["error"])
            return math.exp((1.0 - part) * math.log(a["seconds"]) + part * math.log(b["seconds"]))
    return None


def _advice(rows: list[dict], faster: float | None) -> str:
    """Cost of accuracy, in one sentence."""
    rough, fine = (
        min((row for row in rows if row["error"] <= error), key=lambda row: row["seconds"], default=None) for error in (ROUGH, FINE)
    )
    if fine is None:
        best = min(rows, key=lambda row: row["error"])
        text = f"no method reaches a t-error of {FINE:g} mm; the least, {best['error']:.2g} mm, is that of {_named(best)}"
    elif fine is rough:
        text = (
            f"{_named(fine)} is the fastest way to a t-error of {ROUGH:g} mm and reaches {fine['error']:.2g} mm at no extra"
            f" cost, in {1e3 * fine['seconds']:.3g} ms"
        )
    else:
        text = (
            f"t-error {FINE:g} mm costs {fine['seconds'] / rough['seconds']:.2g} x the time of {ROUGH:g} mm: {_named(fine)}"
            f" in {1e3 * fine['seconds']:.3g} ms against {_named(rough)} in {1e3 * rough['seconds']:.3g} ms"
        )
    return text if faster is None else f"{text}; at {EQUAL:g} mm newton is {faster:.2g} times as fast as the mesh"


def _named(row: dict) -> str:
    return row["series"] if row["n_u"] is None else f"{row['series']} with n_u = {row['n_u']}"


def _fit_words(orders: dict[str, Order | None]) -> str:
    """The fitted orders of the mesh's curves, in a title."""
    return ", ".join(f"{word} n$_u^{{{-found.exponent:.2f}}}$" for word, found in orders.items() if found is not None)


def draw_convergence(study: Study, figure: Figure) -> None:
    """Fig. 6.2.14: mean z- and t-error, computation time and number of intersections against n_u."""
    figure.set_size_inches(10.0, 7.4)
    panels, style = figure.subplots(2, 2), styles(row["series"] for row in study.rows)
    table = {name: [row for row in study.rows if row["series"] == name] for name in style}
    (newton,), n = table["newton"], np.array([row["n_u"] for row in table["mesh"]], float)
    for axes, kind, columns in ((panels[0, 0], "z-error", ("z_mean", "z_max")), (panels[0, 1], "t-error", ("error", "t_max"))):
        orders = {word: study.orders[f"mesh, {word} {kind}"] for word in ("mean", "maximum")}
        _draw_errors(axes, table, style, columns)
        axes.set(xscale="log", yscale="log", ylabel=f"{kind} (mm), mean unless stated", title=f"{kind}; mesh: {_fit_words(orders)}")
    for name, rows in table.items():
        if name != "newton" and rows:
            panels[1, 0].errorbar(
                [row["n_u"] for row in rows], [row["seconds"] for row in rows], yerr=spread(rows), label=name, **style[name]
            )
            panels[1, 1].plot(
                [row["n_u"] for row in rows],
                [row["hits"] for row in rows],
                linewidth=1,
                label=name,
                markersize=5,
                color=style[name]["color"],
                marker=style[name]["marker"],
            )
    for axes, value in ((panels[1, 0], newton["seconds"]), (panels[1, 1], newton["hits"])):
        axes.axhline(value, color=style["newton"]["color"], linestyle=":", label="newton")
    panels[1, 0].set(xscale="log", yscale="log", ylabel="time (s): median, least and most", title="computation time")
    panels[1, 1].set(xscale="log", ylabel=f"of {newton['rays']} rays", title="number of intersections")
    panels[1, 1].ticklabel_format(axis="y", useOffset=False)
    most = max(abs(row["hits"] - newton["hits"]) for row in study.rows)
    panels[1, 1].set_ylim(newton["hits"] - 1.1 * most - 5, newton["hits"] + 1.1 * most + 5)
    plain_ticks(panels[1, 0].yaxis)
    for axes in panels.flat:
        axes.set_xscale("log", base=2)
        axes.set_xticks(n, [f"{k:g}" for k in n])
        axes.set_xlabel("n$_u$ = n$_v$")
        axes.grid(which="major", linewidth=0.4)
    figure.legend(*_every_label(panels.flat), loc="outside lower center", ncols=5, fontsize="small")


def _draw_errors(axes: Axes, table: dict[str, list[dict]], style: dict[str, dict], columns: tuple[str, str]) -> None:
    """Mean and largest error of the mesh, and the mean ones of the other methods."""
    mesh = table["mesh"]
    n = np.array([row["n_u"] for row in mesh], float)
    looks = (
        {"linestyle": "-", "marker": "o", "markerfacecolor": None, "label": "mesh"},
        {"linestyle": "--", "marker": "^", "markerfacecolor": "none", "label": "mesh, maximum"},
    )
    for column, look in zip(columns, looks, strict=True):
        y = np.array([row[column] for row in mesh])
        use = y > 0
        axes.plot(n[use], y[use], linewidth=1, color=style["mesh"]["color"], markersize=5, **look)
    for name, line in (("mesh+newton", "-"), ("newton", ":")):
        points = [row for row in table[name] if row[columns[0]] > 0]
        if points and name == "newton":
            axes.axhline(points[0][columns[0]], color=style[name]["color"], linestyle=line, label=name)
        elif points:
            axes.plot(
                [row["n_u"] for row in points],
                [row[columns[0]] for row in points],
                color=style[name]["color"],
                linewidth=1,
                marker=style[name]["marker"],
                markersize=5,
                label=name,
            )


def _every_label(panels: Iterable[Axes]) -> tuple[list[Artist], list[str]]:
    """Curves of all panels and their labels, each label once."""
    found = {label: curve for axes in panels for curve, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    return list(found.values()), list(found)


def draw_pareto(study: Study, figure: Figure) -> None:
    """Error against time; dashed, the errors that the advice is about."""
    axes = figure.add_subplot()
    draw_front(axes, study)
    for error in (ROUGH, EQUAL, FINE):
        said = "errors compared in the advice" if error == ROUGH else None
        axes.axhline(error, color="grey", linewidth=0.8, linestyle="--", label=said)
    axes.set(xlabel="time (s): median, least and most", ylabel="mean t-error (mm)", title="intersection: error and time")
    legend_beside(figure)


#: Endings of the pictures' names, and what draws them.
PLOTS = {"": draw_convergence, "-pareto": draw_pareto}
