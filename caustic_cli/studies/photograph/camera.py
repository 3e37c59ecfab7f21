"""The geometry of a camera that looks at the screen: a projective map with radial distortion, fitted to marks.

Notation
    (X, Y)      a point of the screen over its half widths, in [-1, 1] on the screen
    (a, b)      column and row of the photograph; the centre of its upper left pixel is (0, 0)
    h           projective map (8,): (a', b') = (h0 X + h1 Y + h2, h3 X + h4 Y + h5) / (h6 X + h7 Y + 1)
    S, s        height of a curved screen over its tangent plane, half widths; s (3,): the map has s0 S and s1 S in the numerators
                and s2 S in the denominator, too
    k           radial distortion: (a, b) = c + (1 + k |q|^2) q s, q = ((a', b') - c) / s, with c the middle of the photograph and s
                half of its diagonal (the first term of Brown's model, Close-range camera calibration, 1971)
    B           displacements of the picture on the screen that a camera leaves undetermined, nine fields of (X, Y), in half widths

Marks are measured with errors, so a camera is known up to a covariance, which is given in terms of B.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from caustic_cli.errors import InputError

#: Names of the displacements B, in their order.
DISPLACEMENTS = ("shift x", "shift y", "width", "height", "shear x", "shear y", "keystone x", "keystone y", "distortion")
#: Number of parameters of the projective map, and of the heights of a curved screen.
PROJECTIVE, RAISED = 8, 3
#: Marks from which on distortion is fitted: as many coordinates as parameters are there from 5 on, and enough to check by 8.
DISTORTED = 8
#: Standard deviation of a distortion that is not fitted: of phones, corrected by their software, less.
UNKNOWN_DISTORTION = 0.01
#: Standard deviation of a mark, pixels, where there are too few of them to estimate it; and the least, of rounding.
BY_HAND, LEAST = 0.5, 0.01
#: Largest number of points along a pixel of the screen over which the photograph is averaged.
MOST = 8
#: S at points (X, Y) of common shape.
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def displacements(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The fields B at points (X, Y) of common shape (N,): (9, 2, N), in half widths of the screen."""
    zero, one, r2 = np.zeros_like(x), np.ones_like(x), x * x + y * y
    rows = [(one, zero), (zero, one), (x, zero), (zero, y), (y, zero), (zero, x), (x * x, x * y), (x * y, y * y), (x * r2, y * r2)]
    return np.array(rows)


