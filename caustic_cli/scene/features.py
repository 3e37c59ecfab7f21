"""Scene features that the export formats and Mitsuba scenes written here do not support."""

from __future__ import annotations

from caustic_cli.scene import Scene


def special_features(scene: Scene) -> list[str]:
    """The features of a scene beyond a non-absorbing lens of homogeneous index, unpolarised monochromatic light and a plane screen
    centred on the axis and perpendicular to it: noun phrases for messages, empty for a basic scene."""
    lens, screen, light = scene.lens, scene.screen, scene.light
    found = {
        "a mirror": lens.mirror,
        "an index that varies": lens.gradient is not None,
        "absorption": lens.absorption > 0 or any(e.absorption > 0 for e in scene.elements),
        "roughness": lens.roughness > 0,
        "polarised light": light.polarisation is not None,
        "several wavelengths": len(light.wavelengths) > 1,
        "a tilted screen": any(screen.tilt),
        "a shifted screen": any(screen.shift),
        "a curved screen": screen.curved,
    }
    return [name for name, there in found.items() if there]
