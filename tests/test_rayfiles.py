"""Ray files: what is written by the description of a format is read back, and hostile ones are refused in one line."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rayfiles import cone_of, lighttools, tm25, zemax

from caustic_cli.errors import InputError
from caustic_cli.io.files import read_bytes
from caustic_cli.io.rayfiles import MAX_BYTES, parse_rays
from caustic_cli.scene.sources.rayset import RaySet

RAYS = cone_of(50, 40.0, (1.0, 0.5))
NM = np.linspace(450.0, 650.0, 50)
WRITERS = {"tm25": tm25, "zemax": zemax, "lighttools": lighttools}


def refused(data: bytes) -> str:
    """The one line of the refusal."""
    with pytest.raises(InputError) as error:
        parse_rays(data, "led.dat")
    message = str(error.value)
    assert message.startswith("led.dat: ") and "\n" not in message
    return message


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize("colored", [False, True])
def test_rays_come_back(form, colored):
    positions, directions, flux = RAYS
    found = parse_rays(WRITERS[form](positions, directions, flux, wavelengths=NM if colored else None), "led")
    assert found.count == 50 and found.unit == "W" and found.total == pytest.approx(1.0)
    np.testing.assert_allclose(found.positions, positions, atol=1e-7)
    np.testing.assert_allclose(found.directions, directions, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(found.flux, flux, rtol=1e-6)
    if colored:
        np.testing.assert_allclose(found.wavelengths, NM, rtol=1e-6)
    else:
        assert found.wavelengths is None


def test_everything_else_a_tm25_file_may_hold():
    table = [(450.0, 10.0), (550.0, 100.0), (650.0, 20.0)]
    data = tm25(*RAYS, tables=(table,), columns=2, text=b"notes".ljust(64, b"\0"), stokes=True)
    found = parse_rays(data, "led")
    np.testing.assert_allclose(found.flux, RAYS[2], rtol=1e-6)
    assert len(data) == 36_288 + 32 + 2 * 512 + 64 + 50 * 15 * 4  # a table of 28 bytes, filled up to 32
    luminous = parse_rays(tm25(*RAYS, unit="lm", total=float("nan")), "led")
    assert luminous.unit == "lm" and luminous.total == pytest.approx(1.0)  # an unknown total is that of the rays
    assert parse_rays(tm25(*RAYS, spectrum=1, single=630.0), "led").wavelengths.tolist() == [630.0] * 50


@pytest.mark.parametrize(("length", "mm"), [(0, 1000.0), (1, 25.4), (2, 10.0), (3, 304.8), (4, 1.0)])
def test_units_of_length_of_zemax(length, mm):
    found = parse_rays(zemax(*RAYS, length=length), "led")
    np.testing.assert_allclose(found.positions, mm * RAYS[0], rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize(("unit", "mm"), [("millimeters", 1.0), ("Inches", 25.4), ("CENTIMETERS", 10.0), ("m", 1000.0)])
def test_units_of_length_of_lighttools(unit, mm):
    found = parse_rays(lighttools(*RAYS, length_units=unit), "led")
    np.testing.assert_allclose(found.positions, mm * RAYS[0], rtol=1e-6, atol=1e-6)


def test_ways_of_writing_text():
    for options in ({"end": "\r\n"}, {"closing": False}):
        assert parse_rays(lighttools(*RAYS, **options), "led").count == 50
    data = lighttools(*RAYS)
    assert parse_rays(data.replace(b"lt_", b"LT_").replace(b"  ", b"\t"), "led").count == 50
    assert parse_rays(data.replace(b"lt_endofdata", b"# the end\n\nlt_endofdata\n\n"), "led").count == 50
    luminous = lighttools(*RAYS, datatype="luminous_flux", luminous_flux="120")
    assert (parse_rays(luminous, "led").unit, parse_rays(luminous, "led").total) == ("lm", 120.0)


@pytest.mark.parametrize("form", WRITERS)
@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda p, d, f: (np.where(np.arange(50)[:, None] == 6, np.nan, p), d, f), "ray 7 of 50 has a position"),
        (lambda p, d, f: (np.where(np.arange(50)[:, None] == 6, 1e30, p), d, f), "ray 7 of 50 has a position"),
        (lambda p, d, f: (p, 0.0 * d, f), "ray 1 of 50 has a direction"),
        (lambda p, d, f: (p, np.where(np.arange(50)[:, None] == 2, np.inf, d), f), "ray 3 of 50 has a direction"),
        (lambda p, d, f: (p, d, -f), "ray 1 of 50 has a flux that is negative"),
        (lambda p, d, f: (p, d, np.where(np.arange(50) == 1, np.nan, f)), "ray 2 of 50 has a flux"),
        (lambda p, d, f: (p, d, 0.0 * f), "holds no light"),
        (lambda p, d, f: (p[:0], d[:0], f[:0]), "holds no rays"),
    ],
)
def test_rays_that_are_none(form, what, message):
    options = {"radiant_flux": "1"} if form == "lighttools" else {"total": 1.0}
    assert message in refused(WRITERS[form](*what(*RAYS), **options))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (tm25(*RAYS)[:-3], "is 37,685 bytes, but its header and 50 rays of 7 columns are 37,688"),
        (tm25(*RAYS) + b"\0", "is 37,689 bytes"),
        (tm25(*RAYS)[:1000], "is cut off"),
        (tm25(*RAYS, count=2**64 - 1), "bytes, but its header and 18,446,744,073,709,551,615 rays"),
        (tm25(*RAYS, count=0), "holds no rays"),
        (tm25(*RAYS, version=2099), "version 2099; 2013 and 2020 are read"),
        (tm25(*RAYS, order=">"), "big-endian"),
        (tm25(*RAYS, flags=(1, 1, 0, 0, 0, 0, 0, 0)), "neither radiant nor luminous flux"),
        (tm25(*RAYS, flags=(1, 0, 1, 0, 0, 0, 0, 0)), "without position or direction"),
        (tm25(*RAYS, flags=(1, 1, 9, 0, 0, 0, 0, 0)), "radiant flux flag of 9"),
        (tm25(*RAYS, flags=(1, 1, 1, 1, 0, 0, 0, 0)), "50 rays of 8 columns"),
        (tm25(*RAYS, spectrum=2), "has no column for it"),
        (tm25(*RAYS, spectrum=7), "spectral data identifier of 7"),
        (tm25(*RAYS, spectrum=1, single=-3.0), "a single wavelength of -3 nm"),
        (tm25(*RAYS, wavelengths=0 * NM), "ray 1 of 50 has a wavelength"),
        (tm25(*RAYS)[:76] + struct.pack("<i", -1) + tm25(*RAYS)[80:], "counts -1 spectral tables"),
        (tm25(*RAYS)[:76] + struct.pack("<i", 2**31 - 1) + tm25(*RAYS)[80:], "at most 10,000"),
        (tm25(*RAYS)[:76] + struct.pack("<i", 9_999) + tm25(*RAYS)[80:], "spectral table"),
        (tm25(*RAYS)[:80] + struct.pack("<ii", 2**31 - 1, 2**31 - 1) + tm25(*RAYS)[88:], "50 rays of 2147483654 columns"),
        (zemax(*RAYS)[:-1], "is 1,607 bytes, but its header and 50 rays of 7 columns are 1,608"),
        (zemax(*RAYS)[:100], "is cut off: the header of a Zemax source file is 208 bytes, the file 100"),
        (zemax(*RAYS, count=2**32 - 1), "4,294,967,295 rays"),
        (zemax(*RAYS, count=0), "holds no rays"),
        (zemax(*RAYS, order=">"), "big-endian"),
        (zemax(*RAYS, length=5), "unit of length 5"),
        (zemax(*RAYS, form=1), "ray format 1"),
        (zemax(*RAYS, form=2), "50 rays of 8 columns"),
        (zemax(*RAYS, luminous=3), "flux type 3"),
        (zemax(*RAYS, wavelengths=NM, luminous=1), "flux type 1 with ray format 2"),
        (lighttools(*RAYS, length_units="furlongs"), "lt_length_units 'furlongs'"),
        (lighttools(*RAYS, datatype="heat"), "lt_datatype 'heat'"),
        (lighttools(*RAYS, far_field_data="YES"), "far-field"),
        (lighttools(*RAYS, data_origin="0 0 1"), "lt_data_origin"),
        (lighttools(*RAYS, color_info="rainbow"), "lt_color_info 'rainbow'"),
        (lighttools(*RAYS, color_info="wavelength"), "has 7 columns in its first ray; 8 to 24 are needed"),
        (lighttools(*RAYS, radiant_flux="much"), "lt_radiant_flux 'much'"),
        (lighttools(*RAYS).replace(b"lt_startofdata", b"lt_start"), "no line lt_startofdata"),
        (lighttools(*RAYS).replace(b"lt_endofdata", b"1 2 3\nlt_endofdata"), "not 7 numbers in a line"),
        (lighttools(*RAYS).replace(b"lt_endofdata", b"1 2 3 4 5 six 7\nlt_endofdata"), "not 7 numbers in a line"),
        (lighttools(*RAYS).replace(b"lt_endofdata", b"lt_endofdata\n1 2 3 4 5 6 7\n" * 60), "not 7 numbers in a line"),
        (b"lt_startofdata", "holds no rays"),
        (b"\x89PNG\r\n\x1a\n", "is not a ray file that can be read; a ray file is needed: IES TM-25"),
        (b"TM26" + tm25(*RAYS)[4:], "is not a ray file"),
        (b"", "is not a ray file"),
        (b"\0" * 50_000, "is not a ray file"),
    ],
)
def test_hostile_files(data, message):
    assert message in refused(data)


@given(st.integers(0, 36_400), st.binary(min_size=1, max_size=8), st.sampled_from(sorted(WRITERS)))
def test_no_byte_makes_it_stumble(at, bytes_, form):
    """Whatever is written over a file, it is read or refused in one line."""
    data = WRITERS[form](*cone_of(4, 30.0))
    at %= len(data)
    try:
        found = parse_rays(data[:at] + bytes_ + data[at + len(bytes_) :], "led")
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert np.isfinite(found.positions).all() and found.flux.sum() > 0


def test_files_that_are_none(tmp_path):
    for path, message in ((tmp_path, "is a directory"), (tmp_path / "none.dat", "no such file"), ("\0", "cannot be read")):
        with pytest.raises(InputError, match=message):
            read_bytes(tmp_path / path, MAX_BYTES, "a ray file is needed")
    (tmp_path / "empty.dat").touch()
    with pytest.raises(InputError, match="is empty"):
        read_bytes(tmp_path / "empty.dat", MAX_BYTES, "a ray file is needed")
    (tmp_path / "large.dat").write_bytes(bytes(11))
    with pytest.raises(InputError, match="is 11 bytes; at most 10 are read"):
        read_bytes(tmp_path / "large.dat", 10, "a ray file is needed")


def test_where_a_source_is_and_how_large():
    positions, directions, flux = cone_of(100_000, 60.0, (3.0, 1.0), lambertian=True)
    found = RaySet(positions + np.array([1.0, -2.0, 5.0]), directions, flux)
    assert found.focus == pytest.approx((1.0, -2.0, 5.0), abs=0.02)
    assert found.spread == pytest.approx((1.5, 0.5), rel=0.02)
    on_sphere = RaySet(positions + 20.0 * directions, directions, flux)  # rays recorded away from where they come from
    assert on_sphere.focus == pytest.approx((0.0, 0.0, 0.0), abs=0.02) and on_sphere.nearest == pytest.approx(20.0, abs=0.1)
    assert on_sphere.spread == pytest.approx((1.5, 0.5), rel=0.02)


def test_rays_that_go_back_do_not_shine():
    positions, directions, flux = cone_of(1000, 30.0)
    both = RaySet(np.concatenate([positions, positions + 3.0]), np.concatenate([directions, -directions]), np.tile(flux, 2))
    assert both.nearest == 0.0 and both.focus == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert both.forward.sum() == pytest.approx(1.0)
    with pytest.raises(InputError, match="no ray that carries light towards"):
        _ = RaySet(positions, -directions, flux).focus


def test_parallel_rays_meet_far_behind_where_they_start():
    positions = np.random.default_rng(0).uniform(-5, 5, (1000, 3))
    found = RaySet(positions, np.tile([0.0, 0.0, 1.0], (1000, 1)), np.ones(1000))
    assert found.focus[2] == pytest.approx(-1e6, rel=1e-5)
    assert np.allclose(found.focus[:2], positions[:, :2].mean(0), atol=1e-6)
