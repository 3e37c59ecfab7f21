"""Light that smooth creases take from pixels at gaps, and masses that make up for it."""

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from caustic_cli.inverse import creases, transport
from caustic_cli.inverse.scattered import Pixels
from caustic_cli.optics.bspline import GridSpline

A, SIZE, TIMES = 5.0, 24, 4
AT = transport.centres(2400, A)  # a hundred rays a pixel along either axis


def test_the_profile_of_a_crease():
    """WIDTH and POSITIONS are of a kink of phi averaged as by `Transport.finer` and interpolated by a cubic spline."""
    i, reach = np.arange(-24.0, 25.0), 4.0
    box = np.ones(round(transport.FINE * transport.SHARP))
    kernel = np.convolve(np.convolve(box, box), (1.0, 1.0)) / (2.0 * box.sum() ** 2)
    points = (i[:, None] + (np.arange(len(kernel)) - 0.5 * (len(kernel) - 1)) / transport.FINE).ravel()
    shape = (len(i), len(kernel), len(i), len(kernel))
    x, y = (0.04 * (np.arange(500) + 0.5) - 10.0 for _ in range(2))
    lands = []
    for angle in (np.arange(8) + 0.5) * np.pi / 32:
        a, b = np.cos(angle), np.sin(angle)
        phi = np.maximum(a * points[:, None] + b * points - 0.37, 0.0).reshape(shape)
        spline = RectBivariateSpline(i, i, np.einsum("iajb,a,b->ij", phi, kernel, kernel), s=0)
        s = a * spline(x, y, dx=1) + b * spline(x, y, dy=1)
        lands.append(np.sort(s[np.abs(a * x[:, None] + b * y - 0.37) < reach])[:: max(1, 100)])
    s = np.sort(np.concatenate(lands))
    away = np.minimum(np.abs(s), np.abs(1.0 - s))
    table = np.asarray(creases.POSITIONS)
    np.testing.assert_allclose(
        np.minimum(np.abs(table), np.abs(1.0 - table)).mean() * creases.WIDTH, away.mean() * 2.0 * reach, rtol=0.06
    )
    for low in (0.05, 0.2, 0.35):  # width of the strip whose light lands between low and 1 - low
        wide = ((s > low) & (s < 1.0 - low)).mean() * 2.0 * reach
        between = np.interp((low, 1.0 - low), table, np.arange(len(table)) + 0.5)
        assert np.ptp(between) / len(table) * creases.WIDTH == pytest.approx(wide, rel=0.15)


def bars() -> np.ndarray:
    """Three bars, one of them dim, between dark gaps."""
    picture = np.zeros((SIZE, SIZE))
    picture[2:7, 2:22], picture[11:13, 2:22], picture[18:20, 2:22] = 1.0, 1.0, 0.3
    return picture


def image(found: transport.Transport, half: float) -> np.ndarray:
    """Light of the spline through phi at the corners of fine cells, as fractions of that on the picture."""
    fine = found.finer(TIMES)
    lines = [transport.corners(n - 1, A) for n in fine.potential.shape]
    x, y = GridSpline(*lines, fine.potential).derivatives(AT, AT, [(1, 0), (0, 1)])
    edges = np.linspace(-half, half, SIZE + 1)
    light = np.histogram2d(x.ravel(), y.ravel(), (edges, edges))[0]
    return light / light[bars() > 0].sum()


@pytest.mark.parametrize("displaced", [False, True])
def test_pixels_at_gaps_get_their_light(displaced):
    """They lose more than others, which a compensated map gives back."""
    picture, half, light = bars(), 12.0, np.ones((64, 64))
    wanted = picture / picture.sum()

    def error(times: int) -> tuple[float, float]:
        found = transport.solve(light, picture, (A, A), (half, half), tolerance=5e-4, most=30, times=times)
        if displaced:
            sites = Pixels(picture, (half, half)).sites(light, (A, A), times=times)
            nothing = np.zeros((2, 65, 65))
            options = {"tolerance": 5e-4, "times": times}
            found = transport.solve_displaced(light, sites, (A, A), found.potential, nothing, start=found.potential, **options)
            np.testing.assert_array_equal(found.solved.sites.spots.mass, sites.mass)
        off = (image(found, half) / wanted.max() - wanted / wanted.max())[picture > 0]
        edge = (picture > 0) & ~((np.roll(picture, 1, 0) > 0) & (np.roll(picture, -1, 0) > 0))
        return float(np.sqrt((off**2).mean())), float(off[edge[picture > 0]].mean())

    (plain, lost), (compensated, left) = error(1), error(TIMES)
    assert lost < -0.003 and abs(left) < 0.3 * abs(lost)
    assert compensated < 0.7 * plain


def test_dim_pixels_keep_their_light():
    """A pixel too faint for the parts of bright ones is a site of its own where creases are sharpened."""
    picture = np.zeros((SIZE, SIZE))
    picture[4:18, 4:20], picture[20, 12] = 1.0, 0.02
    masses = {}
    for times in (1, TIMES):
        x, y, mass = transport.point_masses(np.ones((64, 64)), picture, (12.0, 12.0), times=times)
        masses[times] = mass[(x > 8.0) & (x < 9.0) & (np.abs(y - 0.5) < 0.5)].sum()
        assert mass.sum() == pytest.approx(1.0)
    assert masses[1] == 0.0 and masses[TIMES] == pytest.approx(0.02 / picture.sum())
