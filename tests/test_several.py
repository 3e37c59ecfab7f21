"""Several sources at once: their light adds up, by power and wavelength, from the settings to the image."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import write_blob
from rayfiles import cone_of, zemax
from test_emission import LENS, heights

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.export.supported import refuse
from caustic_cli.inverse.reachability import refuse_unreachable
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.measured import coarse_words
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.optics.waves.image import lines_of, wave_image
from caustic_cli.project.completion import complete
from caustic_cli.project.project import Project
from caustic_cli.scene import Aperture, Disc, FreeForm, Lens, Light, Offset, PlaneWave, Points, Pupil, Scene, Screen
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several

SCREEN = Screen((40.0, 32.0), 100.0, (40, 32))
MEMBERS = (
    PlaneWave(1.0),
    Points(((0.5, 0.0, -20.0),), (2.0,)),
    Disc((0.0, 1.0, -30.0), (2.0, 1.0), 0.5),
    Measured(RaySet(*cone_of(100_000, 12.0)), (0.0, 0.0, -25.0), 3.0),
    Disc(angle=1.0, power=0.25),
)
NONE = ((), ())
PUPIL = Pupil(Aperture((5.0, 4.0)), 0.0)
GLASS = Lens(size=(10.0, 8.0), control=(8, 7), glass="N-BK7", index=1.5168)


def test_what_they_say_together():
    some = Several(MEMBERS[1:3], (NONE,) * 2)
    assert (some.kind, some.power, some.distant, some.collimated) == ("several", 2.5, False, False) and some.several and some.apart
    assert some.fractions == pytest.approx((0.8, 0.2)) and some.nearest == -20.0 and some.extent == (1.0, 0.5)
    assert some.centre == pytest.approx((0.4, 0.2, -22.0)) and sum(some.powers) == pytest.approx(2.5)
    assert some.blur(0.0, 100.0) == MEMBERS[2].blur(0.0, 100.0) and some.pointlike().extent == (0.0, 0.0)
    assert some.cone_over(PUPIL) == max(m.cone_over(PUPIL) for m in some.members)
    far = Several((MEMBERS[0], MEMBERS[4]), (NONE,) * 2)
    assert far.distant and not far.collimated and far.nearest == -math.inf and len(far.points()[0]) == 0
    assert far.half_angle == pytest.approx(math.radians(0.5)) and far.incidence(PUPIL) == far.half_angle
    mixed = Several(MEMBERS, (NONE,) * 5)
    assert not mixed.distant and mixed.cone_over(PUPIL) == math.pi / 2 and mixed.extent_words(0.0)
    assert mixed.incidence(PUPIL) == max(m.incidence(PUPIL) for m in MEMBERS)
    same = Several((Points(((0.0, 0.0, -20.0),)),) * 3, (NONE,) * 3)
    assert not same.apart and same.sharp and not same.extended


def test_their_light_adds_up():
    """The image of all is the sum of each one's own by its part of the power, up to the rays that are drawn."""
    here = Scene(Several(MEMBERS, (NONE,) * 5), LENS, SCREEN)
    field, z = HeightField.of(LENS), heights(LENS)
    sampler = rays_of(here, "stratified", 1_000_000, 3)
    together = expose(here, field, z, sampler)
    assert abs(float(together.image.sum()) + math.fsum(together.lost.values()) - 1.0) < 1e-12
    alone = [expose(one, field, z, rays, chunk=1 << 17) for one, rays in zip(here.by_source, sampler.members, strict=True)]
    image = sum(fraction * found.image for fraction, found in zip(here.source.fractions, alone, strict=True))
    torch.testing.assert_close(together.image, image, rtol=0, atol=1e-15)
    assert sampler.count == sum(one.count for one in sampler.members)
    for chunk in (1 << 20, 999):
        whole = [
            (float(c.flux.sum()) if hasattr(c, "flux") and c.flux.ndim else float(c.flux) * math.prod(c.shape))
            if hasattr(c, "flux")
            else float(c.power.sum()) + c.lost["missed_lens"]
            for c in sampler.chunks(chunk)
        ]
        assert math.fsum(whole) == pytest.approx(1.0, abs=1e-12)


