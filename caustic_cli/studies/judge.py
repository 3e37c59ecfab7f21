"""The image by which a lens is judged: that by rays, or its wave image where that was refined; what is said of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Judge:
    """An image by which a lens can be judged: that by rays unless given."""

    by: str = "rays"
    #: Of the keys of its figures.
    prefix: str = ""
    #: What its errors are of, the title of the energy balance beside it, and what is said of its figures among those by rays.
    points: str = "retraced with independent rays"
    balance: str = "where the light goes"
    beside_rays: str = ""
    #: What an error is by, after that, with the {noise} of rays; what the image is made of, with their number {rays}.
    after: str = "by rays{noise}"
    light: str = "{rays:,} independent rays"
    #: Key of what its light leaves uncertain of an error, and whether that is noise.
    unsure: str = "noise"
    noisy: bool = True

    def figure(self, figures: Mapping[str, Any], name: str) -> Any:
        """A figure of its image, None if there is none."""
        return figures.get(f"{self.prefix}{name}")

    def noise(self, figures: Mapping[str, Any], key: str = "noise") -> float | None:
        """A standard error, None where rays leave none."""
        return figures.get(key) if self.noisy else None


RAYS = Judge()
WAVES = Judge(
    "waves",
    "wave_",
    points="wave image of the lens",
    balance="where the light goes, by rays",
    beside_rays=", by waves",
    after="of the wave image",
    light="independent wave image",
    unsure="wave_spectral_error",
    noisy=False,
)
#: By whether the wave image judges.
JUDGES = {False: RAYS, True: WAVES}


def judge_of(figures: Mapping[str, Any]) -> Judge:
    """That of the figures of a judged lens."""
    return JUDGES[figures.get("error_by") == WAVES.by]


def judged(figures: dict, by_waves: bool) -> dict:
    """The figures of a lens, after the one it is judged by.

    by_waves: judge it by its wave image, where there is one.

    Returns:
        error, wave_relative_rms or relative_rms, and error_by, waves or rays, both None without a target; the figures; and of them
        of_source, which the rays give, for the light that lands on the picture by the judged image.
    """
    judge = JUDGES[by_waves and WAVES.figure(figures, "relative_rms") is not None]
    error = judge.figure(figures, "relative_rms")
    own = {"error": error, "error_by": None if error is None else judge.by}
    found = own | figures | own  # first, and whatever an earlier judgement was
    if judge is not RAYS and figures.get("of_source") and figures["on_target"] > 0:
        found["of_source"] = figures["of_source"] * judge.figure(figures, "on_target") / figures["on_target"]
    return found
