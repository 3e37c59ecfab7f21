"""What each export format does not hold of a scene, and why."""

from __future__ import annotations

from dataclasses import replace

from caustic_cli.export import FORMATS, SOLIDS
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import Capability

#: Formats that hold all elements of a scene.
WHOLE = ("lighttools", *SOLIDS, "mitsuba")
#: By format: why it does not hold what, in the words of its table, with {} for those of the traits.
_REASONS: dict[str, dict[str, tuple[str, ...]]] = {
    "lighttools": {"its types of sources are those of this program": ("user-defined source",)},
    "phase": {"rays have no phase": ("ray file", "ray file among sources")},
    "mitsuba": {
        "its rays are straight": ("gradient index",),
        "its light tracer knows no media that absorb": ("absorption",),
        "its emitters are not polarised": ("polarisation",),
        "its emitters have no given rays": ("ray file", "ray file among sources", "user-defined source"),
        "its emitters have no wavefront": ("laser beam",),
        "its light from infinity has one direction": ("disc at infinity",),
    },
}


def _exported(format: str) -> Capability:
    said = _REASONS.get(format, {})
    others = ", ".join(name for name in FORMATS if name not in _REASONS)
    return Capability.because(
        f"export to {format}", said, f"⟨format⟩ {format}: {{reason}}, so {{{{}}}} cannot be written; {others} hold the lens alone"
    )


EXPORT: dict[str, Capability] = {format: _exported(format) for format in FORMATS}
MOULD = Capability("moulds", {})
_SCRIPT = Capability.because(
    "script for LightTools",
    {
        "its sources have no wavefront": ("laser beam",),
        "no call by which a sheet reflects is documented": ("mirror",),
        "the directions of its sources are even": ("uneven directions",),
        "it builds one solid": ("other elements", "folded axis"),
        "no call that sets it is documented": (
            *("gradient index", "absorption", "roughness", "polarisation"),
            *("ray file", "ray file among sources", "tabulated intensity"),
        ),
        "its freeform solid is a rectangle": ("circular aperture", "round lenslets"),
        "its receiver is a plane": ("curved screen", "far field"),
        "how a plane stands about its normal is not documented": ("tilted screen", "tilted light"),
    },
    f"⟨script⟩: {{reason}}, so {{{{}}}} cannot be written; {', '.join(WHOLE)} without ⟨script⟩ hold the scene",
)


#: Of what its archive holds.
SCRIPT = replace(
    EXPORT["lighttools"],
    name=_SCRIPT.name,
    unsupported={**EXPORT["lighttools"].unsupported, **_SCRIPT.unsupported},
    reasons={**EXPORT["lighttools"].reasons, **_SCRIPT.reasons},
)


def refuse(scene: Scene, format: str, script: bool, mould: bool) -> None:
    """Refuse a scene that a format does not hold, or not with a script or as a mould.

    Raises:
        InputError: it is not supported.
    """
    for asked, capability in ((True, EXPORT[format]), (script, SCRIPT), (mould, MOULD)):
        if asked:
            capability.refuse(scene, format=format)
