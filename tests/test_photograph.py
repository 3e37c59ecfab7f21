"""Photographs of a part: registration, inference and correction, judged by a tracer and a camera of their own."""

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.errors import CausticError, InputError
from caustic_cli.project import correction as corrections
from caustic_cli.scene import Screen
from caustic_cli.studies.photograph import inference, registration
from caustic_cli.studies.photograph.camera import displacements, fit_camera, rectified
from caustic_cli.studies.photograph.card import RADIUS, find_marks, marks_of_card, write_card
from caustic_cli.studies.photograph.comparison import registered, surfaces
from caustic_cli.studies.photograph.model import Grid, Guess, PartModel, Prediction, Response, View, deviation
from caustic_cli.workflow import correction, photographs
from caustic_cli.workflow.outputs.photograph import rows_of_part
from caustic_cli.workflow.reporter import Listener

sys.path.insert(0, str(Path(__file__).parent / "independent"))
from photographs import form_error, image_of, landed, landed_from, photographed, relative_rms

#: Standard deviation of the marks of a file, pixels.
SHARP, BLURRED = 0.05, 0.25


@pytest.fixture(scope="module")
def lens(tmp_path_factory):
    """A lens of 10 mm and its project, for a picture without symmetry on 128 x 128 pixels."""
    home = tmp_path_factory.mktemp("photograph")
    x, y = np.meshgrid(np.linspace(-1, 1, 96), np.linspace(-1, 1, 96), indexing="ij")
    light = (
        0.25
        + 0.75 * np.exp(-((x + 0.4) ** 2 + (y - 0.35) ** 2) / 0.08)
        + 0.5 * ((np.abs(x - 0.3) < 0.35) & (np.abs(y + 0.5) < 0.12))
    )
    np.save(home / "picture.npy", light)
    how = [
        "--mag",
        "3",
        "--resolution",
        "128",
        "--control",
        "67",
        "--waves",
        "off",
        "--iterations",
        "25",
        "--rays",
        "400000",
        "--quiet",
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAUSTIC_EFFORT", "test report=True")
        assert cli.run(["design", str(home / "picture.npy"), *how, "-o", str(home / "lens.caustic")]) == 0
    return load(home / "lens.caustic")


@pytest.fixture(autouse=True)
def _few_rays(monkeypatch):
    """The model with fewer rays than the command takes."""
    monkeypatch.setattr(photographs, "RAYS", 200)
    monkeypatch.setattr(correction, "DRAWS", 4)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def photograph(lens, error, sigma, seed=0, heights=None, **how) -> str:
    """Write wall.jpg, and marks.csv with errors of `sigma` pixels; its name."""
    data, project = photographed(lens, lens.heights if heights is None else heights, error, seed=seed, **how)
    Path("wall.jpg").write_bytes(data)
    known = marks_of_card()
    pixels = np.stack(project(*known.T), 1) + sigma * np.random.default_rng(seed + 100).standard_normal(known.shape)
    rows = np.concatenate([pixels, known * np.array(lens.scene.screen.half_size)], 1)
    Path("marks.csv").write_text("column,row,x,y\n" + "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows))
    return "marks.csv"


def judged(lens, marks=None, corners=None, photos=("wall.jpg",)):
    """What is found of photographs."""
    return photographs.judge(lens, photographs.shots([*map(Path, photos)], marks, corners), Listener())


def errors(lens, heights, error, rays=1400) -> tuple[float, float]:
    """In the frame of the wall and registered, by the independent tracer."""
    image, aim = image_of(lens, heights, error, lens.target.shape, rays=rays), lens.target / lens.target.mean()
    return relative_rms(image, aim), relative_rms(registered(image, aim), aim)


# Registration


def seen_by(h, k, size):
    """A camera with this projective map and distortion, through 17 exact marks."""
    camera = replace(fit_camera(marks_of_card(), np.stack(_image(h, k, size, *marks_of_card().T), 1), size, ""))
    return camera


def _image(h, k, size, x, y):
    (ca, cb), half = ((size[0] - 1) / 2, (size[1] - 1) / 2), np.hypot(*size) / 2
    w = h[6] * x + h[7] * y + 1
    a, b = ((h[0] * x + h[1] * y + h[2]) / w - ca) / half, ((h[3] * x + h[4] * y + h[5]) / w - cb) / half
    s = 1 + k * (a * a + b * b)
    return ca + half * s * a, cb + half * s * b


VIEW, SIZE = np.array([300.0, 20.0, 410.0, 12.0, -330.0, 390.0, 0.04, -0.03]), (820, 800)


def test_a_camera_is_found_through_its_marks():
    camera = seen_by(VIEW, 0.02, SIZE)
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 50))
    np.testing.assert_allclose(camera.project(x, y), _image(VIEW, 0.02, SIZE, x, y), atol=1e-5)
    assert not camera.mirrored
    flipped = VIEW * np.array([-1, -1, 1, 1, 1, 1, 1, 1])
    assert seen_by(flipped, 0.0, SIZE).mirrored


