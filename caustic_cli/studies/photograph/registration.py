"""A photograph of a screen: read, found by marks, corners or the picture itself, and refused where it cannot be one of the lens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, zoom

from caustic_cli.errors import InputError
from caustic_cli.io.files import naming, read_bytes
from caustic_cli.io.picture import read_picture
from caustic_cli.studies.photograph.camera import Camera, Shape, fit_camera, rectified
from caustic_cli.studies.photograph.card import find_marks
from caustic_cli.studies.photograph.model import WHOLE, Window

#: Exponent by which codes are made about linear in light before they are averaged, and back; the fitted gamma refers to codes.
ABOUT = 2.2
#: Least side of a photograph, pixels.
LEAST = 64
#: Codes below which a photograph is dark all over, and least contrast between its bright and its middle parts.
BLACK, CONTRAST = 0.06, 0.04
#: Codes from which on a pixel is saturated, and largest fraction of the screen, and of the image's light, where it may be.
SATURATED, BLOWN = 0.98, 0.25
#: Saturated part of what is averaged, and part that is not, from which on the average is not known.
PARTLY = 0.01
#: Pixels along a side of the images that are compared, blurred by so many pixels; the least correlation of a photograph and the
#: image of its lens, and by how much another orientation may be better.
COARSE, SMOOTH, LEAST_LIKE, BETTER = 48, 2.0, 0.45, 0.03
#: Light over the mean from which on the screen counts as bright.
BRIGHT = 0.3
#: Standard deviations of shift, size and shear, keystone and distortion, half widths, where the picture itself says where it is.
BY_PICTURE = (0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.02, 0.02, 0.02)
CORNERS = ((-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0))
MARKS = "lines of column, row, x, y: pixels from the centre of the upper left one, and mm on the screen, of at least 4 marks"
#: What is needed instead of a photograph that is turned, and of one whose marks are upright.
UPRIGHT = "a photograph with column 0 at the screen's -x edge and row 0 at its +y edge is needed, or one with the test card"
TURNED = "its marks are upright, so that the part or the card is mounted so; one with both as designed is needed"
#: The ways in which a screen may be seen, as functions of images [i, j], with what they are called.
SEEN = {
    "": lambda a: a,
    "is rotated by 90 degrees": lambda a: np.rot90(a, 1),
    "is rotated by 180 degrees": lambda a: np.rot90(a, 2),
    "is rotated by 270 degrees": lambda a: np.rot90(a, 3),
    "is mirrored": lambda a: a[::-1],
    "is upside down and mirrored": lambda a: a[:, ::-1],
    "is mirrored and rotated by 90 degrees": lambda a: a.T,
    "is mirrored and rotated by 270 degrees": lambda a: a[::-1, ::-1].T,
}


def by_light(codes: np.ndarray, primaries: np.ndarray) -> np.ndarray:
    """Codes (3, rows, columns) of a photograph in sRGB, about as of the light of each colour alone.

    primaries: linear R, G, B of sRGB of a unit of each light, as the columns of a matrix.
    """
    apart = np.linalg.inv(primaries / np.diag(primaries)[None, :])
    light = np.clip(np.tensordot(apart, codes**ABOUT, 1), 0.0, 1.0) ** (1.0 / ABOUT)
    return np.where(codes >= SATURATED, codes, light)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph and its camera."""

    path: Path
    #: Codes in [0, 1], (rows, columns).
    codes: np.ndarray
    camera: Camera

    def on_screen(
        self, shape: tuple[int, int], window: Window = WHOLE, gamma: float = ABOUT, *, splined: bool = False
    ) -> np.ndarray:
        """Codes on n x m pixels of a window of the screen, [i, j], averaged as light, code^gamma, over each pixel or by the
        quadratic B-spline about it; NaN beyond the photograph."""
        return np.clip(rectified(self.codes**gamma, self.camera, shape, window, splined=splined), 0.0, 1.0) ** (1.0 / gamma)

    def for_model(self, shape: tuple[int, int], window: Window, gamma: float, exact: bool = True) -> np.ndarray:
        """The same averaged as the rays of the model are: another average would be taken for a part of another relief; exact: NaN
        also where a part of what is averaged is saturated, so that its mean is not known."""
        seen = self.on_screen(shape, window, gamma, splined=True)
        if not exact:
            return seen
        full = rectified((self.codes >= SATURATED).astype(float), self.camera, shape, window, splined=True)
        return np.where((full > PARTLY) & (full < 1.0 - PARTLY), np.nan, seen)


