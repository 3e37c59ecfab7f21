"""project.toml: what it says comes back, what it cannot say is refused by name, and what follows from what."""

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from caustic_cli.config import settings
from caustic_cli.config.default_stages import GAPS, creased_control, transport_cells
from caustic_cli.config.design import build_options, build_stages
from caustic_cli.config.settings import ELEMENT, SCHEMA, STAGE, Settings, build_lens, build_scene, dump, parse, tables_of
from caustic_cli.effort import DRAFT, FINE, SINGLE_SPANS, STANDARD, TEST, current_effort
from caustic_cli.errors import InputError
from caustic_cli.kinds.robust import RobustSurface
from caustic_cli.project.completion import complete
from caustic_cli.schema.table import TABLE, Parameters

INDEX = 1.5443  # table D.2

number = st.floats(allow_nan=False)
whole = st.integers(-(2**63), 2**63 - 1)
VALUES = {
    "number": number,
    "whole": whole,
    "text": st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
    "flag": st.booleans(),
    "numbers": st.lists(number, min_size=2, max_size=2),
    "wholes": st.lists(whole, min_size=2, max_size=2),
    "list": st.lists(number, max_size=5),
    "points": st.lists(st.lists(number, min_size=3, max_size=3), min_size=1, max_size=3),
}


def some(keys):
    return st.fixed_dictionaries({}, optional={name: VALUES[key.kind] for name, key in keys.items()})


@st.composite
def written(draw):
    s = {section: draw(some(keys)) for section, keys in SCHEMA.items() if keys}
    s.get("source", {}).pop("direction", None)  # is read as a tilt
    stages = draw(st.lists(some(STAGE).filter(bool), max_size=2))
    if stages:
        s["design"]["stages"] = stages
    elements = draw(st.lists(some(ELEMENT).filter(bool), max_size=2))
    if elements:
        s["element"] = {"list": elements}
    return s


# reading and writing


@given(written())
def test_parse_undoes_dump(s):
    full = Settings.of(s)
    assert parse(dump(full), "here") == tables_of(full)


@given(written())
def test_dump_is_toml_any_reader_reads(s):
    full = Settings.of(s)
    raw = tomllib.loads(dump(full))
    assert raw.pop("format_version") == 1
    assert raw.pop("created_by").startswith("caustic ")
    assert raw == tables_of(full) | ({"element": s["element"]["list"]} if "element" in s else {})


def test_complete_settings_round_trip():
    s = complete({}, 0.75)
    assert parse(dump(s), "here") == tables_of(s)
    assert dump(complete(parse(dump(s), "here"), 0.75)) == dump(s)


def test_every_length_carries_its_unit():
    text = dump(complete({}, 1.0)).splitlines()
    for key in ("size", "z_in", "thickness", "radius", "height_range", "min_thickness", "z"):
        rows = [line for line in text if line.split(" =")[0] == key]
        assert rows and all("# mm" in line for line in rows), key
    noted = [line for line in text if " = " in line and "#" in line]
    assert len(noted) > 40


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[lens]\ndegre = [3, 3]", ["[lens]", "degre", "degree"]),
        ("[lense]\nindex = 1.5", ["lense", "lens"]),
        ("[screen]\nresolutoin = [2, 2]", ["[screen]", "resolution"]),
        ("[[design.stages]]\nblurr = 1.0", ["design.stages", "blurr", "blur"]),
        ("[source]\nzzzzzz = 1", ["zzzzzz", "type", "power"]),
        ("lens = 3", ["lens", "section"]),
        ("[lens]\nindex = '1.5'", ["[lens] index", "number", "'1.5'"]),
        ("[lens]\nindex = true", ["[lens] index", "number"]),
        ("[lens]\nindex = nan", ["[lens] index", "nan"]),
        ("[lens]\nsize = 10", ["[lens] size", "pair"]),
        ("[lens]\nsize = [10]", ["[lens] size", "pair"]),
        ("[lens]\nsize = [1, 2, 3]", ["[lens] size", "pair"]),
        ("[lens]\nsize = [1, '2']", ["[lens] size", "number"]),
        ("[lens]\ncontrol = [3.0, 3]", ["[lens] control", "whole"]),
        ("[design]\nseed = 1.5", ["[design] seed", "whole"]),
        ("[design]\nfilter_target = 1", ["[design] filter_target", "true or false"]),
        ("[design]\nloss = 3", ["[design] loss", "text"]),
        ("[design]\nstages = 3", ["stages", "tables"]),
        ("[design]\nstages = []", ["stages"]),
        ("format_version = 99", ["format_version", "99", "1"]),
        ("format_version = 'one'", ["format_version", "one"]),
        ("[lens", ["TOML"]),
        ("a = 1\na = 2", ["TOML"]),
    ],
)
def test_refused_by_name(text, words):
    with pytest.raises(InputError) as caught:
        parse(text, "there.toml")
    message = str(caught.value)
    assert message.startswith("there.toml: ") and "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize("version", ["0", "-1", "true"])