def test_the_covariance_of_a_camera_is_that_of_repeated_fits():
    """Displacements on the screen of 60 cameras through marks with errors, against the covariance that one of them gives."""
    rng, known = np.random.default_rng(1), marks_of_card()
    exact = np.stack(_image(VIEW, 0.02, SIZE, *known.T), 1)
    x, y = rng.uniform(-0.9, 0.9, (2, 40))
    truth, found = np.array(_image(VIEW, 0.02, SIZE, x, y)), []
    for _ in range(60):
        camera = fit_camera(known, exact + 0.3 * rng.standard_normal(exact.shape), SIZE, "")
        found.append((np.array(camera.project(x, y)) - truth) / 310.0)  # about half widths
    fields = displacements(x, y).reshape(9, -1)
    predicted = np.sqrt(np.einsum("ip,ij,jp->p", fields, camera.covariance * (0.3 / camera.sigma) ** 2, fields).mean())
    measured = np.sqrt(np.square(found).mean())
    assert predicted == pytest.approx(measured, rel=0.2)


def test_a_photograph_is_brought_into_screen_coordinates():
    a, b = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    camera = seen_by(VIEW, 0.02, SIZE)
    picture = np.sin(a / 60.0) + 0.01 * b
    screen = rectified(picture, camera, (40, 30))
    x, y = np.meshgrid((np.arange(40) + 0.5) / 20 - 1, (np.arange(30) + 0.5) / 15 - 1, indexing="ij")
    a, b = _image(VIEW, 0.02, SIZE, x, y)
    assert np.nanmax(np.abs(screen - np.sin(a / 60.0) - 0.01 * b)) < 0.01
    half = rectified(picture, camera, (20, 30), ((0.0, 1.0), (-1.0, 1.0)))
    assert np.nanmax(np.abs(half - screen[20:])) < 0.01


@pytest.mark.parametrize(("splined", "variance"), [(False, 1 / 12), (True, 1 / 4)])
def test_a_photograph_is_averaged_over_pixels_or_by_splines_about_them(splined, variance):
    """The mean of x^2 is larger than that of the middle by the variance of the weights, of pixels of 1/10."""
    camera = seen_by(np.array([300.0, 0.0, 409.5, 0.0, -330.0, 399.5, 0.0, 0.0]), 0.0, SIZE)
    a = (np.arange(SIZE[0]) - 409.5) / 300.0
    screen = rectified(np.broadcast_to(a**2, SIZE[::-1]), camera, (20, 16), splined=splined)
    x = (np.arange(20) + 0.5) / 10 - 1
    np.testing.assert_allclose(screen, np.repeat((x**2 + variance / 100)[:, None], 16, 1), atol=3e-5)


def test_the_marks_of_the_card_are_found_however_it_lies(lens, here):
    data, project = photographed(lens, lens.heights, None, marks=(marks_of_card(), RADIUS), background=0.05)
    codes = np.asarray(Image.open(io.BytesIO(data)), float) / 255
    truth = np.stack(project(*marks_of_card().T), 1)
    camera = find_marks(codes**2.2)
    assert camera.marks == 17 and not camera.mirrored
    assert np.abs(np.stack(camera.project(*marks_of_card().T), 1) - truth).max() < 0.1
    w, h = codes.shape[::-1]
    for turned, place in (
        (codes[:, ::-1], truth * [-1, 1] + [w - 1, 0]),
        (codes[::-1, ::-1], truth * [-1, -1] + [w - 1, h - 1]),
        (codes.T, truth[:, ::-1]),
    ):
        found = find_marks(turned**2.2)
        assert np.abs(np.stack(found.project(*marks_of_card().T), 1) - place).max() < 0.1
    with pytest.raises(InputError, match="no marks"):
        find_marks(np.random.default_rng(0).uniform(size=(200, 200)))


@pytest.mark.parametrize("radius", [np.inf, 40.0, -40.0])
def test_the_card_is_drawn_as_seen_from_the_lens(here, radius):
    """For a cylinder it is unrolled: seen from far away it has its marks where a plane one has them."""
    write_card(Path("card.png"), Path("card.csv"), Screen((60.0, 40.0), 300.0, shift=(1.0, 2.0), radius=(np.inf, radius)))
    sheet = np.asarray(Image.open("card.png").convert("L"), float) / 255
    if np.isfinite(radius):
        high = 2.0 * 40.0 * np.arcsin(25.0 / 40.0)
        assert sheet.shape[0] / sheet.shape[1] == pytest.approx(high / 75.0, rel=2e-3)
        arc = 40.0 * np.arcsin(np.linspace(-25.0, 25.0, 800) / 40.0)
        sheet = sheet[np.rint((arc / high + 0.5) * (len(sheet) - 1)).astype(int)]
    camera = find_marks(np.pad(sheet, 20, constant_values=1.0))
    assert camera.marks == 17 and camera.mirrored and camera.sigma < 0.6
    table = np.loadtxt("card.csv", delimiter=",", skiprows=2)
    np.testing.assert_allclose((table - [1.0, 2.0]) / [30.0, 20.0], marks_of_card(), atol=1e-5)