def read_codes(path: Path, color: bool = False) -> np.ndarray:
    """The codes of a photograph, (rows, columns) in [0, 1], or of its red, green and blue, (3, rows, columns).

    Raises:
        InputError: it cannot be read, is too small, black, without contrast or without colours.
    """
    picture = read_picture(path, color=color)
    if picture.values.dtype == np.float64:
        raise InputError(f"{path}: holds numbers, not the codes of a camera; a PNG, JPEG or TIFF of 8 or 16 bits is needed")
    found = picture.values / np.iinfo(picture.values.dtype).max
    codes = found.max(-1) if color else found
    with naming(path):
        if color and (codes == found.min(-1)).all():
            raise InputError("has no colours, and the picture of this lens has: a photograph in colour is needed")
        if min(codes.shape) < LEAST:
            raise InputError(
                f"is {codes.shape[1]} x {codes.shape[0]} pixels; a photograph of at least {LEAST} along each side is needed"
            )
        bright, middle = np.percentile(gaussian_filter(codes, 1.0), (99.5, 50.0))
        if bright < BLACK:
            raise InputError("is black: no part of it is brighter than 6 % of the camera's range; a longer exposure is needed")
        if np.mean(codes >= SATURATED) > 0.9:
            raise InputError("is blown out: more than 90 % of it are at the camera's maximum; a shorter exposure is needed")
        if bright - middle < CONTRAST and codes.std() < 0.5 * CONTRAST:
            raise InputError("has no contrast: nothing on it is brighter than the rest; a photograph of the caustic is needed")
    return np.moveaxis(found, -1, 0) if color else found


