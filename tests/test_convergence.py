"""Orders by regression, the honesty of the reference, and what the studies write."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob
from PIL import Image

from caustic_cli import cli, load
from caustic_cli.errors import CausticError, InputError
from caustic_cli.io.files import is_ours
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import SAMPLERS
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import freeform_of
from caustic_cli.scene import Component, Lens, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies import intersection
from caustic_cli.studies.convergence import FILTERS, run_study, single_precision
from caustic_cli.studies.efficiency import DesignedLens, run_efficiency
from caustic_cli.studies.fit import knee, order, pareto
from caustic_cli.studies.measurement import REFERENCE_FACTOR, Benchmark, Setting
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.report import as_json, plot, write


def smooth(resolution=(25, 23), tilt=0.0):
    """A lens that spreads its light smoothly, with no fold and no symmetry, over most of the screen."""
    lens = Lens(control=(10, 10), offset=Offset.for_magnification((2.0, 2.0), 1.5443, 100.0, 5.0))
    scene = Scene(PlaneWave(), lens, Screen((24.3, 23.1), 100.0, resolution))
    field = HeightField.of(lens)
    x, y = (c.numpy() for c in field.control_xy())
    sag = lens.offset.sag(x[:, None], y[None]) + 0.01 * np.sin(0.6 * x[:, None] + 0.3) * np.cos(0.5 * y)
    return scene, field, torch.from_numpy(5.0 + 12.0 * abs(tilt) + sag + tilt * x[:, None])


@pytest.fixture(scope="module")
def rays():
    return run_study("rays", *smooth(), max_rays=1 << 15, repeats=2)


@pytest.fixture(scope="module")
def reconstruction():
    return run_study("reconstruction", *smooth(), max_rays=1 << 14, repeats=3)


@pytest.fixture(scope="module")
def precision():
    return run_study("precision", *smooth(), max_rays=1 << 15, repeats=1)


def test_order_of_an_exact_power_law():
    n = np.array([10.0, 20.0, 40.0, 80.0])
    found = order(n, 3.0 * n**-0.7)
    assert found.exponent == pytest.approx(0.7, abs=1e-12)
    assert found.deviation < 1e-12
    assert (found.points, found.low, found.high) == (4, 10.0, 80.0)


def test_order_equals_the_least_squares_line_of_numpy():
    g = np.random.default_rng(0)
    n = np.geomspace(10, 1e5, 9)
    error = n**-0.5 * np.exp(0.3 * g.normal(size=9))
    (slope, _), covariance = np.polyfit(np.log(n), np.log(error), 1, cov=True)
    found = order(n, error)
    assert found.exponent == pytest.approx(-slope, rel=1e-10)
    assert found.deviation == pytest.approx(np.sqrt(covariance[0, 0]), rel=1e-10)


def test_order_keeps_to_the_range_asked_for_and_leaves_out_what_has_none():
    n = [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]
    error = [9.0, 9.0, *(k**-1.0 for k in n[2:])]
    assert order(n, error, least=4.0).exponent == pytest.approx(1.0, abs=1e-12)
    assert order(n, error, least=4.0).points == 4
    assert order(n, error, least=16.0).points == 6  # two points are no regression: all are taken
    assert order([1.0, 2.0, 4.0], [1.0, 0.0, 0.5]) is None
    assert order([5.0, 5.0, 5.0], [1.0, 0.9, 0.5]) is None


def test_pareto_front():
    cost, error = [1.0, 2.0, 3.0, 3.0, 1.0, 0.5], [5.0, 4.0, 4.5, 1.0, 5.0, 9.0]
    assert pareto(cost, error) == [True, True, False, True, False, True]  # of two that are the same, one
    assert pareto([1.0, 2.0, 3.0], [1.0, 0.99, 0.5], gain=0.02) == [True, False, True]  # what is gained is noise
    assert pareto([1.0, 1.02, 3.0], [1.0, 0.5, 0.4], alike=0.05) == [False, True, True]  # what is cheaper is noise
    assert pareto([1.0, 1.08, 1.16], [3.0, 2.0, 1.0], alike=0.1) == [False, True, True]  # not from one to the next on and on


@pytest.mark.parametrize(
    ("difference", "speedup", "words"),
    [(0.001, 1.5, "float32 is enough"), (0.02, 1.5, "use float64"), (0.001, 0.98, "float32 gains nothing here")],
)
def test_advice_on_single_precision(difference, speedup, words):
    assert single_precision({"difference": difference, "error": 0.05, "speedup": speedup}) == words


def test_the_knee_is_the_cheapest_that_is_nearly_the_best():
    seconds, error = [0.004, 0.017, 0.06, 0.23], [0.2, 0.053, 0.051, 0.049]
    assert knee(seconds, error) == 1 and knee(seconds, error, near=0.0) == 3 and knee([1.0], [0.0]) == 0


def test_orders_of_the_samplers(rays):
    """Independent rays: 1/2.  One ray a cell: 3/4 in the limit (only cells on a pixel's border count).

    The regression covers 575 to 32768 rays on 575 pixels, 1 to 57 a pixel, where the limit is not quite reached; its
    standard error is about 0.01.
    """
    assert rays.orders["uniform"].exponent == pytest.approx(0.5, abs=0.03)
    assert 0.65 < rays.orders["stratified"].exponent < 0.8
    for kind in ("grid", "lines"):
        assert rays.orders[kind].exponent > 0.5
    assert all(found.points >= 5 and found.low >= 575 and found.deviation < 0.1 for found in rays.orders.values())


def test_uniform_rays_have_the_error_of_a_poisson_process(rays):
    """n independent rays on N pixels: relative RMS^2 = N^2 mean(p (1 - p)) / n, about N sum(p) / n for shares p."""
    scene, field, heights = smooth()
    bench = Benchmark(scene, field, heights, 7, 1, 1 << 15)
    p = bench.image(Setting("", "lines", 1 << 18, Filter(), torch.float64), 0).numpy()
    p = p / p.sum()
    checked = 0
    for row in rays.rows:
        if row["sampler"] == "uniform":
            expected = np.sqrt(p.size * (p * (1 - p)).sum() / row["rays"])
            # relative scatter of a mean over 575 pixels and 2 rounds: about 1 / sqrt(2 * 1150) = 0.02
            assert row["error"] == pytest.approx(expected, rel=0.1)
            checked += 1
    assert checked == 7


def test_the_reference_is_better_than_what_it_judges_and_knows_its_own_error(rays):
    assert rays.about["reference_rays"] >= 0.99 * REFERENCE_FACTOR * rays.about["max_rays"]
    assert REFERENCE_FACTOR >= 16
    assert 0 < rays.about["reference_error"] < 0.4 * min(row["error"] for row in rays.rows)
    scene, field, heights = smooth()
    one, other = (Benchmark(scene, field, heights, seed, 1, 1 << 12).reference(Filter()) for seed in (0, 50))
    apart = relative_rms(one.image, other.image)  # of two equally wrong images: sqrt(2) times the error of either
    assert 0.8 < apart / np.hypot(one.error, other.error) < 1.25
    assert one.error_of(one.image) == 0.0
    assert one.error_of(other.image) == pytest.approx(np.sqrt(apart**2 - one.error**2), rel=1e-12)


def test_errors_do_not_depend_on_the_reference():
    """The same image against a poor reference and a far better one."""
    scene, field, heights = smooth()
    setting = Setting("", "uniform", 1 << 13, Filter(), torch.float64)
    poor, good = (Benchmark(scene, field, heights, 0, 1, n).reference(Filter()) for n in (1 << 8, 1 << 14))
    image = Benchmark(scene, field, heights, 0, 1, 1).image(setting, 0)
    assert poor.error > 5 * good.error
    # 575 pixels: relative scatter 1 / sqrt(1150) = 0.03
    assert poor.error_of(image) == pytest.approx(good.error_of(image), rel=0.1)


def test_errors_repeat_and_follow_the_seed():
    found = [run_study("rays", *smooth((12, 11)), seed=seed, max_rays=1 << 10, repeats=1) for seed in (3, 3, 4)]
    errors = [[row["error"] for row in study.rows] for study in found]
    assert errors[0] == errors[1]
    differ = [a != b for a, b in zip(errors[0], errors[2], strict=True)]
    assert sum(differ) == len(differ)  # even those of the grid: the reference's rays are others


def test_blur_trades_noise_for_bias(reconstruction):
    rows = {(row["series"], row["rays"]): row for row in reconstruction.rows}
    counts = sorted({row["rays"] for row in reconstruction.rows})
    assert len(rows) == len(FILTERS) * len(counts) == 21
    for n in counts:
        assert rows["bincount", n]["bias"] == rows["bincount", n]["kernel"] == 0.0
        assert rows["bincount", n]["noise"] == rows["bincount", n]["error"]
        for kind in ("gaussian", "cosine"):
            series = [rows["bincount", n], *(rows[f"{kind} {v}", n] for v in (3, 5))]
            assert np.diff([row["noise"] for row in series]).max() < 0 < np.diff([row["bias"] for row in series]).min()
    for row in rows.values():
        assert row["reference_error"] < 0.5 * row["noise"]
        # noise and bias are independent: their squares add up, but for the scatter of their product over 575 pixels
        assert row["error"] == pytest.approx(np.hypot(row["noise"], row["bias"]), rel=0.1)
    assert all(found.exponent > 0.4 for found in reconstruction.orders.values())


def test_single_precision_is_compared_on_the_same_rays(precision):
    assert len(precision.rows) == 3 * 2 * len(SAMPLERS)
    for double, single in zip(precision.rows[::2], precision.rows[1::2], strict=True):
        assert (double["dtype"], single["dtype"]) == ("float64", "float32")
        assert (double["sampler"], double["rays"]) == (single["sampler"], single["rays"])
        assert double["difference"] is double["speedup"] is None
        assert single["difference"] < 0.2 * single["error"]  # other rays would be sqrt(2) apart
        assert single["error"] == pytest.approx(double["error"], rel=0.05)
        assert single["speedup"] > 0
    assert any(single_precision(row) in precision.advice for row in precision.rows if row["dtype"] == "float32")


def test_progress_ends_where_it_said():
    for name in ("rays", "reconstruction", "precision"):
        told = []
        run_study(name, *smooth((6, 5)), max_rays=256, repeats=1, progress=lambda *step, told=told: told.append(step))
        done, total = zip(*told, strict=True)
        assert len(set(total)) == 1 and done[-1] == total[0]
        assert min(np.diff(done)) > 0 and len(done) > 20


def test_the_profile_of_the_source_is_seen():
    scene, field, heights = smooth()
    half = replace(scene, source=PlaneWave(profile=np.array([[0.0], [1.0]])))
    image = Benchmark(half, field, heights, 0, 1, 256).reference(Filter()).image
    assert float(image[:9].sum()) == 0.0
    assert float(image[14:].sum()) > 0.8 * float(image.sum()) > 0


@pytest.mark.parametrize("name", ["rays", "reconstruction", "precision"])
def test_files_hold_the_study(name, request, tmp_path):
    study = request.getfixturevalue(name)
    paths = write(study, tmp_path / "new" / "place")
    assert [p.name for p in paths] == [f"{name}.csv", f"{name}.json", f"{name}.png"]
    assert sorted(p.name for p in paths[0].parent.iterdir()) == sorted(p.name for p in paths)
    with open(paths[0], newline="") as f:
        table = list(csv.DictReader(f))
    assert list(table[0]) == list(study.columns)
    for text, row in zip(table, study.rows, strict=True):
        assert set(row) == set(study.columns)
        assert all(text[k] == ("" if v is None else str(v)) for k, v in row.items())

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    data = json.loads(paths[1].read_text(), parse_constant=refuse)
    assert data["rows"] == study.rows and data["advice"] == study.advice
    assert data["about"]["reference_error"] > 0
    assert set(data["orders"]) == {row["series"] for row in study.rows}
    with Image.open(paths[2]) as picture:
        assert picture.format == "PNG" and picture.size[0] > 500
    assert is_ours(paths[1]) and is_ours(paths[2])
    assert write(study, tmp_path / "new" / "place") == paths  # again, over the first


def test_plot_repeats_byte_for_byte_and_survives_an_error_of_zero(rays, tmp_path):
    odd = replace(rays, rows=[{**row, "error": 0.0 if row["sampler"] == "grid" else row["error"]} for row in rays.rows])
    for name in ("a.png", "b.png"):
        plot(odd, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_json_refuses_what_is_not_a_number(rays):
    with pytest.raises(ValueError, match="not JSON compliant"):
        as_json(replace(rays, rows=[{"error": float("nan")}]))


def test_advice_names_the_best_setting(rays):
    best = min(rays.rows, key=lambda row: row["error"])
    assert rays.advice.startswith(f"a relative error of {best['error']:.2g} costs ")
    assert f"with {best['rays']} {best['sampler']} rays; halving it costs " in rays.advice


def test_a_lens_that_lets_no_light_out_is_an_error():
    with pytest.raises(CausticError, match="no light reaches the screen"):
        run_study("rays", *smooth(tilt=2.0), max_rays=256, repeats=1)


@pytest.mark.parametrize(
    ("name", "options", "complaint"),
    [
        ("speed", {}, "must be one of rays, reconstruction, precision"),
        ("rays", {"max_rays": 10}, "rays must be a whole number 256 to"),
        ("rays", {"repeats": 0}, "repeats must be a whole number 1 to"),
    ],
)
def test_bad_input_is_refused(name, options, complaint):
    with pytest.raises(InputError, match=complaint):
        run_study(name, *smooth(), **options)


def test_a_file_in_place_of_the_directory_is_refused(rays, tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        write(rays, tmp_path / "taken")


def front(lens: Lens) -> Lens:
    """The same with a free-form entrance."""
    field = HeightField.of(lens)
    bumps = 0.05 * torch.rand(field.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return replace(lens, entrance=freeform_of(field, bumps))


def test_intersections_behind_a_free_form_entrance():
    """Of rays that begin at places of their own."""
    lens = front(Lens(control=(12, 12), offset=Offset(5.0)))
    scene = Scene(PlaneWave(), lens, Screen((30.0, 30.0), 300.0, (8, 8)))
    case = intersection.of_lens(scene, HeightField.of(lens), torch.full((12, 12), 5.0, dtype=torch.float64), 500)
    x, y, z = case.rays.origin
    assert x.shape == y.shape == z.shape == case.rays.power.shape and float(z.std()) > 0


def test_intersections_behind_another_lens():
    """Rays reach the surface through a plane-parallel plate and the flat entrance, each by Snell's law."""
    lens = Lens((10.0, 10.0), control=(9, 9), index=1.5, offset=Offset(5.0, (30.0, 30.0)))
    plate = Component(-12.0, (30.0, 30.0), thickness=4.0, index=1.7)
    scene = Scene(Points(((1.0, 2.0, -40.0),)), lens, Screen((20.0, 20.0), 100.0), elements=(plate,))
    field = HeightField.of(lens)
    x, y = field.control_xy()
    case = intersection.of_lens(scene, field, 5.0 - 0.01 * (x[:, None] ** 2 + y**2), 3000)
    truth, hit, residual = intersection.reference(case)
    at = [
        np.asarray(o + torch.from_numpy(truth.astype(float)) * d)[hit]
        for o, d in zip(case.rays.origin, case.rays.direction, strict=True)
    ]
    ahead = np.array([np.asarray(c)[hit] for c in case.rays.direction[:2]]) * lens.index  # invariant at parallel planes
    tangent = lambda n: ahead / np.sqrt(n * n - (ahead**2).sum(0))  # noqa: E731
    start = np.array([[1.0], [2.0]])
    there = start + (40.0 - 4.0) * tangent(1.0) + 4.0 * tangent(1.7) + at[2] * tangent(1.5)  # the entrance is at z = 0
    assert np.abs(there - np.array(at[:2])).max() < 1e-12 and residual < 1e-12 and hit.sum() > 100


def test_the_lenses_of_a_study_are_traced_with_all_their_surfaces(tmp_path, monkeypatch):
    """One whose second lens is free-form, too: its error is that of the finished project, rendered as such."""
    monkeypatch.chdir(tmp_path)
    write_blob()
    other = "lens z=60 size=30x30 radius=200,-200 thickness=4 free=back"
    usual = ["--quality", "draft", "--waves", "off", "--resolution", "16", "--iterations", "1", "--quiet"]
    assert cli.run(["design", "blob.png", *usual, "--element", other, "-o", "p"]) == 0
    lens = load("p")
    made = DesignedLens(5.0, 0.0, "rms", lens.project.scene(), lens.field, lens.state.heights, lens.target, 0.0)
    assert lens.state.heights.ndim == 3
    row = run_efficiency([made], 1, rays=100_000).rows[0]
    assert row["error"] == pytest.approx(lens.render(rays=100_000, effects="none").figures["relative_rms"], rel=0.05)