def test_a_mean_of_which_a_part_is_saturated_is_not_known():
    """Half of the light above the maximum: its mean is less than that of the light, by an amount that no one knows."""
    camera = seen_by(np.array([300.0, 0.0, 409.5, 0.0, -330.0, 399.5, 0.0, 0.0]), 0.0, SIZE)
    codes = np.full(SIZE[::-1], 0.5)
    codes[:, 410:] = 1.0
    taken = registration.Photograph(Path("wall.jpg"), codes, camera)
    about, exact = (taken.for_model((20, 16), ((-1.0, 1.0), (-1.0, 1.0)), 2.2, how) for how in (False, True))
    assert np.isfinite(about).all()
    np.testing.assert_array_equal(np.isnan(exact).all(1), np.isnan(exact).any(1))
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(exact[:, 0])), [9, 10])  # splines reach one pixel and a half
    np.testing.assert_allclose(exact[[0, -1], 0], [0.5, 1.0])


# The model


def test_derivatives_of_the_codes_are_those_of_the_model(lens):
    model, grid = PartModel(lens.scene, lens.field, lens.heights, 160**2), Grid((48, 48), 1.0)
    guess = Guess((View(Response(-1.5), np.zeros(9), 0.2),), 0.0, np.zeros((6, 6)))
    prediction = Prediction.of(model, grid, guess)
    by_shape, by_response = np.concatenate(list(prediction.by_shape())), prediction.by_response()

    def numeric(step, **change):
        def codes(s):
            new = {k: v(s) for k, v in change.items()}
            of_view = {k: new.pop(k) for k in ("response", "camera", "throw") if k in new}
            return Prediction.of(model, grid, replace(guess, views=(replace(guess.views[0], **of_view),), **new)).codes

        return (codes(step) - codes(-step)) / (2 * step)

    for k in (0, 4, 8):
        along = numeric(1e-4, camera=lambda s, k=k: s * np.eye(9)[k])
        assert np.abs(by_shape[k] - along).max() < 1e-3 * np.abs(along).max()
    along = numeric(1e-2, throw=lambda s: 0.2 + s)
    assert np.abs(by_shape[9] - along).max() < 1e-3 * np.abs(along).max()
    along = numeric(1e-4, scale=lambda s: s)
    assert np.abs(by_shape[10] - along).max() < 1e-3 * np.abs(along).max()
    for k, m in ((0, 1), (3, 2), (5, 5)):
        along = numeric(1e-6, modes=lambda s, k=k, m=m: s * np.eye(36)[6 * k + m].reshape(6, 6))
        assert np.abs(by_shape[11 + 6 * k + m] - along).max() < 1e-3 * np.abs(along).max()
    response = guess.views[0].response
    for k, name in enumerate(("log_gain", "background", "log_gamma")):
        along = numeric(1e-5, response=lambda s, n=name: replace(response, **{n: getattr(response, n) + s}))
        assert np.abs(by_response[k] - along).max() < 1e-3 * np.abs(along).max()


def test_pixels_that_are_not_known_change_nothing(lens):
    """Not their neighbours either, though all are smoothed."""
    model, known = PartModel(lens.scene, lens.field, lens.heights, 60**2), np.ones((32, 32), dtype=bool)
    known[10:14, 8:20] = False
    grid = Grid((32, 32), 1.0, model=model, known=known)
    codes, other = np.random.default_rng(0).uniform(size=(2, 32, 32))
    np.testing.assert_array_equal(grid.compared(codes), grid.compared(np.where(known, codes, other)))
    assert np.abs(grid.compared(codes) - Grid((32, 32), 1.0).compared(codes)).max() > 0.1


def test_light_spread_widely_has_no_stripes_by_its_many_rays(lens):
    """Rays on a lattice, 1.3 pixels apart where the picture is dim, against 25 times as many."""
    guess = Guess((View(Response(), np.zeros(9)),), 0.0, np.zeros((4, 4)))
    grid, model = Grid((128, 128), 0.7), PartModel(lens.scene, lens.field, lens.heights, 100**2)
    exact = grid.counted(PartModel(lens.scene, lens.field, lens.heights, 500**2).landing(guess), np.zeros(9))
    few, more = (grid.counted(light, np.zeros(9)) for light in (model.landing(guess), model.light(guess)))
    assert (more - exact).std() < 0.5 * (few - exact).std()
    assert more.sum() == pytest.approx(few.sum(), rel=1e-3)


def test_more_modes_are_taken_where_the_prior_expects_them():
    """Of a Gaussian autocorrelation of a third of the lens none are beyond 20, of a tenth some."""
    assert not inference.asked(inference.Sobolev(1e-2, 6.0, 2.0), 20, 32)
    assert inference.asked(inference.Sobolev(3e-4, 3.0, 8.0), 20, 32)
    assert inference.near([1.0, 2.0, 4.0, 8.0], 2.1, True) == [1.0, 2.0, 4.0] and inference.near([1.0, 2.0], 1.0, False) == [
        1.0,
        2.0,
    ]


