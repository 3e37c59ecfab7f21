"""Features of scenes by which capabilities state what they do not support.

Each is known by its noun phrase in messages.  A basic scene has none of them: a non-absorbing lens of homogeneous index with a flat
entrance, unpolarised monochromatic light and a plane screen centred on the axis and perpendicular to it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from caustic_cli.scene import Scene

MIRROR, GRADIENT, FREE_ENTRANCE, ELEMENTS = "a mirror", "an index that varies", "a free-form entrance", "other elements beside it"
TILTED, SHIFTED, CURVED = "a tilted screen", "a shifted screen", "a curved screen"

#: Noun phrase -> whether a scene has the feature.
FEATURES: dict[str, Callable[[Scene], bool]] = {
    MIRROR: lambda s: s.lens.mirror,
    GRADIENT: lambda s: s.lens.gradient is not None,
    FREE_ENTRANCE: lambda s: s.two_sided,
    ELEMENTS: lambda s: bool(s.unfolded.elements),
    "absorption": lambda s: s.lens.absorption > 0 or any(e.absorption > 0 for e in s.elements),
    "roughness": lambda s: s.lens.roughness > 0,
    "polarised light": lambda s: s.light.polarisation is not None,
    "several wavelengths": lambda s: len(s.light.wavelengths) > 1,
    TILTED: lambda s: any(s.screen.tilt),
    SHIFTED: lambda s: any(s.screen.shift),
    CURVED: lambda s: s.screen.curved,
}


def features_of(scene: Scene, among: Iterable[str]) -> list[str]:
    """Which of these features a scene has: their noun phrases."""
    return [name for name in among if FEATURES[name](scene)]


def special_features(scene: Scene) -> list[str]:
    """The features of a scene beyond a basic one that the export formats and Mitsuba scenes written here do not support; those with
    free-form entrances and other elements are refused elsewhere."""
    return features_of(scene, [name for name in FEATURES if name not in (FREE_ENTRANCE, ELEMENTS)])
