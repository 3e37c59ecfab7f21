"""The keys that the manual lists are those of the archives, with their shapes."""

import math
import re
from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
import torch

from caustic_cli.commands import manpage
from caustic_cli.export.archive_keys import KEYS
from caustic_cli.export.lighttools import write_lighttools
from caustic_cli.io.archive import open_archive
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.scene import Component, Disc, FreeForm, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.elements import FoldMirror
from caustic_cli.scene.gradient import Gradient
from caustic_cli.scene.screen import Sags
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.gaussian import Gaussian
from caustic_cli.scene.sources.measured_beam import MeasuredBeam
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.rayset import RaySet
from caustic_cli.scene.sources.several import Several
from caustic_cli.scene.spectrum import Measure, Spectrum

LENS = Lens((10.0, 8.0), control=(8, 7), degree=(3, 2), offset=Offset(5.0))
SCREEN = Screen((20.0, 16.0), 100.0, (10, 8))
FRONT = FreeForm(np.zeros((6, 9)), (3, 2))
CURVE = FreeForm(
    np.zeros((5, 4)), (2, 1), (np.repeat([0.0, 0.3, 0.6, 1.0], [3, 1, 1, 3]), np.repeat([0.0, 0.3, 0.6, 1.0], [2, 1, 1, 2]))
)
RAYS = Measured(RaySet(np.zeros((4, 3)), np.array([[0.01 * k, 0.0, 1.0] for k in range(4)]), np.ones(4)))
TABLE = Distribution((0.0, 20.0, 60.0), (1.0, 0.8, 0.0))
LED = Measure(Spectrum("led", np.array([450.0, 550.0, 650.0]), np.array([1.0, 2.0, 1.0])), "eye")
PLAIN = Scene(PlaneWave(), LENS, SCREEN)
#: Together they have every key.
SCENES = {
    "plain": PLAIN,
    "profile": replace(PLAIN, source=PlaneWave(profile=np.ones((3, 4))), light=Light(polarisation=30.0, unit="lm")),
    "tilted": replace(PLAIN, source=PlaneWave(tilt=(20.0, 0.0))),
    "beam": replace(PLAIN, source=Gaussian((1.0, 2.0), 633.0, -40.0, 1.5)),
    "measured beam": replace(PLAIN, source=MeasuredBeam(np.zeros((5, 6)), 633.0)),
    "far": replace(PLAIN, screen=replace(SCREEN, far=True, z=1000.0)),
    "radial": replace(PLAIN, lens=replace(LENS, gradient=Gradient("radial", (-1e-3,)))),
    "volume": replace(PLAIN, lens=replace(LENS, gradient=Gradient("volume", volume=np.full((4, 5, 3), 1.5)))),
    "round lenslets": replace(PLAIN, lens=replace(LENS, array=(2, 3), control=(11, 10), lenslets="round")),
    "sun": replace(PLAIN, source=Disc(angle=0.5, brightness=np.ones((3, 5)))),
    "grid": replace(PLAIN, source=Points(((0.0, 0.0, -30.0), (1.0, 0.0, -30.0)), kind="grid", intensity=TABLE)),
    "disc": replace(PLAIN, source=Disc(), light=Light(wavelengths=(500.0, 600.0), measure=LED, efficacy=300.0)),
    "rays": replace(PLAIN, source=replace(RAYS, tilt=(20.0, 0.0))),
    "several": replace(PLAIN, source=Several((PlaneWave(), Points(((0.0, 0.0, -20.0),)), RAYS), (((), ()),) * 3)),
    "colour": replace(PLAIN, light=Light(wavelengths=(611.0, 549.0, 464.0), weights=(1.0, 2.0, 1.0), color=True)),
    "lens": replace(
        PLAIN, lens=replace(LENS, absorption=0.01, roughness=0.001, fresnel="schlick", aperture="circle", size=(10.0, 10.0))
    ),
    "glass": replace(PLAIN, lens=replace(LENS, glass="N-BK7", index=1.5168)),
    "mirror": replace(PLAIN, lens=replace(LENS, mirror=True), screen=replace(SCREEN, z=-100.0)),
    "entrance": replace(PLAIN, lens=replace(LENS, entrance=FRONT)),
    "sphere": replace(PLAIN, screen=replace(SCREEN, tilt=(10.0, 0.0), shift=(1.0, 2.0), radius=(60.0, math.inf))),
    "turned": replace(PLAIN, screen=replace(SCREEN, tilt=(0.0, 20.0, 90.0)), source=Disc(angle=0.5, tilt=(0.0, 20.0))),
    "sag": replace(PLAIN, screen=replace(SCREEN, sags=Sags(np.zeros((8, 7)), (20.0, 16.0)))),
    "elements": replace(
        PLAIN,
        elements=(
            Component(20.0, (14.0, 12.0), glass="N-BK7", surfaces=(CURVE, CURVE)),
            FoldMirror(60.0, (60.0, 60.0), tilt=(45.0, 0.0)),
        ),
    ),
}
ALL = {key.name: key for key in chain(*KEYS.values())}