def test_derivatives_reach_a_traced_part(lens):
    """A part of 3 µm traced itself lands where derivatives from the designed one say, within a hundredth of a pixel."""
    model = PartModel(lens.scene, lens.field, lens.heights, 60**2)
    modes = np.zeros((4, 4))
    modes[1, 2] = modes[3, 0] = 2e-3
    guess = Guess((View(Response(), np.zeros(9)),), 0.01, modes)
    near = model.landing(guess)
    model.trace(guess)
    exact = model.landing(guess)
    assert np.abs(near.x - exact.x).max() < 0.01 * 2 / 128 and np.abs(model.designed.x - exact.x).max() > 0.5 * 2 / 128


# The part


@pytest.mark.parametrize(("rms", "sigma", "seed"), [(1e-3, SHARP, 1), (3e-3, SHARP, 2), (3e-3, BLURRED, 3)])
def test_one_photograph_is_enough_for_a_smooth_form_error(lens, here, rms, sigma, seed):
    """Correlation length a third of the lens: the inferred surface is the true one, and the corrected part within 1.5 times
    nominal, as judged by the independent tracer."""
    error = form_error(5.0, rms, 10 / 3, seed)
    marks = photograph(lens, error, sigma, seed)
    found = judged(lens, marks)
    _, off = surfaces(found.found)
    assert found.found.ended
    assert (off - error - (off - error).mean()).std() < 0.15 * rms
    heights = correction.corrected_heights(lens.project, lens, found, "cpu")
    (nominal, own), (made, _), (frame, after) = (
        errors(lens, h, e) for h, e in ((lens.heights, None), (lens.heights, error), (heights, error))
    )
    assert made > 2 * nominal
    assert after < 1.5 * own
    assert frame < (0.10 if sigma == SHARP else 0.25)
    predicted = correction.predicted(lens, found, heights)
    correction.refuse_uncertain(predicted)
    assert predicted["predicted"][0] == pytest.approx(after, abs=0.03)


#: Fewer pixels and modes than the command takes.
COARSE = ((32, 6, 1.0, 4), (48, 8, 1.0, 5))


def test_the_relief_of_parts_of_the_right_height_is_so_within_its_uncertainty(lens, here, monkeypatch):
    """It came out 1 to 2.5 % too low, up to seven standard deviations, when pixels and rays were averaged differently."""
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 3), (48, 12, 0.7, 8)))
    monkeypatch.setattr(photographs, "RAYS", 120)
    off = []
    for seed, (rms, length) in enumerate([(0.0, 1.0), (0.3e-3, 5.0), (1e-3, 10 / 3), (1e-3, 2.0), (3e-3, 10 / 3), (3e-3, 5.0)]):
        error = form_error(5.0, rms, length, 60 + seed) if rms else None
        marks = photograph(lens, error, SHARP, seed, size=(450, 400), blur=0.8, rays=700)
        scale, sigma = judged(lens, marks).found.scale
        assert abs(scale - 1.0) < 0.014 and sigma < 0.012
        off.append((scale - 1.0) / sigma)
    assert np.sqrt(np.square(off).mean()) < 1.5 and max(np.abs(off)) < 2.5


def test_predicted_errors_are_those_of_many_rays(lens):
    """Noise of few rays is no error of a part: it made 0.10 of 0.04."""
    aim = lens.target / lens.target.mean()
    image = image_of(lens, lens.heights, None, aim.shape, rays=3000)
    expected = relative_rms(registered(image, aim), aim), relative_rms(image, aim)
    assert correction.errors_of(lens, lens.heights) == pytest.approx(expected, abs=0.007)


def at_throw(lens, name, heights, error, said, true, larger=1.0, seed=0, light=None) -> str:
    """Write a photograph of a screen `larger` times as large, a TOML file that names it, and its marks; the name of that file."""
    screen = lens.scene.screen
    size = [larger * s for s in screen.size]
    seen = replace(lens, scene=replace(lens.scene, screen=replace(screen, size=tuple(size))))
    data, project = photographed(seen, heights, error, seed=seed, throw=true, rays=700, light=light)
    Path(f"{name}.jpg").write_bytes(data)
    known = marks_of_card()
    pixels = np.stack(project(*known.T), 1) + SHARP * np.random.default_rng(seed + 100).standard_normal(known.shape)
    np.savetxt(f"{name}.csv", np.concatenate([pixels, known * np.array(size) / 2], 1), delimiter=",")
    Path(f"{name}.toml").write_text(f'photo = "{name}.jpg"\nmarks = "{name}.csv"\nthrow = {said}\n[screen]\nsize = {size}\n')
    return f"{name}.toml"


