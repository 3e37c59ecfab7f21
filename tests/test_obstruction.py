"""What stands in the light between the source and the screen: fractions by hand, mirrors, folded axes; designs and renders."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import write_blob

from caustic_cli import cli, load
from caustic_cli.errors import InputError
from caustic_cli.optics.obstruction import RAYS, LightPath, clear_shift, refuse_obstructed
from caustic_cli.project.project import Project
from caustic_cli.scene import Component, Disc, FoldMirror, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.screen import Sags, tilted
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several

MIRROR = Lens((100.0, 100.0), mirror=True, offset=Offset(2.0))
LENS = Lens((10.0, 10.0), offset=Offset(5.0))
WALL = Screen((384.0, 384.0), -1000.0)
SUN = Disc(angle=0.533)
SCREEN = Screen((38.4, 38.4), 300.0)


def found(source, screen=WALL, lens=MIRROR, *elements):
    return LightPath(Scene(source, lens, screen, elements=elements)).obstruction()


def file_of(points: np.ndarray) -> Measured:
    """Rays along +z through these points, from z = -600."""
    along = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    flux = np.ones(len(points))
    return Measured(RaySet(np.column_stack([points, np.zeros(len(points))]), along, flux, 1.0, "W"), (0.0, 0.0, -600.0))


@pytest.mark.parametrize(
    ("source", "screen", "fraction"),
    [
        (PlaneWave(), WALL, 1.0),
        (PlaneWave(), replace(WALL, shift=(0.0, 200.0)), 0.42),  # from y = 8 up to the mirror's edge at 50
        (PlaneWave(), replace(WALL, shift=(-200.0, 200.0)), 0.42**2),
        (PlaneWave(), replace(WALL, shift=(0.0, 250.0), tilt=(85.0, 0.0)), 0.0),
        (PlaneWave(), replace(WALL, shift=(0.0, 0.0), tilt=(85.0, 0.0)), 0.334666),  # edge-on: 384 cos 85 of 100 mm
        (PlaneWave(), replace(WALL, shift=(0.0, 242.0)), 0.0),  # touches
        (SUN, replace(WALL, shift=(0.0, 242.0)), 0.00987),  # 1000 mm (4 / 3 pi) tan 0.2665 degrees / 2, of 100 mm: its penumbra
        (SUN, replace(WALL, shift=(0.0, 246.7)), 0.0),
        (Points(((0.0, 0.0, -500.0),)), WALL, 0.0),  # the source is before the screen
        (Points(((0.0, 0.0, -500.0),)), Screen((40.0, 20.0), -250.0), 0.8 * 0.4),  # its shadow is twice as large
        (Points(((0.0, 0.0, -500.0), (0.0, 0.0, -200.0)), (1.0, 3.0)), Screen((100.0, 100.0), -250.0), None),  # the first alone
        (Several((PlaneWave(1.0), Points(((0.0, 0.0, -200.0),), (3.0,), cone=3.0))), Screen((100.0, 100.0), -250.0), 0.25),
        (file_of(np.linspace(-49.0, 49.0, 99)[:, None] * [0.0, 1.0]), replace(WALL, z=-500.0, shift=(0.0, 200.0)), 42.0 / 99.0),
        (file_of(np.zeros((3, 2))), WALL, 0.0),  # starts beyond the screen
    ],
)
def test_the_light_on_a_mirror_that_its_screen_shadows(source, screen, fraction):
    one = found(source, screen)
    if fraction == 0.0:
        assert one is None
        return
    assert (one.body, one.before, one.behind) == ("the screen", "the source", "the mirror")
    if fraction is None:  # of the light on the mirror: a quarter of all, less what misses it
        assert 0.05 < one.fraction < 0.25
    else:
        assert one.fraction == pytest.approx(fraction, abs=4.0 * math.sqrt(fraction / RAYS))


@pytest.mark.parametrize("radius", [-300.0, 300.0])
def test_a_curved_screen_is_where_its_surface_is(radius):
    """Beside the light by its middle; a bowl round the mirror's side reaches back to it, a dome does not."""
    wall = Screen((384.0, 384.0), -250.0, radius=(radius, radius), shift=(0.0, 200.0))
    flat = replace(wall, radius=(math.inf, math.inf))
    assert found(PlaneWave(), wall).fraction == pytest.approx(found(PlaneWave(), flat).fraction, abs=0.02)
    y = np.linspace(-1.0, 1.0, 9)
    ramp = Screen((384.0, 384.0), -250.0, sags=Sags(np.tile(100.0 * y, (9, 1)), (384.0, 384.0)), shift=(0.0, 200.0))
    assert found(PlaneWave(), ramp).fraction == pytest.approx(0.42, abs=0.02)


