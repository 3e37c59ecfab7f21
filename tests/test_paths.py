"""Systems that no command makes, by every path there is: fused kernels, stages, plain torch."""

from __future__ import annotations

import math

import pytest
import torch

from caustic_cli.optics.bspline import SplineSpace
from caustic_cli.optics.effects import Requests
from caustic_cli.optics.frames import Pose
from caustic_cli.optics.gradient.fields import SplineIndex
from caustic_cli.optics.gradient.medium import GradientMedium, index_name
from caustic_cli.optics.media import Medium
from caustic_cli.optics.sampling import Sampler
from caustic_cli.optics.surfaces import HeightField, Plane, Sphere
from caustic_cli.optics.system import Element, System
from caustic_cli.optics.trace import Tracer, render, trace
from caustic_cli.scene import Aperture, CircularAperture, PlaneWave, Points, Screen

GLASS, FLAT = Medium(1.5), Aperture((5.0, 5.0))
FIELD = HeightField((SplineSpace.uniform(8, 3), SplineSpace.uniform(7, 2)), (5.0, 5.0))
SCREEN = Screen((30.0, 30.0), 60.0, (20, 20))


def bumpy(size: float) -> torch.Tensor:
    return size * torch.randn(FIELD.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def front(surface, aperture: Aperture = FLAT, z: float = -3.0, behind: Medium = GLASS, name: str = "front", **options) -> Element:
    return Element(name, surface, aperture, behind=behind, pose=Pose((0.0, 0.0, z)), **options)


def back(**options) -> Element:
    return Element("back", FIELD, **({"aperture": FLAT} | options))


FAR, NEAR = PlaneWave(), Points(((0.0, 0.0, -60.0),))
#: Name -> source, elements and the part of the light that leaves them, where that is known.
ODD = {
    "a plate and a lens": (
        FAR,
        (front(Plane(), z=-9.0, name="plate"), front(Plane(), z=-6.0, behind=Medium(1.0), name="its back"), front(Plane()), back()),
        None,
    ),
    "a plate alone": (FAR, (front(Plane()), Element("last", Plane(), FLAT)), 0.96**2),
    "one side alone": (FAR, (front(Plane()),), 0.96),
    "a round exit": (
        FAR,
        (front(Plane(), fresnel="none"), back(aperture=CircularAperture((5.0, 5.0)), fresnel="none")),
        math.pi / 4.0,
    ),
    "a small exit": (FAR, (front(Plane(), fresnel="none"), back(aperture=Aperture((2.0, 2.0)), fresnel="none")), 0.16),
    "a small exit, near light": (NEAR, (front(Plane()), back(aperture=Aperture((2.0, 2.0)))), None),
    "into denser glass": (FAR, (front(Plane(), behind=Medium(1.0)), back(behind=Medium(1.7), fresnel="schlick")), None),
    "the same, near light": (NEAR, (front(Plane(), behind=Medium(1.0)), back(behind=Medium(1.7), fresnel="schlick")), None),
    "from beyond the aperture": (
        FAR,
        (
            Element("front", Sphere(20.0), Aperture((9.0, 9.0)), behind=GLASS, fresnel="none"),
            Element("between", Sphere(-20.0), Aperture((12.0, 12.0)), pose=Pose((0.0, 0.0, 6.0)), fresnel="none"),
            Element("back", FIELD, FLAT, behind=GLASS, pose=Pose((0.0, 0.0, 16.0)), fresnel="none"),
            Element("last", Plane(), Aperture((9.0, 9.0)), pose=Pose((0.0, 0.0, 18.0)), fresnel="none"),
        ),
        None,
    ),
}


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("kind", ["grid", "stratified"])
def test_every_path_says_the_same_of_odd_systems(name, kind, monkeypatch):
    """Fused or by stages, compiled or plain, of rays in rows and columns or scattered; nothing is made or lost on the way."""
    source, elements, leaves = ODD[name]
    system, images = System((source,), elements, (SCREEN,)), []
    heights = {"back": bumpy(0.3 if "denser" in name or "same" in name else 0.05)} if "back" in system.shapes else {}
    for kernels in ("", "torch"):
        monkeypatch.setenv("CAUSTIC_KERNELS", kernels)
        for stages in (False, True):
            (image,) = render(system, heights, 3600, kind=kind, requests=Requests(stages=stages))
            assert float(image.leaving) + sum(v for k, v in image.lost.items() if k != "off_screen") == pytest.approx(1.0, abs=1e-9)
            images.append(image)
    for image in images:
        assert float(image.leaving) == pytest.approx(images[0].leaving, rel=1e-12)
        assert float((image.image - images[0].image).abs().max()) < 1e-12
        if leaves is not None:
            assert float(image.leaving) == pytest.approx(leaves, rel=0.02)
    if "beyond" in name:
        assert images[0].lost["missed_surface"] < 0.5


def test_steps_through_glass_follow_its_index():
    """A tracer that was called with an even index takes as many steps through an uneven one as a new tracer does."""
    even = torch.full((8, 8, 1), 1.5, dtype=torch.float64)
    uneven = even + 0.05 * torch.rand(8, 8, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    medium = GradientMedium(1.5, gradient=SplineIndex(even, (5.0, 5.0), 5.0))
    elements = (front(Plane(), z=0.0, behind=medium), Element("last", Plane(), FLAT, pose=Pose((0.0, 0.0, 5.0))))
    system, rays = System((PlaneWave(),), elements, (SCREEN,)), next(iter(Sampler("stratified", (20, 20), 1).chunks()))
    name, kept = index_name(elements[0]), Tracer(system, rays)
    (first,) = kept.land({name: even}, SCREEN)
    (again,), (anew,) = kept.land({name: uneven}, SCREEN), Tracer(system, rays).land({name: uneven}, SCREEN)
    assert float((first.origin[0] - anew.origin[0]).abs().max()) > 0.1
    assert torch.equal(again.origin[0], anew.origin[0])


@pytest.mark.parametrize("kind", ["grid", "stratified"])
def test_roughness_before_the_first_free_surface(kind):
    system = System((PlaneWave(),), (front(Sphere(60.0), roughness=0.01), back()), (SCREEN,))
    (out,) = trace(system, next(iter(Sampler(kind, (20, 20), 1).chunks())), {"back": bumpy(0.0)})
    smooth = System((PlaneWave(),), (front(Sphere(60.0)), back()), (SCREEN,))
    (plain,) = trace(smooth, next(iter(Sampler(kind, (20, 20), 1).chunks())), {"back": bumpy(0.0)})
    leans = [float((a - b).std()) for a, b in zip(out.direction[:2], plain.direction[:2], strict=True)]
    assert leans == pytest.approx([0.005, 0.005], rel=0.15)  # (n - 1) / n of it within, n times that behind a flat exit
