"""Colours of images that are given as tristimulus values: sRGB for viewing, CIELAB, and the difference of colours.

Notation
    X, Y, Z    tristimulus values for the CIE 1931 2-degree observer, in any unit in which `white` is given too
    white      tristimulus values of what counts as white: the light of the source on a white screen (`scene.spectrum.white_point`)
    L, a, b    CIELAB (ISO/CIE 11664-4)

An eye that has adapted to the source sees its light as white.  For a display the colours are therefore adapted from that white to
D65 by the Bradford transform (von Kries with sharpened cones; Lam 1985, as in ISO 15076-1, annex E), and then expressed in the
primaries of IEC 61966-2-1.  Colours outside its gamut are moved towards the grey of their own luminance, at most 1, as far as
necessary and no further: hue and luminance are kept, and light brighter than white becomes white.  The matrices are computed from
the standard's chromaticities and not rounded.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caustic_cli.io.picture import to_srgb

#: Chromaticities x, y of the primaries and of D65 in IEC 61966-2-1.
PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
D65_XY = (0.3127, 0.3290)
#: Sharpened cone responses of X, Y, Z (Lam 1985).
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
#: CIELAB's cube root is continued by a line below DELTA^3.
DELTA = 6.0 / 29.0
#: Negative part of the largest of three powers that counts as rounding.
ROUNDING = 1e-9


def _xyz_of(x: float, y: float) -> np.ndarray:
    """Tristimulus values with Y = 1 of a chromaticity."""
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


#: Tristimulus values of D65 as sRGB defines its white, and those of linear R, G, B.
D65 = _xyz_of(*D65_XY)
_COLUMNS = np.stack([_xyz_of(*xy) for xy in PRIMARIES], axis=1)
XYZ_OF_RGB = _COLUMNS * np.linalg.solve(_COLUMNS, D65)


def adaptation(white: Sequence[float] | np.ndarray, to: Sequence[float] | np.ndarray) -> np.ndarray:
    """Bradford adaptation: the matrix (3, 3) from X, Y, Z under one white to those of the same look under another, (3,) each with
    Y as in `white` and `to`."""
    before, after = BRADFORD @ np.asarray(white, dtype=float), BRADFORD @ np.asarray(to, dtype=float)
    return np.linalg.solve(BRADFORD, (after / before)[:, None] * BRADFORD)


def rgb_matrix(white: Sequence[float] | np.ndarray) -> np.ndarray:
    """Matrix (3, 3) from X, Y, Z under a white (3,) to linear R, G, B of sRGB under its own."""
    return np.linalg.solve(XYZ_OF_RGB, adaptation(np.asarray(white, dtype=float), D65))


def xyz_to_rgb(xyz: np.ndarray, white: Sequence[float] | np.ndarray, exposure: float = 1.0, axis: int = -1) -> np.ndarray:
    """Linear R, G, B from 0 to 1, of the same shape, in the primaries of sRGB: as of `xyz_to_srgb`, before the encoding."""
    rgb = np.moveaxis(np.asarray(xyz, dtype=float), axis, -1) @ (exposure * rgb_matrix(white)).T
    return np.moveaxis(_into_gamut(rgb), -1, axis)


def xyz_to_srgb(xyz: np.ndarray, white: Sequence[float] | np.ndarray, exposure: float = 1.0, axis: int = -1) -> np.ndarray:
    """uint8 codes of the same shape: sRGB under its own D65, in which `white` divided by the exposure appears white.

    Args:
        xyz: X, Y, Z along `axis`: (..., 3), or with axis 0 an image (3, n_x, n_y).
        white: (3,) X, Y, Z of the source's light.
        exposure: factor of the brightness.
    """
    return np.rint(to_srgb(xyz_to_rgb(xyz, white, exposure, axis)) * 255.0).astype(np.uint8)


def mixture(rgb: np.ndarray, primaries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Powers of three lights that together look like a picture: those that have its X, Y, Z.

    A colour that they cannot mix, of which one power would be negative, is moved towards the grey of its own luminance as far as
    necessary; towards the mixture of equal luminances where the lights cannot mix the grey of D65 itself.

    Args:
        rgb: (3, ...) linear R, G, B.
        primaries: (3, 3) X, Y, Z of a unit of power of each light, in columns.

    Returns:
        (3, ...) powers, not negative, and the mask (...) of the pixels that were moved.
    """
    luminance = primaries[1]
    neutral = np.linalg.solve(primaries, D65)
    if not (neutral > 0).all():
        neutral = 1.0 / (3.0 * luminance)
    powers = np.tensordot(np.linalg.solve(primaries, XYZ_OF_RGB), rgb, 1)
    grey = np.multiply.outer(neutral, np.tensordot(luminance, powers, 1))
    negative = powers < -ROUNDING * powers.max(0)
    way = np.divide(powers, powers - grey, out=np.zeros_like(powers), where=negative).max(0)
    return np.maximum(powers + way * (grey - powers), 0.0), negative.any(0)