def test_a_format_version_that_never_was_is_refused(version):
    with pytest.raises(InputError, match="format_version"):
        parse(f"format_version = {version}", "there.toml")


def test_a_whole_number_serves_as_a_length():
    assert parse("[screen]\nz = 300\nsize = [40, 30]", "here")["screen"] == {"z": 300.0, "size": [40.0, 30.0]}


def test_a_file_that_is_no_text(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "a.toml", tmp_path / "none.toml", tmp_path):
        with pytest.raises(InputError, match="TOML file is needed"):
            settings.read(path)


# what follows from what


def test_the_default_scene_is_table_d2():
    s = complete({}, 1.0)
    assert s.lens.size == (10.0, 10.0) and s.screen.z == 300.0 and s.lens.index == INDEX
    assert s.target.size == pytest.approx([30.0, 30.0])
    assert s.screen.size == pytest.approx([38.4, 38.4])
    assert s.screen.resolution == (250, 250)
    assert s.lens.control == (503, 503) and s.lens.degree == (3, 3)
    build_scene(s), build_stages(s), build_options(s)


def test_mag_3():
    s = complete({}, 1.0, Parameters(mag=3.0))
    assert s.target.size == pytest.approx([30.0, 30.0]) and s.screen.size == pytest.approx([38.4, 38.4])
    assert s.lens.radius == pytest.approx([(INDEX - 1) * (300 - 5) / 2] * 2, rel=1e-14)
    assert build_lens(s.lens).offset.radius == s.lens.radius


def test_mag_1_is_flat():
    assert complete({}, 1.0, Parameters(mag=1.0)).lens.radius == (math.inf, math.inf)


def test_mag_counts_lens_widths():
    s = complete({"lens": {"size": [20.0, 20.0]}}, 1.0, Parameters(mag=2.0, margin=0.5))
    assert s.target.size == pytest.approx([40.0, 40.0]) and s.screen.size == pytest.approx([60.0, 60.0])


@pytest.mark.parametrize(("at", "thickness"), [(-10.0, 11.607), (-60.0, 6.0)])
def test_a_lens_close_to_its_source_is_thick_enough_for_its_corners(at, thickness):
    """A source 10 mm before a lens of 30 mm: the offset gathers 56 degrees, and its corners lie 10.6 mm below its middle."""
    said = {"source": {"type": "point", "position": [[0.0, 0.0, at]]}, "lens": {"size": [30.0, 30.0]}}
    s = complete(said, 1.0, Parameters(mag=3.0))
    low, _ = build_lens(s.lens).height_bounds(np.array([-15.0, 0.0, 15.0]), np.array([-15.0, 0.0, 15.0]))
    assert low.min() >= 1.0 and s.lens.thickness == pytest.approx(thickness, abs=1e-3)
    with pytest.raises(InputError, match="leaves no room for the heights"):
        thin = complete({**said, "lens": said["lens"] | {"thickness": 0.9}}, 1.0, Parameters(mag=3.0))
        build_lens(thin.lens).height_bounds(np.array([-15.0, 0.0, 15.0]), np.array([-15.0, 0.0, 15.0]))


def test_a_non_square_picture_keeps_its_shape():
    s = complete({}, 0.5, Parameters(mag=3.0))
    assert s.target.size == pytest.approx([30.0, 15.0])
    assert s.screen.size == pytest.approx([38.4, 19.2])
    assert s.screen.resolution == (250, 125)
    reach = (INDEX - 1) * 295  # each axis has its own magnification, 3 and 1.5
    assert s.lens.radius == pytest.approx([reach / 2, reach / 0.5])


@pytest.mark.parametrize(
    ("width", "aspect", "expected"), [(24, 1.0, (24, 24)), (100, 2.0, (100, 200)), (100, 0.753, (100, 75)), (2, 0.01, (2, 2))]
)
def test_resolution_counts_across(width, aspect, expected):
    assert complete({}, aspect, Parameters(resolution=(width,))).screen.resolution == expected


def test_screen_size_alone_sets_the_picture():
    s = complete({"screen": {"size": [64.0, 64.0]}}, 1.0)
    assert s.target.size == pytest.approx([50.0, 50.0])


def test_a_picture_fits_on_a_screen_of_another_shape():
    for aspect in (0.5, 1.0, 3.0):
        s = complete({"screen": {"size": [64.0, 32.0]}}, aspect)
        width, height = s.target.size
        assert height == pytest.approx(aspect * width)
        assert width <= 50.0 + 1e-9 and height <= 25.0 + 1e-9
        assert width == pytest.approx(50.0) or height == pytest.approx(25.0)