def test_each_has_its_own_wavelengths():
    """Red from one source and blue from the other: each refracted by its own index, and by that alone."""
    members = (Points(((0.0, 0.0, -20.0),), (3.0,)), Points(((1.0, 0.0, -20.0),), (1.0,)))
    whole = Several(members, (((656.3,), ()), ((486.1, 435.8), (1.0, 3.0))))
    light = Light(None, (656.3, 486.1, 435.8), (0.75, 0.0625, 0.1875))
    here = Scene(whole, GLASS, SCREEN, light)
    assert [(b.member, pytest.approx(b.weight)) for b in here.bands] == [(0, 0.75), (1, 0.0625), (1, 0.1875)]
    field, z = HeightField.of(GLASS), heights(LENS)
    found = expose(here, field, z, sampler := rays_of(here, "stratified", 200_000))
    red = expose(Scene(members[0], GLASS, SCREEN, Light(None, (656.3,))), field, z, sampler.members[0])
    blue = expose(Scene(members[1], GLASS, SCREEN, Light(None, (486.1, 435.8), (1.0, 3.0))), field, z, sampler.members[1])
    torch.testing.assert_close(found.image, 0.75 * red.image + 0.25 * blue.image, rtol=0, atol=1e-15)
    plan = compile_plan(here, field, z)
    assert plan["dispersion"].on and not compile_plan(here, field, z, ["entrance"]).scene.light.wavelengths
    assert len(compile_plan(here, field, z, ["entrance", "intersection"]).scene.bands) == 2
    assert sum(line.part for line in lines_of(here, field)) == pytest.approx(1.0) and len(lines_of(here, field)) == 3
    assert bounds_of(here, field, z).index == max(b.scene.lens.index for b in here.bands)


def test_the_coarsest_ray_file_speaks():
    few = Measured(RaySet(*cone_of(500, 12.0)), (0.0, 0.0, -25.0))
    words = coarse_words(Scene(Several((MEMBERS[3], few), (NONE,) * 2), LENS, SCREEN))
    assert "its 500 rays" in words


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (lambda: Several((MEMBERS[0],), (NONE,)), "must be 1 to 64 sources"),
        (lambda: Several(MEMBERS[:2], (((500.0,), ()), NONE)), "given for every source, or for none"),
        (lambda: settings.parse("source = 3", "a"), "source must be a section"),
        (lambda: settings.parse("[[source]]\nsise = 3", "a"), r"\[source\] sise is not a key"),
        (lambda: settings.parse("[[source]]\n[[source]]\nsise = 3", "a"), r"\[\[source\]\] sise is not a key"),
        (lambda: settings.parse("[[source]]\n[[source]]\npolarisation = 3", "a"), r"\[\[source\]\] polarisation is not a key"),
        (lambda: settings.parse("[source]\nalso = 3", "a"), r"\[\[source\]\] must be a list of tables"),
        (lambda: complete(settings.parse("[[source]]\n[[source]]\ntype = 'sun'", "a"), 1.0), r"\[\[source\]\] type must be one of"),
        (
            lambda: settings.build_light(complete({"source": {"also": [{"type": "point"}]}, "target": {"color": True}}, 1.0)),
            "of a coloured picture must be one",
        ),
    ],
)
def test_impossible_ones_are_refused(what, message):
    with pytest.raises(InputError, match=message):
        what()


def test_settings_go_round():
    text = (
        "[[source]]\ntype = 'point'\npower = 3.0\nwavelengths = [620.0]\n[[source]]\ntype = 'disc'\nwavelengths = [450.0, 500.0]\n"
    )
    full = complete(settings.parse(text, "a"), 1.0)
    assert settings.dump(full).count("[[source]]") == 2
    again = settings.parse(settings.dump(full), "b")
    assert again == settings.tables_of(full)
    source, light = settings.build_source(full.source), settings.build_light(full)
    assert [m.kind for m in source.members] == ["point", "disc"] and source.fractions == (0.75, 0.25)
    assert light.wavelengths == (620.0, 450.0, 500.0) and light.fractions == pytest.approx((0.75, 0.125, 0.125))
    assert full.design.start == "transport"  # both stand in the same place
    one = complete(settings.parse("[[source]]\ntype = 'point'\n", "a"), 1.0)
    assert len(settings.build_source(one.source).members) == 1 and "[source]" in settings.dump(one)


