"""What a scene accepts and refuses, and the few formulas it holds: sag, magnification, height bounds, Sellmeier."""

import math
from fractions import Fraction

import numpy as np
import pytest

from caustic_cli.errors import CausticError, InputError
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.scene.materials import D_LINE, MATERIALS, material, refractive_index, rows
from caustic_cli.schema import checks

INF, NAN = math.inf, math.nan


REFUSED = {
    "size zero": (lambda: Lens(size=(0.0, 10.0)), r"\[lens\] size must be 1e-06 to 1e\+06, got 0"),
    "size one number": (lambda: Lens(size=10.0), r"\[lens\] size must be a pair \[x, y\], got 10.0"),
    "size text": (lambda: Lens(size=("10", 10.0)), r"\[lens\] size must be a number, got '10'"),
    "size nan": (lambda: Lens(size=(NAN, 10.0)), r"\[lens\] size must be .*, got nan"),
    "z_in": (lambda: Lens(z_in=INF), r"\[lens\] z_in must be -1e\+09 to 1e\+09, got inf"),
    "index 1": (lambda: Lens(index=1.0), r"\[lens\] index must be greater than 1 and at most 5, got 1"),
    "index 6": (lambda: Lens(index=6), r"\[lens\] index must be .*, got 6"),
    "index flag": (lambda: Lens(index=True), r"\[lens\] index must be a number, got True"),
    "degree 0": (lambda: Lens(degree=(0, 3)), r"\[lens\] degree must be a whole number 1 to 15, got 0"),
    "degree 16": (lambda: Lens(degree=(3, 16)), r"\[lens\] degree must be a whole number 1 to 15, got 16"),
    "degree fraction": (lambda: Lens(degree=(3.0, 3)), r"\[lens\] degree must be a whole number"),
    "control few": (lambda: Lens(control=(50, 3)), r"\[lens\] control must be a whole number 4 to 4096, got 3"),
    "control many": (lambda: Lens(control=(5000, 50)), r"\[lens\] control must be"),
    "control fraction": (lambda: Lens(control=(50.5, 50)), r"\[lens\] control must be a whole number"),
    "min_thickness": (lambda: Lens(min_thickness=-0.1), r"\[lens\] min_thickness must be 0 to 1e\+09, got -0.1"),
    "range equal": (lambda: Lens(height_range=(1.0, 1.0)), r"\[lens\] height_range must ascend, got \[1, 1\]"),
    "range infinite": (lambda: Lens(height_range=(-INF, 1.0)), r"\[lens\] height_range must be -1e\+09 to 1e\+09"),
    "fresnel": (lambda: Lens(fresnel="full"), r"\[lens\] fresnel must be one of none, schlick, exact, got 'full'"),
    "thickness": (lambda: Offset(NAN), r"\[lens\] thickness must be -1e\+09 to 1e\+09, got nan"),
    "radius zero": (lambda: Offset(5.0, (0.0, INF)), r"\[lens\] radius must be a non-zero number or inf, got 0.0"),
    "radius nan": (lambda: Offset(5.0, (NAN, INF)), r"\[lens\] radius must be a non-zero number or inf, got nan"),
    "screen size": (lambda: Screen((10.0, -1.0)), r"\[screen\] size must be .*, got -1"),
    "screen z": (lambda: Screen((10.0, 10.0), NAN), r"\[screen\] z must be -1e\+12 to 1e\+12, got nan"),
    "pixels 1": (lambda: Screen((10.0, 10.0), 300.0, (1, 250)), r"\[screen\] resolution must be .* 2 to 16384, got 1"),
    "pixels fraction": (lambda: Screen((10.0, 10.0), 300.0, (250.0, 250)), r"\[screen\] resolution must be a whole number"),
    "power 0": (lambda: PlaneWave(0.0), r"\[source\] power must be greater than 0 and at most 1e\+30, got 0"),
    "profile black": (lambda: PlaneWave(profile=np.zeros((3, 3))), r"\[source\] profile must be .* not black"),
    "profile negative": (lambda: PlaneWave(profile=np.array([[1.0, -0.1]])), r"\[source\] profile must be"),
    "profile nan": (lambda: PlaneWave(profile=np.array([[1.0, NAN]])), r"\[source\] profile must be"),
    "profile colour": (lambda: PlaneWave(profile=np.ones((3, 3, 3))), r"\[source\] profile must be a 2-D picture"),
    "behind": (lambda: Scene(PlaneWave(), Lens(z_in=300.0), Screen((1.0, 1.0))), r"\[screen\] z must lie behind the lens"),
}


@pytest.mark.parametrize(("build", "sentence"), REFUSED.values(), ids=REFUSED.keys())
def test_bad_values_are_refused_by_name(build, sentence):
    with pytest.raises(InputError, match=sentence) as caught:
        build()
    assert isinstance(caught.value, CausticError)  # the command line turns it into a sentence, not a traceback
    assert "\n" not in str(caught.value)


