"""Conservation of energy: surfaces without glass, ghosts that focus, energy balances of random scenes."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import write_blob

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import CausticError, InputError
from caustic_cli.kinds import evaluation
from caustic_cli.optics.bounds import bounds_of, check_exit_above_entrance
from caustic_cli.optics.effects import EFFECTS
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.image import Image
from caustic_cli.optics.plan import compile_plan
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.spread import Convolution, point_source, spread_at
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.trace import expose
from caustic_cli.project.completion import complete
from caustic_cli.scene import Disc, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.studies.retrace import require_energy_balance, retrace


def sphere(index: float, magnification: float, pixels: int = 100, **lens) -> tuple[Scene, HeightField, torch.Tensor]:
    """A scene whose lens is the sphere of that magnification, on a screen of 12 mm or as wide as its light."""
    offset = Offset.for_magnification((magnification, magnification), index, 300.0, 5.0)
    scene = Scene(
        PlaneWave(), Lens(index=index, offset=offset, control=(30, 30), **lens), Screen((12.0, 12.0), 300.0, (pixels, pixels))
    )
    field = HeightField.of(scene.lens)
    x, y = (c.numpy() for c in field.control_xy())
    return scene, field, torch.from_numpy(offset.thickness + offset.sag(x[:, None], y[None, :]))


# surfaces without glass


def test_a_surface_below_its_entrance_is_refused():
    scene, field, heights = sphere(1.5, 3.0, z_in=4.9)
    lowest = float(heights.min())
    check_exit_above_entrance(scene, field, heights + 4.9 - lowest)
    with pytest.raises(InputError, match=r"\[lens\] z_in of 4.9 mm lies above .* dips 0.0998 mm below it; it must be at most 4.80"):
        check_exit_above_entrance(scene, field, heights + 4.8 - lowest)


def test_a_corner_that_a_round_lens_has_not_may_dip():
    heights = torch.full((8, 8), 2.0, dtype=torch.float64)
    heights[0, 0] = -1.0
    for aperture, refused in (("circle", False), ("rectangle", True)):
        scene = Scene(PlaneWave(), Lens(control=(8, 8), aperture=aperture), Screen((12.0, 12.0), 300.0, (16, 16)))
        if refused:
            with pytest.raises(InputError, match="dips 1 mm"):
                check_exit_above_entrance(scene, HeightField.of(scene.lens), heights)
        else:
            check_exit_above_entrance(scene, HeightField.of(scene.lens), heights)


def test_projects_and_archives_without_glass_are_not_opened(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    write_blob()
    small = ["--resolution", "24", "--control", "12", "--start", "offset", "--rays", "4000", "--iterations", "1", "--waves", "off"]
    assert cli.run(["design", "blob.png", *small, "--quiet"]) == 0
    assert cli.run(["export", "blob.caustic", "--quiet"]) == 0
    toml = tmp_path / "blob.caustic" / "project.toml"
    toml.write_text(toml.read_text().replace("z_in = 0.0", "z_in = 5.3"))
    archive = dict(np.load("blob.npz"))
    np.savez("blob.npz", **archive | {"z_in": np.array(5.3)})
    capfd.readouterr()
    for path in ("blob.caustic", "blob.npz"):
        before = {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")}
        extra = ["--absorption", "500"] if path == "blob.caustic" else []
        assert cli.run(["render", path, *extra, "--quiet"]) == 2
        message = capfd.readouterr().err
        assert message.count("\n") == 1 and path in message and "mm below it" in message
        assert {p: p.stat().st_mtime_ns for p in tmp_path.rglob("*")} == before


def of_parts(on_screen: float, absorbed: float) -> Image:
    return Image(torch.full((2, 2), on_screen / 4.0, dtype=torch.float64), 1.0, {"absorbed": absorbed})


@pytest.mark.parametrize("parts", [(1.45, -0.45), (0.5, 0.4), (math.nan, 0.0), (1.0 + 1e-8, 0.0)])
def test_an_invalid_energy_balance_stops_a_render(parts):
    with pytest.raises(CausticError, match="does not close"):
        require_energy_balance(of_parts(*parts), torch.float64)
    require_energy_balance(of_parts(0.6, 0.4), torch.float64)


def test_an_energy_that_does_not_close_is_not_hidden_by_its_fractions(monkeypatch):
    """Fractions are of the sum of all parts; the sum itself is checked before."""
    scene, field, heights = sphere(1.5, 1.5)
    brighter = lambda *a, **k: replace(one := expose(*a, **k), image=1.001 * one.image)  # noqa: E731
    monkeypatch.setattr("caustic_cli.studies.retrace.expose", brighter)
    with pytest.raises(CausticError, match="does not close"):
        retrace(scene, field, heights, None, rays=1000)


def test_all_light_on_the_screen_is_1_and_no_more():
    """Sums of 90,000 equal powers of 1 / 90,000 are not: of a plane mirror, whose light all lands on few pixels."""
    lens = Lens(control=(5, 5), mirror=True)
    field, heights = HeightField.of(lens), torch.full((5, 5), 5.0, dtype=torch.float64)
    target, drift = np.ones((8, 8)), []
    for pixels in ((2, 2), (8, 8), (3, 5)):
        screen = Screen((12.0, 12.0), -40.0, pixels)
        exposure, figures = retrace(
            Scene(PlaneWave(), lens, screen), field, heights, target if pixels == (8, 8) else None, rays=90_000, noise=False
        )
        drift.append(float(exposure.image.sum()) - 1.0)
        assert figures["on_screen"] == 1.0 and figures["on_target"] in (None, 1.0)
        assert not any(figures["lost"].values())
    assert max(drift) > 1e-14


def test_weights_that_overflow_are_refused():
    with pytest.raises(InputError, match=r"\[source\] weights must be"):
        settings.build_light(complete({"source": {"wavelengths": [400.0, 500.0], "weights": [1e308, 1e308]}}, 1.0))


# ghosts


@pytest.mark.parametrize("index", [1.5, 1.9])
@pytest.mark.parametrize("shape", ["focused", "near", "usual"])
def test_what_a_ghost_adds_is_foreseen(index, shape):
    """Where its first ghost comes to a point on the screen, where it nearly does, and of a lens that spreads."""
    magnification = {"focused": 1.0 - (index - 1.0) / (3.0 * index - 1.0), "near": 0.95, "usual": 2.0}[shape]
    scene, field, heights = sphere(index, magnification)
    foreseen, images = bounds_of(scene, field, heights).ghost_error, []
    for ghosts in (True, False):
        names = {e.name for e in compile_plan(scene, field, heights).effects if e.on} - {"ghosts"} | (
            {"ghosts"} if ghosts else set()
        )
        plan = compile_plan(scene, field, heights, names)
        rays = rays_of(plan.scene, "stratified", 250_000, 1)
        images.append(expose(plan.scene, field, heights, rays, None, torch.float64, requests=plan.requests).image)
    added = float((images[0] - images[1]).square().mean().sqrt() / images[1].mean())
    room = 3.0 if shape == "focused" else 1.4
    assert added / 1.1 < foreseen < room * added or max(added, foreseen) < 2e-3  # light at the screen's border is not foreseen
    assert compile_plan(scene, field, heights)["ghosts"].on == (foreseen > 0.01 or bounds_of(scene, field, heights).ghost > 0.01)
    assert shape != "focused" or (compile_plan(scene, field, heights)["ghosts"].on and added > 0.05)


# blur


@pytest.mark.parametrize("source", [Disc(angle=0.533), Disc((0.0, 0.0, -500.0), (5.0, 5.0)), Disc((0.0, 0.0, -100.0), (1.0, 1.0))])
def test_the_blur_of_a_source_knows_the_glass(source):
    scene, field, heights = sphere(1.5, 3.0)
    scene = Scene(source, scene.lens, scene.screen)
    spread = spread_at(scene, field, heights)
    assert Resolution.at(scene, field, heights).source == pytest.approx(2.0 * max(spread.half), rel=0.005)


def test_an_image_spread_is_the_image_of_the_source():
    """Of a lens with relief: the centre's image, convolved, beside rays from all of the disc in two independent halves, whose noise
    the product of the differences does not have."""
    scene, field, heights = sphere(1.5, 1.5)
    x, y = field.control_xy()
    heights = heights + 0.01 * torch.sin(1.3 * x)[:, None] * torch.sin(0.9 * y)[None, :]
    disc = Scene(Disc((0.0, 0.0, -500.0), (5.0, 5.0), intensity="uniform"), scene.lens, Screen((30.0, 30.0), 300.0, (60, 60)))
    spread = spread_at(disc, field, heights).on(disc.screen.pixel)
    assert spread.cut == 4
    fine = replace(disc, screen=replace(disc.screen, resolution=(240, 240)), source=point_source(disc))

    def image(scene: Scene, rays: int, seed: int) -> torch.Tensor:
        found = expose(scene, field, heights, rays_of(scene, "sobol", rays, seed), None, torch.float64).image
        return found / found.mean()

    sharp, discs = image(fine, 2_000_000, 1), [image(disc, 1_000_000, seed) for seed in (2, 3)]

    def square(kernel: Convolution) -> float:
        seen = kernel.whole(sharp).reshape(60, 4, 60, 4).sum((1, 3))
        first, second = (seen / seen.mean() - one for one in discs)
        return float((first * second).mean())

    assert abs(square(spread)) < 0.01**2
    found = spread_at(disc, field, heights)
    wider = replace(found, half=tuple(1.03 * h for h in found.half))
    assert square(wider.on(disc.screen.pixel)) > 0.01**2  # 3 % are noticed


# a start that is better


def test_a_brighter_lens_is_kept_though_its_start_was_more_like_the_picture():
    figures = [{"relative_rms": e, "on_screen": s, "noise": None} for e, s in ((0.5, 0.9), (0.4, 0.8), (0.4, 0.895))]
    brighter, start, alike = figures
    assert not evaluation._worse(brighter, start) and evaluation._worse(brighter, alike)


# accounts


def random_scene(rng: np.random.Generator) -> tuple[Scene, HeightField, torch.Tensor]:
    """A scene of any source, effects and shape, hostile ones among them; its lens may be rough, steep and thin."""

    def one(*values):
        return values[rng.integers(len(values))]

    half = 10.0 ** rng.uniform(-1.0, 2.0)
    round_, mirror = bool(rng.random() < 0.3), bool(rng.random() < 0.15)
    degree = (int(rng.integers(1, 6)), int(rng.integers(1, 6)))
    control = tuple(int(p + rng.integers(1, 12)) for p in degree)
    thickness = half * 10.0 ** rng.uniform(-2.0, 0.7)
    glass = None if mirror or rng.random() < 0.7 else one("N-BK7", "PMMA", "N-SF11")
    lens = Lens(
        size=(2.0 * half, 2.0 * half * (1.0 if round_ else rng.uniform(0.3, 3.0))),
        index=float(one(1.0001, 1.33, 1.5, 1.9, 3.0, 5.0)),
        glass=glass,
        control=control,
        degree=degree,
        offset=Offset(thickness),
        fresnel=one("none", "schlick", "exact"),
        absorption=float(one(0.0, 0.0, 1e-3, 1.0, 1e3, 1e6)),
        roughness=float(one(0.0, 0.0, 0.02, 0.5)),
        mirror=mirror,
        aperture="circle" if round_ else "rectangle",
    )
    heights = torch.from_numpy(thickness * np.maximum(0.0, 1.0 + one(0.0, 0.01, 0.3, 2.0) * rng.standard_normal(control)))
    before = -half * 10.0 ** rng.uniform(-2.0, 4.0)
    position = (float(rng.normal() * half), float(rng.normal() * half), before)
    wide = (half * rng.uniform(0.0, 2.0), half * rng.uniform(0.0, 2.0))
    cone = one(None, None, 90.0, 5.0)
    shine = {"cone": cone, "intensity": one("uniform", "lambertian"), "aimed": bool(rng.random() < 0.7)}
    source = one(
        PlaneWave(float(rng.uniform(1e-6, 1e6))),
        Points((position,), None, **shine),
        Points((position, (0.0, 0.0, 2.0 * before)), (0.3, 5.0), **shine),
        Points.grid(position, wide, (3, 4), 2.0, **shine),
        Disc(position, wide, 3.0, **shine),
        Disc(angle=float(one(0.0, 0.533, 20.0, 170.0))),
    )
    light = Light(
        polarisation=one(None, None, 30.0),
        wavelengths=one((), (450.0, 600.0)),
        weights=(),
        tracked=bool(rng.random() < 0.2),
    )
    away = (2.0 * thickness + 10.0 ** rng.uniform(-1.0, 4.0)) * (-1.0 if mirror else 1.0)
    screen = Screen(
        (10.0 ** rng.uniform(-2.0, 3.0),) * 2,
        away,
        (int(rng.integers(2, 40)), int(rng.integers(2, 40))),
        one((0.0, 0.0), (20.0, -70.0)),
        one((0.0, 0.0), (half, 3.0 * half)),
    )
    return Scene(source, lens, screen, light), HeightField.of(lens), heights


def balance_of(seed: int) -> dict[str, float] | None:
    """Where the light of a random scene goes, None of a scene that is refused."""
    rng = np.random.default_rng(seed)
    try:
        scene, field, heights = random_scene(rng)
        check_exit_above_entrance(scene, field, heights)
        wanted = None if rng.random() < 0.7 else {e.name for e in EFFECTS if rng.random() < 0.5}
        plan = compile_plan(scene, field, heights, wanted)
        _, figures = retrace(plan.scene, field, heights, None, rays=1000, seed=seed, requests=plan.requests, noise=False)
    except InputError:
        return None
    return {"on_screen": figures["on_screen"], **figures["lost"]}


def test_energy_balances_of_random_scenes():
    """Every part in [0, 1] exactly, all together 1 to 1e-12.  `python tests/test_energy.py 1000` goes through so many."""
    check_balances(range(60))


def check_balances(seeds: range) -> int:
    counted = 0
    for seed in seeds:
        account = balance_of(seed)
        if account is None:
            continue
        counted += 1
        assert abs(math.fsum(account.values()) - 1.0) <= 1e-12, (seed, account)
        assert all(0.0 <= part <= 1.0 for part in account.values()), (seed, account)
    assert counted > 0.7 * len(seeds)
    return counted


if __name__ == "__main__":
    print(f"{check_balances(range(int(sys.argv[1])))} accounts of {sys.argv[1]} scenes close")