def xyz_to_lab(xyz: np.ndarray, white: Sequence[float] | np.ndarray, axis: int = -1) -> np.ndarray:
    """CIELAB L, a, b, of the same shape, of X, Y, Z along `axis`, relative to the white (3,)."""
    ratio = np.moveaxis(np.asarray(xyz, dtype=float), axis, -1) / np.asarray(white, dtype=float)
    x, y, z = np.moveaxis(np.where(ratio > DELTA**3, np.cbrt(ratio), ratio / (3.0 * DELTA**2) + 4.0 / 29.0), -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=axis)


def delta_e_2000(lab1: np.ndarray, lab2: np.ndarray, axis: int = -1) -> np.ndarray:
    """CIEDE2000 differences of CIELAB colours along `axis` (ISO/CIE 11664-6; k_L = k_C = k_H = 1), without that axis.

    A difference of 1 is about the least that is seen side by side; the formula is meant for differences below 5.
    """
    l1, a1, b1 = np.moveaxis(np.asarray(lab1, dtype=float), axis, 0)
    l2, a2, b2 = np.moveaxis(np.asarray(lab2, dtype=float), axis, 0)
    c7 = (0.5 * (np.hypot(a1, b1) + np.hypot(a2, b2))) ** 7
    stretch = 1.0 + 0.5 * (1.0 - np.sqrt(c7 / (c7 + 25.0**7)))
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, stretch * a)) % 360.0 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = h2 - h1
    turn = np.where(grey, 0.0, np.where(np.abs(turn) <= 180.0, turn, turn - np.copysign(360.0, turn)))
    far, total = np.abs(h1 - h2) > 180.0, h1 + h2
    h = np.where(grey, total, np.where(~far, 0.5 * total, 0.5 * (total + np.where(total < 360.0, 360.0, -360.0))))
    lightness, c = 0.5 * (l1 + l2), 0.5 * (c1 + c2)
    d_h = 2.0 * np.sqrt(c1 * c2) * np.sin(np.radians(0.5 * turn))
    cosines = ((-0.17, 1.0, -30.0), (0.24, 2.0, 0.0), (0.32, 3.0, 6.0), (-0.20, 4.0, -63.0))
    t = 1.0 + sum(factor * np.cos(np.radians(k * h + phase)) for factor, k, phase in cosines)
    s_l = 1.0 + 0.015 * (lightness - 50.0) ** 2 / np.sqrt(20.0 + (lightness - 50.0) ** 2)
    s_c, s_h = 1.0 + 0.045 * c, 1.0 + 0.015 * c * t
    rotation = -2.0 * np.sqrt(c**7 / (c**7 + 25.0**7)) * np.sin(np.radians(60.0 * np.exp(-(((h - 275.0) / 25.0) ** 2))))
    along_l, along_c, along_h = (l2 - l1) / s_l, (c2 - c1) / s_c, d_h / s_h
    return np.sqrt(np.maximum(along_l**2 + along_c**2 + along_h**2 + rotation * along_c * along_h, 0.0))


def mean_color_difference(
    xyz_image: np.ndarray, xyz_target: np.ndarray, white: Sequence[float] | np.ndarray, axis: int = 0
) -> float:
    """Mean CIEDE2000 over the pixels of an image and of its target, both X, Y, Z along `axis` and in the unit of `white`: neither
    is scaled to the other."""
    return float(delta_e_2000(xyz_to_lab(xyz_image, white, axis), xyz_to_lab(xyz_target, white, axis), axis).mean())


def _into_gamut(rgb: np.ndarray) -> np.ndarray:
    """Linear R, G, B (..., 3) moved towards the grey of their luminance until all are 0 to 1."""
    grey = np.clip(rgb @ XYZ_OF_RGB[1], 0.0, 1.0)[..., None]
    off = rgb - grey
    room = np.where(off > 0, 1.0 - grey, grey)
    with np.errstate(divide="ignore", invalid="ignore"):
        kept = np.where(np.abs(off) > room, room / np.abs(off), 1.0).min(-1, keepdims=True)
    return np.clip(grey + kept * off, 0.0, 1.0)
