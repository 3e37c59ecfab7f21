"""Rays of any direction through the lens: kernel against reference, energy, derivatives, and against plain ray optics."""

from __future__ import annotations

import math

import pytest
import torch
from torch.autograd import forward_ad

from caustic_cli.inverse.objective import Objective
from caustic_cli.inverse.schedule import LossImage
from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.rays import LOSSES
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose
from caustic_cli.scene import Disc, Lens, Points, Scene, Screen

SCREEN = Screen((40.0, 30.0), 25.0, (40, 30))
SOURCES = {
    "point": Points(((0.3, -0.2, -5.0),)),
    "unaimed": Points(((0.3, -0.2, -5.0),), cone=80.0, aimed=False),
    "grid": Points.grid((0.0, 0.0, -9.0), (2.0, 2.0), (3, 4)),
    "two": Points(((0.0, 0.0, -5.0), (1.0, 0.0, -7.0)), (1.0, 2.0), intensity="lambertian"),
    "disc": Disc((0.0, 0.1, -8.0), (2.0, 1.0)),
    "sun": Disc(angle=5.0),
    "hemisphere": Points(((0.0, 0.0, -2.5),), cone=90.0),
}


def setup(source="point", fresnel="exact", size=0.15):
    lens = Lens(size=(10.0, 8.0), control=(13, 11), degree=(3, 4), z_in=-2.0, index=1.5, fresnel=fresnel)
    field = HeightField.of(lens)
    x, y = field.control_xy()
    noise = torch.randn(13, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Scene(SOURCES[source], lens, SCREEN), field, 3.0 - 0.02 * (x[:, None] ** 2 + y**2) + size * noise


def parts(scene, field, heights, rays, filter, dtype, monkeypatch):
    """(value and gradient) by the reference and by the kernel."""
    target = torch.rand(SCREEN.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    out = []
    for kernels in ("torch", ""):
        monkeypatch.setenv("CAUSTIC_KERNELS", kernels)
        objective = Objective(scene, field, rays, target, "rms-light", LossImage(filter), dtype=dtype)
        out.append((expose(scene, field, heights, rays, filter, dtype), objective(heights)))
    return out


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("fresnel", ["none", "schlick", "exact"])
@pytest.mark.parametrize("dtype, image_close, close", [(torch.float64, 1e-12, 1e-11), (torch.float32, 3e-5, 3e-5)])
def test_kernel_equals_reference(source, fresnel, dtype, image_close, close, monkeypatch):
    scene, field, heights = setup(source, fresnel, 0.02)
    rays = rays_of(scene, "stratified", 2500, 3)
    (a, da), (b, db) = parts(scene, field, heights, rays, Filter("cosine", (3, 5)), dtype, monkeypatch)
    assert float((a.image - b.image).norm() / a.image.norm()) < image_close
    assert a.lost == pytest.approx(b.lost, abs=1e-12 if dtype == torch.float64 else 1e-6)
    assert float((da.gradient - db.gradient).norm() / da.gradient.norm()) < close


def test_kernel_equals_reference_on_a_steep_surface(monkeypatch):
    """Several roots, total internal reflection, rays that never reach the screen."""
    scene, field, heights = setup("hemisphere", size=0.6)
    rays = rays_of(scene, "stratified", 20_000, 3)
    (a, da), (b, db) = parts(scene, field, heights, rays, Filter("gaussian", (5, 5), (0.3, 0.3)), torch.float64, monkeypatch)
    assert min(a.lost[k] for k in ("missed_lens", "missed_surface", "total_internal_reflection", "off_screen")) > 0.01
    assert float((a.image - b.image).norm() / a.image.norm()) < 1e-11
    assert float((da.gradient - db.gradient).norm() / da.gradient.norm()) < 1e-9  # grazing hits amplify rounding


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("sampler", ["stratified", "sobol", "uniform", "lines"])
def test_energy_closes(source, sampler):
    scene, field, heights = setup(source)
    exposure = expose(scene, field, heights, rays_of(scene, sampler, 5000, 1), Filter("cosine", (3, 3)))
    assert set(exposure.lost) == set(LOSSES)
    assert float(exposure.image.sum()) + sum(exposure.lost.values()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("kernels", ["", "torch"])
def test_forward_mode_is_the_transpose_and_both_match_differences(kernels, monkeypatch):
    monkeypatch.setenv("CAUSTIC_KERNELS", kernels)
    scene, field, heights = setup("point", size=0.05)
    (bundle,) = rays_of(scene, "stratified", 3000, 3).chunks()
    trace, filter = Tracer(System.of(scene, field), bundle), Filter("cosine", (3, 3))
    assert (trace.fused is not None) == (kernels == "")
    g = torch.Generator().manual_seed(5)
    along = torch.randn(heights.shape, generator=g, dtype=torch.float64)
    by = torch.randn(SCREEN.resolution, generator=g, dtype=torch.float64)
    with forward_ad.dual_level():
        part = trace.expose({EXIT: forward_ad.make_dual(heights, along)}, SCREEN, filter)
        image, leaving = (forward_ad.unpack_dual(t).tangent for t in (part.image, part.leaving))
    leaf = heights.clone().requires_grad_()
    part = trace.expose({EXIT: leaf}, SCREEN, filter)
    (pulled,) = torch.autograd.grad((part.image * by).sum() + 3.0 * part.leaving, leaf)
    forward = float((image * by).sum() + 3.0 * leaving)
    assert float((pulled * along).sum()) == pytest.approx(forward, rel=1e-10)
    step = 1e-7
    up, down = (trace.expose({EXIT: heights + s * along}, SCREEN, filter) for s in (step, -step))
    difference = ((up.image - down.image) * by).sum() + 3.0 * (up.leaving - down.leaving)
    assert float(difference / (2 * step)) == pytest.approx(forward, rel=1e-5)


def test_one_ray_by_hand():
    """Snell at both surfaces of a slab with a tilted exit, in the plane of incidence."""
    lens = Lens(size=(10.0, 10.0), control=(4, 4), degree=(3, 3), z_in=0.0, index=1.5, fresnel="none")
    field = HeightField.of(lens)
    x, _ = field.control_xy()
    heights = (4.0 + 0.1 * x)[:, None].expand(4, 4).contiguous()
    scene = Scene(Points(((0.0, 0.0, -10.0),), cone=30.0), lens, Screen((200.0, 200.0), 50.0, (20, 20)))
    (bundle,) = rays_of(scene, "uniform", 50, 2).chunks()
    trace = Tracer(System.of(scene, field), bundle)
    (landing,), (x0, y0, _), (dx, dy, dz) = trace.land({EXIT: heights}, scene.screen), trace.start.origin, trace.start.direction
    for k in range(len(x0)):
        azimuth = math.atan2(float(dy[k]), float(dx[k]))
        if abs(math.sin(azimuth)) > 0.3 or float(landing.power[k]) == 0:
            continue
        # trace by vectors, normalising everything: an independent form of the same law
        d = torch.stack([dx[k], dy[k], dz[k]])
        t = (4.0 + 0.1 * x0[k]) / (d[2] - 0.1 * d[0])
        hit = torch.stack([x0[k], y0[k], torch.zeros(())]) + t * d
        normal = torch.tensor([-0.1, 0.0, 1.0], dtype=torch.float64) / math.hypot(0.1, 1.0)
        inside = float(d @ normal)
        tangential = 1.5 * (d - inside * normal)
        out = tangential + math.sqrt(1.0 - float(tangential @ tangential)) * normal
        landed = hit + (50.0 - hit[2]) / out[2] * out
        assert float(landing.origin[0][k]) == pytest.approx(float(landed[0]), rel=1e-12, abs=1e-12)
        assert float(landing.origin[1][k]) == pytest.approx(float(landed[1]), rel=1e-12, abs=1e-12)


def test_chunks_add_up():
    scene, field, heights = setup("grid")
    rays = rays_of(scene, "stratified", 5000, 1)
    one = expose(scene, field, heights, rays, Filter("cosine", (3, 3)))
    many = expose(scene, field, heights, rays, Filter("cosine", (3, 3)), chunk=333)
    assert float((one.image - many.image).abs().max() / one.image.max()) < 1e-13
    target = torch.rand(SCREEN.resolution, dtype=torch.float64)
    objective = Objective(scene, field, rays, target, "rms", LossImage(Filter("cosine", (3, 3))), dtype=torch.float64)
    whole = objective(heights)
    objective.kept = [(0, Tracer(System.of(scene, field), b)) for b in rays.chunks(700)]
    assert len(objective.kept) > 5
    again = objective(heights)
    assert again.loss == pytest.approx(whole.loss, rel=1e-12)
    assert float((again.gradient - whole.gradient).norm() / whole.gradient.norm()) < 1e-11