def test_what_was_given_is_kept():
    given_ = {"lens": {"radius": [100.0, 90.0], "control": [20, 21], "degree": [2, 5]}, "screen": {"resolution": [7, 9]}}
    s = complete(given_, 1.0)
    assert s.lens.radius == (100.0, 90.0) and s.lens.control == (20, 21) and s.screen.resolution == (7, 9)


def test_glass_replaces_the_index():
    s = complete({"lens": {"glass": "N-BK7"}}, 1.0)
    assert "index" not in s.lens
    assert build_lens(s.lens).index == pytest.approx(1.5168, abs=1e-4)  # n_d of the Schott catalogue
    with pytest.raises(InputError, match="not both"):
        complete({"lens": {"glass": "N-BK7", "index": 1.5}}, 1.0)


OFFSET = {"design": {"start": "offset", "waves": "off"}}
RAYS = {"design": {"waves": "off"}}


def test_the_environment_gives_the_effort_that_no_quality_sets(monkeypatch):
    assert current_effort() == TEST
    monkeypatch.setenv("CAUSTIC_EFFORT", "fine report=False waves=((3,9),)")
    assert current_effort() == replace(FINE, report=False, waves=((3, 9),))
    asked, plain = (complete(OFFSET, 1.0, by).design.stages for by in (Parameters(quality="draft"), None))
    assert [stages[-1].iterations for stages in (asked, plain)] == [25, 120]
    monkeypatch.delenv("CAUSTIC_EFFORT")
    assert current_effort() == STANDARD


@pytest.mark.parametrize(("quality", "first", "last"), [("draft", 15, 25), ("standard", 25, 50), ("fine", 40, 120)])
def test_quality_shapes_the_stages(quality, first, last):
    stages = complete(OFFSET, 1.0, Parameters(quality=quality)).design.stages
    assert stages[0].iterations == first and stages[-1].iterations == last
    moved = [complete(RAYS, 1.0, Parameters(quality=q)).design.stages for q in ("draft", "standard", "fine")]
    assert [len(s) for s in moved] == [1, 2, 2]
    assert moved[0][-1].rays < moved[1][-1].rays < moved[2][-1].rays
    assert [s[-1].control[0] for s in moved] == sorted(s[-1].control[0] for s in moved)


def test_stages_end_sharp_on_the_lens_own_net():
    s = complete({"lens": {"control": [19, 35]}, **OFFSET}, 1.0, Parameters(rays=5000))
    stages = build_stages(s)
    assert stages[-1].control == (19, 35) and stages[-1].rays == 5000 and stages[-1].rendering.blur == 0.0
    blurs = [stage.rendering.blur for stage in stages]
    assert blurs == sorted(blurs, reverse=True) and blurs[0] > 0


@pytest.mark.parametrize("design", [{"network": "dense", "optimizer": "adam"}, {"optimizer": "adam"}])
def test_adam_has_one_stage(design):
    assert len(complete({"design": design}, 1.0).design.stages) == 1


@pytest.mark.parametrize(
    ("given_", "shaped", "word"),
    [
        ({}, {"mag": 0.0}, "mag"),
        ({}, {"mag": math.nan}, "mag"),
        ({}, {"mag": -3.0}, "mag"),
        ({}, {"margin": -0.1}, "margin"),
        ({}, {"quality": "superb"}, "quality"),
        ({"screen": {"z": 3.0}}, {}, "[screen] z"),
        ({"screen": {"z": math.inf}}, {}, "[screen] z"),
        ({"lens": {"degree": [99, 99]}}, {}, "[lens] degree"),
        ({"lens": {"index": 1.0}}, {}, "[lens] index"),
        ({"lens": {"glass": "wood"}}, {}, "wood"),
        ({"lens": {"size": [0.0, 1.0]}}, {}, "[lens] size"),
        ({"screen": {"size": [0.0, 1.0]}}, {}, "[screen] size"),
        ({"design": {"stages": [{"blur": 1.0}]}}, {"rays": 1000}, "rays"),
    ],
)
def test_out_of_range(given_, shaped, word):
    with pytest.raises(InputError) as caught:
        complete(given_, 1.0, Parameters(**shaped))
    assert word in str(caught.value)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"design": {"stages": [{"control": [9, 9]}]}}, "control"),
        ({"design": {"stages": [{"alpha_per_mm2": 1.0, "alpha_per_pixel2": 1.0, "reconstruction": "gaussian"}]}}, "alpha"),
        ({"design": {"stages": [{"reconstruction": "moon"}]}}, "reconstruction"),
        ({"design": {"stages": [{"filter_size": [2, 2]}]}}, "filter"),
        ({"design": {"stages": [{"rays": 0}]}}, "rays"),
    ],
)
def test_stages_out_of_range(change, word):
    with pytest.raises(InputError) as caught:
        build_stages(complete(change, 1.0))
    assert word in str(caught.value)


