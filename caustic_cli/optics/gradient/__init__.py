"""Media whose refractive index varies from place to place: index fields, the rays in them, and where these meet a surface."""

from __future__ import annotations

from caustic_cli.optics.gradient.crossing import Crossing, cross
from caustic_cli.optics.gradient.fields import (
    Axial,
    Extremes,
    FishEye,
    IndexField,
    Luneburg,
    Radial,
    Selfoc,
    SplineIndex,
    field_of,
)
from caustic_cli.optics.gradient.integrator import Flow, flow, steps_for

__all__ = [
    "Axial",
    "Crossing",
    "Extremes",
    "FishEye",
    "Flow",
    "IndexField",
    "Luneburg",
    "Radial",
    "Selfoc",
    "SplineIndex",
    "cross",
    "field_of",
    "flow",
    "steps_for",
]