def test_a_number_beyond_float_is_refused_in_a_sentence():
    """TOML has whole numbers of any length; float() of this one overflows."""
    with pytest.raises(InputError, match="thickness"):
        Offset(10**400)


def test_limits_themselves_are_accepted():
    Lens(size=(1e-6, 1e6), index=5.0, degree=(1, 15), control=(2, 16), height_range=(-0.0, 1e-9), fresnel="none")
    Screen((1e-6, 1e9), -5.0, (2, 16384))
    assert checks.number("x", 3, 3, 3) == 3.0
    assert isinstance(checks.number("x", 3), float)
    assert PlaneWave(profile=[[0, 1], [2, 3]]).profile.dtype == float
    assert Scene(PlaneWave(), Lens(), Screen((1.0, 1.0))).screen.z == 300.0


def test_scenes_are_frozen():
    for thing, field in ((Lens(), "index"), (Screen((1.0, 1.0)), "z"), (PlaneWave(), "power"), (Offset(), "radius")):
        with pytest.raises(AttributeError):
            setattr(thing, field, 2.0)


@pytest.mark.parametrize("rho", [30.0, -30.0, 1e6, -1e9])
def test_spherical_sag(rho):
    """thickness + rho - sqrt(rho^2 - r^2) for rho > 0, its mirror image for rho < 0, to 4 roundings in exact arithmetic.

    Checked by squaring: (rho - sag)^2 = rho^2 - r^2, which holds for both signs and needs no root.
    """
    x, y = np.linspace(-5, 5, 21)[:, None], np.linspace(-4, 4, 17)[None, :]
    sag = Offset(3.0, (rho, rho)).sag(x, y)
    assert sag.shape == (21, 17)
    checked = 0
    for i in range(21):
        for j in range(17):
            square = Fraction(x[i, 0]) ** 2 + Fraction(y[0, j]) ** 2
            z, r = Fraction(sag[i, j]), Fraction(rho)
            error = (r - z) ** 2 - (r * r - square)  # about -2 rho dz
            assert abs(error) <= Fraction(4, 2**52) * square
            assert sag[i, j] * rho >= 0
            checked += square > 0
    assert checked > 300


def test_different_radii_make_two_profiles_and_inf_is_flat():
    x, y = np.linspace(-5, 5, 11)[:, None], np.linspace(-4, 4, 9)[None, :]
    both = Offset(3.0, (30.0, -40.0)).sag(x, y)
    np.testing.assert_allclose(both, (30 - np.sqrt(900 - x**2)) + (-40 + np.sqrt(1600 - y**2)), rtol=0, atol=1e-13)
    one = np.broadcast_to(30 - np.sqrt(900 - x**2), (11, 9))
    np.testing.assert_allclose(Offset(3.0, (30.0, INF)).sag(x, y), one, rtol=0, atol=1e-13)
    assert not Offset(3.0, (INF, INF)).sag(x, y).any()
    assert Offset(3.0, (INF, INF)).sag(x, y).shape == (11, 9)


@pytest.mark.parametrize("radius", [(5.0, 5.0), (-5.0, -5.0), (4.9, INF), (INF, 3.0)])
def test_a_sphere_that_ends_inside_the_aperture_is_refused(radius):
    x, y = np.linspace(-5, 5, 11)[:, None], np.linspace(-4, 4, 9)[None, :]
    with pytest.raises(InputError, match="radius must exceed the lens' semi-aperture"):
        Offset(3.0, radius).sag(x, y)


def test_radius_for_a_magnification():
    """Table 6.1 (cm): n = 1.5, screen 4 from the lens: magnifications 1.25 and 1.5 give 8 and 4 (erratum E12)."""
    reach = {"index": 1.5, "throw": 300.0, "thickness": 10.0}
    assert Offset.for_magnification((1.0, 1.0), **reach).radius == (INF, INF)
    assert Offset.for_magnification((3.0, 5.0), **reach).radius == pytest.approx((0.5 * 290 / 2, 0.5 * 290 / 4))
    assert Offset.for_magnification((0.5, -1.0), **reach).radius == pytest.approx((-290.0, -72.5))
    assert Offset.for_magnification((3.0, 3.0), **reach).thickness == 10.0
    assert Offset.for_magnification((1.25, 1.5), index=1.5, throw=4.0, thickness=0.0).radius == pytest.approx((8.0, 4.0))