def test_photographs_at_two_throws_tell_the_scale_of_the_relief_from_the_throw(lens, here, monkeypatch, capfd):
    """A relief 2 % too high on a part that stands 3 mm farther from all screens than it is said to: one photograph shows the
    product, 3 %, two show both."""
    monkeypatch.setattr(inference, "LEVELS", COARSE)
    monkeypatch.setattr(photographs, "RAYS", 120)
    made, error = lens.heights.mean() + 1.02 * (lens.heights - lens.heights.mean()), form_error(5.0, 1e-3, 5.0, 1)
    near = at_throw(lens, "near", made, error, 300, 303)
    far = at_throw(lens, "far", made, error, 450, 453, 1.6, seed=1)
    alone, both = judged(lens, photos=[near]), judged(lens, photos=[near, far])
    (product, sigma), own = alone.found.scale, 1.02 * 303 / 300
    assert abs(product - own) < 2.5 * sigma < 0.02 and not alone.found.throws_free
    scale, sigma = both.found.scale
    assert abs(scale - 1.02) < 2.5 * sigma < 0.03
    assert both.found.of_view(0)[13] < 4.5 and abs(both.found.guess.views[0].throw - 3.0) < 2.5 * both.found.of_view(0)[13]
    words = " ".join(both.figures["part"]["not_told_apart"])
    assert "throw" not in words and "throw and index" in " ".join(alone.figures["part"]["not_told_apart"])
    assert len(both.figures["others"]) == 1 and both.figures["others"][0]["file"] == "far.jpg"
    arguments = ["render", str(lens.project.path), "--photo", near, "--photo", far, "--rays", "20000", "-o", "r.png"]
    assert cli.run([*arguments, "--json", "--quiet"]) == 0
    found = json.loads(capfd.readouterr().out)["photo"]
    assert found["part"]["relief_scale"] == pytest.approx(scale) and found["screen_farther_mm"][0] > 0
    assert cli.run([*arguments, "--marks", "near.csv", "--quiet"]) == 2
    assert "--marks are of one photograph" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("photo = 3", "photo must name a file"),
        ('marks = "m.csv"', "photo must name a file"),
        ('photo = "wall.jpg"\nthrow = -1', "throw must be greater than 0"),
        ('photo = "wall.jpg"\n[lens]\nindex = 1.5', "[lens] is not of a photograph"),
        ('photo = "wall.jpg"\n[screen]\nfar = 1', "near.toml"),
        ('photo = "wall.jpg"\nscreen_corners = ["1,2"]', "four texts"),
        ('photo = "wall.jpg"\nmarks = "a"\nscreen_corners = ["1,2"]', "leave one out"),
        ('photo = "none.jpg"', "none.jpg"),
    ],
)
def test_a_file_that_names_a_photograph_badly_is_refused(lens, here, capfd, text, words):
    photograph(lens, None, SHARP, rays=200)
    Path("near.toml").write_text(text)
    assert cli.run(["design", "--correct", "near.toml", str(lens.project.path), "-o", "x.caustic", "--quiet"]) == 2
    assert words in (said := capfd.readouterr().err) and said.count("\n") == 1


@pytest.mark.parametrize("exposure", [0.8, 1.6])
def test_a_folded_caustic_is_inferred_within_what_is_said(lens, here, monkeypatch, exposure):
    """Light of a pixel comes from several places of the part, and its lines are saturated: with these the gamma was 2.42."""
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 4), (64, 12, 1.0, 4), (96, 16, 0.7, 8)))
    monkeypatch.setattr(photographs, "RAYS", 160)
    error = form_error(5.0, 3e-3, 2.0, 11)
    found = judged(lens, photograph(lens, error, SHARP, 11, exposure=exposure))
    response = found.found.guess.views[0].response
    assert np.exp(response.log_gamma) == pytest.approx(2.4, rel=0.005) and response.background == pytest.approx(0.01, abs=3e-4)
    off = surfaces(found.found)[1] - error
    assert off.std() < 2.0 * found.found.uncertainty()
    heights = correction.corrected_heights(lens.project, lens, found, "cpu")
    predicted = correction.predicted(lens, found, heights)
    before, after = (errors(lens, h, error, rays=3000)[1] for h in (lens.heights, heights))
    assert after < 0.2 * before and abs(after - predicted["predicted"][0]) < 2.5 * predicted["predicted"][1] + 0.007  # of rays


def test_a_fit_that_ends_on_another_surface_is_said(lens, here):
    """Errors of a tenth of the lens' width fold light in many places: what is found is off by more than is said of it."""
    error = form_error(5.0, 3e-3, 1.0, 6)
    found = judged(lens, photograph(lens, error, SHARP, 6))
    off = surfaces(found.found)[1] - error
    assert (off - off.mean()).std() > 2.0 * found.found.uncertainty()
    (name, words), *_ = rows_of_part(found.figures)
    assert not found.figures["part"]["found"] and name == "uncertain" and "another surface" in words


def test_a_part_without_errors_is_left_alone(lens, here):
    marks = photograph(lens, None, SHARP)
    found = judged(lens, marks)
    assert found.found.rms()[0] < 1e-4
    heights = correction.corrected_heights(lens.project, lens, found, "cpu")
    before, after = errors(lens, lens.heights, None), errors(lens, heights, None)
    assert after[1] < 1.1 * before[1]