def test_a_source_stands_in_the_light_that_comes_back_and_in_that_of_another():
    led = Disc((0.0, 0.0, -500.0), (20.0, 20.0))
    one = found(led)
    assert (one.body, one.before, one.behind) == ("the source", "the mirror", "the screen") and 1e-3 < one.fraction < 0.05
    assert "the source stands in the light between the mirror and the screen and shadows" in one.sentence()
    assert found(replace(led, size=(0.0, 0.0))) is None
    assert found(led, replace(WALL, shift=(0.0, 400.0))) is None
    near = replace(led, position=(0.0, 0.0, -250.0))
    both = found(Several((led, near)), replace(WALL, shift=(0.0, 900.0)))
    assert (both.body, both.before) == ("the source", "the source")
    assert found(Several((led, replace(led, power=2.0))), replace(WALL, shift=(0.0, 400.0))) is None  # both in one place


def mirror(z: float, tilt: float, size: float = 40.0) -> FoldMirror:
    return FoldMirror(z, (size, size), tilt=(tilt, 0.0))


@pytest.mark.parametrize(
    ("elements", "bodies"),
    [
        ((mirror(100.0, 45.0),), None),
        ((mirror(100.0, 45.0), mirror(200.0, 45.0)), None),  # back, 100 mm above
        ((mirror(100.0, 5.0),), ("the free-form lens", "the mirror of [[element]] 1", "the screen")),
        (
            (mirror(100.0, 45.0), mirror(108.0, 45.0, 12.0), Component(150.0, (20.0, 20.0))),
            ("the lens of [[element]] 3", "the free-form lens", "the mirror of [[element]] 1"),
        ),
        (
            (mirror(100.0, 45.0), mirror(108.0, 45.0, 12.0), Component(250.0, (20.0, 20.0), aperture="circle")),
            ("the lens of [[element]] 3", "the source", "the free-form lens"),
        ),
        ((Component(-30.0, (12.0, 12.0)), mirror(100.0, -45.0)), None),
    ],
)
def test_axes_that_are_folded_back(elements, bodies):
    screen = replace(SCREEN, shift=(60.0, 0.0)) if len(elements) > 2 else SCREEN  # beside the light of the source
    one = found(PlaneWave(), screen, LENS, *elements)
    assert bodies == (None if one is None else (one.body, one.before, one.behind))
    if one is not None:
        with pytest.raises(InputError, match=r"shadows [0-9.e-]+% of it; accepted: a"):
            refuse_obstructed(Scene(PlaneWave(), LENS, screen, elements=elements))


def test_the_screen_of_a_folded_axis_in_the_light_of_the_source():
    """Two mirrors that send the light back 30 mm above its way, to a screen of 90 mm: by as much of the beam as it covers."""
    elements = (mirror(100.0, 45.0), mirror(130.0, 45.0, 30.0))
    one = found(PlaneWave(), Screen((60.0, 60.0), 280.0), LENS, *elements)
    assert (one.body, one.before) == ("the screen", "the source")
    assert one.fraction == pytest.approx(0.5, abs=0.02)  # from y = 0 on


