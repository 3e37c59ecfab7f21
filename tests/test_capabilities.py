"""What a capability supports is what its table says: each of them, in a scene with each trait."""

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from caustic_cli.commands import manpage
from caustic_cli.config.exclusions import EXCLUDED, EXCLUDED_LATER
from caustic_cli.errors import InputError
from caustic_cli.export import FORMATS, page
from caustic_cli.export.lighttools_script import write_script
from caustic_cli.export.milling import Milling
from caustic_cli.export.part import part_of
from caustic_cli.export.supported import refuse
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.waves.unsupported import WAVE_IMAGE
from caustic_cli.scene import (
    Component,
    Disc,
    FoldMirror,
    FreeForm,
    Lens,
    Light,
    Offset,
    PlaneWave,
    Points,
    Scene,
    Screen,
    SecondTarget,
)
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.screen import Sags
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several
from caustic_cli.scene.traits import TRAITS, Capability
from caustic_cli.schema.table import TABLE
from caustic_cli.studies.gradmap import gradient_image
from caustic_cli.studies.manufacture import manufacture
from caustic_cli.studies.shop_page import write_page
from caustic_cli.workflow.capabilities import capabilities
from caustic_cli.workflow.export import _arguments, _home

LENS = Lens(size=(10.0, 10.0), control=(8, 8), index=1.5, offset=Offset(5.0, (math.inf, math.inf)))
PLAIN = Scene(PlaneWave(), LENS, Screen((20.0, 20.0), 100.0, (12, 12)))
AT = (0.0, 0.0, -50.0)


class Ring(Points):
    """A type of source from outside, with the rays of points."""

    emission = "point"


def lens(**changes):
    return replace(PLAIN, lens=replace(LENS, **changes))


def light(**changes):
    return replace(PLAIN, light=Light(**changes))


def screen(**changes):
    return replace(PLAIN, screen=replace(PLAIN.screen, **changes))


def of(source):
    return replace(PLAIN, source=source)


FILE = Measured(RaySet(np.zeros((4, 3)), np.array([[0.01 * k, 0.0, 1.0] for k in range(4)]), np.ones(4)), AT)
FRONT = FreeForm(np.zeros((8, 8)), (3, 3))
RGB = (611.0, 549.0, 464.0)
NONE = ((), ())
#: A scene with each trait, and, as far as possible, without others.
SCENES: dict[str, Scene] = {
    "mirror": replace(PLAIN, lens=replace(LENS, mirror=True), screen=replace(PLAIN.screen, z=-100.0)),
    "gradient index": lens(gradient=Gradient("axial", (0.01,))),
    "two sides": replace(lens(entrance=FRONT), second_target=SecondTarget()),
    "designed entrance": lens(entrance=FRONT),
    "unknown entrance": replace(lens(entrance=FRONT), second_target=SecondTarget()),
    "other elements": replace(PLAIN, elements=(Component(30.0, (20.0, 20.0)),)),
    "unknown elements": replace(PLAIN, elements=(Component(30.0, (20.0, 20.0), free="front", surfaces=(FRONT, None)),)),
    "folded axis": replace(PLAIN, elements=(FoldMirror(50.0, (60.0, 60.0), tilt=(45.0, 0.0)),)),
    "lenslet array": lens(array=(2, 1), control=(11, 8)),
    "round lenslets": lens(array=(2, 1), control=(11, 8), lenslets="round"),
    "circular aperture": lens(aperture="circle"),
    "absorption": lens(absorption=0.01),
    "roughness": lens(roughness=0.1),
    "approximate Fresnel": lens(fresnel="schlick"),
    "polarisation": light(polarisation=30.0),
    "several wavelengths": light(wavelengths=(500.0, 600.0)),
    "coloured picture": light(wavelengths=RGB, color=True),
    "lumens": light(unit="lm"),
    "tilted screen": screen(tilt=(10.0, 0.0)),
    "shifted screen": screen(shift=(3.0, 0.0)),
    "curved screen": screen(radius=(50.0, math.inf)),
    "unrollable screen": screen(sags=Sags(np.zeros((4, 4)), PLAIN.screen.size)),
    "far field": screen(far=True),
    "several sources": of(Several((PlaneWave(), PlaneWave(2.0)), (NONE, NONE))),
    "ray file": of(FILE),
    "ray file among sources": of(Several((PlaneWave(), FILE), (NONE, NONE))),
    "user-defined source": of(Ring((AT,), kind="ring")),
    "laser beam": of(Gaussian((1.0, 1.0), 633.0)),
    "near source": of(Points((AT,))),
    "tilted light": of(PlaneWave(tilt=(20.0, 0.0))),
    "light not parallel": of(Disc(angle=0.5)),
    "separate places": of(Several((PlaneWave(), Points((AT,))), (NONE, NONE))),
    "uneven plane wave": of(PlaneWave(profile=np.array([[1.0, 2.0], [3.0, 4.0]]))),
    "uneven source": of(Disc(AT, brightness=np.array([[1.0, 2.0], [3.0, 4.0]]))),
    "uneven directions": of(Disc(angle=0.5, brightness=np.array([[1.0, 2.0], [3.0, 4.0]]))),
    "tabulated intensity": of(Points((AT,), intensity=Distribution((0.0, 90.0), (1.0, 0.5)))),
    "uneven points": of(Points((AT,), intensity="lambertian")),
    "disc at infinity": of(Disc(angle=0.5)),
    "disc not Lambertian": of(Disc(AT, intensity="uniform")),
    "disc in a cone": of(Disc(AT, cone=20.0)),
    "elliptical disc": of(Disc(AT, (2.0, 1.0))),
    "line source": of(Disc(AT, (2.0, 0.0))),
}
CAPABILITIES = {one.name: one for one in capabilities()}


