"""A plan that skips an effect makes the image of one that simulates it, and no proof holds where it must not."""

import math
from dataclasses import replace

import pytest
import torch
from test_effects import DETOURS, POINT, STAGES, bumpy, cliff, heights_through, scene_of, shine, sloped, traced_through

from caustic_cli.errors import InputError
from caustic_cli.optics.bounds import bounds_of
from caustic_cli.optics.effects import EFFECTS, NEGLIGIBLE, NO_REQUESTS, Requests
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.plan import compile_plan, parse_effects
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.reintersection import next_intersection
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.trace import is_lowered
from caustic_cli.scene import Disc, Lens, Light, Offset, PlaneWave, Points, Scene, Screen
from caustic_cli.scene.gradient import Gradient

SMOOTH = Filter("cosine", (3, 3))
NARROW = Points(((0.4, -0.2, -40.0),), cone=4.0)
SOURCES = [None, POINT, NARROW, Points(((0.0, 0.0, -8.0),)), Disc(angle=2.0), Disc((0.0, 0.0, -30.0), (2.0, 1.0))]


def plan_of(scene, heights, wanted=None):
    return compile_plan(scene, HeightField.of(scene.lens), heights, wanted)


def image_of(plan, heights, rays=3000):
    return shine(plan.scene, heights, plan.requests, rays, filter=SMOOTH)


@pytest.mark.parametrize("source", SOURCES)
def test_what_is_skipped_changes_nothing(source):
    """Every effect that auto leaves out, forced on: the same image and account, but for what the bound itself allows."""
    skipped = []
    for seed, (bumps, fresnel) in enumerate([(0.02, "exact"), (0.05, "exact"), (0.05, "schlick"), (0.1, "none"), (0.25, "exact")]):
        scene = scene_of(source, fresnel=fresnel)
        heights = bumpy(scene, bumps, seed)
        plan = plan_of(scene, heights)
        here = image_of(plan, heights)
        for effect in plan.effects:
            if effect.on or not effect.present or effect.fixed or effect.name == "fresnel":
                continue
            other = plan_of(scene, heights, {*plan.simulated, effect.name})
            assert other[effect.name].on and set(other.simulated) == {*plan.simulated, effect.name}
            there, allowed = image_of(other, heights), 1e-12
            if effect.limit == NEGLIGIBLE:
                allowed += 2.0 * effect.bound  # moved from one pixel to another, or between image and losses
            assert float((there.image - here.image).abs().sum()) <= allowed, effect.name
            assert there.lost == pytest.approx(here.lost, abs=allowed), effect.name
            skipped.append(effect.name)
    assert {"total-reflection", "secondary-intersection", "ghosts"} <= set(skipped)
    assert source is not None or {"entrance", "intersection", "missed-surface", "polarisation"} <= set(skipped)
    assert len(skipped) >= 8


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("bumps", [0.05, 0.3, 0.6, 1.0, 2.0])
def test_no_ray_breaks_a_proof(source, bumps):
    """On random surfaces from gentle to wild: what a bound excludes does not happen, and the bounds bound."""
    scene, proven = scene_of(source), 0
    field = HeightField.of(scene.lens)
    for seed in range(4):
        heights = bumpy(scene, bumps, seed)
        bounds, plan = bounds_of(scene, field, heights), plan_of(scene, heights)
        plain, ghostly = (shine(scene, heights, r, rays=1000) for r in (STAGES, STAGES | Requests.to("ghosts")))
        if not plan["total-reflection"].on:
            assert plain.lost["total_internal_reflection"] == 0.0
            proven += 1
        if not plan["missed-surface"].on:
            assert plain.lost.get("missed_surface", 0.0) == 0.0
            proven += 1
        back = [e.lost["fresnel"] + e.lost["total_internal_reflection"] for e in (plain, ghostly)]
        assert back[0] - back[1] <= bounds.ghost
        (rays,) = rays_of(scene, "stratified", 1000, seed).chunks()
        traced = traced_through(scene, rays)
        assert traced.first == len(traced.system.elements) - 1
        interaction = traced.trace_element(traced.first, traced.start, heights)
        alive = interaction.state.power > 0
        o, d = ([c[alive] for c in interaction.state.full(v)] for v in (interaction.hit.local, interaction.state.direction))
        if not plan["secondary-intersection"].on:
            _, found = next_intersection(field, heights, o, d, below=False)
            assert not bool(found.any())
            leaning = torch.hypot(d[0], d[1]) / d[2]
            assert bounds.exit.slope * float(leaning.max()) <= bounds.exit.slope_ratio * (1 + 1e-12)
            proven += 1
    assert proven >= (8 if bumps < 0.1 else 4 if source is None else 0)