@pytest.mark.parametrize(
    "source",
    [
        PlaneWave(),
        SUN,
        Disc(angle=60.0),
        Points(((3.0, 0.0, -20.0),)),
        Disc((0.0, 0.0, -20.0), (5.0, 5.0)),
        Points.grid((0, 0, -30.0), (9.0, 9.0), (3, 3)),
    ],
)
@pytest.mark.parametrize("tilt", [(0.0, 0.0), (60.0, 0.0)])
def test_a_screen_behind_a_lens_is_in_no_light(source, tilt):
    for screen in (Screen((400.0, 400.0), 300.0, tilt=tilt), Screen((100.0, 100.0), 100.0, tilt=tilt, shift=(20.0, -300.0))):
        for elements in ((), (Component(20.0, (20.0, 20.0)),)):
            assert found(source, screen, LENS, *elements) is None


@pytest.mark.parametrize(
    ("screen", "lens", "words"),
    [
        (Screen((100.0, 100.0), 100.0, tilt=(60.0, 0.0), shift=(0.0, 40.0)), LENS, None),
        (Screen((100.0, 100.0), 100.0, tilt=(60.0, 0.0), shift=(0.0, -100.0)), LENS, None),
        (
            Screen((100.0, 100.0), 100.0, tilt=(80.0, 0.0), shift=(0.0, 100.0)),
            LENS,
            "behind the lens and face it: it turns its back to it",
        ),
        (
            Screen((100.0, 100.0), 100.0, tilt=(80.0, 0.0), shift=(0.0, 17.0)),
            LENS,
            "behind the lens and face it: its plane passes through it",
        ),
        (Screen((384.0, 384.0), -1000.0, tilt=(85.0, 0.0), shift=(0.0, 250.0)), MIRROR, None),
        (
            Screen((384.0, 384.0), -1000.0, tilt=(85.0, 0.0), shift=(0.0, -250.0)),
            MIRROR,
            "before the mirror and face it: it turns its back",
        ),
    ],
)
def test_the_back_of_a_screen(screen, lens, words):
    """Its plane meets the axis z - shift tan(tilt) from the origin."""
    scene = Scene(PlaneWave(), lens, screen)
    if words is None:
        refuse_obstructed(scene)
    else:
        with pytest.raises(InputError, match=words):
            refuse_obstructed(scene)


@pytest.mark.parametrize("tilt", [(0.0, 40.0), (-60.0, 0.0), (20.0, 70.0)])
def test_a_screen_square_to_reflected_light_is_beside_it(tilt):
    """And one before the mirror, in the incident light, is refused with the part of the beam that it covers."""
    dx, dy, dz = tilted(tilt)[2]
    sun, reach = PlaneWave(tilt=tilt), 1000.0
    free = Screen((384.0, 384.0), 2.0 - reach * dz, tilt=(-tilt[0], -tilt[1]), shift=(reach * dx, reach * dy))
    refuse_obstructed(Scene(sun, MIRROR, free))
    before = Screen((10.0, 384.0), 2.0 - reach * dz, tilt=tilt, shift=(-reach * dx, -reach * dy))
    one = found(sun, before)
    assert (one.body, one.behind) == ("the screen", "the mirror")
    ex = tilted(tilt)[0]  # of a square, its shadow on the mirror along the light is a strip along y
    assert one.fraction == pytest.approx(0.1 / ex[0] if tilt[0] == 0.0 or tilt[1] == 0.0 else one.fraction, abs=0.01)


@pytest.mark.parametrize(
    ("source", "shift"),
    [
        (PlaneWave(), (0.0, 250.0)),
        (SUN, (0.0, 250.0)),
        (Points(((0.0, 0.0, -500.0),)), (0.0, 0.0)),
        (Points(((0.0, 0.0, -2000.0),)), (0.0, 220.0)),
    ],
)
def test_the_least_shift_out_of_the_light(source, shift):
    """242 mm of a plane wave, 246.65 of the sun, each rounded up to two digits; half the mirror's size of a point twice as far."""
    scene = Scene(source, MIRROR, WALL)
    assert clear_shift([scene]) == shift
    refuse_obstructed(replace(scene, screen=replace(WALL, shift=shift)))
    wide = replace(scene, screen=replace(WALL, size=(200.0, 600.0)))
    assert clear_shift([wide, scene])[1] == pytest.approx(shift[1], abs=400.0)


