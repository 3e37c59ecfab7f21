"""Spectra of sources: the tables against colour-science, rules of wavelengths and weights, files and their refusals."""

import os
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracle import colour_science

from caustic_cli.errors import InputError
from caustic_cli.io.files import read_bytes
from caustic_cli.io.spectra import MOST_BYTES, TABLE, parse_spectrum
from caustic_cli.scene import spectrum as module
from caustic_cli.scene.spectrum import (
    BUILT_IN,
    DETECTORS,
    MOST_NODES,
    MOST_ROWS,
    TAIL,
    Measure,
    Spectrum,
    built_in,
    luminous_efficacy,
    luminous_efficiency,
    tristimulus,
    white_point,
)

#: Names of the tables in colour-science.
CIE = {"daylight": "D65", "halogen": "A", "led-3000": "LED-B2", "led-4000": "LED-B3", "led-6500": "LED-B5"}
OBSERVER = "CIE 1931 2 Degree Standard Observer"


@pytest.fixture(scope="module")
def colour():
    return colour_science()


def oracle(colour, name: str):
    """The same spectrum in colour-science, in equal steps."""
    if name == "equal":
        return colour.colorimetry.sd_ones(colour.SpectralShape(380, 780, 5))
    if name == "sun":
        found = colour.plotting.datasets.astm_g_173.SD_ASTMG173_GLOBAL_TILT.copy()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says that its steps differ
            return found.interpolate(colour.SpectralShape(280, 4000, 0.5), interpolator=colour.LinearInterpolator)
    return colour.SDS_ILLUMINANTS[CIE[name]]


def two_lines(width: float) -> Spectrum:
    at = (450.0, 620.0)
    return Spectrum("two lines", np.array([x + k * width for x in at for k in (-1, 0, 1)]), np.array([0.0, 1, 0, 0, 2, 0]))


# the tables


@pytest.mark.parametrize("name", CIE)
def test_the_tables_are_those_of_the_cie(colour, name):
    theirs, ours = oracle(colour, name), built_in(name)
    np.testing.assert_allclose(ours.wavelengths, theirs.wavelengths)
    np.testing.assert_allclose(ours.power, theirs.values)


def test_the_observer_is_that_of_the_cie(colour):
    theirs = colour.MSDS_CMFS[OBSERVER]
    np.testing.assert_allclose(tristimulus(theirs.wavelengths), theirs.values, rtol=1e-9)
    assert not tristimulus(np.array([359.0, 831.0])).any()
    photopic = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    assert np.abs(luminous_efficiency(photopic.wavelengths) - photopic.values).max() < 1e-6


@pytest.mark.parametrize("name", BUILT_IN)
def test_lumens_per_watt_agree(colour, name):
    """Within 0.1%: colour-science sums at the wavelengths of the table, here V is resolved between them."""
    assert luminous_efficacy(built_in(name)) == pytest.approx(float(colour.luminous_efficacy(oracle(colour, name))), rel=1e-3)


