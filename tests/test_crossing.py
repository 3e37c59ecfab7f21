"""Light that crosses over on its way to the screen: the other one of the two surfaces for a picture."""

import numpy as np
import pytest

import caustic_cli
from caustic_cli import cli
from caustic_cli.inverse.projection import CrossedProjection, ScreenProjection
from caustic_cli.scene import Screen

SMALL = {"resolution": 48, "control": [40, 40], "rays": 20_000, "iterations": 1, "waves": "off"}
#: A beam or a point, a lens or a mirror, upright or tilted to the light.
SCENES = {
    "lens": {},
    "far": {"throw": 100_000, "picture_size": [30_000, 30_000]},
    "tilted screen": {"screen_tilt": [0, 20]},
    "oblique light": {"source_tilt": [0, 20]},
    "point": {"source": "point", "source_position": [0, 0, -60]},
    "mirror": {"mirror": True, "source_tilt": [0, 45]},
    "point, mirror": {"mirror": True, "source": "point", "source_position": [40, 0, -60]},
    "array": {"array": [2, 2], "control": [45, 45]},
}


def lopsided():
    """A picture without any symmetry."""
    picture = np.full((24, 24), 0.2)
    picture[3:9, 4:20], picture[9:18, 4:8] = 1.0, 0.6
    return picture


def bent(lens):
    """Mean second differences of the heights along x and along y."""
    z = lens.heights.numpy()
    return [np.diff(z, 2, axis).mean() for axis in (0, 1)]


@pytest.mark.parametrize("name", SCENES)
def test_both_surfaces_draw_the_picture_and_one_is_more_convex(name):
    made = [caustic_cli.design(lopsided(), **SMALL | SCENES[name], crossing=crossing) for crossing in (False, True)]
    errors = [lens.figures["relative_rms"] for lens in made]
    assert max(errors) < 0.5 and abs(errors[1] - errors[0]) < 0.15, errors
    one, other = map(bent, made)
    if name == "array":  # the sign of a whole net is that of its lenslets' creases
        return
    assert all(b < a for a, b in zip(one, other, strict=True)), (one, other)  # a mirror is seen from below: hollow


def test_light_of_a_crossing_lens_lands_on_the_other_side():
    """A bright half of the picture is lit by the half of the lens that faces it, or by the other one."""
    picture = np.full((24, 24), 0.1)
    picture[12:] = 1.0
    share = []
    for crossing in (False, True):
        lens = caustic_cli.design(picture, **SMALL, crossing=crossing)
        z = lens.heights.numpy()
        mean = np.diff(z, axis=0)[:, 15:25].mean(1)  # slope along x
        flat = int(np.abs(mean).argmin())  # where light goes straight on, to the middle of the picture
        share.append(flat / len(mean))
    assert share[0] < 0.45 and share[1] > 0.55  # most of the lens lights the bright half


def test_a_crossed_projection_is_the_other_one_turned():
    own = ScreenProjection(Screen((300.0, 200.0), 500.0, (30, 20), shift=(12.0, -5.0), tilt=(0.0, 20.0)), 5.0)
    crossed = CrossedProjection(own)
    x, y = np.array([3.0, -40.0]), np.array([20.0, 7.0])
    u, v = crossed.project(x, y)
    np.testing.assert_allclose(crossed.screen_coordinates(u, v), [x, y], atol=1e-9)
    np.testing.assert_allclose([u, v], -np.array(own.project(x, y)))
    one, other = own.projected_target(np.ones((30, 20))), crossed.projected_target(np.ones((30, 20)))
    assert other[1] == one[1] and other[2] == tuple(-c for c in one[2]) and crossed.sign == -1.0
    np.testing.assert_array_equal(other[0], one[0][::-1, ::-1])


def test_a_lamp_has_no_crossing_light(capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.run(["design", "uniform", "--lamp", "15", "--angles", "60", "--crossing"]) == 2
    assert "--crossing is not a setting of a lamp" in capfd.readouterr().err