# designs and renders

SUNLIT = ["--mirror", "--lens-size", "100", "--throw", "1000", "--mag", "3", "--margin", "0.28", "--source-angle", "0.533"]
SMALL = ["--resolution", "24", "--control", "12", "--rays", "4000", "--iterations", "1", "--waves", "off"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png")


def run(capfd, *arguments, code=0):
    assert cli.run(list(map(str, arguments))) == code
    return capfd.readouterr()


@pytest.mark.usefixtures("here")
def test_a_mirror_throws_its_picture_beside_the_light_on_it(capfd):
    out, err = run(capfd, "design", "blob.png", *SUNLIT, *SMALL, "--json")
    assert "the screen is shifted by 0,250 mm" in err and json.loads(out)["on_screen"] > 0.9
    project = Project.open("blob.caustic")
    assert project.settings.screen.shift == (0.0, 250.0) and found(SUN, project.scene().screen) is None
    run(capfd, "render", "blob.caustic", "--rays", "1e4")
    run(capfd, "export", "blob.caustic", "--format", "lighttools", "-o", "blob.npz")
    for source in ("blob.caustic", "blob.npz"):
        before = {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()}
        asked = ["--screen-shift", "0,100"] if source == "blob.caustic" else ["--screen-at", "-9000"]
        _, err = run(capfd, "render", source, "--rays", "1e4", *asked, code=2)
        assert err.startswith("caustic: the screen stands in the light that falls on the mirror and shadows ")
        assert err.count("\n") == 1 and "; accepted: a lens designed for a screen beside it, such as --screen-shift 0,2" in err
        assert {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()} == before
    _, err = run(capfd, "design", "blob.png", *SUNLIT, "--mag", "4", *SMALL, "-o", "wide.caustic")
    assert "the screen is shifted by 0,310 mm" in err
    _, err = run(capfd, "design", "blob.png", "--mirror", "--screen-shift", "0,20", *SMALL, "-o", "in.caustic", code=2)
    assert "shadows 42" in err and "such as --screen-shift 0,25" in err and not Path("in.caustic").exists()


@pytest.mark.usefixtures("here")
def test_the_mirror_of_the_preset_is_lit_from_the_side(capfd):
    """Its wall is 1 m away along the light, square to it, and beside the light on the mirror."""
    out, err = run(capfd, "design", "blob.png", "--preset", "mirror-100", *SMALL, "--json")
    made, screen = json.loads(out), Project.open("blob.caustic").scene().screen
    assert "shifted" not in err and made["on_screen"] > 0.9 and made["lost"]["missed_surface"] < 0.02
    assert math.dist(screen.centre, (0.0, 0.0, 0.0)) == pytest.approx(1000.0, abs=0.1)
    assert screen.axes[2] == pytest.approx([-c / 1000.0 for c in screen.centre], abs=1e-4)
    run(capfd, "render", "blob.caustic", "--rays", "1e4")


@pytest.mark.usefixtures("here")
def test_an_old_project_whose_screen_stands_in_its_own_light_is_refused(capfd):
    run(capfd, "design", "blob.png", "--mirror", *SMALL)
    toml = Path("blob.caustic/project.toml")
    lines = [line for line in toml.read_text().splitlines() if not line.startswith("shift")]
    toml.write_text("\n".join(lines) + "\n")
    assert Project.open("blob.caustic").scene().screen.shift == (0.0, 0.0)
    for command in (["render", "blob.caustic"], ["design", "--resume", "blob.caustic"]):
        _, err = run(capfd, *command, "--quiet", code=2)
        assert err.startswith("caustic: the screen stands in the light that falls on the mirror and shadows 100% of it")
    with pytest.raises(InputError, match="shadows 100%"):
        load("blob.caustic").render(1e4)
