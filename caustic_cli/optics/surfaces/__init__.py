"""Optical surfaces, one file each; all implement `base.Surface`."""

from __future__ import annotations

from caustic_cli.optics.surfaces.base import Surface, SurfaceIntersection
from caustic_cli.optics.surfaces.cylinder import Cylinder
from caustic_cli.optics.surfaces.fixed import Fixed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.surfaces.nurbs import Nurbs
from caustic_cli.optics.surfaces.plane import Plane
from caustic_cli.optics.surfaces.sphere import Sphere

__all__ = ["Cylinder", "Fixed", "HeightField", "Nurbs", "Plane", "Sphere", "Surface", "SurfaceIntersection"]