def test_the_critical_angle_decides_total_reflection():
    """A prism's slope is its bound: 1 / sqrt(n^2 - 1) from either side."""
    critical = 1.0 / math.sqrt(1.5**2 - 1.0)
    for slope, on in ((critical * (1 - 1e-9), False), (critical * (1 + 1e-9), True)):
        scene = scene_of()
        plan = plan_of(scene, heights_through(scene, sloped(slope)))
        assert plan["total-reflection"].on == on == plan["secondary-intersection"].on
        assert plan["total-reflection"].bound == pytest.approx(1.0, abs=1e-8)
    oblique = scene_of(POINT)
    assert plan_of(oblique, heights_through(oblique, sloped(critical * 0.95)))["total-reflection"].on
    rough = scene_of(roughness=0.05)
    assert plan_of(rough, heights_through(rough, sloped(critical * 0.9)))["total-reflection"].on


def test_what_a_scene_has_is_simulated():
    scene, heights = cliff()
    plan = plan_of(scene, heights)
    assert {"secondary-intersection", "ghosts", "total-reflection"} <= set(plan.simulated)
    assert plan.requests == DETOURS
    scene = scene_of(
        POINT,
        light=Light(10.0, (500.0, 600.0)),
        glass="PMMA",
        screen=Screen((16.0, 14.0), 60.0, (8, 8), (0.0, 5.0), (1.0, 0.0), (40.0, 40.0)),
        absorption=0.01,
        roughness=0.001,
    )
    plan = plan_of(scene, bumpy(scene, 0.1))
    assert {
        "polarisation",
        "dispersion",
        "entrance",
        "intersection",
        "missed-surface",
        "absorption",
        "roughness",
        "fresnel",
        "screen-shape",
        "screen-tilt",
        "screen-shift",
    } <= set(plan.simulated)
    assert plan.scene is scene
    assert not plan_of(scene_of(NARROW), bumpy(scene, 0.1))["missed-surface"].on
    assert plan_of(scene_of(Disc(angle=1.0)), bumpy(scene, 0.1))["source-size"].on
    mirror = scene_of(mirror=True, screen=Screen((16.0, 14.0), -60.0, (8, 8)))
    assert {"mirror"} <= set(plan_of(mirror, bumpy(mirror, 0.1), ()).simulated)
    assert plan_of(mirror, heights_through(mirror, lambda x, y: 3.0 + 0.2 * x * x + 0 * y))["secondary-intersection"].on


def test_a_plane_wave_without_effects_runs_the_bare_path(monkeypatch):
    """The plan of the default scene is the scene itself and no request: its tracer is the fused kernel, without effects."""
    monkeypatch.setenv("CAUSTIC_KERNELS", "")
    scene = scene_of()
    heights = bumpy(scene, 0.1)
    plan = plan_of(scene, heights)
    assert plan.scene is scene and plan.requests == NO_REQUESTS
    assert is_lowered(plan.scene, HeightField.of(scene.lens), plan.requests)
    assert plan.simulated == ("fresnel", "diffraction")
    (sample,) = rays_of(scene, "lines", 100).chunks()
    traced = traced_through(plan.scene, sample, plan.requests)
    assert type(traced.fused).__name__ == "PlaneImage" and traced.actions == () and not traced.recorded


