"""Manufacturing and alignment errors: their file, draws, surface errors, tracing, tolerance analysis, and robust designs."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import misaligned
import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.config import tolerances as schema
from caustic_cli.errors import InputError
from caustic_cli.inverse.losses import Loss
from caustic_cli.inverse.objective import Evaluation
from caustic_cli.inverse.robust import robust_objective
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.emission.coherent import central_mode
from caustic_cli.optics.form_error import FormErrors, refined
from caustic_cli.optics.frames import Pose, rotate_to_global
from caustic_cli.optics.misalignment import Misalignment, landing_points, reason_ignored
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Disc, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.light import Light
from caustic_cli.scene.materials import refractive_index
from caustic_cli.scene.room import tilt_of
from caustic_cli.scene.sources.distribution import Distribution
from caustic_cli.scene.sources.several import Several
from caustic_cli.scene.tolerances import KINDS, FormError, Waviness, hypercube
from caustic_cli.studies import tolerances as study
from caustic_cli.studies.tolerances_by_waves import WaveTrials

EXAMPLE = Path(__file__).parents[1] / "examples" / "tolerances.toml"
ALL = Misalignment(0.003, 0.04, 2.0, (0.3, -0.2), 1.5, 0.1, (0.4, -0.3), (0.2, -0.1), (0.7, -0.5), (0.5, 0.3), (3.0, -2.0))


def small(source=None, control=24) -> tuple[Scene, HeightField, torch.Tensor]:
    """A concave lens with a little relief, 32 x 32 pixels."""
    lens = Lens((10.0, 10.0), control=(control, control), offset=Offset(5.0, (80.0, 80.0)))
    scene = Scene(source or PlaneWave(), lens, Screen((34.0, 34.0), 300.0, (32, 32)))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())
    relief = 0.004 * np.sin(0.7 * x)[:, None] * np.cos(0.5 * y)[None, :]
    return scene, field, torch.from_numpy(5.0 + lens.offset.sag(x[:, None], y[None, :]) + relief)


def test_the_example_is_read_and_names_every_error():
    found = schema.read(EXAMPLE)
    assert {e.name for e in found.errors} == set(KINDS) and found.form is not None and found.draws == 200
    shift = next(p for p in found.parameters if p.name == "throw")
    assert shift.distribution == "half_width" and shift.sigma == pytest.approx(3.0 / math.sqrt(3.0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[thro]\nsigma = 1", "did you mean throw?"),
        ("[throw]\nwidth = 1", "[throw] must say sigma (normal) or half_width (uniform)"),
        ("[throw]\nsigma = 1\nhalf_width = 1", "one of them"),
        ("[throw]\nsigma = [1, 2]", "[throw] sigma must be a number, got 2 numbers"),
        ("[lens_tilt]\nsigma = 'a'", "must be a number or a pair of numbers"),
        ("[lens_tilt]\nsigma = -1", "must be 0 to 10, got -1"),
        ("[throw]\nsigma = 0", "all widths are 0"),
        ("draws = 3\n[throw]\nsigma = 1", "draws must be a whole number 10 to 100000, got 3"),
        ("[form_error]\nexponent = 2", "rms is missing"),
        ("[form_error]\nrms = 1e-4\nlongest = 1\nshortest = 2", "longest must exceed shortest"),
        ("[waviness]\namplitude = 1e-4", "period is missing"),
        ("throw = 1", "must be a section"),
        ("[throw", "is not valid TOML"),
    ],
)
def test_what_a_file_may_not_say(text, words):
    with pytest.raises(InputError) as error:
        schema.parse(text, "t.toml")
    assert words in str(error.value) and str(error.value).startswith("t.toml: ") and "\n" not in str(error.value)


def test_a_hypercube_has_one_draw_in_every_part():
    parameters = schema.parse("[throw]\nhalf_width = 2\n[lens_tilt]\nsigma = [1, 2]", "t").parameters
    drawn = hypercube(parameters, 50, 3)
    assert sorted(np.floor((drawn[:, 0] + 2.0) / 4.0 * 50).astype(int)) == list(range(50))
    assert drawn[:, 1:].std(0) == pytest.approx([1.0, 2.0], rel=0.05)
    assert not np.allclose(drawn, hypercube(parameters, 50, 3, 1))


def test_a_form_error_has_its_rms_and_its_spectrum():
    """Of 24 realisations on the surface itself: RMS, power-law slope within the band, and next to nothing beyond it."""
    _, field, _ = small(control=103)
    errors = FormErrors(field, FormError(1e-4, 2.5, 10.0, 1.0), None)
    n = 256
    at = torch.linspace(-5.0, 5.0, n + 1, dtype=torch.float64)[:-1]
    x, y = (c.reshape(-1) for c in torch.meshgrid(at, at, indexing="ij"))
    power, squares = 0.0, []
    window = np.hanning(n)[:, None] * np.hanning(n)[None, :]
    for k in range(24):
        h = field.at(errors.heights(np.random.default_rng(k), ("form_error",)), x, y, [(0, 0)])[0].view(n, n).numpy()
        squares.append(np.mean(h * h))
        power = power + np.abs(np.fft.fft2(h * window)) ** 2
    assert math.sqrt(np.mean(squares)) == pytest.approx(1e-4, rel=0.08)  # 24 realisations of a few dozen strong modes: 4 %
    f = np.fft.fftfreq(n, 10.0 / n)
    radius = np.hypot(f[:, None], f[None, :])
    rings = [(radius > r / 1.15) & (radius < r * 1.15) for r in (0.3, 0.45, 0.67)]
    slope = np.polyfit(np.log([radius[r].mean() for r in rings]), np.log([power[r].mean() for r in rings]), 1)[0]
    assert slope == pytest.approx(-2.5, abs=0.3)
    assert power[radius > 1.5].sum() < 1e-3 * power.sum()
    exact = errors.form_values(np.random.default_rng(0), at.numpy(), at.numpy())
    spline = field.at(errors.heights(np.random.default_rng(0), ("form_error",)), x, y, [(0, 0)])[0].view(n, n).numpy()
    assert np.abs(spline - exact).max() < 1e-6  # 1 % of the RMS


def test_waviness_is_a_sine_across_its_direction():
    _, field, heights = small()
    field, _ = refined(field, heights, 1.0)
    wave = FormErrors(field, None, Waviness(2e-4, 1.0, 90.0)).heights(np.random.default_rng(1), ("waviness",))
    y = torch.linspace(-4.0, 4.0, 400, dtype=torch.float64)
    along = field.at(wave, torch.zeros_like(y), y, [(0, 0), (1, 0)])
    assert float(along[1].abs().max()) < 1e-9
    assert float(along[0].max()) == pytest.approx(2e-4, rel=0.01) and float(along[0].min()) == pytest.approx(-2e-4, rel=0.01)
    crossings = int((along[0].sign().diff() != 0).sum())
    assert 15 <= crossings <= 17


def test_a_refined_net_is_the_same_surface():
    _, field, heights = small()
    finer, net = refined(field, heights, 1.0)
    assert finer.shape > field.shape
    x, y = torch.rand(2, 500, dtype=torch.float64) * 9.8 - 4.9
    for a, b in zip(field.at(heights, x, y), finer.at(net, x, y), strict=True):
        assert float((a - b).abs().max()) < 1e-11
    with pytest.raises(InputError, match="must be at least"):
        refined(field, heights, 1e-3)


def test_the_lens_frame_is_the_rooms():
    """The same rays in the room's frame, where surfaces are turned and shifted, land at the same points."""
    scene, field, heights = small()
    rays = rays_of(scene, "stratified", 900, 4)
    (here,) = landing_points(scene, field, heights, rays, ALL)
    system, screen = misaligned.room(scene, field, ALL)
    stand = ALL.frame(scene)
    (sample,) = rays.chunks()
    on = RayState.on_axis(sample, scene.lens.half_size, scene.lens.z_in).expanded()
    inside = rotate_to_global(stand, (on.origin[0], on.origin[1], torch.zeros_like(on.power)))
    direction = rotate_to_global(Pose(tilt=ALL.source_tilt), (0.0, 0.0, 1.0))
    start = tuple(p + o - 3.0 * d for p, o, d in zip(inside, stand.position, direction, strict=True))
    state = RayState(start, tuple(torch.full_like(on.power, d) for d in direction), on.power)
    there = Tracer(system, state).land({EXIT: heights}, screen)[0]
    lit = there.power > 0
    assert int(lit.sum()) > 850
    for a, b in ((here.x, there.origin[0]), (here.y, there.origin[1])):
        assert float((a - b)[lit].abs().max()) < 1e-9