def test_height_bounds():
    lens = Lens(offset=Offset(3.0, (50.0, 50.0)), height_range=(-0.5, 1.0), z_in=1.0, min_thickness=1.8)
    x, y = np.linspace(-5, 5, 7), np.linspace(-4, 4, 5)
    low, high = lens.height_bounds(x, y)
    f = 3.0 + 50 - np.sqrt(2500 - x[:, None] ** 2 - y[None, :] ** 2)
    np.testing.assert_allclose(high, f + 1.0, rtol=0, atol=1e-13)
    np.testing.assert_allclose(low, np.maximum(f - 0.5, 2.8), rtol=0, atol=1e-13)
    assert low.min() == 2.8  # the floor z_in + min_thickness is felt in the middle, not at the rim
    assert low.max() > 2.81


def test_height_bounds_without_room_are_refused():
    with pytest.raises(InputError, match="min_thickness of 7 mm leaves no room for the heights"):
        Lens(min_thickness=7.0).height_bounds(np.zeros(3), np.zeros(2))


def test_pixels():
    screen = Screen((24.0, 9.0), 100.0, (12, 6))
    assert screen.pixel == (2.0, 1.5)
    assert screen.half_size == (12.0, 4.5)
    wide = screen.grown((3, 1))
    assert (wide.size, wide.resolution, wide.z) == ((36.0, 12.0), (18, 8), 100.0)
    assert wide.pixel == screen.pixel
    assert screen.grown((0, 0)) == screen


#: n_d and Abbe number V_d = (n_d - 1) / (n_F - n_C) as catalogues print them: Schott's data sheets; for silica and CaF2 the usual
#: figures after Malitson; for plastics Sultanova's fits as refractiveindex.info prints them (index only).
CATALOGUE = {
    "N-BK7": (1.51680, 64.17),
    "N-F2": (1.62005, 36.43),
    "N-BAF10": (1.67003, 47.11),
    "N-SF11": (1.78472, 25.68),
    "SILICA": (1.45846, 67.82),
    "CAF2": (1.43385, 95.0),
    "PMMA": (1.4906, None),
    "PC": (1.5848, None),
    "PS": (1.5916, None),
    "WATER": (1.33344, 55.8),  # 20 degrees C
    "SODA-LIME": (1.5234, None),
    "NOA61": (1.5597, None),
}


def test_catalogue_covers_every_material():
    assert set(CATALOGUE) == {name for name, material in MATERIALS.items() if not material.spread}


@pytest.mark.parametrize(
    ("called", "name"),
    [
        ("acrylic", "PMMA"),
        ("Plexiglass", "PMMA"),
        ("polycarbonate", "PC"),
        ("water", "WATER"),
        ("BK7", "N-BK7"),
        ("n bk7", "N-BK7"),
        ("Formlabs clear", "PRINT-RESIN"),
        ("resin", "PRINT-RESIN"),
        ("fused_silica", "SILICA"),
        ("float glass", "SODA-LIME"),
    ],
)
def test_materials_have_the_names_that_people_use(called, name):
    assert material(called) is MATERIALS[name]


def test_a_batch_s_index_and_dispersion_are_those_it_is_described_by():
    resin = material("resin")
    assert (resin.index(D_LINE), resin.abbe) == (pytest.approx(1.51, abs=1e-12), pytest.approx(50.0, rel=1e-9))
    assert resin.spread > 0 and "1.51 +- 0.01" in dict((r[0], r[1]) for r in rows())["PRINT-RESIN"]


def test_light_along_the_axis_is_totally_reflected_from_the_steepest_slope_on():
    n, slope = refractive_index("acrylic"), material("acrylic").steepest
    assert n * math.sin(math.atan(slope)) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("glass", CATALOGUE)
def test_refractive_indices(glass):
    n_d, abbe = CATALOGUE[glass]
    assert refractive_index(glass) == pytest.approx(n_d, abs=6e-5)  # half a unit of the last digit printed
    assert refractive_index(glass.lower(), D_LINE) == refractive_index(glass)
    n_f, n_c = refractive_index(glass, 486.1327), refractive_index(glass, 656.2725)
    assert n_f > refractive_index(glass) > n_c  # normal dispersion
    if abbe is not None:
        assert (refractive_index(glass) - 1) / (n_f - n_c) == pytest.approx(abbe, rel=2e-3)


def test_he_ne_is_not_the_d_line():
    """Erratum E14: N-BK7 has 1.51509 at 632.8 nm (Schott)."""
    assert refractive_index("N-BK7", 632.8) == pytest.approx(1.51509, abs=1e-5)


def test_unknown_glass_and_wavelength():
    with pytest.raises(InputError, match="did you mean PMMA"):
        refractive_index("acryllic")
    with pytest.raises(InputError, match=r"must be one of .*, got 'diamond'; of any other material, give its \[lens\] index"):
        refractive_index("diamond")
    with pytest.raises(InputError, match=r"brass is a metal: give \[lens\] mirror"):
        refractive_index("brass")
    for wavelength in (300.0, 2600.0, NAN):
        with pytest.raises(InputError, match="wavelength for N-BK7 must be 310 to 2500 nm"):
            refractive_index("N-BK7", wavelength)