def surface(scene):
    """Spline spaces and heights of the lens' offset."""
    field = HeightField.of(scene.lens)
    return field, torch.full(field.shape, 5.0, dtype=torch.float64)


def exported(scene, path, format, mould=False):
    """Write the lens in a format as an exporter does, without judging the picture."""
    refuse(scene, format, False, mould)
    part = part_of(format, scene, *surface(scene), mould)
    how = {} if format in ("step", "gcode") else {"samples": (9, 9)}
    write = getattr(_home(format), f"write_{format}")
    if format == "gcode":
        write(path.with_suffix(".nc"), part, Milling(scallop=0.5))
    else:
        write(path.with_suffix(FORMATS[format][0]), *_arguments(format, part), **how)


def scripted(scene, path):
    refuse(scene, "lighttools", True, False)
    write_script(path.with_suffix(".npz"), scene, *surface(scene))


def derived(scene, path):
    field, heights = surface(scene)
    rays = rays_of(scene, "stratified", 500, 0)
    gradient_image(scene, field, heights, (3, 3), sampler=rays, filter=Filter("cosine", (3, 3)))


def reported(scene, path):
    CAPABILITIES["manufacturing report"].refuse(scene)
    manufacture(scene, *surface(scene))


def shopped(scene, path):
    CAPABILITIES["page for the shop"].refuse(scene)
    report = manufacture(scene, *surface(scene))
    write_page(path.with_suffix(".html"), "part", scene, *surface(scene), report, "", (50.0, 40.0), 0)


def imaged(scene, path):
    """Refuse where the plan does not have diffraction by what the scene is."""
    decision = compile_plan(scene, *surface(scene))["diffraction"]
    if decision.why in WAVE_IMAGE.unsupported.values():
        assert not decision.on
        raise InputError(decision.why)


#: How some of the capabilities are used, with a scene and a path.
USED = {f"export to {format}": (lambda scene, path, format=format: exported(scene, path, format)) for format in FORMATS} | {
    "interactive page": lambda scene, path: page.write_page(path, scene, *surface(scene)),
    "moulds": lambda scene, path: exported(scene, path, "stl", True),
    "script for LightTools": scripted,
    "gradmap": derived,
    "manufacturing report": reported,
    "page for the shop": shopped,
    "wave image": imaged,
}


def test_traits_are_those_of_the_scenes():
    assert list(SCENES) == list(TRAITS)
    assert not [name for name, trait in TRAITS.items() if trait.found_in(PLAIN)]
    assert not [name for name, scene in SCENES.items() if not TRAITS[name].found_in(scene)]
    known = {row.partition(" ")[0] for trait in TRAITS.values() for row in trait.settings}
    assert known - {*TABLE} <= {"element", "element.reshapes", "source.also"}


@pytest.mark.parametrize("name", CAPABILITIES)
def test_a_table_names_traits_and_says_why(name):
    one = CAPABILITIES[name]
    assert {*one.unsupported} <= {*TRAITS} and one.supports(PLAIN) and one.why_not(PLAIN) == ""
    for trait, message in one.unsupported.items():
        words = {"format": "stl", "study": name, "others": "rays"}
        said = one.why_not(SCENES[trait], **words)
        assert said and not one.supports(SCENES[trait]) and "{" not in said
        assert "{}" not in message or TRAITS[trait].words in said


def test_capabilities_have_names_of_their_own():
    counted = Counter(one.name for one in capabilities())
    assert {name for name, count in counted.items() if count > 1} == {"images"}  # of outputs without a table
    assert len(counted) > 30 and all(isinstance(one, Capability) for one in capabilities())


@pytest.mark.parametrize("trait", SCENES)
@pytest.mark.parametrize("name", USED)
def test_a_scene_is_refused_or_accepted_as_the_table_says(name, trait, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "CELLS", (32,))
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")  # what is refused is not the kernels'; those of a scene take long to compile
    one, scene = CAPABILITIES[name], SCENES[trait]
    format = "lighttools" if "script" in name else "stl" if name == "moulds" else name.rpartition(" ")[2]
    if why := one.why_not(scene, format=format):
        with pytest.raises(InputError) as refused:
            USED[name](scene, tmp_path / "lens")
        assert str(refused.value) == str(InputError(why))
    else:
        USED[name](scene, tmp_path / "lens")
    assert (trait in one.unsupported) <= bool(why)


def test_what_excludes_each_other_are_settings():
    rows = {entry.partition(" ")[0] for feature, others in (EXCLUDED | EXCLUDED_LATER).items() for entry in (feature, *others)}
    assert rows - {*TABLE} <= {"element", "element.reshapes", "source.also"} and len(rows) > 20


def test_the_guide_has_the_matrix_of_today():
    for name in manpage.DOCUMENTS:
        text = (Path(__file__).parents[1] / name).read_text("utf-8")
        assert text == manpage.document(name, text), "python -m caustic_cli.commands.manpage man"