def test_a_near_source_moves_against_the_lens():
    """A source, a lens and a screen that are shifted alike are what they were; a wider disc is a wider disc."""
    scene, field, heights = small(Points(((0.0, 0.0, -100.0),)))
    together = Misalignment(source_shift=(0.4, 0.3), lens_shift=(0.4, 0.3), screen_shift=(0.4, 0.3))
    found = [
        next(iter(landing_points(scene, field, heights, rays_of(e.scene(scene), "sobol", 500, 1), e)))
        for e in (Misalignment(), together)
    ]
    assert float((found[0].x - found[1].x).abs().max()) < 1e-9 and float((found[0].power - found[1].power).abs().max()) < 1e-12
    disc = replace(scene, source=Disc((0.0, 0.0, -100.0), (2.0, 3.0)))
    assert Misalignment(source_size=0.1).scene(disc).source.size == pytest.approx((2.2, 3.3))
    nearer = Misalignment(source_distance=10.0)
    power = [
        sum(float(p.power.sum()) for p in landing_points(scene, field, heights, rays_of(e.scene(scene), "sobol", 4000, 1), e))
        for e in (Misalignment(), nearer)
    ]
    assert power[1] / power[0] == pytest.approx((100.0 / 90.0) ** 2, rel=0.01)  # the lens catches more of the same light