@pytest.mark.parametrize("name", BUILT_IN)
def test_white_points_agree(colour, name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says that it aligns the tables
        theirs = np.asarray(colour.sd_to_XYZ(oracle(colour, name), colour.MSDS_CMFS[OBSERVER], method="Integration"))
    ours = np.array(white_point(built_in(name)))
    np.testing.assert_allclose(ours, theirs / theirs[1], rtol=1e-3)
    assert ours[1] == 1.0
    np.testing.assert_allclose(ours[:2] / ours.sum(), colour.XYZ_to_xy(theirs), atol=2e-4)
    if name in CIE:  # as published: by sums in steps of 5 nm, between which ours are linear
        np.testing.assert_allclose(ours[:2] / ours.sum(), colour.CCS_ILLUMINANTS[OBSERVER][CIE[name]], atol=3e-4)


def test_the_sun_carries_its_irradiance():
    """1000 W/m^2, for which the standard was normalised."""
    sun = built_in("sun")
    assert np.trapezoid(sun.power, sun.wavelengths) == pytest.approx(1000.4, abs=0.1)


def test_the_tables_are_small_and_say_their_source():
    tables = list(module.FOLDER.glob("*.csv"))
    assert {p.stem for p in tables} == {*BUILT_IN, "observer"} - {"equal"}
    assert sum(p.stat().st_size for p in tables) < 60_000
    for path in tables:
        assert "CIE 15:2018" in (first := path.read_text().splitlines()[0]) or "ISO/CIE 11664" in first or "G173-03" in first


def test_a_spectrum_is_frozen():
    spectrum = built_in("daylight")
    with pytest.raises(ValueError, match="read-only"):
        spectrum.power[0] = 1.0
    given_values = np.array([1.0, 2.0])
    kept = Spectrum("x", np.array([400.0, 500.0]), given_values)
    given_values[:] = 7.0
    assert kept.power.tolist() == [1.0, 2.0]


# rules


def fine(measure: Measure, points: int = 400_001) -> tuple[np.ndarray, np.ndarray]:
    """A discretisation of the density that shares nothing with the package's: midpoints of equal cells."""
    low, high = measure.range
    x = low + (np.arange(points) + 0.5) * (high - low) / points
    s = np.interp(x, measure.spectrum.wavelengths, measure.spectrum.power)
    w = s * luminous_efficiency(x) if measure.detector == "eye" else s
    return x, w / w.sum()


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("name", BUILT_IN)
def test_mean_and_spread(name, detector):
    measure = Measure(built_in(name), detector)
    x, w = fine(measure)
    assert measure.mean == pytest.approx(w @ x, abs=1e-3)
    assert measure.spread == pytest.approx(np.sqrt(w @ (x - w @ x) ** 2), abs=1e-3)
    nodes, weights = measure.nodes(24)
    assert weights @ nodes == pytest.approx(measure.mean, abs=1.0)
    assert np.sqrt(weights @ (nodes - measure.mean) ** 2) == pytest.approx(measure.spread, abs=1.5)
    assert measure.density(x).mean() * (measure.range[1] - measure.range[0]) == pytest.approx(1.0, abs=1e-6)
    assert not measure.density(np.array([100.0, 379.0, 781.0, 5000.0])).any()


def test_a_laser_is_one_wavelength():
    laser = Spectrum("laser", np.array([632.8 - 1e-11, 632.8, 632.8 + 1e-11]), np.array([0.0, 1.0, 0.0]))
    nodes, weights = Measure(laser).nodes(5)
    assert nodes == pytest.approx([632.8]) and weights.tolist() == [1.0]


@given(
    st.lists(st.tuples(st.floats(1e-3, 60.0), st.floats(0.0, 1.0)), min_size=3, max_size=30),
    st.integers(1, 61),
    st.sampled_from(DETECTORS),
)
def test_any_spectrum_has_a_rule(rows, n, detector):
    steps, power = zip(*rows, strict=True)
    power = np.array(power)
    power[1] = 1.0
    measure = Measure(Spectrum("any", 405.0 + np.cumsum(steps) - steps[0], power), detector)
    nodes, weights = measure.nodes(n)
    assert 1 <= len(nodes) <= n and (np.diff(nodes) > 0).all() and (weights > 0).all()
    low, high = measure.range
    least, most = (400.0, 700.0) if detector == "eye" else (380.0, 780.0)
    assert least <= low <= nodes[0] and nodes[-1] <= high <= most and weights.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(measure.weights_at(nodes), weights)


@pytest.mark.parametrize("n", [2, 5, 9])
def test_nodes_of_a_constant_density_are_the_middles_of_equal_parts(n):
    nodes, weights = Measure(built_in("equal"), "power").nodes(n)
    low, high = 380.0 + 400.0 * TAIL, 780.0 - 400.0 * TAIL
    middles = low + (high - low) * (np.arange(n) + 0.5) / n
    np.testing.assert_allclose(nodes[1:-1], middles[1:-1], atol=0.3)
    assert 380.0 < nodes[0] < middles[0] and middles[-1] < nodes[-1] < 780.0  # they take the tails, too
    np.testing.assert_allclose(weights, 1.0 / n, atol=0.01)


def test_two_lines_have_two_nodes():
    for width in (1e-9, 1e-3, 5.0):
        for n in (2, 9, 61):
            nodes, weights = Measure(two_lines(width), "power").nodes(n)
            assert (np.abs(nodes[:, None] - [450.0, 620.0]).min(1) <= width).all()
            assert weights[nodes < 535.0].sum() == pytest.approx(1 / 3, abs=0.01)
    assert len(Measure(two_lines(1e-9), "power").nodes(9)[0]) == 2


def test_power_is_of_visible_light_unless_there_is_none():
    assert Measure(built_in("sun"), "power").range == (380.0, 780.0)
    infrared = Spectrum("850 nm", np.array([750.0, 800.0, 850.0, 900.0]), np.array([0.0, 0.01, 1.0, 0.0]))
    assert Measure(infrared, "power").range == (750.0, 900.0)
    with pytest.raises(InputError, match="850 nm: has no power that the eye sees, 400 to 700 nm"):
        Measure(Spectrum("850 nm", np.array([800.0, 900.0]), np.ones(2)))
    with pytest.raises(InputError, match="no visible light"):
        white_point(Spectrum("1 um", np.array([950.0, 1050.0]), np.ones(2)))
    with pytest.raises(InputError, match="the detector must be eye or power, got 'camera'"):
        Measure(built_in("sun"), "camera")


# weights of given wavelengths


@pytest.mark.parametrize("at", [np.linspace(385.0, 775.0, 40), np.array([400.0, 410.0, 700.0]), np.linspace(300.0, 900.0, 500)])
@pytest.mark.parametrize("detector", DETECTORS)
def test_weights_are_those_of_the_nearest_wavelength(at, detector):
    measure = Measure(built_in("led-3000"), detector)
    x, w = fine(measure)
    weights = measure.weights_at(at)
    assert (weights >= 0).all() and weights.sum() == pytest.approx(1.0, abs=1e-12)
    nearest = np.bincount(np.searchsorted(0.5 * (at[1:] + at[:-1]), x), w, len(at))
    np.testing.assert_allclose(weights, nearest, atol=2e-5)


@pytest.mark.parametrize("at", [[500.0, 400.0], [500.0, 500.0], [], [400.0, np.nan], [[400.0, 500.0]]])
def test_wavelengths_that_have_no_weights(at):
    with pytest.raises(InputError, match="ascend"):
        Measure(built_in("sun")).weights_at(np.array(at))


@pytest.mark.parametrize("n", [0, -1, MOST_NODES + 1])
def test_numbers_of_nodes_that_are_refused(n):
    with pytest.raises(InputError, match=f"1 to {MOST_NODES}, got {n}"):
        Measure(built_in("sun")).nodes(n)


# files


def spectrum_of(name, directory=Path()):
    """That of a built-in name, or of a .csv file in a directory, as a project reads it."""
    path = Path(directory) / name
    return parse_spectrum(read_bytes(path, MOST_BYTES, TABLE), str(path)) if path.suffix == ".csv" else built_in(str(name))


def write(folder: Path, text: str | bytes, name: str = "lamp.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


@pytest.mark.parametrize(
    "text",
    [
        "400,1\n500,2\n600,0.5\n",
        "# my lamp\nwavelength (nm),power\n400,1\n500,2 # peak\n\n600,0.5\n",
        "\ufeff400;1\r\n500;2\r\n600;.5",
        "lambda\tS\n400\t1e0\n500\t2\n600\t0.5\n",
    ],
)
def test_files_are_read(tmp_path, text):
    write(tmp_path, text)
    spectrum = spectrum_of("lamp.csv", tmp_path)
    assert spectrum.wavelengths.tolist() == [400.0, 500.0, 600.0] and spectrum.power.tolist() == [1.0, 2.0, 0.5]
    assert spectrum.name == str(tmp_path / "lamp.csv")
    assert spectrum_of(tmp_path / "lamp.csv").power.tolist() == [1.0, 2.0, 0.5]
    scaled = write(tmp_path, "400,1e300\n500,2e299\n", "bright.csv"), write(tmp_path, "400,1e-300\n500,2e-301\n", "dim.csv")
    bright, dim = (Measure(spectrum_of(p)) for p in scaled)
    np.testing.assert_allclose(bright.nodes(5), dim.nodes(5), rtol=1e-9)
    assert luminous_efficacy(bright.spectrum) == pytest.approx(luminous_efficacy(dim.spectrum))


def test_a_name_is_no_file(tmp_path):
    write(tmp_path, "400,1\n500,2\n", "sun.csv")
    assert spectrum_of("sun", tmp_path) is built_in("sun")
    assert spectrum_of("SUN").name == "sun"
    assert len(spectrum_of("sun.csv", tmp_path).power) == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("# nothing\n", "no wavelengths, at least 2"),
        ("nm,power\n400,1\n", "one wavelength, at least 2"),
        ("400,1\n500,-2\n", "line 2 is '500,-2'; finite numbers are needed, and a power of at least 0"),
        ("400,1\n500,nan\n", "line 2 is '500,nan'; finite"),
        ("nan,inf\n500,1\n", "line 1 is 'nan,inf'; finite"),
        ("400,inf\n500,1\n", "line 1 is '400,inf'; finite"),
        ("400,1e999\n500,1\n", "line 1 is '400,1e999'; finite"),
        ("400,1e301\n500,1\n", "at most 1e300"),
        ("500,1\n400,1\n", "ascending wavelengths, each once, got 500 nm and then 400 nm"),
        ("400,1\n500,1\n500,2\n", "ascending wavelengths, each once, got 500 nm twice"),
        ("400,0\n500,0\n", "must have power"),
        ("0.4,1\n0.5,1\n", "wavelengths of 100 to 20000 nm"),
        ("400,1\n1e9,1\n", "wavelengths of 100 to 20000 nm"),
        ("400,1\n500,x\n", "line 2 is '500,x'; a .csv of two columns"),
        ("a,b\nc,d\n400,1\n", "line 2 is 'c,d'; a .csv"),
        ("400,1,2\n500,1,2\n", "line 1 is '400,1,2'; a .csv of two columns"),
        ("400\n500\n", "line 1 is '400'; a .csv of two columns"),
        ("400;0,5\n500;0,6\n", "line 1 is '400;0,5'; a .csv of two columns"),
        (b"\xff\xfe4\x000\x000\x00", "is not text"),
        (bytes(range(256)), "is not text"),
        (b"\0" * 64, "is not text"),
    ],
)
def test_bad_files_are_refused_in_a_line(tmp_path, text, said):
    path = write(tmp_path, text)
    with pytest.raises(InputError) as caught:
        spectrum_of(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and said in message and "\n" not in message and len(message) < 600


def test_files_that_are_none(tmp_path):
    with pytest.raises(InputError, match=r"gone\.csv: no such file; a \.csv of two columns"):
        spectrum_of("gone.csv", tmp_path)
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(InputError, match=r"folder\.csv: is a directory"):
        spectrum_of("folder.csv", tmp_path)
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="is a pipe"):
        spectrum_of("pipe.csv", tmp_path)
    for name in ("x\0.csv", "x" * 300 + ".csv"):
        with pytest.raises(InputError, match="cannot be read"):
            spectrum_of(name, tmp_path)
    with pytest.raises(InputError, match="'daylite' is no spectrum; did you mean daylight"):
        spectrum_of("daylite")
    with pytest.raises(InputError, match=r"'xyzzy' is no spectrum; known are equal, .*or the name of a \.csv file"):
        spectrum_of("xyzzy")
    for name in ("", ".", "observer", "../spectra/sun"):
        with pytest.raises(InputError, match="is no spectrum"):
            spectrum_of(name)


