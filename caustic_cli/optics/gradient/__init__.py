"""Gradient-index media: index fields, integration of the ray equation, and ray transfer between surfaces."""

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
from caustic_cli.optics.gradient.transfer import NextSurface, RayFlow, Transfer, transfer

__all__ = [
    "Axial",
    "Extremes",
    "FishEye",
    "Flow",
    "IndexField",
    "Luneburg",
    "NextSurface",
    "Radial",
    "RayFlow",
    "Selfoc",
    "SplineIndex",
    "Transfer",
    "flow",
    "index_field_of",
    "steps_for",
    "transfer",
]
