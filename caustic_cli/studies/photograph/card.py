"""The test card: a sheet with marks around the place of the picture, and their detection in a photograph.

The marks are black discs on the edges of a rectangle around the screen, five along each edge, and one more beside one corner, by
which the sheet is recognised however it is turned or mirrored.  It faces the lens and is drawn as seen from there, where +x points
to the left.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.ndimage import center_of_mass, find_objects, gaussian_filter, label, maximum_filter, uniform_filter
from scipy.spatial import ConvexHull, QhullError

from caustic_cli import __version__
from caustic_cli.errors import InputError
from caustic_cli.io.files import CREATED_BY, SOFTWARE, atomic_file, write_bytes
from caustic_cli.scene import Screen
from caustic_cli.scene.screen import SHEET
from caustic_cli.studies.photograph.camera import Camera, Shape, fit_camera

#: Positions of the marks along an edge, in half widths of their rectangle; this rectangle over the screen; radius of a mark over
#: the mean half width of the screen.
PLACES, AROUND, RADIUS = (-1.0, -0.5, 0.0, 0.5, 1.0), 1.12, 0.03
#: Position of the further mark along the upper edge, near its -x end.
BESIDE = -0.75
#: Half size of the sheet over that of the screen; mm per inch; pixels along its longer side.
EDGE, INCH, PIXELS = SHEET, 25.4, 2000.0
#: Darkness of a mark relative to its surroundings, most candidates, and largest miss of a mark, in radii.
DARK, MOST, MISS = 0.55, 200, 0.6
#: Marks that may be missing, that beside the corner excepted.
MISSING = 3
#: The orientations of a rectangle's corners: as they are, turned, and mirrored.
TURNS = [[(k + d * i) % 4 for i in range(4)] for d in (1, -1) for k in range(4)]


def marks_of_card() -> np.ndarray:
    """The marks of the card, (17, 2) (X, Y) in half widths of the screen: the corners first, in the order of the circumference."""
    corners = [(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)]
    inner = [(p, s) for p in PLACES[1:-1] for s in (1.0, -1.0)] + [(s, p) for p in PLACES[1:-1] for s in (1.0, -1.0)]
    return AROUND * np.array([*corners, *inner, (BESIDE, 1.0)])


def find_marks(photograph: np.ndarray, shape: Shape | None = None) -> Camera:
    """The camera by the marks of the card in a photograph (rows, columns) of linear light, at most 1; shape: of a curved screen.

    Raises:
        InputError: they are not found.
    """
    dots = _dots(photograph)
    size = (photograph.shape[1], photograph.shape[0])
    known, least = marks_of_card(), len(marks_of_card()) - MISSING
    if 4 <= len(dots) <= MOST:
        places, radii = dots[:, :2], dots[:, 2]
        for corners in _quadrilaterals(places):
            for turn in TURNS:
                camera = fit_camera(known[:4], places[[corners[i] for i in turn]], size, "marks")
                matched = _matched(camera, known, places, radii)
                if len(matched) >= least and matched[-1][0] == len(known) - 1:
                    return _refitted(matched, known, places, radii, size, shape)
    raise InputError("shows no marks of the test card")


def _refitted(
    matched: list, known: np.ndarray, places: np.ndarray, radii: np.ndarray, size: tuple[int, int], shape: Shape | None
) -> Camera:
    """The camera through all marks that were matched, matched once more by it."""
    camera = None
    for _ in range(2):
        if len(matched) < 4:
            break
        i, j = np.array(matched).T
        camera = fit_camera(known[i], places[j], size, "marks", shape)
        matched = _matched(camera, known, places, radii)
    assert camera is not None  # four corners are matched by the camera through them
    return camera


def _matched(camera: Camera, known: np.ndarray, places: np.ndarray, radii: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of a mark of the card and a dot where the camera images it."""
    seen = np.stack(camera.project(*known.T), 1)
    far = np.hypot(*(seen[:, None] - places[None]).transpose(2, 0, 1))
    return [(i, int(j)) for i, j in enumerate(far.argmin(1)) if far[i, j] <= MISS * radii[j]]