@dataclass(frozen=True, eq=False)
class Camera:
    """A fitted camera, see the module."""

    h: np.ndarray
    k: float
    #: Width and height of the photograph, pixels.
    size: tuple[int, int]
    #: (9, 9) covariance of the amplitudes of B that remain, in half widths of the screen.
    covariance: np.ndarray
    #: Standard deviation of a mark, pixels; marks; how they were found.
    sigma: float = BY_HAND
    marks: int = 0
    found: str = ""
    #: s, and S of a curved screen.
    s: np.ndarray = field(default_factory=lambda: np.zeros(RAISED))
    shape: Shape | None = None

    def project(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows of points (X, Y)."""
        return _project(np.concatenate([self.h, [self.k], self.s]), x, y, self.size, self.shape)

    @property
    def mirrored(self) -> bool:
        """Whether the photograph shows the screen mirrored, as it does from the side of the lens: rows run downwards."""
        (a, b), (c, d) = self.h[[0, 1]] - self.h[2] * self.h[[6, 7]], self.h[[3, 4]] - self.h[5] * self.h[[6, 7]]
        return bool(a * d - b * c > 0)


def fit_camera(screen: np.ndarray, pixels: np.ndarray, size: tuple[int, int], found: str, shape: Shape | None = None) -> Camera:
    """The camera that images points (N, 2) of the screen, (X, Y), at pixels (N, 2), in a photograph of width and height `size`;
    shape: S of a curved screen.

    Raises:
        InputError: there are fewer than four marks, on a curved screen than eight, or they lie on a line.
    """
    if len(screen) < 4:
        raise InputError(f"has {len(screen)} marks; at least 4, no three of them on a line, are needed")
    if shape is not None and len(screen) < DISTORTED:
        raise InputError(
            f"has {len(screen)} marks; at least {DISTORTED} are needed on a curved screen, which a camera does not image as it does"
            " a plane"
        )
    middle, half = 0.5 * (np.array(size) - 1.0), 0.5 * float(np.hypot(*size))
    x, y = screen.T
    a, b = ((pixels - middle) / half).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    system = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -a * x, -a * y], 1),
            np.stack([zero, zero, zero, x, y, one, -b * x, -b * y], 1),
        ]
    )
    start, _, rank, _ = np.linalg.lstsq(system, np.concatenate([a, b]), rcond=1e-9)
    if rank < PROJECTIVE:
        raise InputError("its marks lie on a line; at least 4, no three of them on a line, are needed")
    h = _in_pixels(start, middle, half)
    every = PROJECTIVE + 1 + RAISED
    free = PROJECTIVE + (len(screen) >= DISTORTED) + RAISED * (shape is not None)
    scale = np.array([half, half, half, half, half, half, 1.0, 1.0, 1.0, half, half, 1.0])
    first = np.append(h, np.zeros(every - PROJECTIVE))

    def misses(p: np.ndarray) -> np.ndarray:
        full = first + np.append(p, np.zeros(every - free)) * scale
        return np.concatenate(_project(full, x, y, size, shape)) - np.concatenate(pixels.T)

    best = least_squares(misses, np.zeros(free), method="lm", x_scale=1.0)
    spare = 2 * len(screen) - free
    sigma = max(LEAST, float(np.sqrt((best.fun**2).sum() / spare))) if spare >= 4 else BY_HAND
    full = first + np.append(best.x, np.zeros(every - free)) * scale
    jacobian = best.jac / sigma
    covariance = np.zeros((every, every))
    covariance[:free, :free] = np.linalg.inv(jacobian.T @ jacobian)
    if free == PROJECTIVE:
        covariance[8, 8] = UNKNOWN_DISTORTION**2
    covariance = covariance * np.outer(scale, scale)
    on_screen = _on_screen(full, covariance, size, shape)
    return Camera(full[:8], float(full[8]), size, on_screen, sigma, len(screen), found, full[9:], shape)


def _in_pixels(h: np.ndarray, middle: np.ndarray, half: float) -> np.ndarray:
    """The projective map to pixels of one to coordinates from the middle in half diagonals."""
    m = np.append(h, 1.0).reshape(3, 3)
    m = np.array([[half, 0.0, middle[0]], [0.0, half, middle[1]], [0.0, 0.0, 1.0]]) @ m
    return (m / m[2, 2]).ravel()[:8]


def _project(
    p: np.ndarray, x: np.ndarray, y: np.ndarray, size: tuple[int, int], shape: Shape | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows of points (X, Y); p: h, k and s."""
    (ca, cb), half = 0.5 * (np.array(size) - 1.0), 0.5 * float(np.hypot(*size))
    z = 0.0 if shape is None else shape(x, y)
    w = p[6] * x + p[7] * y + p[11] * z + 1.0
    a = ((p[0] * x + p[1] * y + p[9] * z + p[2]) / w - ca) / half
    b = ((p[3] * x + p[4] * y + p[10] * z + p[5]) / w - cb) / half
    stretch = half * (1.0 + p[8] * (a * a + b * b))
    return ca + stretch * a, cb + stretch * b


def _on_screen(p: np.ndarray, covariance: np.ndarray, size: tuple[int, int], shape: Shape | None) -> np.ndarray:
    """Covariance of the amplitudes of B from that of the parameters h, k and s."""
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 9)]))
    half = 0.5 * np.hypot(*size)
    step = 1e-5 * np.array([half] * 6 + [1.0] * 3 + [half] * 2 + [1.0])
    by_parameter = []
    for k in range(len(p)):
        more, less = p.copy(), p.copy()
        more[k] += step[k]
        less[k] -= step[k]
        by_parameter.append(
            [(u - v) / (2 * step[k]) for u, v in zip(*(_project(q, x, y, size, shape) for q in (more, less)), strict=True)]
        )
    ends = [_project(p, x + dx, y + dy, size, shape) for dx, dy in ((1e-5, 0), (-1e-5, 0), (0, 1e-5), (0, -1e-5))]
    along = [[(ends[i][c] - ends[i + 1][c]) / 2e-5 for i in (0, 2)] for c in (0, 1)]  # d pixel c / d (X, Y)
    inverse = np.linalg.inv(np.moveaxis(np.array(along), -1, 0))  # (N, 2, 2)
    moved = np.einsum("nij,kjn->kin", inverse, np.array(by_parameter))  # (12, 2, N) in half widths
    basis = displacements(x, y).reshape(9, -1)
    amplitudes = np.linalg.lstsq(basis.T, moved.reshape(len(p), -1).T, rcond=None)[0]  # (9 of B, 12 parameters)
    return amplitudes @ covariance @ amplitudes.T


def rectified(
    photograph: np.ndarray,
    camera: Camera,
    resolution: tuple[int, int],
    window: tuple = ((-1.0, 1.0), (-1.0, 1.0)),
    *,
    splined: bool = False,
) -> np.ndarray:
    """A photograph (rows, columns) in screen coordinates: (n, m) means over the pixels of a window of the screen, its lower and
    upper X and Y, [i, j], or means weighted by the quadratic B-spline about each; NaN beyond the edges of the photograph."""
    (n, m), ((left, right), (low, high)) = resolution, window
    x, y = np.array([left, right, left, right]), np.array([low, low, high, high])
    a, b = camera.project(x, y)
    along = max(np.hypot(np.diff(a)[[0, 2]], np.diff(b)[[0, 2]]).max() / n, 1.0)
    times, beyond = int(min(MOST, max(2, np.ceil(1.5 * along)))), int(splined)
    fine = [
        p + (q - p) * ((np.arange(times * (r + 2 * beyond)) + 0.5) / times - beyond) / r
        for r, (p, q) in zip((n, m), window, strict=True)
    ]
    x, y = np.meshgrid(*fine, indexing="ij")
    a, b = camera.project(x.ravel(), y.ravel())
    values = map_coordinates(photograph, [b, a], order=1, mode="constant", cval=np.nan).reshape(x.shape)
    weights = _weights(times, splined)
    along_x = sliding_window_view(values, len(weights), 0)[::times] @ weights
    return sliding_window_view(along_x, len(weights), 1)[:, ::times] @ weights


def _weights(times: int, splined: bool) -> np.ndarray:
    """Weights of points, `times` for each pixel, in the mean over a pixel or about it."""
    if not splined:
        return np.full(times, 1.0 / times)
    t = np.abs((np.arange(3 * times) + 0.5) / times - 1.5)
    weights = np.where(t < 0.5, 0.75 - t * t, 0.5 * (1.5 - t) ** 2)
    return weights / weights.sum()