AT = (np.arange(100) + 0.5) / 10.0 - 5.0


def beam(x: float = 0.0, y: float = 0.0) -> np.ndarray:
    """A lopsided beam about (x, y) mm over the lens of `small`, on cells of 0.1 mm, and dark at its edges."""
    u, v = AT[:, None] - x, AT[None, :] - y
    return np.clip(1.0 - (u * u + 2.0 * v * v + 0.3 * u * v) / 12.0, 0.0, None)


@pytest.mark.parametrize("aperture", ["rectangle", "circle"])
def test_a_profile_moves_with_its_beam(aperture):
    """A decentred beam, or a lens decentred the other way, is the beam that was drawn there; and no power is lost or gained."""
    scene, field, heights = small(PlaneWave(profile=beam()))
    scene = replace(scene, lens=replace(scene.lens, aperture=aperture))
    there = replace(scene, source=PlaneWave(profile=beam(0.7, -0.4)))

    def landed(s: Scene, e: Misalignment):
        (found,) = landing_points(s, field, heights, rays_of(e.scene(s), "sobol", 20_000, 1), e)
        return found

    drawn, before = landed(there, Misalignment()), landed(scene, Misalignment())
    within = AT[:, None] ** 2 + AT[None, :] ** 2 < (25.0 if aperture == "circle" else math.inf)
    more = beam(0.7, -0.4)[within].sum() / beam()[within].sum()
    for e in (Misalignment(source_shift=(0.7, -0.4)), Misalignment(lens_shift=(-0.7, 0.4), screen_shift=(-0.7, 0.4))):
        found = landed(scene, e)
        assert float((found.power / more - drawn.power).abs().max()) < 1e-3 * float(drawn.power.max())
        assert float((found.x - drawn.x).abs().max()) < 1e-9
    together = Misalignment(source_shift=(0.7, -0.4), lens_shift=(0.7, -0.4))
    assert torch.equal(landed(scene, together).power, before.power)
    assert float((before.power - drawn.power).abs().max()) > 0.3 * float(drawn.power.max())


def test_a_wavelength_is_the_index_of_its_glass():
    scene, field, heights = small()
    scene = replace(scene, lens=replace(scene.lens, glass="N-BK7"), light=Light(wavelengths=(550.0,)))
    more = refractive_index("N-BK7", 550.0 * 1.05) - refractive_index("N-BK7", 550.0)
    rays = rays_of(scene, "sobol", 5_000, 1)
    (own,), (index,), (before,) = (
        landing_points(scene, field, heights, rays, e)
        for e in (Misalignment(wavelength=0.05), Misalignment(index=more), Misalignment())
    )
    assert torch.allclose(own.x, index.x, atol=1e-12) and float((own.x - before.x).abs().max()) > 1e-3
    assert not reason_ignored(scene, "wavelength") and "glass" in reason_ignored(small()[0], "wavelength")


