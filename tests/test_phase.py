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
from caustic_cli.scene import Component, FoldMirror, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.several import Several

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
    array, said, relief = companions(path, lens[0])
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
    wrapped, whole = np.load(companions(path, lens[0])[0]), phase_of(*lens, (2000, 8))
    assert set(np.unique(wrapped / (0.5 * math.pi)).round(9)) == {0.0, 1.0, 2.0, 3.0}
    assert np.abs(np.angle(np.exp(1j * (wrapped - whole)))).max() <= 0.25 * math.pi * 1.001
    assert np.abs(np.exp(1j * (wrapped - whole)).mean()) ** 2 == pytest.approx(np.sinc(0.25) ** 2, rel=1e-2)
    with Image.open(path) as picture:
        assert set(np.unique(np.asarray(picture))) == {0, LEVELS // 4, LEVELS // 2, 3 * LEVELS // 4}
    assert json.loads(companions(path, lens[0])[1].read_text())["levels"] == 4
    with pytest.raises(InputError, match="levels"):
        write_phase(path, *lens, (20, 8), levels=1)


BEHIND = Component(20.0, (6.0, 6.0), radius=(40.0, math.inf), index=1.6)
FOLD = FoldMirror(60.0, (20.0, 20.0), tilt=(45.0, 0.0))


@pytest.mark.parametrize(
    "changed",
    [
        lambda s: replace(s, screen=replace(s.screen, z=1000.0, far=True)),
        lambda s: replace(s, screen=replace(s.screen, z=70.0)),
        lambda s: replace(s, screen=replace(s.screen, radius=(30.0, 30.0), tilt=(20.0, 5.0))),
        lambda s: replace(s, elements=(BEHIND,)),
        lambda s: replace(s, elements=(FOLD,)),
        lambda s: replace(s, elements=(BEHIND, FOLD)),
    ],
)
def test_what_is_behind_the_lens_does_not_matter(changed):
    """Far field, curved screens, other lenses, and mirrors that fold the axis."""
    scene, field, heights = lens_of(Gaussian((1.0, 1.0), NM))
    alone = phase_of(scene, field, heights, (30, 20))
    assert phase_of(changed(scene), field, heights, (30, 20)) == pytest.approx(alone, abs=1e-9)


def test_of_light_at_an_angle_it_is_where_the_surface_is():
    """A bump delays light at 20 degrees by its height times n cos i' - cos i, right at its place, wherever the screen is."""
    at, tilt = 0.6, math.radians(20.0)
    source = PlaneWave(tilt=(0.0, 20.0))
    scene, field, heights = lens_of(source, lambda x, y: 1e-4 * torch.exp(-8.0 * (x - at) ** 2) + 0.0 * y)
    phase = phase_of(scene, field, heights, (400, 8))[:, 4]
    x = (np.arange(400) + 0.5) / 100.0 - 2.0
    inside = math.asin(math.sin(tilt) / 1.5)
    z = field.at(heights, torch.from_numpy(x), torch.zeros(400, dtype=torch.float64))[0].numpy() - 1.0
    wanted = 2.0 * math.pi / (1e-6 * NM) * (1.5 * math.cos(inside) - math.cos(tilt)) * z
    assert phase - phase[0] == pytest.approx(wanted - wanted[0], abs=0.01 * np.ptp(wanted)) and np.ptp(wanted) > 0.3
    assert abs(x[phase.argmax()] - at) < 0.1


def test_a_mirror_sends_light_twice_over_its_heights():
    scene, field, heights = lens_of(PlaneWave(), lambda x, y: x * x / 2000.0 + y / 3000.0)
    scene = replace(scene, lens=replace(scene.lens, mirror=True), screen=replace(scene.screen, z=-500.0))
    x, y = ((np.arange(n) + 0.5) * (w / n) - w / 2 for n, w in ((60, 4.0), (40, 3.0)))
    wanted = 4.0 * math.pi / (1e-6 * NM) * (x[:, None] ** 2 / 2000.0 + y[None, :] / 3000.0)
    assert phase_of(scene, field, heights, (60, 40)) == pytest.approx(wanted - wanted[30, 20], abs=0.02)


def test_the_relief_of_a_mirror_is_half_a_wave_high_before_its_back(tmp_path):
    scene, field, heights = lens_of(PlaneWave(), lambda x, y: x / 3000.0 + 0.0 * y)
    scene = replace(scene, lens=replace(scene.lens, mirror=True), screen=replace(scene.screen, z=-500.0))
    path = tmp_path / "mirror.phase.png"
    write_phase(path, scene, field, heights, (300, 20))
    _, said, relief = companions(path, scene)
    assert json.loads(said.read_text())["relief_height_mm"] == pytest.approx(0.5e-6 * NM)
    z = np.frombuffer(relief.read_bytes()[84:], np.dtype([("n", "<f4", 3), ("c", "<f4", (3, 3)), ("a", "<u2")]))["c"][..., 2]
    face = z[z < z.max() - 0.1]
    assert z.max() == scene.lens.z_in and np.ptp(face) == pytest.approx(0.5e-6 * NM, rel=0.02)


def test_a_gradient_delays_light_by_its_index():
    """n = 1.5 + a r^2 between flat faces: k a r^2 d to first order, of 6 rad."""
    scene, field, heights = lens_of(PlaneWave(), lambda x, y: 0.0 * x + 0.0 * y)
    scene = replace(scene, lens=replace(scene.lens, gradient=Gradient("radial", (-1e-3,))))
    x = (np.arange(60) + 0.5) / 15.0 - 2.0
    wanted = -1e-3 * (x**2 - x[30] ** 2) * 2.0 * math.pi / (1e-6 * NM)
    found = phase_of(scene, field, heights, (60, 40))[:, 20]
    assert found == pytest.approx(wanted, abs=0.02 * np.ptp(wanted)) and np.ptp(wanted) > 6.0


def test_light_through_a_lens_in_front_is_that_of_its_focus():
    """A diverging lens in front, whose virtual focus is a point source: to the phase that the glass adds to such light."""
    height = lambda x, y: (x * x - y * y) / 900.0  # noqa: E731
    scene, field, heights = lens_of(PlaneWave(), height)
    front = Component(-20.0, (6.0, 6.0), 1.0, (-150.0, math.inf), 1.5)
    among = replace(scene, elements=(front,))
    point = replace(scene, source=Points(((0.0, 0.0, -300.0 - 20.0 + 1.0 / 1.5 * 0.5),)))
    found, wanted = (phase_of(s, field, heights, (40, 30)) for s in (among, point))
    assert found == pytest.approx(wanted, abs=0.02) and np.ptp(wanted) > 10.0


def test_each_of_several_sources_has_its_own(tmp_path):
    sources = PlaneWave(), Points(((0.5, 0.0, -100.0),))
    scene, field, heights = lens_of(Several(sources, (((NM,), (1.0,)),) * 2))
    path = tmp_path / "two.phase.png"
    write_phase(path, scene, field, heights, (50, 40))
    assert {*tmp_path.iterdir()} == {path, *companions(path, scene)}
    for name, source in zip(("two.phase.npy", "two.phase-2.npy"), sources, strict=True):
        alone = phase_of(replace(scene, source=source), field, heights, (50, 40))
        assert np.exp(1j * np.load(tmp_path / name)) == pytest.approx(np.exp(1j * alone))


@pytest.mark.parametrize(
    "round_", [{"aperture": "circle", "size": (3.0, 3.0)}, {"array": (4, 3), "control": (33, 25), "lenslets": "round"}]
)
def test_what_is_not_clear_is_a_picture_of_its_own(round_, tmp_path):
    """A circle and the circles of lenslets: pi / 4 of their squares."""
    scene, _, _ = lens_of(PlaneWave())
    lens = replace(scene.lens, **round_)
    scene, field = replace(scene, lens=lens), HeightField.of(lens)
    path = tmp_path / "round.phase.png"
    write_phase(path, scene, field, torch.full(field.shape, 1.0, dtype=torch.float64), (400, 300))
    assert {*tmp_path.iterdir()} == {path, *companions(path, scene)}
    with Image.open(tmp_path / "round.phase.clear.png") as picture:
        clear = np.asarray(picture)
    assert clear.shape == (300, 400) and {*np.unique(clear)} == {0, 255}
    assert (clear > 0).mean() == pytest.approx(math.pi / 4.0, abs=2e-3)


def test_by_default_it_is_resolved_and_too_many_pixels_are_refused():
    steep = lens_of(Gaussian((1.0, 1.0), NM), lambda x, y: x * x / 15.0 + 0.0 * y)
    phase = phase_of(*steep)
    assert phase.shape[0] > 512 == phase.shape[1] and np.abs(np.diff(phase, axis=0)).max() < math.pi
    with pytest.raises(InputError, match="samples"):
        phase_of(*steep, (9000, 10))