def test_a_design_in_several_lights(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    Path("led.dat").write_bytes(zemax(*cone_of(20_000, 12.0)))
    Path("led.csv").write_text("0,1\n30,0.5\n")
    Path("two.toml").write_text(
        "[[source]]\ntype = 'point'\npower = 2.0\nwavelengths = [620.0]\n[[source]]\ntype = 'rays'\n"
        "file = 'led.dat'\nwavelengths = [450.0]\n[[source]]\ntype = 'disc'\nintensity = 'led.csv'\n"
        "wavelengths = [500.0]\n[lens]\nglass = 'N-BK7'\n"
    )

    def run(*arguments, code=0):
        assert cli.run([*arguments, "--json", "--quiet", "--threads", "1"]) == code
        out, err = capfd.readouterr()
        return json.loads(out) if code == 0 else err.strip()

    base = ["design", "blob.png", "--config", "two.toml", "--resolution", "24", "--control", "12", "--rays", "6000"]
    figures = run(*base, "--iterations", "6")
    assert figures["on_screen"] + sum(figures["lost"].values()) == pytest.approx(1.0, abs=1e-12)
    for name in ("led.dat", "led.csv"):
        Path(name).unlink()
    assert {"source-2.dat", "intensity-3.csv"} <= {p.name for p in Path("blob.caustic").iterdir()}
    history = Project.open("blob.caustic").load().state.history
    assert history[-1][2] < history[0][2]
    again = run(
        "render",
        "blob.caustic",
        "--rays",
        "40000",
        "--force",
        "-o",
        "a.png",
        "--effects",
        "entrance,intersection,fresnel,dispersion,source-size",
    )
    assert again["relative_rms"] == pytest.approx(figures["relative_rms"], rel=0.05)
    other = run("render", "blob.caustic", "--rays", "40000", "-o", "b.png", "--source", "plane", "--effects", "fresnel,dispersion")
    assert other["lost"]["missed_lens"] == 0.0  # another light is another light for all of it
    assert cli.run(["gradmap", "blob.caustic", "--control", "5,5", "--rays", "20000", "--check", "--quiet", "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["maps"][0]["check"]["relative_error"] < 1e-4
    Path("led.dat").write_bytes(zemax(*cone_of(20_000, 12.0)))
    Path("two.toml").write_text("[[source]]\n[[source]]\ntype = 'rays'\nfile = 'led.dat'\n")
    assert "--waves on: a ray file contains no phase" in run(*base, "-o", "c.caustic", "--waves", "on", code=2)


@pytest.mark.parametrize("spectra", [(NONE,) * 5, tuple(((450.0 + 20.0 * k, 650.0), (1.0, 0.5 + k)) for k in range(5))])
def test_an_archive_holds_all_of_them(tmp_path, spectra):
    """With power, place, intensity and light of each; the rays of a file are given again."""
    light = Light(None, *(tuple(c for one in spectra for c in one[k]) for k in (0, 1)))
    here = Scene(Several(MEMBERS, spectra), LENS, SCREEN, light)
    field, z = HeightField.of(LENS), heights(LENS)
    write_lighttools(tmp_path / "a.npz", here, field, z)
    there, *lens = open_archive(tmp_path / "a.npz", MEMBERS[3].rays)
    assert [m.kind for m in there.source.members] == [m.kind for m in MEMBERS]
    assert there.source.fractions == pytest.approx(here.source.fractions, rel=1e-15)
    assert [s[0] for s in there.source.spectra] == [s[0] for s in spectra] and len(there.bands) == len(here.bands)
    assert [b.weight for b in there.bands] == pytest.approx([b.weight for b in here.bands], rel=1e-14)
    one, other = (expose(s, *of, rays_of(s, "stratified", 40_000)).image for s, *of in ((here, field, z), (there, *lens)))
    torch.testing.assert_close(other, one, rtol=0, atol=1e-12)
    with pytest.raises(InputError, match="source 4: its source is a ray file"):
        open_archive(tmp_path / "a.npz")
    refuse(Scene(Several(MEMBERS[:2], (NONE,) * 2), LENS, SCREEN), "lighttools", script=True, mould=False)
    with pytest.raises(InputError, match="the rays of a file among several sources cannot be written"):
        refuse(here, "lighttools", script=True, mould=False)
    write_lighttools(tmp_path / "b.npz", replace(here, source=Several(MEMBERS[:2], spectra[:2])), field, z)
    with pytest.raises(InputError, match="none of this one's is"):
        open_archive(tmp_path / "b.npz", MEMBERS[3].rays)


def test_a_wave_image_names_the_wavelengths_of_all_sources():
    waves = Several((PlaneWave(1.0), PlaneWave(2.0)), (((620.0,), ()), ((450.0, 500.0), ())))
    light = Light(wavelengths=(620.0, 450.0, 500.0), weights=(1.0, 1.0, 1.0))
    scene = Scene(waves, replace(LENS, size=(0.5, 0.5)), Screen((1.0, 1.0), 100.0, (8, 8)), light)
    field = HeightField.of(scene.lens)
    z = torch.full(field.shape, 5.0, dtype=torch.float64)
    assert wave_image(scene, field, z).wavelengths == (620.0, 450.0, 500.0)


@pytest.mark.parametrize(("slope", "reach"), [(0.0, 48.19), (-0.4, 48.19 + 7.46), (0.4, 48.19 - 7.46)])
def test_an_inclined_entrance_moves_what_refraction_reaches(slope, reach):
    """By the angle of the light behind it: psi - asin(sin psi / n), psi = atan 0.4 = 21.80 degrees."""
    front = FreeForm(np.repeat(5.0 * slope * np.linspace(-1.0, 1.0, 4)[:, None], 4, 1), (3, 3)) if slope else None
    lens = Lens((10.0, 10.0), control=(8, 8), index=1.5, offset=Offset(8.0), z_in=0.0, entrance=front)
    for angle, reached in ((reach - 0.3, True), (reach + 0.3, False)):
        screen = Screen((1.0, 1.0), 20_000.0, (8, 8), shift=(20_000.0 * math.tan(math.radians(angle)), 0.0))
        with nullcontext() if reached else pytest.raises(InputError, match="deflects it by less than 48"):
            refuse_unreachable(Scene(PlaneWave(), lens, screen), np.ones((8, 8)))


def test_a_picture_out_of_the_reach_of_one_source_may_be_within_that_of_another():
    """Glass of index 1.5 deflects by less than arccos(1 / 1.5) = 48.2 degrees: light along the axis does not reach a picture 60
    degrees from it, light that arrives at 45 degrees, 28 in the glass, does, of points as of the rays of a file."""
    lens = Lens((10.0, 10.0), control=(8, 8), index=1.5, offset=Offset(5.0))
    screen = Screen((10.0, 10.0), 105.0, (8, 8), shift=(100.0 * math.tan(math.radians(60.0)), 0.0))
    axial, aslant = PlaneWave(), Points(((-100.0, 0.0, -100.0),))
    start = np.array([[0.1 * k, 0.0, -100.0] for k in range(20)])
    below, beside = (
        Measured(RaySet(start + np.array([x, 0.0, 0.0]), np.array([[slope, 0.0, 1.0]] * 20), np.ones(20)), (0.0, 0.0, 0.0))
        for x, slope in ((0.0, 0.0), (-100.0, 1.0))
    )
    reaches = {
        False: [axial, below, Several((axial, axial), (NONE, NONE)), Several((axial, below), (NONE, NONE))],
        True: [aslant, beside, Several((axial, aslant), (NONE, NONE)), Several((below, beside), (NONE, NONE))],
    }
    for reached, sources in reaches.items():
        for source in sources:
            with nullcontext() if reached else pytest.raises(InputError, match="deflects it by less than 48"):
                refuse_unreachable(Scene(source, lens, screen), np.ones((8, 8)))
