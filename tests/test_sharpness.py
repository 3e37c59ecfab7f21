"""Advice on the blur of a source, against the deconvolution for the advised geometry."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from caustic_cli.errors import InputError, at_least, at_most
from caustic_cli.inverse import sharpness
from caustic_cli.inverse.deconvolution import deconvolved
from caustic_cli.inverse.sharpness import SHARP, STEPS, _blurred, advice, required_reduction, scaled_spread
from caustic_cli.inverse.source_image import source_images
from caustic_cli.inverse.source_limits import source_spread
from caustic_cli.optics.spread import Convolution, Spread
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Scene, Screen
from caustic_cli.studies.retrace import retrace

PIXELS = 48


def picture():
    """A square and a ring on black, relative irradiance."""
    x, y = np.meshgrid(*[(np.arange(PIXELS) + 0.5) / PIXELS - 0.5] * 2, indexing="ij")
    r = np.hypot(x, y)
    return ((r > 0.2) & (r < 0.3) | (np.maximum(abs(x), abs(y)) < 0.1)).astype(float)


def scene(source, throw=300.0, mag=3.0):
    """A lens of 10 mm with a picture on all of the screen, its field and the heights of the sphere that magnifies so."""
    lens = Lens(control=(12, 12))
    lens = replace(lens, offset=Offset.for_magnification((mag, mag), lens.index, throw, lens.offset.thickness))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())
    heights = torch.from_numpy(lens.offset.thickness + lens.offset.sag(x[:, None], y[None, :]))
    return Scene(source, lens, Screen((10.0 * mag, 10.0 * mag), throw, (PIXELS, PIXELS))), field, heights


def disc(width):
    """The image of a uniform disc of this width on the screen, mm."""
    return Spread((0.5 * width, 0.5 * width), ((0.0, 0.0, 1.0),), 0.0)


def numbers(text):
    """Numbers of the advice by what they are of."""
    found = {name: float(value) for name, value in re.findall(r"⟨\+(mag|throw)⟩ ([\d.e+]+)", text)}
    return found | {"lens": float(re.search(r"a lens of ([\d.e+]+)", text)[1])}


def test_the_advised_lens_is_sharp():
    """The least error behind the sun, of the scene as advised, is what sharp means; at half as much it is not."""
    target, light = picture(), Disc(angle=0.533)
    before = scene(light)
    found = numbers(advice(before[0], target, (30.0, 30.0)))
    error = SHARP * target.std() / target.mean()

    def least(throw, mag):
        after = scene(light, throw, mag)
        return deconvolved(target, source_spread(*after).on(after[0].screen.pixel, 1), STEPS).error

    assert found["mag"] > 3.6 and found["throw"] < 250
    assert found["mag"] / 3.0 == pytest.approx(300.0 / found["throw"], rel=0.05)
    assert found["lens"] == pytest.approx(10.0 * found["mag"] / 3.0, rel=0.05)
    for throw, mag in ((300.0, found["mag"]), (found["throw"], 3.0)):
        assert least(throw, mag) <= 1.1 * error < least(throw * 1.3, mag)
    assert least(300.0, 3.0) > 1.1 * error


def test_advice_is_of_the_way_from_the_lens_wherever_it_stands():
    one = scene(Disc(angle=0.533))[0]
    lens, screen = one.lens, one.screen
    offset = replace(lens.offset, thickness=lens.offset.thickness + 150.0)
    moved = replace(one, lens=replace(lens, z_in=150.0, offset=offset), screen=replace(screen, z=screen.z + 150.0))
    here, there = (numbers(advice(s, picture(), (30.0, 30.0))) for s in (one, moved))
    assert there["mag"] == here["mag"] and there["throw"] == pytest.approx(here["throw"] + 150.0, abs=0.6)


def test_the_factor_is_the_least():
    target = picture()
    spread, pixel = disc(6.0), (30.0 / PIXELS,) * 2
    for error in (0.1, 0.3):
        f = required_reduction(target, pixel, spread, error)
        assert deconvolved(target, scaled_spread(spread, 1.0 / f).on(pixel, 1), STEPS).error <= error
        assert deconvolved(target, scaled_spread(spread, 1.1 / f).on(pixel, 1), STEPS).error > error
    assert required_reduction(target, pixel, disc(1e-3), 0.3) == 1.0


def test_nothing_is_said_of_what_is_sharp_or_has_no_extent():
    small = scene(Disc(angle=0.01))
    assert advice(small[0], picture(), (30.0, 30.0)) == ""
    flat = scene(Disc(angle=0.533))
    assert advice(flat[0], np.ones((PIXELS, PIXELS)), (30.0, 30.0)) == ""


def test_parallel_light_may_spread_as_far_as_is_said():
    """The image of a lens in light of that angle, against its image in parallel light: a tenth of the contrast, by rays."""
    wave, field, heights = scene(PlaneWave())
    wave = replace(wave, screen=Screen((45.0, 45.0), 300.0, (90, 90))), field, heights  # dark around it
    image, _ = retrace(*wave, None, rays=400_000)
    sharp = image.image.numpy()  # what this lens throws is its picture
    text = advice(wave[0], sharp, (30.0, 30.0))
    angle = float(re.search(r"up to ([\d.]+) degrees", text)[1])
    after = replace(wave[0], source=Disc(angle=angle))
    found, figures = retrace(after, *wave[1:], None, rays=1_000_000)
    blurred = found.image.numpy()
    error = np.sqrt(np.mean((blurred / blurred.mean() - sharp / sharp.mean()) ** 2) - figures["error_estimate"] ** 2)
    assert error == pytest.approx(SHARP * sharp.std() / sharp.mean(), rel=0.15)
    assert 0.0 < angle < math.degrees(30.0 / 300.0)


def test_a_large_screen_is_not_cut_finer(monkeypatch):
    """What is convolved grows no faster than the picture, and its angle is that of pixels cut into 4 all the same."""
    pixels, shapes, whole = 600, [], Convolution.whole

    def seen(self, image, adjoint=False):
        shapes.append(max(image.shape))
        return whole(self, image, adjoint)

    monkeypatch.setattr(Convolution, "whole", seen)
    at = (np.arange(pixels) + 0.5) / pixels
    target = 1.5 + np.cos(9.0 * np.pi * at)[:, None] * np.cos(7.0 * np.pi * at)
    wave = scene(PlaneWave())[0]
    wave = replace(wave, screen=Screen((30.0, 30.0), 300.0, (pixels, pixels)))
    text = advice(wave, target, (30.0, 30.0))
    assert pixels < max(shapes) <= 2 * pixels
    throw = 300.0 - wave.lens.offset.thickness
    width = throw * math.radians(float(re.search(r"up to ([\d.]+) degrees", text)[1]))
    exact = _blurred(target, disc(width).on(wave.screen.pixel))
    assert exact == pytest.approx(SHARP * target.std() / target.mean(), rel=0.1)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (35.0, 0.0), (-20.0, 40.0)])
def test_a_tilted_screen_has_advice_too(tilt):
    """Sharp by as much as is said, of the scene as advised."""
    target, pixel, light = picture(), (30.0 / PIXELS,) * 2, Disc(angle=0.533)
    tilted = replace(scene(light)[0], screen=Screen((30.0, 30.0), 300.0, (PIXELS, PIXELS), tilt))
    found = numbers(advice(tilted, target, (30.0, 30.0)))
    nearer = replace(tilted, screen=replace(tilted.screen, z=found["throw"]))
    error = SHARP * target.std() / target.mean()
    for one, within in ((tilted, False), (nearer, True)):
        image = source_images(one, middle=True)[0]
        assert (deconvolved(target, image.on(pixel, 1), STEPS).error <= 1.15 * error) == within
    parallel = advice(replace(tilted, source=PlaneWave()), target, (30.0, 30.0))
    angle = float(re.search(r"up to ([\d.]+) degrees", parallel)[1])
    image = source_images(replace(tilted, source=Disc(angle=angle)), middle=True)[0]
    assert _blurred(target, image.on(pixel)) == pytest.approx(error, rel=0.15)


def test_advice_names_nothing_that_is_refused():
    """A magnification beyond its range, or a lens from which the picture is out of reach, is not named."""
    one, target = scene(Disc(angle=0.533))[0], picture()
    assert numbers(advice(one, target, (30.0, 30.0)))["mag"] > 3.0
    wide = replace(one, lens=replace(one.lens, mirror=True), screen=Screen((9e3, 9e3), -90e3, (PIXELS, PIXELS)))
    text = advice(wide, target, (9e3, 9e3))  # a mirror has no limit of refraction: 900 times, and sharp by more
    assert "mag" not in text and "a lens of" in text
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sharpness, "largest_magnification", lambda scene, picture: 3.0 if scene.lens.size[0] == 10.0 else 2.0)
        text = advice(one, target, (30.0, 30.0))
    assert "mag" not in text and "a lens of" not in text and "details are" in text


def test_a_limit_is_rounded_to_what_is_accepted():
    assert (at_most(2.46, 2), at_least(61.2201, 4), at_most(-0.0123456, 3)) == ("2.4", "61.23", "-0.0124")
    assert (at_most(0.3, 2), at_least(1e-9, 3), at_most(1000.0, 2)) == ("0.3", "1e-09", "1e+03")
    with pytest.raises(InputError) as refused:
        Screen((60.0, 60.0), 300.0, radius=(40.0, 40.0)).check_curvature()
    least = float(re.search(r"at least ([\d.]+) mm", str(refused.value))[1])
    Screen((60.0, 60.0), 300.0, radius=(least, least)).check_curvature()
