"""Photometric files: symmetry, intensities between their angles, a second reader, and targets of lamps."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from caustic_cli import cli
from caustic_cli.errors import InputError
from caustic_cli.inverse.lamp import directions_of, pixels_of
from caustic_cli.io.photometry import Photometry, read_photometry, write_ies, write_ldt
from caustic_cli.project.photometric_target import PIXELS, angles_of, as_means, divided, edges_of, picture_of, refined
from caustic_cli.scene.lamp import Goal

PLANES, ANGLES = 15.0 * np.arange(24), 5.0 * np.arange(37)


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def light_of(intensity, planes=PLANES, angles=ANGLES):
    """A file whose intensity is a function of C and gamma, degrees."""
    plane, gamma = np.meshgrid(planes, angles, indexing="ij")
    return Photometry(planes, angles, intensity(plane, gamma), 1000.0, "test")


def lopsided(plane, gamma):
    """No symmetry at all."""
    return (300.0 + 50.0 * np.cos(np.radians(plane - 40.0)) + 20.0 * np.sin(np.radians(2.0 * plane))) * np.exp(
        -((gamma / 40.0) ** 2)
    )


#: Symmetry Isym: an intensity that has it.
SYMMETRIC = {
    1: lambda plane, gamma: 200.0 * np.exp(-((gamma / 30.0) ** 2)) + 0.0 * plane,
    2: lambda plane, gamma: (200.0 + 90.0 * np.cos(np.radians(plane))) * np.exp(-((gamma / 30.0) ** 2)),
    3: lambda plane, gamma: (200.0 + 90.0 * np.sin(np.radians(plane))) * np.exp(-((gamma / 30.0) ** 2)),
    4: lambda plane, gamma: (200.0 + 90.0 * np.cos(np.radians(2.0 * plane))) * np.exp(-((gamma / 30.0) ** 2)),
}
STORED = {1: [0.0], 2: PLANES[:13], 3: PLANES[6:19], 4: PLANES[:7]}


def directions(count=500):
    """Unit vectors (N, 3) of the whole sphere."""
    found = np.random.default_rng(3).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


# Reading


@pytest.mark.parametrize("symmetry", SYMMETRIC)
def test_eulumdat_of_any_symmetry_is_read_as_all_planes(symmetry):
    whole = light_of(SYMMETRIC[symmetry])
    write_ldt(Path("whole.ldt"), whole)
    lines = Path("whole.ldt").read_text("latin-1").splitlines()
    rows = np.array(lines[42 + 24 + 37 :]).reshape(24, 37)
    rows = rows[[*range(18, 24), *range(7)]] if symmetry == 3 else rows[np.isin(PLANES, STORED[symmetry])]  # from C 270 to 90
    lines[2] = f"{symmetry}"
    Path("part.ldt").write_text("\r\n".join([*lines[: 42 + 24 + 37], *rows.reshape(-1), ""]), "latin-1")
    part = read_photometry(Path("part.ldt"))
    assert part.planes.tolist() == PLANES.tolist()
    np.testing.assert_allclose(part.values, whole.values, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("symmetry", SYMMETRIC)
def test_lm_63_of_any_symmetry_is_read_as_all_planes(symmetry):
    whole = light_of(SYMMETRIC[symmetry])
    stored = np.isin(PLANES, STORED[symmetry])
    head = f"IES:LM-63-2019\n[LUMINAIRE] half\nTILT=NONE\n1 1000 1 37 {stored.sum()} 1 2 0 0 0\n1 1 0\n"
    body = [ANGLES, PLANES[stored], *whole.values[stored]]
    Path("part.ies").write_text(head + "\n".join(" ".join(map(str, row)) for row in body) + "\n")
    part = read_photometry(Path("part.ies"))
    assert part.planes.tolist() == (PLANES.tolist() if symmetry > 1 else [0.0, 90.0, 180.0, 270.0])
    d = directions()
    np.testing.assert_allclose(part.intensity(d), whole.intensity(d), rtol=1e-6, atol=1e-6)


def test_absolute_photometry_has_the_lumens_of_its_light():
    Path("a.ies").write_text("IES:LM-63-2019\nTILT=NONE\n1 -1 1 3 1 1 2 0 0 0\n1 1 0\n0 90 180\n0\n10 10 10\n")
    assert read_photometry(Path("a.ies")).lumens == pytest.approx(40.0 * np.pi, rel=1e-9)


def test_intensities_are_those_of_the_angles_and_linear_between():
    light = light_of(lopsided)
    plane, gamma = np.radians(np.array([30.0, 345.0, 352.5, 37.5])), np.radians(np.array([20.0, 90.0, 10.0, 12.5]))
    d = np.stack([np.sin(gamma) * np.cos(plane), np.sin(gamma) * np.sin(plane), np.cos(gamma)], 1)
    v = light.values
    wanted = [v[2, 4], v[23, 18], 0.5 * (v[23, 2] + v[0, 2]), 0.25 * (v[2, 2] + v[2, 3] + v[3, 2] + v[3, 3])]
    np.testing.assert_allclose(light.intensity(d), wanted, rtol=1e-9)
    half = light._replace(angles=ANGLES[:19], values=light.values[:, :19])
    assert half.intensity(np.array([[0.0, 0.0, -1.0]])) == 0.0


def test_another_program_reads_and_writes_the_same():
    """Only where eulumdat-py is installed."""
    pyldt = pytest.importorskip("pyldt", exc_type=ImportError)
    light = light_of(lopsided)
    write_ldt(Path("a.ldt"), light)
    read = pyldt.LdtReader.read("a.ldt")
    np.testing.assert_allclose(np.array(read.intensities), light.values, rtol=1e-6, atol=1e-6)
    assert read.header.lamp_flux == [1000.0] and read.header.isym == 0
    for symmetry, intensity in SYMMETRIC.items():
        read.intensities, read.header.isym = light_of(intensity).values.tolist(), symmetry
        pyldt.LdtWriter.write(read, f"{symmetry}.ldt")
        np.testing.assert_allclose(read_photometry(Path(f"{symmetry}.ldt")).values, light_of(intensity).values, atol=0.2)


def test_another_program_reads_the_same_of_lm_63():
    """Only where eulumdat-ies is installed: in candela per 1000 lm, over C 0 to 345 and gamma."""
    reader = pytest.importorskip("eulumdat_ies", exc_type=ImportError)
    light = light_of(lopsided)._replace(lumens=2500.0)
    write_ies(Path("a.ies"), light)
    read = reader.ies_to_ldt(Path("a.ies"))
    np.testing.assert_allclose(np.array(read.intensities) * 2.5, light.values, rtol=1e-6, atol=1e-5)
    assert read.header.g_angles == ANGLES.tolist() and read.header.lamp_flux == [2500.0]


def strictly_lm63(text):
    """Planes, angles and intensities of a file of LM-63-2019, by the clauses of the standard and nothing but them."""
    assert text.isascii() and text.endswith("\r\n") and "\n" not in text.replace("\r\n", "")
    lines = text.split("\r\n")[:-1]
    assert lines[0] == "IES:LM-63-2019" and all(len(line) <= 256 for line in lines)
    tilt = lines.index("TILT=NONE")
    keywords = [re.fullmatch(r"\[([A-Z0-9_]+)\] ?(.*)", line) for line in lines[1:tilt]]
    assert all(keywords) and {"TEST", "TESTLAB", "ISSUEDATE", "MANUFAC"} <= {found[1] for found in keywords}
    lamps, lumens, factor, vertical, horizontal, kind, unit, *size = lines[tilt + 1].split()
    assert (lamps, kind) == ("1", "1") and unit in "12" and len(size) == 3 and float(lumens) > 0
    ballast, file_type, watts = lines[tilt + 2].split()
    assert float(ballast) == 1.0 and float(watts) >= 0 and re.fullmatch(r"1\.[01]{5}", file_type)  # 4.1.2: how it was made
    numbers = [float(word) for line in lines[tilt + 3 :] for word in line.split()]
    n, m = int(vertical), int(horizontal)
    gamma, plane, values = np.split(np.array(numbers), [n, n + m])
    assert len(values) == n * m and (np.diff(gamma) > 0).all() and (np.diff(plane) > 0).all()
    assert gamma[0] in (0.0, 90.0) and gamma[-1] in (90.0, 180.0) and plane[0] == 0.0 and plane[-1] in (0.0, 90.0, 180.0, 360.0)
    return plane, gamma, float(factor) * values.reshape(m, n), float(lumens)


def strictly_eulumdat(text):
    """The same of EULUMDAT, with the widths of its fields, of a file without symmetry and with one set of lamps."""
    lines = text.split("\r\n")[:-1]
    widths = [78, 1, 1, 2, 5, 2, 5, 78, 78, 78, 8, 78, *[4] * 7, *[4] * 4, 1, 6, 6]
    assert all(len(line) <= most for line, most in zip(lines, widths, strict=False) if not line.replace(".", "").isdigit())
    m, step, n, fine = int(lines[3]), float(lines[4]), int(lines[5]), float(lines[6])
    assert lines[1:3] == ["3", "0"] and m * step == 360.0 and (n - 1) * fine == 180.0 and lines[25] == "1"
    assert len(lines) == 42 + m + n + m * n and all(len(line) <= 12 for line in lines[32:])
    numbers = np.array([float(line) for line in lines[42:]])
    plane, gamma, values = np.split(numbers, [m, m + n])
    np.testing.assert_allclose(plane, step * np.arange(m))
    np.testing.assert_allclose(gamma, fine * np.arange(n))
    lumens = float(lines[28])
    return plane, gamma, values.reshape(m, n) * lumens / 1000.0, float(lines[22]), lumens


def test_files_are_of_their_formats_to_the_letter():
    """By readers that know the formats, not what writes them, and keep nothing that these do not have."""
    light = light_of(lopsided)._replace(lumens=2500.0, name="a lamp", diameter=30.0, height=12.5)
    write_ies(Path("a.ies"), light)
    write_ldt(Path("a.ldt"), light)
    plane, gamma, values, lumens = strictly_lm63(Path("a.ies").read_bytes().decode("ascii"))
    np.testing.assert_allclose(values, np.concatenate([light.values, light.values[:1]]), rtol=1e-6, atol=1e-5)
    assert lumens == 2500.0 and plane.tolist() == [*PLANES, 360.0] and gamma.tolist() == ANGLES.tolist()
    _, _, values, ratio, lumens = strictly_eulumdat(Path("a.ldt").read_bytes().decode("latin-1"))
    np.testing.assert_allclose(values, light.values, rtol=1e-6, atol=1e-5)
    fine = np.linspace(0.0, np.pi, 20_001)  # light output ratio: the flux by the trapezoidal rule over that of the lamps
    over = np.interp(fine, np.radians(ANGLES), light.values.mean(0)) * np.sin(fine)
    flux = 2.0 * np.pi * float(0.5 * (over[1:] + over[:-1]).sum() * (fine[1] - fine[0]))
    assert lumens == 2500.0 and ratio == pytest.approx(100.0 * flux / lumens, rel=5e-3)


# Targets


def test_the_angles_of_a_target_hold_all_light():
    def box(plane, gamma):
        d = np.sin(np.radians(gamma)) * np.cos(np.radians(plane)), np.sin(np.radians(gamma)) * np.sin(np.radians(plane))
        x, y, z = *d, np.cos(np.radians(gamma))
        return 1.0 * ((z > 0) & (np.abs(np.degrees(np.arctan2(x, z))) <= 50.0) & (np.abs(np.degrees(np.arcsin(y))) <= 20.0))

    width, height = angles_of(light_of(box, 5.0 * np.arange(72), np.arange(181.0)))
    assert 100.0 <= width <= 104.0 and 40.0 <= height <= 44.0  # its edges lie within a step beyond
    with pytest.raises(InputError, match="no light within 90 degrees"):
        angles_of(light_of(lambda plane, gamma: 1.0 * (gamma > 100.0) + 0.0 * plane))
    assert max(angles_of(light_of(lambda plane, gamma: 1.0 + 0.0 * plane * gamma))) == 178.0


FINELY = 5.0 * np.arange(72), np.arange(181.0)


def counted(intensity, fine=8):
    """A file of the means over cells of an intensity at points of a grid (C, gamma)."""
    at = [(np.arange(len(a) * fine) + 0.5) / fine * a[1] - 0.5 * a[1] for a in FINELY]
    plane, gamma = np.meshgrid(*at, indexing="ij")
    weight = np.abs(np.sin(np.radians(gamma)))
    power, area = (c.reshape(72, fine, 181, fine).sum((1, 3)) for c in (intensity(plane, gamma) * weight, weight))
    return Photometry(*FINELY, power / area, 1000.0, "test")


def rectangle(plane, gamma):
    """120 x 40 degrees with sharp edges."""
    x, y = (np.sin(np.radians(gamma)) * trig(np.radians(plane)) for trig in (np.cos, np.sin))
    longitude, latitude = np.degrees(np.arctan2(x, np.cos(np.radians(gamma)))), np.degrees(np.arcsin(y))
    return 1.0 * ((np.abs(longitude) < 60.0) & (np.abs(latitude) < 20.0))


def test_the_values_of_a_file_are_means_over_its_cells():
    """Of a file of the means of a rectangle with sharp edges, counted in cells, and of a smooth one."""
    goal = Goal((124.0, 46.0))
    for wanted, most in ((rectangle, 0.015), (lambda plane, gamma: 1.0 + np.cos(np.radians(2.0 * gamma)) + 0.0 * plane, 0.005)):
        light = counted(wanted)
        picture = picture_of(light, goal)
        i, j = np.mgrid[:72, :181]
        seen = np.zeros((72, 181))
        pixels = [4 * n for n in picture.shape]
        d = directions_of(goal, tuple(pixels)).numpy()
        gamma, plane = np.degrees(np.arccos(d[:, 2])), np.degrees(np.arctan2(d[:, 1], d[:, 0])) % 360.0
        cosine = np.cos(np.arcsin(d[:, 1]))
        cell = (np.round(plane / 5.0).astype(int) % 72, np.round(gamma).astype(int))
        np.add.at(seen, cell, picture.repeat(4, 0).repeat(4, 1).reshape(-1) * cosine)
        full = np.zeros((72, 181))
        np.add.at(full, cell, cosine)
        known = (full > 0.8 * full.max(0)) & (j > 3) & (j < 60) & (i % 18 != 0)  # cells that lie on the target
        error = (seen / full.clip(1e-9) - light.values)[known]
        assert float(np.sqrt((error**2).mean() / (light.values[known] ** 2).mean())) < most


def test_sharp_edges_run_within_the_cells_of_a_file():
    """Light in wrong places of a picture, which is 4.2 % of all with steps at the borders of cells; and what is smooth is left."""
    goal = Goal((124.0, 46.0))
    found = picture_of(counted(rectangle), goal)
    d = directions_of(goal, found.shape).numpy()
    plane, gamma = np.degrees(np.arctan2(d[:, 1], d[:, 0])), np.degrees(np.arccos(d[:, 2]))
    wanted = rectangle(plane, gamma).reshape(found.shape)
    assert np.abs(found - wanted).sum() < 0.015 * wanted.sum()
    cone = counted(lambda plane, gamma: 1.0 * (gamma < 30.3) + 0.0 * plane)
    finely = as_means(cone)
    assert np.ptp(finely.values, axis=0).max() < 1e-9  # the same in all planes
    at = float(np.interp(-0.5, -finely.values[0], finely.angles))
    assert at == pytest.approx(30.3, abs=0.1)
    smooth = counted(lambda plane, gamma: np.exp(-((gamma / 40.0) ** 4)) * (2.0 + np.cos(np.radians(plane))))
    finely = refined(smooth)
    assert np.array_equal(divided(finely, smooth.values).values, finely.values)


def test_pictures_are_intensities_far_away_and_irradiance_on_a_plane():
    light = light_of(lopsided, 5.0 * np.arange(72), np.arange(181.0))
    far, near = Goal((100.0, 60.0)), Goal((4000.0, 2000.0), 2000.0)
    for goal in (far, near):
        found = picture_of(light, goal)
        d = directions_of(goal, pixels_of(goal, PIXELS)).numpy()
        plane, gamma = np.degrees(np.arctan2(d[:, 1], d[:, 0])), np.degrees(np.arccos(d[:, 2]))
        wanted = lopsided(plane, gamma) * (1.0 if goal is far else d[:, 2] ** 3)
        np.testing.assert_allclose(found.reshape(-1), wanted, rtol=3e-3, atol=0.05)
    with pytest.raises(InputError, match="no light on the target"):
        picture_of(light._replace(values=0.0 * light.values), far)


@pytest.mark.parametrize("write", [write_ies, write_ldt])
def test_a_lamp_throws_the_light_of_a_file(write, capfd):
    name = {write_ies: "goal.ies", write_ldt: "goal.ldt"}[write]
    light = light_of(
        lambda plane, gamma: 300.0 * (1.0 + 0.6 * np.cos(np.radians(plane))) * np.exp(-((gamma / 45.0) ** 4)),
        5.0 * np.arange(72),
        np.arange(181.0),
    )
    write(Path(name), light)
    assert cli.run(["design", name, "--lamp", "15", "--lamp-inner", "3", "-o", "far", "--json", "--quiet"]) == 0
    figures = json.loads(capfd.readouterr().out)
    assert figures["uniformity"] is None and figures["interior_rms"] < 0.6
    assert cli.run(["export", "far", "--format", "ldt", "--quiet"]) == 0
    d = directions(4000)
    d = d[d[:, 2] > 0.2]
    one, other = (np.stack(read.intensity(d)) for read in (light, read_photometry(Path("far.ldt"))))
    turned = read_photometry(Path("far.ldt")).intensity(d * [-1.0, 1.0, 1.0])
    assert np.corrcoef(one, other)[0, 1] > 0.9 > np.corrcoef(one, turned)[0, 1] + 0.1
    text = Path("far/project.toml").read_text()
    assert "angles = [" in text and torch.from_numpy(np.load("far/target.npy")).min() >= 0.0


def test_a_file_with_sharp_edges_says_that_they_are_lost(capfd):
    planes, angles = 5.0 * np.arange(72), np.arange(181.0)
    smooth = light_of(lambda plane, gamma: 300.0 * np.exp(-((gamma / 45.0) ** 8)) + 0.0 * plane, planes, angles)
    assert edges_of(smooth) == "" != edges_of(smooth._replace(angles=10.0 * np.arange(19.0), values=smooth.values[:, ::10]))
    write_ldt(Path("sharp.ldt"), light_of(lambda plane, gamma: 300.0 * (gamma < 40.2) + 0.0 * plane, planes, angles))
    assert cli.run(["design", "sharp.ldt", "--lamp", "15", "--lamp-inner", "30", "-o", "far.caustic"]) == 2
    line, _ = capfd.readouterr().err.splitlines()
    assert "sharp.ldt: has sharp edges, within one of its steps of 1 degrees" in line and "--angles" in line


def test_photometric_targets_are_refused_in_one_line(capfd):
    write_ldt(Path("a.ldt"), light_of(lopsided))
    Path("bad.ies").write_text("IES:LM-63-2019\nTILT=NONE\n1 x\n")
    Path("dark.ldt").write_bytes(Path("a.ldt").read_bytes())
    write_ldt(Path("dark.ldt"), light_of(lambda plane, gamma: 0.0 * plane * gamma))
    for arguments, words in (
        (["a.ldt"], "--lamp is needed"),
        (["bad.ies", "--lamp", "15"], "damaged"),
        (["dark.ldt", "--lamp", "15"], "no light within 90 degrees"),
        (["none.ldt", "--lamp", "15"], "none.ldt"),
    ):
        assert cli.run(["design", *arguments, "--quiet"]) == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert words in line
    assert not list(Path().glob("*.caustic"))
