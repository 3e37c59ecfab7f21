"""Tristimulus values to sRGB and CIELAB, and differences of colours, against colour-science."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracle import colour_science

from caustic_cli.io.colorimetry import (
    D65,
    XYZ_OF_RGB,
    adaptation,
    delta_e_2000,
    mean_color_difference,
    xyz_to_lab,
    xyz_to_srgb,
)
from caustic_cli.io.picture import to_linear
from caustic_cli.scene.spectrum import BUILT_IN, built_in, tristimulus, white_point

WHITES = {name: np.array(white_point(built_in(name))) for name in BUILT_IN}


@pytest.fixture(scope="module")
def colour():
    return colour_science()


def labs(n: int, seed: int) -> np.ndarray:
    """Random colours (n, 3), some of them grey or nearly so."""
    random = np.random.default_rng(seed)
    found = np.stack([random.uniform(0, 100, n), random.uniform(-128, 128, n), random.uniform(-128, 128, n)], axis=1)
    found[: n // 10, 1:] = 0.0
    found[n // 10 : n // 5, 1:] *= 1e-3
    return found


def srgb_to_xyz(codes, white=tuple(D65), axis: int = -1) -> np.ndarray:
    """X, Y, Z, of the same shape, of R, G, B along an axis, integer codes or values from 0 to 1, adapted to a white."""
    values = codes / np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else codes
    return np.moveaxis(np.moveaxis(to_linear(values), axis, -1) @ (adaptation(D65, white) @ XYZ_OF_RGB).T, -1, axis)


# differences


def test_ciede2000_agrees_on_random_pairs(colour):
    one, other = labs(20_000, 1), np.random.default_rng(2).permutation(labs(20_000, 3))
    near = one + np.random.default_rng(4).normal(0, 2, one.shape)
    for pair in ((one, other), (one, near), (one, one), (one[::-1], one)):
        np.testing.assert_allclose(delta_e_2000(*pair), colour.difference.delta_E_CIE2000(*pair), atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize(
    ("one", "other", "difference"),
    [  # Sharma, Wu and Dalal, Color Res. Appl. 30, 21 (2005), table 1
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0009), 7.1792),
        ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_ciede2000_of_published_pairs(one, other, difference):
    for pair in ((one, other), (other, one)):
        assert delta_e_2000(*map(np.array, pair)) == pytest.approx(difference, abs=5e-5)


def test_lab_agrees(colour):
    random = np.random.default_rng(5)
    xyz = random.uniform(0, 1.2, (5000, 3)) ** 4  # with dark ones, on the linear part
    for white in WHITES.values():
        theirs = colour.XYZ_to_Lab(xyz, colour.XYZ_to_xy(white))
        np.testing.assert_allclose(xyz_to_lab(xyz, white), theirs, atol=1e-9)
        np.testing.assert_allclose(xyz_to_lab(xyz.T, white, axis=0), theirs.T, atol=1e-9)
    np.testing.assert_allclose(xyz_to_lab(white, white), [100.0, 0.0, 0.0], atol=1e-12)


def test_mean_difference_of_images():
    """0 of the same image; of images [3, n, m] the mean over pixels; and not blind to brightness."""
    white = WHITES["led-3000"]
    random = np.random.default_rng(6)
    image, target = (white[:, None, None] * random.uniform(0.1, 1.0, (3, 5, 7)) for _ in range(2))
    assert mean_color_difference(image, image, white) == 0.0
    one_by_one = [
        float(delta_e_2000(xyz_to_lab(image[:, i, j], white), xyz_to_lab(target[:, i, j], white)))
        for i in range(5)
        for j in range(7)
    ]
    assert mean_color_difference(image, target, white) == pytest.approx(np.mean(one_by_one))
    assert mean_color_difference(image, 1.1 * image, white) > 0.5


# sRGB


def test_the_primaries_are_those_of_the_standard(colour):
    space = colour.RGB_COLOURSPACES["sRGB"]
    np.testing.assert_allclose(XYZ_OF_RGB, space.matrix_RGB_to_XYZ, atol=1e-4)  # the standard's is rounded to four digits
    np.testing.assert_allclose(XYZ_OF_RGB @ np.ones(3), D65, rtol=1e-12)


def test_bradford_agrees(colour):
    for white in WHITES.values():
        theirs = colour.adaptation.matrix_chromatic_adaptation_VonKries(white, D65, transform="Bradford")
        np.testing.assert_allclose(adaptation(white, D65), theirs, atol=1e-9)
        np.testing.assert_allclose(adaptation(white, D65) @ white, D65, rtol=1e-12)


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_white_screen_is_white(name):
    """Under the light of any source, adapted to; greys are neutral."""
    image = WHITES[name][:, None, None] * np.array([[1.0, 0.2158605, 0.0]])
    codes = xyz_to_srgb(image, WHITES[name], axis=0)
    assert codes.dtype == np.uint8 and codes.shape == (3, 1, 3)
    assert codes[:, 0].T.tolist() == [[255] * 3, [128] * 3, [0] * 3]


def test_daylight_is_white_without_adaptation():
    """The white of the integrated table of D65 is that of the standard's chromaticity, to 1 of 255."""
    codes = xyz_to_srgb(WHITES["daylight"], D65)
    assert np.abs(codes.astype(int) - 255).max() <= 1