def test_large_files_are_refused_at_once(tmp_path):
    """A million rows within the size that is read, and a file beyond it, which is not read at all."""
    rows = write(tmp_path, "1,1\n" * 1_000_000)
    assert rows.stat().st_size <= MOST_BYTES
    begin = time.process_time()
    with pytest.raises(InputError, match=f"more than {MOST_ROWS:,} wavelengths"):
        spectrum_of(rows)
    with open(tmp_path / "huge.csv", "wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(InputError, match=f"at most {MOST_BYTES:,} are read"):
        spectrum_of("huge.csv", tmp_path)
    with pytest.raises(InputError) as caught:
        spectrum_of(write(tmp_path, "x" * MOST_BYTES + "\n400,y\n", "line.csv"))
    assert len(str(caught.value)) <= 600
    assert time.process_time() - begin < 2.0


def test_a_table_of_the_most_rows(tmp_path):
    at = np.linspace(300.0, 900.0, MOST_ROWS)
    text = "".join(f"{x:.6f},{1 + (k % 7)}\n" for k, x in enumerate(at))
    measure = Measure(spectrum_of(write(tmp_path, text)))
    assert (measure.nodes(9)[1] > 0).all()
    with pytest.raises(InputError, match=f"more than {MOST_ROWS:,}"):
        spectrum_of(write(tmp_path, text + "901,1\n"))
