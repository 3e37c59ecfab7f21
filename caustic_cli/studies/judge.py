"""The image by which a lens is judged: that by rays, or its wave image where that was refined; what is said of its figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar


class Judge:
    """The image by rays."""

    by: ClassVar[str] = "rays"
    #: Of the keys of its figures.
    prefix: ClassVar[str] = ""
    #: What its errors are of, the title of the energy balance beside it, and what is said of its figures among those by rays.
    points: ClassVar[str] = "retraced with independent rays"
    balance: ClassVar[str] = "where the light goes"
    beside_rays: ClassVar[str] = ""

    def error(self, figures: Mapping[str, Any]) -> float | None:
        """The error of the lens, None without a target."""
        return figures.get(f"{self.prefix}relative_rms")

    def on_target(self, figures: Mapping[str, Any]) -> float:
        """Part of the light that lands on the picture."""
        return figures[f"{self.prefix}on_target"]

    def noise(self, figures: Mapping[str, Any], key: str = "noise") -> float | None:
        """Standard error of the error that is called so, None where rays leave none."""
        return figures.get(key)

    def unsure(self, figures: Mapping[str, Any]) -> float:
        """What its light leaves uncertain of an error."""
        return figures.get("noise") or 0.0

    def of_source(self, figures: Mapping[str, Any]) -> dict[str, float]:
        """of_source, which the rays give, for the light that lands on the picture by this image; empty where that is the same."""
        return {}

    def words(self, noise: str) -> str:
        """What an error is by, after that, with the words of its noise."""
        return f"by rays{noise}"

    def light(self, figures: Mapping[str, Any]) -> str:
        """Of what the image is made."""
        return f"{figures['rays']:,} independent rays"


class _ByWaves(Judge):
    """The wave image."""

    by = "waves"
    prefix = "wave_"
    points = "wave image of the lens"
    balance = "where the light goes, by rays"
    beside_rays = ", by waves"

    def noise(self, figures: Mapping[str, Any], key: str = "noise") -> float | None:
        return None

    def unsure(self, figures: Mapping[str, Any]) -> float:
        return figures.get("wave_spectral_error") or 0.0

    def of_source(self, figures: Mapping[str, Any]) -> dict[str, float]:
        if not (figures.get("of_source") and figures["on_target"] > 0):
            return {}
        return {"of_source": figures["of_source"] * self.on_target(figures) / figures["on_target"]}

    def words(self, noise: str) -> str:
        return "of the wave image"

    def light(self, figures: Mapping[str, Any]) -> str:
        return "independent wave image"


#: By whether the wave image judges.
JUDGES = {False: Judge(), True: _ByWaves()}


def judge_of(figures: Mapping[str, Any]) -> Judge:
    """That of the figures of a judged lens."""
    return JUDGES[figures.get("error_by") == "waves"]


def judged(figures: dict, by_waves: bool) -> dict:
    """The figures of a lens, after the one it is judged by.

    by_waves: judge it by its wave image, where there is one.

    Returns:
        error, wave_relative_rms or relative_rms, and error_by, waves or rays, both None without a target; the figures; and of them
        of_source, which the rays give, for the light that lands on the picture by the judged image.
    """
    judge = JUDGES[by_waves and figures.get("wave_relative_rms") is not None]
    error = judge.error(figures)
    own = {"error": error, "error_by": None if error is None else judge.by}
    return own | figures | own | judge.of_source(figures)  # first, and whatever an earlier judgement was
