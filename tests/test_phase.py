"""The phase of a lens, written for a modulator or a diffractive plate."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from caustic_cli.errors import InputError
from caustic_cli.export.phase import LEVELS, companions, phase_of, write_phase
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.scene import Lens, Light, Offset, Points, Scene, Screen
from caustic_cli.scene.sources.gaussian import Gaussian

NM = 1064.0


def lens_of(source, height=lambda x, y: -(x * x) / 800.0 + 0.0 * y) -> tuple[Scene, HeightField, torch.Tensor]:
    lens = Lens((4.0, 3.0), control=(12, 12), index=1.5, fresnel="none", offset=Offset(1.0), min_thickness=0.5)
    field = HeightField.of(lens)
    x, y = field.control_xy()
    a, b = (torch.linalg.inv(s.matrix(s.greville)) for s in field.spaces)
    heights = a @ (1.0 + height(x[:, None], y[None, :])) @ b.T
    return Scene(source, lens, Screen((8.0, 8.0), 500.0, (16, 16)), Light(wavelengths=(NM,))), field, heights


@pytest.mark.parametrize("source", [Gaussian((1.0, 1.0), NM), Gaussian((1.0, 1.0), NM, 400.0), Points(((0.0, 0.0, -300.0),))])
def test_it_is_what_the_lens_adds_to_the_light(source):
    """(n - 1) h 2 pi / lambda, whatever the light; half a radian of hundreds, since rays cross 1 mm of glass on their way."""
    phase = phase_of(*lens_of(source), (60, 40))
    x = (np.arange(60) + 0.5) / 15.0 - 2.0
    expected = -0.5 * x**2 / 800.0 * 2.0 * math.pi / (1e-6 * NM)
    at = phase[:, 20] - phase[30, 20]
    slack = 0.05 if isinstance(source, Gaussian) else 0.5
    assert np.abs(at - expected + expected[30]).max() < slack * 1.5 and np.ptp(expected) > 14.0


def test_files_hold_it(tmp_path):
    path, lens = tmp_path / "beam.phase.png", lens_of(Gaussian((1.0, 1.0), NM), lambda x, y: (x + 0.3 * y) / 900.0)
    write_phase(path, *lens, (300, 200))
    array, said, relief = companions(path)
    wrapped, about = np.load(array), json.loads(said.read_text())
    assert wrapped.shape == (300, 200) and wrapped.min() >= 0.0 and wrapped.max() < 2.0 * math.pi
    assert np.exp(1j * wrapped) == pytest.approx(np.exp(1j * phase_of(*lens, (300, 200))))
    with Image.open(path) as picture:
        levels = np.asarray(picture).astype(float)[::-1].T
    apart = (levels * (2.0 * math.pi / LEVELS) - wrapped + math.pi) % (2.0 * math.pi) - math.pi
    assert picture.mode == "I;16" and np.abs(apart).max() <= math.pi / LEVELS * 1.001
    assert about["pixel_pitch_mm"] == pytest.approx([4.0 / 300, 3.0 / 200]) and about["wavelength_nm"] == NM
    assert about["levels"] == LEVELS and about["largest_step_rad"] == pytest.approx(np.abs(np.diff(wrapped[:2, 0]))[0], rel=0.5)
    data = relief.read_bytes()
    corners = np.frombuffer(data[84:], np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))["c"]
    z = corners[..., 2]
    assert z.max() - 0.5 == pytest.approx(1e-6 * NM / 0.5, rel=0.02)  # lambda / (n - 1) on the least thickness
    edges = np.sort(np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3), 1)
    pairs = np.concatenate([edges[:, [0, 1]], edges[:, [1, 2]], edges[:, [0, 2]]])
    assert (np.unique(pairs, axis=0, return_counts=True)[1] == 2).all()  # closed


def test_levels_are_the_nearest_phases(tmp_path):
    """Four steps; of a linear phase 0.81 of the light goes to its order, sinc^2(1 / 4), as the far field of the file says."""
    path, lens = tmp_path / "beam.phase.png", lens_of(Gaussian((1.0, 1.0), NM), lambda x, y: (x + 0.0 * y) / 150.0)
    write_phase(path, *lens, (2000, 8), levels=4)
    wrapped, whole = np.load(companions(path)[0]), phase_of(*lens, (2000, 8))
    assert set(np.unique(wrapped / (0.5 * math.pi)).round(9)) == {0.0, 1.0, 2.0, 3.0}
    assert np.abs(np.angle(np.exp(1j * (wrapped - whole)))).max() <= 0.25 * math.pi * 1.001
    assert np.abs(np.exp(1j * (wrapped - whole)).mean()) ** 2 == pytest.approx(np.sinc(0.25) ** 2, rel=1e-2)
    with Image.open(path) as picture:
        assert set(np.unique(np.asarray(picture))) == {0, LEVELS // 4, LEVELS // 2, 3 * LEVELS // 4}
    assert json.loads(companions(path)[1].read_text())["levels"] == 4
    with pytest.raises(InputError, match="levels"):
        write_phase(path, *lens, (20, 8), levels=1)


def test_that_of_a_picture_in_the_far_field_is_the_same():
    scene, field, heights = lens_of(Gaussian((1.0, 1.0), NM))
    far = replace(scene, screen=replace(scene.screen, z=1000.0, far=True))
    near = replace(scene, screen=replace(scene.screen, z=1000.0))
    assert phase_of(far, field, heights, (30, 20)) == pytest.approx(phase_of(near, field, heights, (30, 20)), abs=1e-6)


def test_by_default_it_is_resolved_and_too_many_pixels_are_refused():
    steep = lens_of(Gaussian((1.0, 1.0), NM), lambda x, y: x * x / 15.0 + 0.0 * y)
    phase = phase_of(*steep)
    assert phase.shape[0] > 512 == phase.shape[1] and np.abs(np.diff(phase, axis=0)).max() < math.pi
    with pytest.raises(InputError, match="samples"):
        phase_of(*steep, (9000, 10))