@pytest.mark.parametrize("source", [PlaneWave(), Points(((0.0, 0.0, -60.0),)), PlaneWave(tilt=(10.0, 0.0))])
def test_a_narrower_aperture_cuts_the_edge_off(source):
    scene, field, heights = small(source)
    rays = rays_of(scene, "sobol", 60_000, 1)
    (whole,), (wide,), (narrow,) = (landing_points(scene, field, heights, rays, Misalignment(aperture=a)) for a in (0.0, 0.2, -0.2))
    assert torch.equal(whole.power, wide.power) and torch.equal(narrow.x, whole.x)
    cut = whole.power != narrow.power
    assert float(narrow.power[cut].sum()) == 0.0 and 0.2 < float(whole.power[cut].sum() / whole.power.sum()) < 0.4
    if source.collimated and not source.oblique:
        assert float(narrow.power.sum() / whole.power.sum()) == pytest.approx(0.64, abs=0.002)
    else:  # the light spreads within the lens: what is far from the axis behind it was so before
        reach = torch.maximum(whole.x.abs(), (whole.y - whole.y.mean()).abs())
        assert float(reach[cut].min()) > 0.6 * float(reach[~cut].max())


def test_the_decentre_of_a_beam_is_in_the_study():
    """The sensitivity is the error of the drawn beam, in both directions; a uniform profile is as good as none."""
    text = "draws = 10\n[source_shift]\nsigma = [0.5, 0]\n[lens_shift]\nsigma = [0.5, 0]"
    scene, field, heights = small(PlaneWave(profile=beam()))
    target = np.mean(study.Trials(scene, field, heights, np.ones((32, 32)), schema.parse(text, "t")).images({}), 0)[0]

    def of(profile: np.ndarray | None) -> study.Trials:
        lit = replace(scene, source=PlaneWave(profile=profile))
        return study.Trials(lit, field, heights, target, schema.parse(text, "t"), rays=40_000)

    found = {s.name: s for s in study.sensitivities(of(beam()))}
    for sign, error in ((-1, found["source_shift x"].below), (1, found["source_shift x"].above)):
        assert error == pytest.approx(of(beam(0.5 * sign)).evaluate({}).relative_rms, rel=0.01) and error > 0.1
    values = {("source_shift", 0): 0.5}
    still, moved = (of(np.full((3, 5), 2.0)).evaluate(v) for v in ({}, values))
    assert moved.relative_rms == pytest.approx(still.relative_rms, rel=1e-9)
    assert moved.on_screen == pytest.approx(still.on_screen, rel=1e-9)
    assert list(study.study(of(None)).unused) == ["source_shift"]


def test_a_robust_design_moves_the_beam():
    """Opposite draws have the beam on opposite sides of the middle."""
    scene, field, heights = small(PlaneWave(profile=beam()))
    scenes: list[Scene] = []

    class Flat:
        loss = Loss("rms", torch.ones(32, 32, dtype=torch.float64))

    def objective(s: Scene, _) -> Flat:
        scenes.append(s)
        return Flat()

    robust_objective(objective, scene, field, heights, schema.parse("[lens_shift]\nsigma = [0.5, 0]", "t"))
    middles = []
    for light in (s.source.profile for s in scenes):
        x = (np.arange(len(light)) + 0.5) / len(light) * 10.0 - 5.0
        middles.append(float(x @ light.sum(1) / light.sum()))
    assert middles[0] == pytest.approx(0.0, abs=1e-9) and min(abs(m) for m in middles[1:]) > 0.05
    assert middles[1] == pytest.approx(-middles[2], rel=0.05) and middles[3] == pytest.approx(-middles[4], rel=0.05)


def test_a_wave_image_brightens_as_its_rays_do():
    """The warped image of a decentred beam beside its own; both were the same as without the error while the beam stood still."""
    scene, field, heights = small(PlaneWave(profile=np.exp(-(AT[:, None] ** 2 + AT[None, :] ** 2) / 8.0)))
    errors = schema.parse("[source_shift]\nsigma = 0.5", "t")

    def image(s: Scene, *_) -> np.ndarray:  # of rays: smooth, and quick
        return np.mean(study.Trials(s, field, heights, np.ones((32, 32)), errors).images({}), 0)[0]

    t = WaveTrials(scene, field, heights, image(scene), errors, waves=image)
    quick, own = t.by_waves({("source_shift", 0): 0.5}, None)
    assert t.evaluate({}).relative_rms < 0.02 and own.relative_rms > 0.15
    assert quick.relative_rms == pytest.approx(own.relative_rms, rel=0.1)