def _quadrilaterals(places: np.ndarray) -> list[tuple[int, ...]]:
    """Candidates for the four corners, in the order of the circumference: the largest quadrilaterals of hull vertices."""
    try:
        hull = ConvexHull(places).vertices
    except QhullError:  # all on a line
        return []
    hull = hull if len(hull) <= 16 else hull[:: -(-len(hull) // 16)]

    def area(four: tuple[int, ...]) -> float:
        x, y = places[list(four)].T
        return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()))

    return sorted((tuple(map(int, c)) for c in combinations(hull, 4)), key=area, reverse=True)[:12]


def _dots(light: np.ndarray) -> np.ndarray:
    """Round dark dots of a photograph of linear light: (N, 3) column, row, radius, pixels."""
    size = min(light.shape)
    smooth = gaussian_filter(light, 0.7)
    wide = 2 * (size // 24) + 1  # wider than a mark
    ground = uniform_filter(maximum_filter(smooth, wide), wide)
    dark = (smooth < DARK * ground) & (ground > 0.02 * light.max())
    labels, count = label(dark)
    if count > 20 * MOST:
        return np.empty((0, 3))
    found = []
    for k, box in enumerate(find_objects(labels), 1):
        rows, columns = (s.stop - s.start for s in box)
        if not 3 <= min(rows, columns) <= max(rows, columns) <= wide or max(rows, columns) > 2.5 * min(rows, columns):
            continue
        r, c = (slice(max(0, s.start - 3), s.stop + 3) for s in box)
        part = labels[r, c]
        if ((part != 0) & (part != k)).any():
            continue
        area = float((part == k).sum())
        y, x = np.nonzero(part == k)
        spread = np.linalg.det(np.cov(np.stack([x, y]), bias=True) + np.eye(2) / 12.0)
        if not 0.85 < 4.0 * np.pi * np.sqrt(spread) / area < 1.12:  # 1 for a filled ellipse
            continue
        weight = np.clip(np.median(ground[r, c]) - light[r, c], 0.0, None)
        edge = np.concatenate([weight[0], weight[-1], weight[:, 0], weight[:, -1]])
        y0, x0 = center_of_mass(np.clip(weight - np.median(edge), 0.0, None))
        found.append((c.start + x0, r.start + y0, np.sqrt(area / np.pi)))
    return np.array(found).reshape(-1, 3)


def write_card(sheet: Path, table: Path, screen: Screen) -> tuple[float, float]:
    """Write the sheet, a PNG of its true size, and a table of its marks, mm on the screen; width and height of the sheet, mm.

    It is drawn as seen from the side of the lens, +x to the left; for a cylinder unrolled.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415
    from matplotlib.patches import Circle, Rectangle  # noqa: PLC0415

    (rx, ry), radius = screen.half_size, RADIUS * 0.5 * sum(screen.half_size)
    ex, ey = screen.unrolled(EDGE * rx, EDGE * ry)
    wide, high = 2.0 * ex, 2.0 * ey
    figure = Figure(figsize=(wide / INCH, high / INCH), dpi=float(np.clip(PIXELS * INCH / max(wide, high), 20.0, 600.0)))
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axis.set(xlim=(ex, -ex), ylim=(-ey, ey), aspect="auto")
    axis.axis("off")
    for x, y in marks_of_card() * np.array(screen.half_size):
        axis.add_patch(Circle(screen.unrolled(x, y), radius, color="black", linewidth=0))
    line = 0.15 * radius
    for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1)):  # the corners of the screen, outside of which nothing should be bright
        for w, h in ((0.06 * rx, line), (line, 0.06 * ry)):
            axis.add_patch(Rectangle(screen.unrolled(a * rx, b * ry), -a * w, -b * h, color="0.6", linewidth=0))
    size = 72.0 * 0.7 * radius / INCH
    marked = " x ".join(f"{2 * c:.4g}" for c in screen.unrolled(AROUND * rx, AROUND * ry)) + " mm"
    words = f"caustic test card: {wide:.4g} x {high:.4g} mm, marks on {marked}; this side to the lens"
    below = 0.5 * (screen.unrolled(0.0, AROUND * ry)[1] + ey)
    axis.text(0.0, -below - 0.3 * radius, words, ha="center", va="center", fontsize=size, color="0.4")
    with atomic_file(sheet) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
    lines = [f"# {CREATED_BY} {__version__}: marks of the test card on the screen, mm", "x,y"]
    lines += [f"{x:.6g},{y:.6g}" for x, y in marks_of_card() * np.array(screen.half_size) + np.array(screen.shift)]
    write_bytes(table, ("\n".join(lines) + "\n").encode())
    return wide, high
