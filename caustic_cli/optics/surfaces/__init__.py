"""Optical surfaces, one file each; all implement `base.Surface`.  Those of lenses are here, others in their own modules."""

from __future__ import annotations

from caustic_cli.optics.surfaces.base import Surface, SurfaceIntersection
from caustic_cli.optics.surfaces.fixed import Fixed
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.surfaces.plane import Plane
from caustic_cli.optics.surfaces.sphere import Sphere

__all__ = ["Fixed", "HeightField", "Plane", "Sphere", "Surface", "SurfaceIntersection"]