@pytest.mark.parametrize("cone", [None, 7.0, 2.0], ids=["over the lens", "wide", "within the lens"])
def test_a_tilted_lens_leaves_the_axis_of_a_source(cone):
    """A narrow beam by its table, beside random rays of a source that stands in the room."""
    angles = np.linspace(0.0, 8.0, 81)
    table = Distribution(tuple(angles), tuple(np.exp(-((angles / 2.5) ** 2))))
    scene, field, heights = small(Points(((0.0, 0.0, -50.0),), intensity=table, cone=cone))
    scene = replace(scene, screen=replace(scene.screen, size=(60.0, 60.0)))
    e = Misalignment(lens_tilt=(2.0, -1.0), source_shift=(0.3, -0.2), source_distance=2.0)
    parts = landing_points(scene, field, heights, rays_of(e.scene(scene), "sobol", 100_000, 1), e)
    edges = [np.linspace(-30.0, 30.0, 33)] * 2
    found = sum(np.histogram2d(p.x.numpy(), p.y.numpy(), edges, weights=p.power.numpy())[0] for p in parts)

    def intensity(angle: np.ndarray) -> np.ndarray:
        values = np.interp(np.degrees(angle), table.angles, table.values, right=0.0)
        return np.where(np.degrees(angle) <= (cone or 90.0), values, 0.0)

    brute = misaligned.near_image(scene, field, heights, e, intensity, 400_000, np.random.default_rng(1))
    brute /= table.flux(scene.source.cone_over(scene.lens.pupil))
    assert found.sum() == pytest.approx(brute.sum(), rel=1e-3)
    assert (
        np.sqrt(np.mean((found - brute) ** 2)) < 0.1 * brute.mean()
    )  # 3 to 4 % are the noise of the rays; 100 % with the lens' axis
    modes = central_mode(e.scene(scene)).through(*torch.full((2, 1), 0.5, dtype=torch.float64))
    straight = central_mode(replace(e, lens_tilt=(0.0, 0.0)).scene(scene)).through(*torch.full((2, 1), 0.5, dtype=torch.float64))
    assert float(modes.power) > 0.9 * float(straight.power)


def test_a_source_that_is_dark_on_its_axis_moves():
    ring = Points(((0.0, 0.0, -100.0),), intensity=Distribution((0.0, 10.0), (0.0, 1.0)))
    scene, field, heights = small(ring)
    power = [
        sum(float(p.power.sum()) for p in landing_points(scene, field, heights, rays_of(e.scene(scene), "sobol", 4000, 1), e))
        for e in (Misalignment(), Misalignment(source_distance=10.0))
    ]
    assert power[1] / power[0] == pytest.approx((100.0 / 90.0) ** 3, rel=0.02)  # its intensity is proportional to the angle


def test_the_size_of_one_of_several_sources_counts():
    disc = Disc((0.0, 0.0, -100.0), (2.0, 2.0))
    scene, _, _ = small(Several((disc, PlaneWave())))
    assert not reason_ignored(scene, "source_size") and reason_ignored(replace(scene, source=PlaneWave()), "source_size")
    assert Misalignment(source_size=0.1).scene(scene).source.members[0].size == pytest.approx((2.2, 2.2))


def test_an_upright_scene_is_close():
    """What a design for errors sees of a draw: within a pixel of 1 mm, of light moved by many."""
    scene, field, heights = small()
    e = replace(ALL, source_shift=(0.0, 0.0), source_distance=0.0, source_size=0.0, screen_tilt=(0.0, 0.0))
    rays = rays_of(scene, "stratified", 400, 4)
    (exact,) = landing_points(scene, field, heights, rays, e)
    near = e.upright(scene)
    (close,) = landing_points(near, field, heights + e.thickness, rays, Misalignment())
    (still,) = landing_points(scene, field, heights, rays, Misalignment())
    apart = [float(torch.hypot(exact.x - o.x, exact.y - o.y).mean()) for o in (close, still)]
    assert apart[0] < 0.2 and apart[1] > 1.5


