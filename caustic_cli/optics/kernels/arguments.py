"""Scalar arguments of the kernels in `fused`, as named tuples.

Numba compiles a kernel for each combination of argument types: integers are always `int` and other numbers `float`, so that there
is only one.
"""

from __future__ import annotations

from typing import NamedTuple


class Exit(NamedTuple):
    """The exit surface and the screen behind it.

    index: ratio of the indices in front of and behind it; fresnel: kind of Fresnel losses, as in `axial_refraction`; start: height
    of the origins of oblique rays, height: of the screen, mm, both above the zero of the sag.
    """

    index: float  # type: ignore[assignment]  # shadows `tuple.index`, which is not used
    fresnel: int
    start: float
    height: float


class ScreenFrame(NamedTuple):
    """The screen's pixels: their numbers, the coordinates of the lower left corner and the pixel size, mm."""

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
