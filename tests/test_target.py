"""The target on the screen: exact area averages of square cells, and no light made or lost."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caustic_cli.errors import InputError
from caustic_cli.inverse.target import target_on_screen
from caustic_cli.optics.resampling import overlap
from caustic_cli.scene import Screen


def brute(irradiance: np.ndarray, size, screen: Screen) -> np.ndarray:
    """Area averages by intersecting every pixel with every cell."""

    def shared(n_pixels, width, n_cells, cells_width):
        out = np.zeros((n_pixels, n_cells))
        for p in range(n_pixels):
            for c in range(n_cells):
                low = max(-width / 2 + p * width / n_pixels, -cells_width / 2 + c * cells_width / n_cells)
                high = min(-width / 2 + (p + 1) * width / n_pixels, -cells_width / 2 + (c + 1) * cells_width / n_cells)
                out[p, c] = max(0.0, high - low) / (width / n_pixels)
        return out

    ax = shared(screen.resolution[0], screen.size[0], irradiance.shape[0], size[0])
    ay = shared(screen.resolution[1], screen.size[1], irradiance.shape[1], size[1])
    return ax @ irradiance @ ay.T


lengths = st.floats(0.5, 100.0)


@st.composite
def cases(draw):
    a, b = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    irradiance = np.random.default_rng(draw(st.integers(0, 2**20))).random((a, b))
    size = (draw(lengths), draw(lengths))
    margin = draw(st.just(0.0) | st.floats(1e-6, 2.0))  # a margin below 1e-9 is taken for none
    screen = Screen(tuple(s * (1 + margin) for s in size), 300.0, (draw(st.integers(2, 12)), draw(st.integers(2, 12))))
    return irradiance, size, screen


@given(cases())
def test_exact_area_averages(case):
    irradiance, size, screen = case
    assert target_on_screen(irradiance, size, screen) == pytest.approx(brute(irradiance, size, screen), abs=1e-12)


@given(cases())
def test_power_is_conserved(case):
    irradiance, size, screen = case
    got = target_on_screen(irradiance, size, screen).sum() * np.prod(screen.pixel)
    assert got == pytest.approx(irradiance.sum() * np.prod(np.divide(size, irradiance.shape)), rel=1e-12)


@given(cases())
def test_irradiance_stays_within_the_pictures_range(case):
    irradiance, size, screen = case
    got = target_on_screen(irradiance, size, screen)
    assert got.min() >= 0 and got.max() <= irradiance.max() * (1 + 1e-12)


def test_equal_grids_copy_the_picture():
    irradiance = np.random.default_rng(0).random((5, 7))
    got = target_on_screen(irradiance, (10.0, 14.0), Screen((10.0, 14.0), 300.0, (5, 7)))
    assert got == pytest.approx(irradiance, rel=1e-13)


def test_the_margin_is_dark_and_even_all_round():
    """Table 6.1's 6.4 : 5 on 64 pixels: the picture covers the middle 50 exactly."""
    got = target_on_screen(np.ones((10, 10)), (5.0, 5.0), Screen((6.4, 6.4), 300.0, (64, 64)))
    assert got[7:-7, 7:-7] == pytest.approx(np.ones((50, 50)), abs=1e-12)
    edge = got.copy()
    edge[7:-7, 7:-7] = 0.0
    assert edge.max() < 1e-12


def test_pixels_wholly_outside_are_exactly_zero():
    got = target_on_screen(np.ones((9, 9)), (30.0, 30.0), Screen((38.4, 38.4), 300.0, (24, 24)))
    outside = 2  # pixels of 1.6 mm in a margin of 4.2 mm
    ring = np.ones((24, 24), dtype=bool)
    ring[outside:-outside, outside:-outside] = False
    assert (got[ring] == 0.0).all() and (got[~ring] > 0.0).all()


def test_zeros_stay_exactly_zero():
    """`on_target` counts where the target is not zero, so a rounding error there would be a wrong figure."""
    irradiance = np.zeros((30, 30))
    irradiance[10:20, 5:10] = 0.7
    got = target_on_screen(irradiance, (30.0, 30.0), Screen((38.4, 38.4), 300.0, (50, 50)))
    lit = brute(irradiance, (30.0, 30.0), Screen((38.4, 38.4), 300.0, (50, 50))) > 1e-9
    assert np.array_equal(got > 0, lit) and 0 < lit.sum() < 500


@pytest.mark.parametrize(("flip", "mirror"), [("", (1, 1)), ("x", (-1, 1)), ("y", (1, -1)), ("xy", (-1, -1))])
def test_flip_mirrors_about_the_middle(flip, mirror):
    irradiance = np.random.default_rng(0).random((6, 4))
    screen = Screen((40.0, 30.0), 300.0, (16, 12))
    plain = target_on_screen(irradiance, (30.0, 20.0), screen)
    got = target_on_screen(irradiance, (30.0, 20.0), screen, flip)
    assert got == pytest.approx(plain[:: mirror[0], :: mirror[1]], abs=1e-13)


def test_a_picture_off_its_corner_lies_there():
    irradiance = np.zeros((3, 2))
    irradiance[2, 0] = 1.0  # +x, -y
    got = target_on_screen(irradiance, (3.0, 2.0), Screen((3.0, 2.0), 300.0, (6, 4)))
    assert (got[4:, :2] > 0.999).all() and got.sum() == pytest.approx(4.0)


@pytest.mark.parametrize(("size", "word"), [((31.0, 30.0), "width"), ((30.0, 31.0), "height")])
def test_larger_than_the_screen_is_refused(size, word):
    with pytest.raises(InputError, match=word):
        target_on_screen(np.ones((4, 4)), size, Screen((30.0, 30.0), 300.0, (8, 8)))


def test_black_is_refused():
    with pytest.raises(InputError, match="black"):
        target_on_screen(np.zeros((4, 4)), (30.0, 30.0), Screen((30.0, 30.0), 300.0, (8, 8)))


def test_overlap_rows_are_parts_of_a_pixel():
    cells, pixels = np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.5, 2.0, 4.0])
    assert overlap(cells, pixels).toarray() == pytest.approx(np.array([[1 / 3, 0], [1 / 3, 2 / 3], [0, 0.5]]))