@pytest.mark.parametrize("tilt", [(12.0, -7.0), (0.0, 25.0)])
@pytest.mark.parametrize(
    "error",
    [Misalignment(source_tilt=(0.4, -0.3)), Misalignment(lens_tilt=(0.5, 0.2)), Misalignment(lens_shift=(0.6, -0.4), throw=2.0)],
    ids=["source", "lens", "place"],
)
def test_an_upright_scene_is_close_in_tilted_light(tilt, error):
    plain, field, heights = small()
    source = PlaneWave(tilt=tilt)
    x, y, z = source.axis
    scene = replace(plain, source=source, screen=Screen((34.0, 34.0), 300.0 * z, (32, 32), tilt, (300.0 * x, 300.0 * y)))
    rays = rays_of(scene, "stratified", 400, 4)
    (exact,), (still,) = (landing_points(scene, field, heights, rays, e) for e in (error, Misalignment()))
    near = error.upright(scene)
    (close,) = landing_points(near, field, heights, rays_of(near, "stratified", 400, 4), Misalignment())
    apart = [float(torch.hypot(exact.x - o.x, exact.y - o.y).mean()) for o in (close, still)]
    assert apart[0] < 0.05 and apart[1] > (0.08 if any(error.lens_tilt) else 0.5)  # mm; pixels are of 1 mm


@pytest.mark.parametrize(
    "error", [Misalignment(source_tilt=(0.4, -0.3)), Misalignment(lens_tilt=(0.5, 0.2))], ids=["source", "lens"]
)
def test_an_upright_mirror_is_close(error):
    """Its light goes back, and a mirror that is turned turns it twice as far."""
    lens = Lens(control=(8, 8), offset=Offset(5.0), mirror=True)
    scene, field = Scene(PlaneWave(), lens, Screen((30.0, 30.0), -100.0, (32, 32))), HeightField.of(lens)
    heights = torch.full((8, 8), 5.0, dtype=torch.float64)
    rays = rays_of(scene, "stratified", 400, 4)
    (exact,), (still,) = (landing_points(scene, field, heights, rays, e) for e in (error, Misalignment()))
    (close,) = landing_points(error.upright(scene), field, heights, rays, Misalignment())
    apart = [float(torch.hypot(exact.x - o.x, exact.y - o.y).mean()) for o in (close, still)]
    assert apart[0] < 0.15 * apart[1] and apart[1] > 0.8


@pytest.mark.parametrize("source", [PlaneWave(tilt=(30.0, -25.0)), Disc(angle=1.0, tilt=(0.0, 40.0))], ids=["plane", "sun"])
@pytest.mark.parametrize("axis", [0, 1])
def test_the_direction_of_tilted_light_is_a_tolerance(tmp_path, source, axis):
    """Its derivative is the difference of images in light of two other directions."""
    plain, field, heights = small()
    x, y, z = source.axis
    screen = Screen((34.0, 34.0), 300.0 * z, (32, 32), source.tilt, (300.0 * x, 300.0 * y))
    scene = replace(plain, source=source, screen=screen)
    (tmp_path / "t.toml").write_text("[source_tilt]\nsigma = [0.5, 0.5]\n")
    errors = schema.read(tmp_path / "t.toml")
    found = study.Trials(scene, field, heights, np.ones((32, 32)), errors, rays=400_000)
    assert [p.error for p in found.parameters] == ["source_tilt"] * 2
    images, wanted = [], []
    for sign in (-0.5, 0.5):
        images.append(sum(found.images({("source_tilt", axis): sign}))[0])
        turned = rotate_to_global(Pose(tilt=(sign, 0.0) if axis == 0 else (0.0, sign)), source.axis)
        lit = replace(scene, source=replace(source, tilt=tilt_of(turned)))
        wanted.append(expose(lit, field, heights, rays_of(lit, "stratified", 4_000_000)).image.numpy())
    slope, known = ((b / b.mean() - a / a.mean()) / 1.0 for a, b in (images, wanted))
    assert (slope * known).sum() / (known**2).sum() == pytest.approx(1.0, abs=0.04)
    assert np.linalg.norm(slope - known) < 0.25 * np.linalg.norm(known)
    row = {s.name: s for s in study.sensitivities(found)}[f"source_tilt {'xy'[axis]}"]
    assert row.derivative == pytest.approx(np.sqrt((known**2).mean()), rel=0.05)


