"""report.png and tolerances.png: what is drawn, and that every label can be read in scenes of any shape."""

from __future__ import annotations

import threading
from itertools import combinations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D

from caustic_cli.loading import OnDemand, load_behind
from caustic_cli.scene import Lens, Screen
from caustic_cli.scene.tolerances import Parameter
from caustic_cli.studies import tolerances as study
from caustic_cli.studies.design_report import write_report

#: Overlap of two boxes that is no more than their margins, pixels.
TOUCH = 2.0


def test_what_is_loaded_behind_is_there_and_its_errors_are_those_of_its_use():
    for module in (there := OnDemand("caustic_cli.studies.design_report"), absent := OnDemand("caustic_cli.studies.absent")):
        load_behind(module)
    for thread in threading.enumerate():
        if thread.name == "loading":
            thread.join()
    assert there.write_report is write_report
    with pytest.raises(ModuleNotFoundError):
        _ = absent.write_report


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that were saved."""
    found: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: (FigureCanvasAgg(figure).draw(), found.append(figure)))
    return found


def report(tmp_path, shape=(60, 60), waves=False, stages=((0.0, False),), peak=1.0, **more) -> None:
    """A report of a lens and a screen of this shape, mm, whose image is brighter than its target by up to `peak`."""
    rng, pixels = np.random.default_rng(0), tuple(max(4, round(64 * n / max(shape))) for n in shape)
    target = np.zeros(pixels)
    inside = tuple(slice(n // 4, n - n // 4) for n in pixels)
    target[inside] = 1.0
    image = target * (1.0 + (peak - 1.0) * rng.random(pixels))
    image[inside][0, 0] = peak
    figures = {
        "relative_rms": 0.8,
        "start_relative_rms": 0.9,
        "mean_irradiance": 1e-5 * image.mean(),
        "peak_irradiance": 1e-5 * peak,
    }
    figures |= {"irradiance_unit": "W/mm^2", "on_screen": 0.9, "on_target": 0.8, "lost": {"fresnel": 0.1}, "in_black": 0.02}
    if waves:
        figures |= {"error_by": "waves", "wave_relative_rms": 0.09, "start_wave_relative_rms": 0.5}
        figures |= {f"wave_{key}_irradiance": figures[f"{key}_irradiance"] for key in ("mean", "peak")}
    losses = np.linspace(0.5, 0.05, 2 * len(stages)).reshape(-1, 2)
    history = np.array([[1, k, loss / target.size, 0.9, k + 0.1 * i] for k, row in enumerate(losses) for i, loss in enumerate(row)])
    heights = 1e-3 * rng.random((41, 41))
    lens, screen = Lens(tuple(map(float, shape))), Screen(tuple(map(float, shape)), 300.0, pixels)
    write_report(
        tmp_path / "r.png",
        target,
        image,
        heights,
        history,
        lens,
        screen,
        figures | more,
        "srgb",
        image if waves else None,
        stages,
    )


def labels(axis: Axes) -> list:
    """The texts of a panel with a place in the figure."""
    found = [axis.title, axis.xaxis.label, axis.yaxis.label]
    for along in (axis.xaxis, axis.yaxis):
        low, high = sorted(along.get_view_interval())
        found += [tick.label1 for tick in along.get_major_ticks() if low <= tick.get_loc() <= high and tick.label1.get_visible()]
        found += [tick.label2 for tick in along.get_major_ticks() if low <= tick.get_loc() <= high and tick.label2.get_visible()]
    return [text for text in found if text.get_text() and text.get_visible() and axis.axison]


def assert_readable(figure: Figure) -> None:
    """No label is cut, and none covers another."""
    boxes = []
    for axis in figure.findobj(Axes):
        if not isinstance(axis, Axes3D):
            boxes += [(text.get_text(), text.get_window_extent()) for text in labels(axis)]
    assert len(boxes) > 30
    for text, box in boxes:
        assert box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1, f"{text!r} is cut"
    for (one, a), (other, b) in combinations(boxes, 2):
        apart = max(a.x0 - b.x1, b.x0 - a.x1, a.y0 - b.y1, b.y0 - a.y1)
        assert apart > -TOUCH, f"{one!r} covers {other!r}"


@pytest.mark.parametrize("waves", [False, True], ids=["rays", "waves"])
@pytest.mark.parametrize("shape", [(60, 60), (0.5, 0.5), (200, 60), (400, 40), (60, 200), (40, 400), (900, 700)])
def test_labels_can_be_read_in_a_scene_of_any_shape(tmp_path, drawn, shape, waves):
    stages = [(4.0, False), (1.0, False), (0.0, False), (0.0, waves)]
    radius = {"radius_mm": 3.0, "in_black_per_mm": 0.0123, "noise": 1e-4}
    report(tmp_path, shape, waves, stages, least_relative_rms=0.7, min_radius=radius)
    assert_readable(drawn[0])


def test_losses_by_rays_and_by_waves_have_panels_of_their_own(tmp_path, drawn):
    """And the points of a design that is judged by its wave image are not called retraced rays."""
    report(tmp_path, waves=True, stages=[(2.0, False), (0.0, False), (0.0, True)])
    panels = {axis.get_title(): axis for axis in drawn[0].axes if axis.get_ylabel() == "relative RMS"}
    curves = {title: [line for line in axis.get_lines() if len(line.get_xdata()) > 1] for title, axis in panels.items()}
    assert [len(lines) for lines in curves.values()] == [1, 1, 1]
    (title,) = (title for title, axis in panels.items() if len(axis.get_lines()) > 1)
    assert "by waves" in title and "wave image" in title and "independent rays" not in title
    points = [float(line.get_ydata()[0]) for line in panels[title].get_lines() if len(line.get_xdata()) == 1]
    assert points == [0.5, 0.09]
    report(tmp_path, waves=False, stages=[(0.0, False)])
    (title,) = (axis.get_title() for axis in drawn[1].axes if axis.get_ylabel() == "relative RMS")
    assert "retraced with independent rays" in title and "wave" not in title


@pytest.mark.parametrize("peak", [1.0, 1.4, 3.0])
def test_images_are_drawn_over_their_whole_range(tmp_path, drawn, peak):
    """An uneven top is not cut at the target's peak; target and caustic have one exposure."""
    report(tmp_path, peak=peak)
    target, caustic = (axis.images[0] for axis in drawn[0].axes[:2])
    assert caustic.norm.vmax >= caustic.get_array().max() and caustic.norm.vmin == 0
    assert float(caustic.norm(caustic.get_array().max())) <= 1.0
    assert (target.norm.vmin, target.norm.vmax) == (caustic.norm.vmin, caustic.norm.vmax)
    assert target.get_array().sum() == pytest.approx(caustic.get_array().sum())


def test_labels_of_tolerances_can_be_read(tmp_path, drawn):
    """Sixteen errors with long names."""
    rng, names = np.random.default_rng(1), [f"source_distance {k}" for k in range(16)]
    parameters = tuple(Parameter(name, "throw", 0, "degrees", "sigma", 0.123) for name in names)
    figures = [study.TrialFigures(e, 0.9 * e, (0.0, 0.0), 0.9 - 0.1 * e, 0.95, 1e-3) for e in 0.1 + 0.01 * rng.random(200)]
    alone = tuple(study.Sensitivity(p.name, p.unit, 0.123, 1.0, 0.1, 0.1, 0.01) for p in parameters)
    found = study.Study(parameters, rng.normal(size=(200, 16)), tuple(figures), figures[0], alone, {}, False, 0)
    study.write_plot(tmp_path / "t.png", found)
    assert_readable(drawn[0])
