"""What a scene has that other programs' files, as written here, cannot say."""

from __future__ import annotations

from caustic_cli.scene import Scene


def beyond_plain(scene: Scene) -> list[str]:
    """Names of all that goes beyond a clear lens of one index, unpolarised light and a screen straight on the axis."""
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
