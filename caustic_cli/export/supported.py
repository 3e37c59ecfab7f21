"""What each export format does not hold of a scene, and why."""

from __future__ import annotations

from collections.abc import Mapping

from caustic_cli.export import FORMATS, SOLIDS
from caustic_cli.scene import Scene
from caustic_cli.scene.traits import BEYOND_CLEAR, Capability

#: Formats that hold a single refractive index, and formats that hold all elements of a scene.
ONE_INDEX, WHOLE = ("lighttools", "zemax", "mitsuba"), ("lighttools", *SOLIDS, "mitsuba")

ONE_LENS = f"⟨format⟩ {{format}} holds a single lens; with other elements {', '.join(WHOLE)} hold the scene, without ⟨script⟩"
SHAPE = (
    "⟨format⟩ {format} holds one index, and this lens' varies;"
    f" {', '.join(name for name in FORMATS if name not in ONE_INDEX)} hold its shape alone"
)
SOURCE = "⟨format⟩ {format} does not support sources of type {scene.source.kind}"
BEAM = (
    "⟨format⟩ {format}: its sources have rays without a wavefront, so the beam of a laser, with its waist or its phase, cannot be"
    f" written; {', '.join(name for name in FORMATS if name not in ('lighttools', 'mitsuba'))} hold the lens alone"
)
SCREEN = (
    "⟨format⟩ {format} has a screen at a distance, and this lens' picture is in the far field;"
    f" {', '.join(name for name in FORMATS if name not in ONE_INDEX)} hold the lens alone"
)
MASK = (
    "⟨format⟩ {format} holds a lens that is clear all over, not {};"
    f" {', '.join(name for name in FORMATS if name not in (*ONE_INDEX, 'phase'))} hold its shape alone"
)
#: Beyond what ONE_INDEX says.
_UNSUPPORTED: dict[str, Mapping[str, str]] = {
    "zemax": {"other elements": ONE_LENS, "far field": SCREEN},
    "lighttools": {"laser beam": BEAM, "user-defined source": SOURCE, "far field": SCREEN},
    "phase": dict.fromkeys(("ray file", "ray file among sources"), "⟨format⟩ phase is that of waves, and {} have none"),
    "mitsuba": {
        "laser beam": BEAM,
        "gradient index": SHAPE,
        "absorption": "⟨format⟩ mitsuba: its light tracer knows no media that absorb, so glass with {} cannot be written",
        "polarisation": "⟨format⟩ mitsuba: its emitters are not polarised, so {} cannot be written",
        **dict.fromkeys(("ray file", "ray file among sources", "user-defined source"), SOURCE),
        **dict.fromkeys(
            ("disc at infinity", "disc not Lambertian", "disc in a cone"),
            "⟨format⟩ mitsuba: of discs only a Lambertian one without a cone of its own can be written, not one at infinity; render"
            " ⟨verify⟩ mitsuba traces them all",
        ),
    },
}


def _exported(format: str) -> Capability:
    index = {"gradient index": SHAPE, "round lenslets": MASK} if format in ("lighttools", "zemax") else {}
    return Capability(f"export to {format}", index | _UNSUPPORTED.get(format, {}))


EXPORT: dict[str, Capability] = {format: _exported(format) for format in FORMATS}
MOULD = Capability("moulds", {})
SCRIPT = Capability(
    "script for LightTools",
    {
        "laser beam": BEAM,
        "user-defined source": SOURCE,
        **dict.fromkeys(("other elements", "folded axis"), ONE_LENS),
        **dict.fromkeys(BEYOND_CLEAR, "⟨script⟩ builds clear lenses and straight screens, not {}, which the archive alone holds"),
        "gradient index": SHAPE,
        "round lenslets": MASK,
        "far field": SCREEN,
        "tilted light": "⟨script⟩: its source shines along the axis, so light at an angle, which the archive alone holds, cannot be"
        " written",
        "lumens": "⟨script⟩: its power is in watts, so one in {scene.light.unit} cannot be written",
        "uneven plane wave": "⟨script⟩: its source is uniform, so one with a profile cannot be written",
        **dict.fromkeys(
            ("uneven source", "ray file", "tabulated intensity"),
            "⟨script⟩: its source is evenly bright and uniform or Lambertian, so a picture, a table or a ray file cannot be"
            " written",
        ),
        "several sources": "⟨script⟩ builds one source, so that several, which the archive alone holds, cannot be written",
        "elliptical disc": "⟨script⟩: its disc is round, so an elliptical one cannot be written",
        "circular aperture": "⟨script⟩: its freeform solid is a rectangle, so a circular aperture cannot be written",
    },
)


def refuse(scene: Scene, format: str, script: bool, mould: bool) -> None:
    """Refuse a scene that a format does not hold, or not with a script or as a mould.

    Raises:
        InputError: it is not supported.
    """
    for asked, capability in ((True, EXPORT[format]), (script, SCRIPT), (mould, MOULD)):
        if asked:
            capability.refuse(scene, format=format)