@pytest.mark.parametrize("seed", range(10))
def test_no_correction_makes_a_part_worse(lens, here, seed):
    """Random parts: form errors of 0.1 to 3 µm of correlation lengths from a tenth to a half of the lens, marks of 0.05 to 0.5
    pixels; what is applied leaves an error that is no larger than before beyond twice its stated uncertainty."""
    rng = np.random.default_rng(1000 + seed)
    rms, length, sigma = 1e-3 * 10 ** rng.uniform(-1, 0.48), 10 * 10 ** rng.uniform(-1, -0.3), 10 ** rng.uniform(-1.3, -0.3)
    error = form_error(5.0, rms, length, seed)
    how = {
        "gamma": rng.uniform(1.8, 2.6),
        "blur": rng.uniform(0.7, 2.5),
        "noise": rng.uniform(0, 0.01),
        "quality": int(rng.integers(75, 98)),
    }
    marks = photograph(lens, error, sigma, seed, **how)
    found = judged(lens, marks)
    heights = correction.corrected_heights(lens.project, lens, found, "cpu")
    predicted = correction.predicted(lens, found, heights)
    try:
        correction.refuse_bad_fit(found)
        correction.refuse_uncertain(predicted)
    except CausticError:
        return
    before, after = errors(lens, lens.heights, error)[1], errors(lens, heights, error)[1]
    assert after < before + 2 * predicted["gain"][1]


def test_the_commands_close_the_loop(lens, here, capfd):
    """render judges, design corrects into another project, whose own photographs are the next round; resuming is refused."""
    project, error = str(lens.project.path), form_error(5.0, 3e-3, 10 / 3, 5)
    photograph(lens, error, SHARP, marks=(marks_of_card(), RADIUS), background=0.05)
    assert (
        cli.run(["render", project, "--photo", "wall.jpg", "--test-card", "--rays", "20000", "-o", "r.png", "--json", "--quiet"])
        == 0
    )
    f = json.loads(capfd.readouterr().out)
    assert f["photo"]["marks"] == 17 and f["photo"]["registered_by"] == "marks of the test card"
    assert f["photo"]["part"]["explained"] > 0.99 and f["photo"]["error"] > 0.15
    assert f["photo"]["registered"] <= f["photo"]["error"] + 1e-6
    part, off = np.load("r-part.npy"), np.load("r-deviation.npy")
    assert (off - error - (off - error).mean()).std() < 1e-3
    x, _ = (np.linspace(-5, 5, 257), None)
    np.testing.assert_allclose(part - off, lens.surface(x[:, None], x[None, :])[0], atol=1e-9)
    for name in ("photo.png", "photo.npy", "missing.png", "part.png", "card.png", "card.csv"):
        assert Path(f"r-{name}").stat().st_size > 0
    assert cli.run(["design", "--correct", "wall.jpg", project, "-o", "better.caustic", "--json", "--quiet"]) == 0
    c = json.loads(capfd.readouterr().out)["correction"]
    better = load("better.caustic")
    assert c["round"] == 1 and c["predicted"][0] < 0.3 * c["registered"][0]
    after = errors(better, better.heights, error)
    assert after[0] < 0.10 and c["predicted_error"][0] == pytest.approx(after[0], abs=0.03)
    known = corrections.read(Path("better.caustic"), tuple(better.heights.shape))
    assert len(known.history) == 1 and (known.designed == lens.heights).all()
    assert cli.run(["design", "--resume", "better.caustic", "--quiet"]) == 2
    assert "was corrected" in capfd.readouterr().err
    photograph(lens, error, SHARP, 7, heights=better.heights)
    ended = cli.run(
        ["design", "--correct", "wall.jpg", "better.caustic", "--marks", "marks.csv", "-o", "best.caustic", "--quiet", "--json"]
    )
    said = capfd.readouterr()
    if ended == 0:
        best = load("best.caustic")
        assert json.loads(said.out)["correction"]["round"] == 2
        assert errors(best, best.heights, error)[1] < after[1] + 0.01
    else:
        assert ended == 1 and "nothing to correct for certain" in said.err and not Path("best.caustic").exists()


