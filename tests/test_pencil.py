"""Rays of a point source through a tensor product of points of the exit: kernel, reference, and rays from the source."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from caustic_cli.optics.emission import rays_of
from caustic_cli.optics.interface import interact
from caustic_cli.optics.pencil import Pencil
from caustic_cli.optics.reconstruction import Filter, splat
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import Tracer, expose, tracers
from caustic_cli.scene import Lens, Scene, Screen
from caustic_cli.scene.sources.points import Points

FILTER = Filter("cosine", (3, 3))
SCREEN = Screen((36.0, 40.0), 60.0, (30, 34))
SOURCES = {
    "near": Points(((0.0, 0.0, -12.0),), (1.0,), intensity="lambertian"),
    "aside": Points(((1.5, -2.0, -9.0),), (1.0,)),
    "far": Points(((0.0, 1.0, -2e6),), (1.0,)),
}


def scene(source: str = "near", fresnel: str = "exact", **lens) -> Scene:
    lens = Lens(size=(10.0, 12.0), z_in=-1.0, control=(9, 8), degree=(3, 4), fresnel=fresnel, index=1.5, **lens)
    return Scene(SOURCES[source], lens, SCREEN)


def heights(rough: float = 0.03, seed: int = 0) -> torch.Tensor:
    noise = torch.randn((9, 8), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 4.0 + rough * noise


def pencil_of(scene: Scene, rays: int = 1500, kind: str = "lines") -> tuple[Pencil, Tracer]:
    """The pencil of a scene and its tracer."""
    emission = rays_of(scene, kind, rays, seed=3)
    assert emission.homocentric
    (pencil,) = emission.pencils()
    traced = Tracer(System.of(scene, HeightField.of(scene.lens)), pencil)
    assert type(traced.fused).__name__ == "PencilImage"
    return pencil, traced


def reference(scene: Scene, pencil: Pencil, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Image and power behind the lens in plain torch, differentiable."""
    field = HeightField.of(scene.lens)
    found = field.prepare(pencil.sample, torch.float64)(z)
    sag, *slopes = (c.reshape(pencil.sample.shape) for c in found)
    direction, power = pencil.rays(sag - scene.lens.z_in, slopes, scene.lens.index, scene.lens.fresnel)
    out = interact(direction, slopes, power, eta=scene.lens.index, reflects=False, fresnel=scene.lens.fresnel)
    path = (scene.screen.z - sag) / out.direction[2]
    x, y = ((p + place) for p, place in zip(pencil.points(), pencil.position, strict=False))
    x, y = ((c + path * d).reshape(-1) for c, d in zip((x, y), out.direction, strict=False))
    return splat(x, y, out.power.reshape(-1), scene.screen, FILTER)[0], out.power.sum()


@pytest.mark.parametrize(
    ("source", "fresnel", "rough"),
    [("near", "exact", 0.03), ("aside", "schlick", 0.03), ("far", "none", 0.03), ("near", "exact", 0.5)],
)
def test_value_and_gradient_of_the_kernel(source, fresnel, rough):
    """Against the reference; with rough 0.5 some rays are totally reflected."""
    lit, z = scene(source, fresnel), heights(rough).requires_grad_()
    pencil, traced = pencil_of(lit)
    pull = torch.randn(SCREEN.resolution, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    part, results = traced.expose({EXIT: z}, SCREEN, FILTER), []
    for image, leaving in ((part.image, part.leaving), reference(lit, pencil, z)):
        results += [image.detach(), leaving.detach(), torch.autograd.grad((image * pull).sum() + 0.3 * leaving, z)[0]]
    image, leaving, gradient, image_, leaving_, gradient_ = results
    assert (float(part.lost["total_internal_reflection"]) > 0) == (rough > 0.1)
    torch.testing.assert_close(image, image_, rtol=0, atol=1e-10 * float(image_.max()))
    assert float(leaving) == pytest.approx(float(leaving_), rel=1e-10)
    assert float((gradient - gradient_).norm()) <= 1e-9 * float(gradient_.norm())


def test_gradient_is_the_limit_of_differences():
    lit, z, way = scene(), heights(), heights(1.0, seed=5) - 4.0
    _, traced = pencil_of(lit)
    pull = torch.linspace(-1.0, 1.0, math.prod(SCREEN.resolution), dtype=torch.float64).view(SCREEN.resolution) ** 2

    def value(z):
        part = traced.expose({EXIT: z}, SCREEN, FILTER)
        return (part.image * pull).sum() + 0.3 * part.leaving

    (gradient,) = torch.autograd.grad(value(z.requires_grad_()), z)
    step = 1e-6
    difference = (value(z.detach() + step * way) - value(z.detach() - step * way)) / (2.0 * step)
    assert float(difference) == pytest.approx(float((gradient * way).sum()), rel=2e-5)


@pytest.mark.parametrize("round", [False, True])
@pytest.mark.parametrize("source", SOURCES)
def test_energy_and_image_are_those_of_rays_from_the_source(source, round):
    """Scattered rays from the source, intersected one by one, are the independent measure."""
    lit = scene(source)
    if round:
        lens = replace(lit.lens, size=(10.0, 10.0), aperture="circle")
        lit = replace(lit, lens=lens)
    field, z = HeightField.of(lit.lens), heights()
    by_pencil = expose(lit, field, z, rays_of(lit, "grid", 400_000), FILTER)
    by_rays = expose(lit, field, z, rays_of(lit, "sobol", 400_000), FILTER)
    assert float(by_pencil.image.sum()) + sum(by_pencil.lost.values()) == pytest.approx(1.0, abs=1e-12)
    for name, value in by_rays.lost.items():
        assert by_pencil.lost[name] == pytest.approx(value, abs=2e-4)
    assert float((by_pencil.image - by_rays.image).norm()) < 3e-3 * float(by_rays.image.norm())


def test_what_is_no_pencil():
    """A narrow cone, a source beside the lens, scattered rays, tilted axes and effects are traced from the source."""
    lit = scene()
    points = lit.source
    assert not rays_of(lit, "stratified", 100).homocentric
    for other in (
        replace(points, cone=10.0),
        replace(points, positions=((9.0, 0.0, -12.0),)),
        replace(points, positions=((0.0, 0.0, -1.5),)),
    ):
        assert not rays_of(replace(lit, source=other), "grid", 100).homocentric
    rough = replace(lit, lens=replace(lit.lens, roughness=0.01))
    (traced,) = tracers(rough, HeightField.of(rough.lens), rays_of(rough, "grid", 100), torch.float64, 1000)
    assert traced.fused is None and traced.start.count == traced.rays.count