@pytest.mark.parametrize("mirror", [False, True])
def test_an_error_of_the_distance_is_along_the_light(mirror):
    """A picture in tilted light stays in the middle of a screen that is further away."""
    lens = Lens((10.0, 10.0), control=(8, 8), offset=Offset(5.0), mirror=mirror)
    side, source = lens.interaction.side, PlaneWave(tilt=(30.0, -25.0))
    (x, y, z), tilt = source.axis, (30.0 * side, -25.0 * side)
    scene = Scene(source, lens, Screen((34.0, 34.0), 100.0 * side * z, (32, 32), tilt, (100.0 * x, 100.0 * y)))
    field, heights = HeightField.of(lens), torch.full((8, 8), 5.0, dtype=torch.float64)
    rays = rays_of(scene, "stratified", 400, 4)
    (still,), (moved,) = (landing_points(scene, field, heights, rays, e) for e in (Misalignment(), Misalignment(throw=10.0 * side)))
    assert float((still.x - moved.x).abs().max()) < 1e-9 and float((still.y - moved.y).abs().max()) < 1e-9


def test_the_best_shift_is_found():
    x = np.arange(48.0)
    spot = np.exp(-((x[:, None] - 22.3) ** 2 + (x[None, :] - 25.6) ** 2) / 30.0)
    there = np.exp(-((x[:, None] - 24.7) ** 2 + (x[None, :] - 22.6) ** 2) / 30.0)
    _, shift = study.best_shift(there, spot)
    assert shift == pytest.approx((2.4, -3.0), abs=0.02)


def trials(text: str, source=None, rays=40_000) -> study.Trials:
    scene, field, heights = small(source)
    e = Misalignment()
    target = sum(
        misaligned.image(scene, field, heights, e, 40_000, np.random.default_rng(k)) if source is None else np.ones((32, 32))
        for k in range(2)
    )
    return study.Trials(scene, field, heights, target, schema.parse(text, "t"), rays=rays)


def test_percentiles_are_those_of_brute_force():
    """60 draws beside 250 independent ones, each traced in the room's frame with random rays of its own."""
    found = study.study(
        t := trials("draws = 60\n[throw]\nsigma = 8\n[lens_tilt]\nsigma = 0.5\n[screen_shift]\nsigma = 0.7\n[index]\nsigma = 0.002")
    )
    quick = study.figures(found)
    rng, brute = np.random.default_rng(7), []
    for _ in range(250):
        values = {(p.error, p.axis): float(p.sigma * rng.standard_normal()) for p in t.parameters}
        e = Misalignment.of(values)
        brute.append(misaligned.relative_rms(t.scene, t.field, t.heights, e, t.target[0], 6_000, rng))
    error = math.hypot(quick["relative_rms"]["p95_standard_error"], study.percentile_error(np.array(brute), 0.95))
    exact = float(np.quantile(brute, 0.95))
    assert error < 0.12 * exact
    assert quick["relative_rms"]["p95"] == pytest.approx(exact, abs=3.0 * error)
    assert quick["relative_rms"]["p50"] == pytest.approx(np.quantile(brute, 0.5), rel=0.15)
    assert quick["sensitivities"][0]["name"].startswith("screen_shift")
    assert quick["offenders"][0]["name"].startswith("screen_shift")
    assert quick["shifted_relative_rms"]["p95"] < 0.7 * quick["relative_rms"]["p95"]


def test_roughness_blurs_as_facets_scatter():
    """The Gaussian that stands for roughness, beside microfacets traced ray by ray."""
    t = trials("[roughness]\nsigma = 0.005", rays=200_000)
    blurred = np.mean(t.images({("roughness", 0): 0.005}), 0)[0]
    rough = replace(t.scene, lens=replace(t.scene.lens, roughness=0.005))
    traced = study.Trials(rough, t.field, t.heights, t.target, t.tolerances, rays=200_000)
    facets, sharp = np.mean(traced.images({}), 0)[0], np.mean(t.images({}), 0)[0]
    assert np.abs(blurred - facets).sum() < 0.7 * np.abs(sharp - facets).sum()