def listed(name: str) -> str:
    """The entry of the list for a key of an archive."""
    if re.match(r"source_\d+_", name):
        return "source_K_NAME"
    return re.sub(r"^element_\d+_(front|back)_", "element_K_SIDE_", name)


def archive(scene: Scene, path) -> dict[str, np.ndarray]:
    field = HeightField.of(scene.lens)
    write_lighttools(path, scene, field, torch.full(field.shape, 5.0, dtype=torch.float64), (9, 11))
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


def matches(text: str, shape: tuple[int, ...], sizes: dict[str, int]) -> bool:
    """Whether a shape is as the list says; letters other than k, a and b have one size in an archive."""
    words = re.findall(r"\w+", text)
    own: dict[str, int] = {}
    return len(words) == len(shape) and all(
        int(w) == n if w.isdigit() else (own if w in "kab" else sizes).setdefault(w, n) == n
        for w, n in zip(words, shape, strict=True)
    )


@pytest.mark.parametrize("name", SCENES)
def test_every_key_is_listed_with_its_shape_and_type(name, tmp_path):
    sizes: dict[str, int] = {}
    data = archive(SCENES[name], tmp_path / "a.npz")
    for key, array in data.items():
        entry = ALL[listed(key)]
        if entry.name == "source_K_NAME":
            entry = ALL[re.sub(r"_\d+", "", key) if "cone" not in key else "cone_half_angle"]
        assert matches(entry.shape, array.shape, sizes), f"{key}: {entry.shape}, not {array.shape}"
        assert array.dtype.kind == {"whole": "i", "text": "U"}.get(entry.unit, "f"), key
    assert {key.name for key in ALL.values() if key.always} <= set(data)
    assert sizes["N"] == sizes["nx"] * sizes["ny"] and sizes["p"] == sizes["n"] + 4 and sizes["q"] == sizes["m"] + 3


def test_every_listed_key_is_written(tmp_path):
    written = {listed(key) for name, scene in SCENES.items() for key in archive(scene, tmp_path / f"{name}.npz")}
    assert written == set(ALL)


def test_the_manual_lists_them():
    section = manpage.build().split(".SH LIGHTTOOLS ARCHIVE")[1].split(".SH ")[0]
    assert re.findall(r"^\\fB(\w+)\\fR", section, re.M) == list(ALL)
    assert re.findall(r"^\.SS (.*)$", section, re.M) == list(KEYS)


@pytest.mark.parametrize("name", ["beam", "measured beam", "far", "radial", "volume", "round lenslets"])
def test_such_scenes_come_back(name, tmp_path):
    """Light that their archives send through the lens lands where that of the scenes does."""
    scene = SCENES[name]
    if name == "measured beam":
        scene = replace(scene, source=replace(scene.source, phase=np.add.outer(np.arange(5.0) ** 2, np.arange(6.0)) / 9.0))
    if name == "far":
        scene = replace(scene, screen=replace(scene.screen, size=(200.0, 160.0)))
    if name == "volume":
        ramp = 1.5 + 3e-4 * np.arange(60.0).reshape(4, 5, 3)
        scene = replace(scene, lens=replace(scene.lens, gradient=Gradient("volume", volume=ramp)))
    field = HeightField.of(scene.lens)
    x, y = field.control_xy()
    heights = 5.0 + 0.01 * (x[:, None] ** 2 + x[:, None] * y[None, :])
    write_lighttools(tmp_path / "a.npz", scene, field, heights)
    again = open_archive(tmp_path / "a.npz")
    images = [expose(*lens, rays_of(lens[0], "stratified", 5000)).image for lens in ((scene, field, heights), again)]
    assert float(images[0].sum()) > 0.3
    assert images[1].numpy() == pytest.approx(images[0].numpy(), abs=1e-7)
    plain = replace(scene, source=PLAIN.source, screen=PLAIN.screen, lens=replace(scene.lens, gradient=None, array=(1, 1)))
    other = expose(plain, field, heights, rays_of(plain, "stratified", 5000)).image
    assert float((other - images[0]).abs().sum()) > 1e-3