#: Other light: settings of the design, of the independent tracer, RMS of the form error in mm.
LIGHTS = {
    "a point": (["--source", "point", "--source-position", "0,0,-200"], {"point": (0.0, 0.0, -200.0)}, 1.5e-3),
    "the sun": (["--source", "disc", "--source-angle", "0.53"], {"angle": 0.265}, 1.5e-3),
    "a mirror": (["--mirror"], {}, 0.5e-3),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_parts_in_other_light_and_mirrors_are_judged_too(name, lens, here, monkeypatch):
    """The inferred surface, by an independent tracer of that light, and its stated uncertainty."""
    monkeypatch.setattr(inference, "LEVELS", ((32, 6, 1.0, 4), (64, 10, 1.0, 5)))
    monkeypatch.setattr(photographs, "RAYS", 160)
    arguments, light, rms = LIGHTS[name]
    picture = str(lens.project.path.parent / "picture.npy")
    size = ["--mag", "3", "--resolution", "64", "--control", "35"]
    how = [*size, "--waves", "off", "--iterations", "15", "--rays", "100000", "--quiet"]
    assert cli.run(["design", picture, *how, *arguments, "-o", "other.caustic"]) == 0
    other, error = load("other.caustic"), form_error(5.0, rms, 10 / 3, 3)
    screen = other.scene.screen
    data, project = photographed(
        other, other.heights, error, light=landed_from(other, other.heights, error, **light), size=(450, 400), blur=0.8
    )
    Path("wall.jpg").write_bytes(data)
    known = marks_of_card()
    places = known * np.array(screen.half_size) + np.array(screen.shift)
    np.savetxt("marks.csv", np.concatenate([np.stack(project(*known.T), 1), places], 1), delimiter=",")
    found = judged(other, "marks.csv")
    off = surfaces(found.found)[1] - error
    assert found.found.explained > 0.999
    assert off.std() < 0.3 * rms and off.std() < 2.5 * found.found.uncertainty() < 1.5 * rms


def bk7(um):
    """Index of N-BK7 by the dispersion formula of its maker (Schott, optical glass data sheets, 2017)."""
    B, C = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    return float(np.sqrt(1 + sum(b * um**2 / (um**2 - c) for b, c in zip(B, C, strict=True))))


#: A second light: its section of a photograph's file, how much larger its screen is, and how the independent tracer has it.
SECOND = {
    "blue": ("wavelengths = [435.8]", 1.0, lambda lens, error: landed(lens, lens.heights, error, rays=700, index=bk7(0.4358))),
    "a point": (
        'type = "point"\nposition = [[0.0, 0.0, -200.0]]',
        1.6,
        lambda lens, error: landed_from(lens, lens.heights, error, point=(0.0, 0.0, -200.0)),
    ),
}


@pytest.mark.parametrize("name", SECOND)
def test_photographs_in_two_lights_are_judged_together(name, lens, here, monkeypatch, capfd):
    """Of a lens of N-BK7 in yellow light and in another: its index in blue is 1.9 % higher less one, which is not of the part."""
    monkeypatch.setattr(inference, "LEVELS", COARSE)
    monkeypatch.setattr(photographs, "RAYS", 120)
    size = ["--mag", "3", "--resolution", "64", "--control", "35", "--glass", "BK7"]
    how = [*size, "--waves", "off", "--iterations", "15", "--rays", "100000", "--quiet"]
    assert cli.run(["design", str(lens.project.path.parent / "picture.npy"), *how, "-o", "glass.caustic"]) == 0
    glass, error = load("glass.caustic"), form_error(5.0, 1e-3, 5.0, 1)
    section, larger, light = SECOND[name]
    first = at_throw(glass, "first", glass.heights, error, 300, 300)
    second = at_throw(glass, "second", glass.heights, error, 300, 300, larger, seed=1, light=light(glass, error))
    Path(second).write_text(Path(second).read_text() + f"[source]\n{section}\n")
    capfd.readouterr()
    arguments = ["--photo", first, "--photo", second, "--rays", "20000", "-o", "r.png", "--json", "--quiet"]
    assert cli.run(["render", "glass.caustic", *arguments]) == 0
    found = json.loads(capfd.readouterr().out)["photo"]
    part = found["part"]
    assert found["explained"] > 0.999 and found["others"][0]["explained"] > 0.999
    assert abs(part["relief_scale"] - 1.0) < 2.5 * part["relief_scale_sigma"] < 0.02
    off = np.load("r-deviation.npy") - error
    assert off.std() < 2.5e-3 * part["uncertainty_um"] < 1.5e-3
    alone = judged(glass, photos=[first]).found
    assert part["uncertainty_um"] < 1e3 * alone.uncertainty()
    if name == "blue":  # taken for yellow light, its relief seems higher by the index
        Path(second).write_text(Path(second).read_text().split("[source]")[0])
        assert judged(glass, photos=[second]).found.scale[0] == pytest.approx((bk7(0.4358) - 1) / (bk7(0.5876) - 1), abs=0.009)


# Refusals


def _saved(codes) -> None:
    Image.fromarray(np.rint(255 * np.clip(codes, 0, 1)).astype(np.uint8)).save("wall.png")


def _codes(lens, **how):
    return np.asarray(Image.open(io.BytesIO(photographed(lens, lens.heights, None, **how)[0])), float) / 255


REFUSED = {
    "black": (lambda lens: _saved(np.full((300, 300), 0.01)), "black"),
    "blown out": (lambda lens: _saved(np.full((300, 300), 1.0)), "is blown out"),
    "overexposed": (lambda lens: _saved(_codes(lens, exposure=12.0)), "is blown out"),
    "rotated": (lambda lens: _saved(np.rot90(_codes(lens))), "is rotated by"),
    "upside down": (lambda lens: _saved(np.rot90(_codes(lens), 2)), "is rotated by 180 degrees"),
    "mirrored": (lambda lens: _saved(_codes(lens)[:, ::-1]), "mirrored"),
    "a checkerboard": (lambda lens: _saved(0.7 * ((np.indices((300, 300)) // 40).sum(0) % 2)), "shows something else"),
    "noise": (lambda lens: _saved(np.random.default_rng(0).uniform(size=(300, 300))), "shows something else"),
    "text": (lambda lens: Path("wall.png").write_text("no picture"), "is not an image of a known format"),
    "one pixel": (lambda lens: Image.new("L", (1, 1), 200).save("wall.png"), "is 1 x 1 pixels"),
    "small": (lambda lens: _saved(np.eye(20)), "at least 64"),
    "missing": (lambda lens: None, "no such file"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_photograph_of_the_caustic_is_refused(lens, here, capfd, name):
    make, words = REFUSED[name]
    make(lens)
    assert cli.run(["design", "--correct", "wall.png", str(lens.project.path), "-o", "x.caustic", "--quiet"]) == 2
    said = capfd.readouterr().err
    assert words in said and "wall.png" in said and said.count("\n") == 1
    assert not Path("x.caustic").exists()


@pytest.mark.parametrize(("across", "along", "words"), [(-1, -1, "is rotated by 180 degrees"), (-1, 1, "is mirrored")])
def test_a_part_mounted_in_another_way_before_an_upright_card_is_refused(lens, here, across, along, words):
    x, y = landed(lens, lens.heights, None, rays=500)
    photograph(lens, None, SHARP, light=(across * x, along * y))
    with pytest.raises(InputError, match=words) as refusal:
        judged(lens, "marks.csv")
    assert "the part or the card is mounted so" in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3,4\n", "has 1 marks"),
        ("1,2,3\n", "line 1"),
        ("a\n1,2,x,4\n", "line 2"),
        ("1,1,0,0\n2,2,1,1\n3,3,2,2\n4,4,3,3\n", "on a line"),
    ],
)
def test_a_file_of_marks_that_is_none_is_refused(lens, here, capfd, text, words):
    photograph(lens, None, SHARP)
    Path("bad.csv").write_text(text)
    arguments = [
        "render",
        str(lens.project.path),
        "--photo",
        "wall.jpg",
        "--marks",
        "bad.csv",
        "--rays",
        "10000",
        "-o",
        "r.png",
        "--quiet",
    ]
    assert cli.run(arguments) == 2
    assert words in (said := capfd.readouterr().err) and "bad.csv" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--marks", "auto"], "--marks belongs to --photo"),
        (["--photo", "wall.jpg", "--screen-corners", "1,2", "3", "4,5", "6,7"], "--screen-corners must be four points"),
        (["--photo", "wall.jpg", "--marks", "m.csv", "--screen-corners", "1,2", "3,4", "4,5", "6,7"], "leave one out"),
    ],
)
def test_options_that_do_not_fit_are_refused(lens, here, capfd, arguments, words):
    photograph(lens, None, SHARP)
    assert cli.run(["render", str(lens.project.path), *arguments, "--rays", "10000", "-o", "r.png", "--quiet"]) == 2
    assert words in capfd.readouterr().err


def test_corners_and_the_picture_itself_find_the_screen_too(lens, here):
    """With what that costs in certainty: the tilt of a part is then not known."""
    error = form_error(5.0, 2e-3, 10 / 3, 4)
    data, project = photographed(lens, lens.heights, error, distortion=0.0)
    Path("wall.jpg").write_bytes(data)
    corners = tuple(f"{a:.2f},{b:.2f}" for a, b in np.stack(project(*np.array(registration.CORNERS).T), 1))
    by_corners = judged(lens, None, corners)
    itself = judged(lens, None)
    heights = correction.corrected_heights(lens.project, lens, by_corners, "cpu")
    assert errors(lens, heights, error)[1] < 0.5 * errors(lens, lens.heights, error)[1]
    assert by_corners.found.explained > 0.999 and itself.found.explained > 0.99
    with pytest.raises(CausticError, match="without marks"):  # it leaves this part unsure, and a correction would not help
        correction.refuse_bad_fit(itself)
    assert itself.found.uncertainty() > 3 * by_corners.found.uncertainty()
    assert any("without marks" in words for words in itself.figures["part"]["not_told_apart"])


def test_draws_have_the_covariance_of_the_fit(lens, here):
    marks = photograph(lens, form_error(5.0, 1e-3, 10 / 3, 6), SHARP)
    found = judged(lens, marks).found
    modes = np.array([guess.modes for guess in found.draws(400)])
    sigma = np.sqrt(np.diag(found.of_part)[1:]).reshape(modes.shape[1:])
    np.testing.assert_allclose(modes.std(0)[1:4, 1:4], sigma[1:4, 1:4], rtol=0.2)
    assert deviation(found.model.field, found.guess.modes).std() > 5e-4 and len(found.guess.modes) == inference.LEVELS[-2][1]