@pytest.mark.parametrize(("key", "value"), [("optimizer", "moon"), ("dtype", "float16"), ("seed", -1), ("lr", 0.0)])
def test_design_options_out_of_range(key, value):
    with pytest.raises(InputError) as caught:
        build_options(complete({"design": {key: value}}, 1.0))
    assert key in str(caught.value)


def test_a_picture_with_gaps_has_a_net_as_fine_as_its_creases_ask_for():
    rays = {"design": {"waves": "off"}}
    plain, creased = complete(rays, 1.0), complete(rays, 1.0, gaps=1.0)
    assert plain.lens.control == (503, 503)
    assert creased.lens.control == (2523, 2523) == creased.design.stages[-1].control
    assert complete(rays, 1.0, gaps=0.9 * GAPS).design == plain.design
    own = {**rays, "lens": {"control": [203, 203]}}
    assert complete(own, 1.0, gaps=1.0).design.stages == complete(own, 1.0).design.stages
    blurred = {**rays, "source": {"type": "disc", "position": [[0.0, 0.0, -1000.0]]}}
    for other in ({}, blurred):  # the first is seen as a wave
        assert complete(other, 1.0, gaps=1.0).lens.control == complete(other, 1.0).lens.control


@pytest.mark.parametrize(
    ("scene", "spans"),
    [
        ({"source": {"type": "point", "position": [[0.0, 0.0, -60.0]]}}, 2520),
        ({"screen": {"tilt": [0.0, 30.0]}}, 2520),
        ({"screen": {"radius": [45.0, 45.0]}}, 2520),
        ({"lens": {"mirror": True}}, SINGLE_SPANS),  # whose rays are intersected one by one
        ({"element": {"list": [{"z": 60.0, "size": [20.0, 20.0], "radius": [90.0, -90.0]}]}}, SINGLE_SPANS),
        ({"lens": {"gradient": "radial", "gradient_terms": [-1e-3]}}, SINGLE_SPANS),
    ],
)
def test_pictures_with_gaps_have_a_fine_net_in_any_scene(scene, spans):
    assert complete({"design": {"waves": "off"}, **scene}, 1.0, gaps=1.0).lens.control == (spans + 3, spans + 3)


@pytest.mark.parametrize(
    ("changed", "iterations"),
    [
        ({}, 0),
        ({"design": {"loss": "rms-light + 0.1 laplacian"}}, 2),
        ({"design": {"min_radius": 0.5}}, 2),
        ({"design": {"max_slope": 0.1}}, 2),
        ({"lens": {"finish": "gaussian:0.05"}}, 2),
        ({"element": {"list": [{"z": 60.0, "size": [20.0, 20.0], "radius": [90.0, -90.0], "free": "both"}]}}, 2),
        ({"lens": {"gradient": "free", "with_surface": True}}, 2),
    ],
)
def test_iterations_after_the_transport_of_a_picture_with_gaps(changed, iterations, monkeypatch):
    """Only where more is asked for than it knows."""
    monkeypatch.setenv("CAUSTIC_EFFORT", "standard")
    design = {"waves": "off", **changed.get("design", {})}
    stages = complete({**changed, "design": design}, 1.0, gaps=1.0).design.stages
    assert [stage.iterations for stage in stages] == [iterations]
    assert not RobustSurface.known_to_transport(None)


def test_cells_of_the_start_follow_rays_or_a_fine_net():
    assert transport_cells(4_000_000, False, 500) == 500
    assert transport_cells(4_000_000, False, 2000) == 2000
    assert transport_cells(1_000_000, True, 2000) == 2000
    assert transport_cells(1_000_000, True, 500) == 500


def test_after_a_transport_start_heights_are_refined_without_a_preconditioner():
    exact, coarse = (complete({"design": {"start": start}}, 1.0).design for start in ("transport", "offset"))
    assert (exact.preconditioner, coarse.preconditioner) == ("none", "laplacian")


@pytest.mark.parametrize("effort", [DRAFT, STANDARD, FINE])
@pytest.mark.parametrize("pieces", [1, 5, 12])
def test_the_finest_default_net_is_one_that_may_be_asked_for(effort, pieces):
    for pixels in (64, 250, 257, 300, 1000, 3000):
        for degree in (1, 3, 5):
            points = creased_control(pixels, degree, effort.creased, pieces)
            spans = (points - 1) // pieces - degree + 1
            assert points <= TABLE["lens.control"].high and points == pieces * (spans + degree - 1) + 1
            assert spans >= min(0.97 * effort.creased.spans(pixels) / pieces, 64)
