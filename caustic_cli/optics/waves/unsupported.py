"""Scenes without a wave image, and why: the one table of them."""

from __future__ import annotations

from caustic_cli.errors import CausticError, InputError
from caustic_cli.optics.receiver import Receiver, dot
from caustic_cli.optics.system import PlacedScreen, System
from caustic_cli.scene import Scene, Screen
from caustic_cli.scene.traits import Capability

#: Least cosine between a screen's normal and the axis: near grazing incidence off-axis light is parallel to the screen.
LEAST_COSINE = 0.08


class NoWaveImage(CausticError):
    """The wave image of a scene is undefined, or cannot be computed."""


#: Why a scene has no wave image, as clauses.
WAVE_IMAGE = Capability(
    "wave image",
    dict.fromkeys(("ray file", "ray file among sources"), "a ray file contains no phase"),
)
WAVE_REFINEMENT = Capability.because(
    "design by waves",
    {why: tuple(WAVE_IMAGE.unsupported) for why in WAVE_IMAGE.unsupported.values()},
    "⟨design.waves⟩ on: {reason}, so that it has no wave image to refine",
)
_ASKED = Capability.because(
    "design by waves unless asked for",
    {
        "it takes a wave image of each of several sources": ("several sources",),
        "behind the creases of a free-form entrance light has no single wavefront": ("two sides",),
        "behind other elements it takes many samples, or a part of the light": ("other elements",),
        "light of lenslets side by side interferes in fine fringes, which rays alone pass over": ("lenslet array",),
        "on a tilted or curved screen it takes many transforms for each wavelength": ("tilted screen", "curved screen"),
        "in tilted light it holds for surfaces that are smooth over the Fresnel scale of their depth along the light": (
            "tilted light",
        ),
    },
    "{reason}; ⟨waves⟩ on refines it all the same",
)
#: Scenes whose wave image is refined on request only, where there is one.
WAVES_BY_DEFAULT = Capability(_ASKED.name, {**WAVE_IMAGE.unsupported, **_ASKED.unsupported}, _ASKED.reasons)


def refuse_without_image(scene: Scene) -> None:
    """Refuse a scene without a wave image.

    Raises:
        NoWaveImage: it is one.
    """
    if why := WAVE_IMAGE.why_not(scene):
        raise NoWaveImage(f"{why}, so that it has no wave image")


def receiver_of(system: System, screen: Screen | PlacedScreen) -> Receiver:
    """The receiver of a system's light for a wave image.

    Raises:
        InputError: it is nearly parallel to the axis.
        NoWaveImage: the rays are those of a file.
    """
    if system.source.rays is not None:
        raise NoWaveImage(f"{WAVE_IMAGE.unsupported['ray file']}, so that it has no wave image")
    found = Receiver.of(system, screen)
    if abs(dot(found.axes[2], found.axis)) < LEAST_COSINE:
        raise InputError("⟨screen.tilt⟩ makes the screen nearly parallel to the light, where there is no wave image")
    return found
