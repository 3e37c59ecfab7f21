"""The wave image of two free-form sides, and its refinement by the exit."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.config.design import Stage
from caustic_cli.effort import current_effort
from caustic_cli.inverse.initial_two_sided import first_sides
from caustic_cli.inverse.problem import Options
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.kinds.two_sided import TwoSides
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, split_heights
from caustic_cli.optics.waves.image import Imager, lines_of, wave_image
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.optics.waves.wavefront import Survey
from caustic_cli.scene import Lens, Offset, PlaneWave, Scene, Screen, SecondTarget
from caustic_cli.studies.retrace import retrace

PIXELS = 24
LENS = Lens((2.4, 2.4), control=(35, 35), offset=Offset(5.0), height_range=(-2.0, 2.0))
NEAR = Screen((2.8, 2.8), 40.0, (PIXELS, PIXELS))
FAR = Screen((3.4, 3.4), 90.0, (PIXELS, PIXELS))


def picture(*places) -> np.ndarray:
    """Soft spots over a square without dark gaps, within the screen's black margin."""
    u = ((np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1) * 1.2
    x, y = np.meshgrid(u, u, indexing="ij")
    light = 0.5 + sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.15) for a, b in places)
    return light * ((np.abs(x) < 0.98) & (np.abs(y) < 0.98))


ONE, TWO = picture((-0.3, 0.1), (0.35, -0.2)), picture((0.1, 0.2))


@pytest.fixture(scope="module")
def started():
    """A scene, the field, and initial surfaces for collimated light."""
    scene, field = Scene(PlaneWave(), LENS, NEAR, second_target=SecondTarget()), HeightField.of(LENS)
    return scene, field, first_sides(scene, ONE, None, field, 64)


@pytest.mark.parametrize("dense", [False, True])
def test_the_wavefront_has_the_power_of_the_rays(started, dense):
    """At the corners of the light, where the map of the rays is all but singular, none may be thrown across the pupil."""
    scene, field, nets = started
    behind, exit = split_heights(scene, field, nets)
    line, parameters = lines_of(behind, field, (550.0,))[0], {EXIT: exit}
    with torch.no_grad():
        imager = Imager.of([line], parameters, receiver_of(line.system, behind.screen), 1.0, dense=dense)
        front = imager.front(line, imager.modes(line.system)[0], parameters)
    exposure = retrace(behind, field, exit, ONE, rays=40_000)[0]
    leaving = 1.0 - sum(float(part) for name, part in exposure.lost.items() if name != "off_screen")
    assert front.power == pytest.approx(leaving, rel=0.01)


def problem(scene: Scene, second: np.ndarray | None) -> TwoSides:
    stage = Stage(LENS.control, rays=4000, rendering=LossImage(apron=2), waves=(480.0, 530.0, 570.0, 620.0), iterations=12)
    other = None if second is None else torch.from_numpy(second)
    return TwoSides(scene, torch.from_numpy(ONE), [stage], Options(), "cpu", current_effort(), second_target=other)


@pytest.mark.parametrize("second", [None, TWO])
def test_the_exit_is_refined_behind_the_entrance_as_it_is(started, second):
    """The loss has the derivatives of the images by the exit's heights, and none by those of the entrance."""
    scene, _, nets = started
    scene = replace(scene, second_target=SecondTarget() if second is None else SecondTarget(FAR))
    loss = problem(scene, second).objective_in(scene, 0, nets)
    assert len(loss.members) == (1 if second is None else 2)
    found = loss(nets)
    assert found.gradient.shape == nets.shape and not found.gradient[0].any() and found.gradient[1].any()
    way = torch.randn(nets.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    step = 1e-6 * way
    change = (loss(nets + step).loss - loss(nets - step).loss) / 2.0
    assert change == pytest.approx(float((found.gradient * step).sum()), rel=0.02)


def test_refinement_makes_another_wave_image_more_like_the_picture(started):
    """Of the exact trace, at wavelengths between those of the loss."""
    scene, field, nets = started
    made = problem(scene, None)
    loss, heights = made.objective_in(scene, 0, nets), made.parametrised(0, nets)
    optimiser = made.optimiser(0)(loss, heights, 1e-3)
    for _ in range(12):
        optimiser.step()
    after = heights().detach()

    def error(both: torch.Tensor) -> float:
        behind, exit = split_heights(scene, field, both)
        seen = wave_image(behind, field, exit, wavelengths=(460.0, 500.0, 550.0, 590.0, 650.0)).image.numpy()
        return float(np.sqrt(((seen / seen.mean() - ONE / ONE.mean()) ** 2).mean()))

    assert torch.allclose(after[0], nets[0], atol=1e-12) and error(after) < 0.6 * error(nets)


def test_rays_beyond_those_of_a_survey_are_begun_beside_its_nearest():
    """Of light that is wider at one end: where the linear fit is far off, rays begin where their neighbours do."""
    line = torch.linspace(0.0, 1.0, 33, dtype=torch.float64)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    places = u, v, u**2 * (1.0 + 0.2 * v * (1.0 - v)), v
    seen = Survey(((0.0, 0.0), (1.0, 1.0)), ((0.0, 0.0), (1.0, 1.0)), (-0.17, 0.0), (1.0, 1.0), 1.0, ((), ()), places=places)
    inside = torch.tensor([0.25, 0.9999]), torch.tensor([0.5, 0.003])
    beyond = torch.tensor([1.0001, 1.001]), torch.tensor([0.003, 0.003])
    (a, _), (b, w) = (seen.aim(*(c.double() for c in at)) for at in (inside, beyond))
    assert a[0] == pytest.approx((0.25 / 1.05) ** 0.5, abs=1e-3) and a[1] == pytest.approx(1.0, abs=5e-3)
    assert torch.allclose(b, torch.ones(2, dtype=torch.float64), atol=5e-3) and torch.allclose(
        w, torch.full_like(w, 0.003), atol=2e-3
    )