def test_what_means_nothing_is_said():
    found = study.study(trials("draws = 10\n[throw]\nsigma = 3\n[source_shift]\nsigma = 1", rays=2000))
    assert list(found.unused) == ["source_shift"] and [p.name for p in found.parameters] == ["throw"]
    with pytest.raises(InputError, match="applies to this scene"):
        study.study(trials("[source_shift]\nsigma = 1", rays=2000))


def test_the_loss_over_draws_and_its_gradient():
    scene, field, heights = small()
    target = torch.ones(32, 32, dtype=torch.float64)
    weights = torch.from_numpy(np.random.default_rng(0).standard_normal(heights.shape))

    class Square:
        """A quadratic in the heights that knows its screen."""

        def __init__(self, scene: Scene):
            self.loss, self.throw = Loss("rms", target), scene.screen.z

        def __call__(self, h: torch.Tensor) -> Evaluation:
            d = (h - 5.0) * weights - 0.01 * self.throw
            return Evaluation(float((d * d).sum()), {EXIT: 2.0 * d * weights}, 1.0, d)

    errors = schema.parse("[throw]\nsigma = 5\n[thickness]\nsigma = 0.1", "t")
    loss = robust_objective(lambda s, _: Square(s), scene, field, heights, errors)
    found, way = loss(heights), torch.from_numpy(np.random.default_rng(1).standard_normal(heights.shape))
    ends = [loss(heights + sign * 1e-5 * way).loss for sign in (-1, 1)]
    assert float((found.gradient * way).sum()) == pytest.approx((ends[1] - ends[0]) / 2e-5, rel=1e-5)
    assert found.loss > Square(scene)(heights).loss
    with pytest.raises(InputError, match="names no error"):
        robust_objective(lambda s, _: Square(s), scene, field, heights, schema.parse("[roughness]\nsigma = 0.01", "t"))


def test_a_robust_design_and_its_study(tmp_path, monkeypatch, capsys):
    """The file is kept in the project; the study is written, and not done twice; the last stage's loss is over draws."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    Path("errors.toml").write_text(
        "draws = 12\n[throw]\nsigma = 4\n[screen_shift]\nsigma = [0.3, 0]\n[form_error]\nrms = 1e-5\nshortest = 4\n"
    )
    common = [
        "blob.png",
        *[
            "--control",
            "36",
            "--resolution",
            "24",
            "--rays",
            "20000",
            "--iterations",
            "3",
            "--quality",
            "draft",
            "--waves",
            "off",
            "--json",
        ],
    ]
    assert cli.run(["design", *common, "--robust", "errors.toml"]) == 0
    robust = json.loads(capsys.readouterr().out)
    assert cli.run(["design", *common, "-o", "plain.caustic"]) == 0
    plain = json.loads(capsys.readouterr().out)
    assert robust["relative_rms"] != plain["relative_rms"]
    assert 'robust = "tolerances.toml"' in Path("blob.caustic/project.toml").read_text()
    assert Path("blob.caustic/tolerances.toml").read_bytes() == Path("errors.toml").read_bytes()
    assert cli.run(["design", "--resume", "blob.caustic", "--iterations", "4", "--json"]) == 0
    capsys.readouterr()
    ask = ["render", "blob.caustic", "--rays", "20000", "--tolerances", "errors.toml", "--json"]
    assert cli.run(ask) == 0
    out = json.loads(capsys.readouterr().out)["tolerances"]
    assert (
        out["draws"] == 12
        and out["judged_by"] == "rays"
        and {s["name"] for s in out["sensitivities"]} == {"throw", "screen_shift x", "form_error"}
    )
    lines = Path("blob.caustic/tolerances.csv").read_text().splitlines()
    assert lines[0].startswith("# created by caustic") and len(list(csv.DictReader(lines[1:]))) == 12
    assert Path("blob.caustic/tolerances.png").read_bytes()[:4] == b"\x89PNG"
    assert cli.run(ask) == 0 and "nothing to do" in capsys.readouterr().err
    assert cli.run(["render", "blob.caustic", "--tolerances", "none.toml"]) == 2
    assert capsys.readouterr().err.startswith("caustic: none.toml: no such file")