def test_colours_in_the_gamut_agree(colour):
    random = np.random.default_rng(7)
    rgb = random.uniform(0.02, 0.98, (4000, 3))
    xyz = rgb @ XYZ_OF_RGB.T
    theirs = 255.0 * colour.XYZ_to_sRGB(xyz)
    assert np.abs(xyz_to_srgb(xyz, D65) - theirs).max() < 0.6  # half a code, and the rounded matrix of the standard
    np.testing.assert_allclose(srgb_to_xyz(theirs / 255.0), xyz, atol=1e-3)


@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=50), st.sampled_from([*BUILT_IN]))
def test_codes_come_back(codes, name):
    given_codes = np.array(codes, dtype=np.uint8)
    white = WHITES[name]
    assert (xyz_to_srgb(srgb_to_xyz(given_codes, white), white) == given_codes).all()
    image = given_codes.T[:, :, None]
    assert (xyz_to_srgb(srgb_to_xyz(image, white, axis=0), white, axis=0) == image).all()


def test_all_greys_and_deep_codes_come_back():
    codes = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    assert (xyz_to_srgb(srgb_to_xyz(codes), D65) == codes).all()
    deep = np.repeat(np.arange(0, 65536, 257, dtype=np.uint16)[:, None], 3, axis=1)
    assert (xyz_to_srgb(srgb_to_xyz(deep), D65) == codes).all()


def test_exposure_is_a_factor():
    xyz = np.random.default_rng(8).uniform(0.0, 0.3, (50, 3))
    np.testing.assert_array_equal(xyz_to_srgb(xyz, D65, 2.5), xyz_to_srgb(2.5 * xyz, D65))


def test_colours_outside_the_gamut_keep_hue_and_luminance():
    """Spectral colours: a channel reaches 0 or 1, the order of the channels and the luminance are kept."""
    at = np.arange(450.0, 650.0, 10.0)
    xyz = 0.2 * tristimulus(at)
    linear = np.linalg.solve(XYZ_OF_RGB, xyz.T).T
    assert (linear.min(1) < 0).all()
    codes = xyz_to_srgb(xyz, D65)
    shown = srgb_to_xyz(codes)
    np.testing.assert_allclose(shown[:, 1], xyz[:, 1], atol=0.004)
    assert ((codes.min(1) == 0) | (codes.max(1) == 255)).all()
    for before, after in zip(linear, codes.astype(int), strict=True):
        order = np.argsort(before)
        assert (np.diff(after[order]) >= 0).all()


def test_light_brighter_than_white_is_white():
    codes = xyz_to_srgb(np.array([D65 * 50.0, XYZ_OF_RGB[:, 2] * 20.0]), D65)
    assert codes.tolist() == [[255] * 3, [255] * 3]
