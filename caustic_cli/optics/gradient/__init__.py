"""Media whose refractive index varies from place to place: index fields, the rays in them, and where these meet a surface."""

from __future__ import annotations

from caustic_cli.optics.gradient.fields import (
    Axial,
    Extremes,
    FishEye,
    IndexField,
    Luneburg,
    Radial,
    Selfoc,
    SplineIndex,
    index_field_of,
)
from caustic_cli.optics.gradient.integrator import Flow, flow, steps_for
from caustic_cli.optics.gradient.transfer import Transfer, transfer

__all__ = [
    "Axial",
    "Extremes",
    "FishEye",
    "Flow",
    "IndexField",
    "Luneburg",
    "Radial",
    "Selfoc",
    "SplineIndex",
    "Transfer",
    "flow",
    "index_field_of",
    "steps_for",
    "transfer",
]