def read_marks(path: Path, half_size: tuple[float, float], shift: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Marks of a CSV file: (N, 2) (X, Y) in half widths of the screen, and (N, 2) columns and rows.

    Raises:
        InputError: it cannot be read as such.
    """
    with naming(path):
        rows = []
        for number, line in enumerate(read_bytes(path, 1 << 20, MARKS).decode("utf-8", "replace").splitlines(), 1):
            text = line.split("#")[0].replace(";", ",").strip()
            if not text or (number == 1 and text[0].isalpha()):
                continue
            try:
                values = [float(part) for part in text.split(",")]
            except ValueError:
                values = []
            if len(values) != 4 or not np.isfinite(values).all():
                raise InputError(f"line {number}: {line.strip()!r} is no mark; {MARKS} are needed")
            rows.append(values)
        if len(rows) < 4:
            raise InputError(f"has {len(rows)} marks; {MARKS} are needed")
    table = np.array(rows)
    return (table[:, 2:] - np.array(shift)) / np.array(half_size), table[:, :2]


def register(
    path: Path,
    codes: np.ndarray,
    expected: np.ndarray,
    half_size: tuple[float, float],
    shift: tuple[float, float] = (0.0, 0.0),
    *,
    marks: Path | None = None,
    corners: np.ndarray | None = None,
    shape: Shape | None = None,
) -> Photograph:
    """The photograph with its camera, by marks of a file, the corners of the screen (4, 2), marks of the test card in it, or the
    picture itself.

    Args:
        expected: E of the lens as designed, (n, m).
        shape: of a curved screen; without marks it counts as seen along its normal, from far away.

    Raises:
        InputError: neither is possible, or it does not show the caustic of this lens upright.
    """
    size = (codes.shape[1], codes.shape[0])
    if marks is not None:
        places = read_marks(marks, half_size, shift)
        with naming(marks):
            camera = fit_camera(*places, size, f"marks of {marks}", shape)
    elif corners is not None:
        camera = fit_camera(np.array(CORNERS), corners, size, "corners of the screen", shape)
    else:
        try:
            camera = find_marks(codes**ABOUT, shape)
            camera = replace(camera, found="marks of the test card")
        except InputError:
            camera = by_picture(codes, expected)
    found = Photograph(path, codes, camera)
    with naming(path):
        refuse_unlike(found, expected)
    return found


def by_picture(codes: np.ndarray, expected: np.ndarray) -> Camera:
    """An upright camera that sees the bright parts of a photograph where the image (n, m) has them: equal centres and widths."""
    light = np.clip(codes**ABOUT - np.percentile(codes**ABOUT, 30.0), 0.0, None)
    (x, rx), (y, ry) = (
        _moments(np.linspace(-1, 1, expected.shape[0]), expected.sum(1)),
        _moments(np.linspace(-1, 1, expected.shape[1]), expected.sum(0)),
    )
    (a, ra), (b, rb) = (_moments(np.arange(n), light.sum(k)) for k, n in ((0, codes.shape[1]), (1, codes.shape[0])))
    along, across = ra / rx, -rb / ry
    h = np.array([along, 0.0, a - along * x, 0.0, across, b - across * y, 0.0, 0.0])
    return Camera(h, 0.0, (codes.shape[1], codes.shape[0]), np.diag(np.square(BY_PICTURE)), found="the picture itself")


def _moments(at: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of a distribution."""
    middle = float((at * weight).sum() / weight.sum())
    return middle, float(np.sqrt(((at - middle) ** 2 * weight).sum() / weight.sum()))


def refuse_unlike(photograph: Photograph, expected: np.ndarray) -> float:
    """Refuse a photograph that does not show the image (n, m) upright; the correlation of both, blurred, if it does.

    Raises:
        InputError: it is blown out, rotated, mirrored, or of something else, or most of the screen is beyond it.
    """
    n, m = expected.shape
    shape = (COARSE, max(8, round(COARSE * m / n))) if m <= n else (max(8, round(COARSE * n / m)), COARSE)
    seen, light = photograph.on_screen(shape), np.clip(_on(expected, shape), 0.0, None)
    known = np.isfinite(seen)
    full = np.nan_to_num(seen) >= SATURATED
    blown = max(float(full.mean()), float((light * full).sum() / light.sum()))
    if blown > BLOWN:
        raise InputError(f"is blown out: {blown:.0%} of its light is at the camera's maximum; a shorter exposure is needed")
    like = {words: _likeness(photograph, _on(turned(light), shape)) for words, turned in SEEN.items()}
    whole, inner = like[""]
    best = max(like, key=lambda words: like[words][1])
    if like[best][0] >= LEAST_LIKE and like[best][1] > inner + BETTER:
        raise InputError(
            f"{best}: it is like the image of the lens (correlation {like[best][1]:.2f}) only then, as it is {inner:.2f}; "
            + (TURNED if photograph.camera.marks else UPRIGHT)
        )
    if whole < LEAST_LIKE:
        raise InputError(
            f"shows something else: its correlation with the image of the lens, both blurred, is {whole:.2f}, where at least"
            f" {LEAST_LIKE:g} is needed"
        )
    if known.mean() < 0.7:
        raise InputError(f"shows only {known.mean():.0%} of the screen; all of it is needed")
    return whole


def _on(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """An image on other pixels."""
    return image if image.shape == shape else zoom(image, [a / b for a, b in zip(shape, image.shape, strict=True)], order=1)


def _likeness(photograph: Photograph, light: np.ndarray) -> tuple[float, float]:
    """Correlation of a photograph with an image of linear light, both blurred, on the screen and where the image is bright; where
    no marks say where the screen is, the image itself does."""
    if not photograph.camera.marks:
        photograph = replace(photograph, camera=by_picture(photograph.codes, light))
    seen = photograph.on_screen((light.shape[0], light.shape[1]))
    known = np.isfinite(seen)
    if not known.any():
        return 0.0, 0.0
    seen = gaussian_filter(np.where(known, seen, np.median(seen[known])), SMOOTH)
    image, bright = gaussian_filter(light ** (1.0 / ABOUT), SMOOTH), gaussian_filter(light, SMOOTH) > BRIGHT * light.mean()
    return _like(seen, image), _like(seen[bright], image[bright])


def _like(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation of two images."""
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(np.sqrt((a * a).sum() * (b * b).sum()), 1e-300))
