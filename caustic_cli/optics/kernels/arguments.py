"""What the kernels of `plane` take beside arrays, by name.

Numba compiles a kernel for each combination of types it meets: whole numbers are `int` and others `float` always, so that there
is one.
"""

from __future__ import annotations

from typing import NamedTuple


class Exit(NamedTuple):
    """The exit surface, and the screen beyond it.

    index: before it over that behind it; fresnel: kind of Fresnel losses, as in `axial_refraction`; start: height at which
    oblique rays begin, height: of the screen, mm, both above the zero of the sag.
    """

    index: float  # type: ignore[assignment]  # nobody asks an `Exit` for the place of a value
    fresnel: int
    start: float
    height: float


class Frame(NamedTuple):
    """The screen's pixels: how many, the coordinates of the frame's lower left corner and a pixel's size, mm."""

    pixels_x: int
    pixels_y: int
    low_x: float
    low_y: float
    pixel_x: float
    pixel_y: float


class Splat(NamedTuple):
    """The reconstruction filter: its kind, as in `filter_weights`, sizes in pixels (odd), and alpha, per pixel squared."""

    kind: int
    size_x: int
    size_y: int
    alpha_x: float
    alpha_y: float