@pytest.mark.parametrize("source", [None, POINT, Disc((0.0, 0.0, -30.0), (2.0, 1.0)), Disc(angle=1.0)])
def test_overrides(source):
    """`none` leaves out all that can be; each name alone is simulated alone; toggling twice is the plan itself."""
    scene = scene_of(
        source,
        light=Light(10.0, (500.0, 600.0)),
        glass="PMMA",
        screen=Screen((16.0, 14.0), 60.0, (8, 8), (0.0, 5.0), (1.0, 0.0), (40.0, 40.0)),
        absorption=0.01,
        roughness=0.001,
    )
    heights = bumpy(scene, 0.1)
    auto = plan_of(scene, heights)
    bare = plan_of(scene, heights, ())
    fixed = {e.name for e in auto.effects if e.fixed and e.on}
    assert set(bare.simulated) == fixed
    assert bare.scene.lens.absorption == 0 and bare.scene.lens.fresnel == "none" and len(bare.scene.bands) == 1
    assert plan_of(scene, heights, auto.simulated).scene == auto.scene
    for name in (effect.name for effect in EFFECTS):
        one = plan_of(scene, heights, {name})
        assert set(one.simulated) == {name} | fixed or auto[name].fixed
        found = image_of(one, heights, 500)
        assert float(found.image.sum()) + sum(found.lost.values()) == pytest.approx(1.0, abs=1e-12)
    assert "left out as asked" in bare["absorption"].why
    assert "asked for" in plan_of(scene_of(), heights, {"ghosts"})["ghosts"].why


def test_leaving_out_matters_where_the_effect_is():
    """Each effect of this scene, left out: another image or another account."""
    scene = scene_of(
        POINT,
        light=Light(10.0, (450.0, 650.0)),
        glass="N-SF11",
        screen=Screen((16.0, 14.0), 60.0, (16, 14), (0.0, 15.0), (1.0, 0.0)),
        absorption=0.01,
        roughness=0.001,
    )
    heights = bumpy(scene, 0.25)
    plan = plan_of(scene, heights)
    whole, checked = image_of(plan, heights), 0
    for name in plan.simulated:
        if not (plan[name].fixed or name in ("total-reflection", "secondary-intersection", "diffraction")):
            less = image_of(plan_of(scene, heights, set(plan.simulated) - {name}), heights)
            assert float((less.image - whole.image).abs().sum()) > 1e-5, name
            checked += 1
    assert checked >= 9


def test_names():
    assert parse_effects("auto") is None and parse_effects("none") == frozenset()
    assert parse_effects("fresnel, total_reflection") == {"fresnel", "total-reflection"}
    with pytest.raises(InputError, match="did you mean ghosts"):
        parse_effects("ghost")
    names = [effect.name for effect in EFFECTS]
    assert len(set(names)) == len(names) == 18
    assert {effect.name for effect in EFFECTS if effect.free} == {"missed-surface", "total-reflection", "screen-shift"}
    assert replace(NO_REQUESTS, stages=True) == STAGES != NO_REQUESTS


def test_the_bound_of_bending_knows_the_height_of_the_glass():
    """A ray bends over all of it, wherever the offset is."""
    lens = Lens(control=(8, 8), offset=Offset(5.0), height_range=(-1.0, 6.0), gradient=Gradient("radial", (-2e-3,)))
    scene, field = Scene(PlaneWave(), lens, Screen((30.0, 30.0), 300.0, (8, 8))), HeightField.of(lens)
    low, high = (bounds_of(scene, field, torch.full((8, 8), z, dtype=torch.float64)).inside for z in (5.0, 10.0))
    assert high == pytest.approx(2.0 * low, rel=1e-9)
