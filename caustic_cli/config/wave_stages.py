"""Stages on the wave image: on request, or where diffraction matters and this quality has the time; and why there are none."""

from __future__ import annotations

import math

from caustic_cli.config.default_stages import LEAST_WAVES, LONGER_BEAMS, Table, on_waves, wave_refinement
from caustic_cli.config.design import region_of
from caustic_cli.config.exclusions import refuse_excluded, why_excluded
from caustic_cli.config.settings import Settings, build_lens, build_light, build_screen, build_source
from caustic_cli.effort import Effort
from caustic_cli.errors import InputError
from caustic_cli.optics.resolution import Resolution
from caustic_cli.optics.waves.sampling import A_PIXEL, FINER
from caustic_cli.optics.waves.unsupported import WAVE_REFINEMENT
from caustic_cli.scene import Scene, Source


def without_waves(s: Settings, given: bool) -> str:
    """Why `waves = "auto"` omits the wave image from complete settings although diffraction matters, and how to include it.

    given: whether the stages are user-defined.
    """
    if any(stage.waves for stage in s.design.stages):
        return ""
    if given:
        return "none of the given [[design.stages]] has waves; one with waves = [550.0] refines it at that wavelength"
    if (seen := Resolution.before(_scene(s, build_source(s.source)), s.target.size)).source > seen.pixel:
        return "that of a source whose blur is wider than a pixel takes many times as long; ⟨waves⟩ on refines it all the same"
    excluded = why_excluded("design.waves auto", s)
    return excluded or f"{LEAST_WAVES} iterations on it would take longer than this quality's time; ⟨waves⟩ on takes it"


def wave_stages(s: Settings, source: Source, effort: Effort, lit: tuple[float, float]) -> list[Table]:
    """Stages that refine the wave image after the ray image, on request or where diffraction matters.

    Raises:
        InputError: they are asked for, and the scene has none.
    """
    lens, screen, asked = s.lens, s.screen, s.design.waves
    if asked == "on":
        refuse_excluded("design.waves on", s)
    elif asked == "off" or why_excluded("design.waves auto", s):
        return []
    scene = _scene(s, source)
    if asked == "on" and (why := WAVE_REFINEMENT.why_not(scene)):
        raise InputError(why)
    seen, light = Resolution.before(scene, s.target.size), scene.light
    if asked == "auto" and (seen.source > seen.pixel or not seen.matters):
        return []
    own, whole = light.wavelengths if s.source.get("wavelengths") else (), light.continuum
    plan = wave_refinement(wave_samples(s, seen, lit), len(own), effort, timed=asked == "auto")
    if region_of(s.design) is not None:
        plan = [(count, LONGER_BEAMS * n) for count, n in plan]
    apron = math.ceil(0.04 * max(screen.resolution))
    return [on_waves(lens.control, own if own or whole is None else whole.rule(count)[0], apron, n) for count, n in plan]


def _scene(s: Settings, source: Source) -> Scene:
    """Source, lens, screen and light of complete settings."""
    return Scene(source, build_lens(s.lens), build_screen(s.screen), build_light(s))


def wave_samples(s: Settings, seen: Resolution, lit: tuple[float, float]) -> float:
    """Estimated number of samples of the field at one wavelength: space-bandwidth product of the lens and the blurred bright
    region."""
    throw, shortest = abs(s.screen.z), min(build_light(s).lines()[0]) * 1e-6
    return math.prod(w * width / (shortest * throw) for w, width in zip(s.lens.size, _wide(s, seen, lit), strict=True))


def transform_samples(s: Settings, seen: Resolution, lit: tuple[float, float]) -> float:
    """The same of its transform, which also has A_PIXEL samples per pixel at the longest wavelength."""
    throw, lines = abs(s.screen.z), build_light(s).lines()[0]
    shortest, range_of = min(lines) * 1e-6, max(lines) / min(lines)
    return math.prod(
        width * max(w / (shortest * throw), A_PIXEL / FINER * range_of * n / across)
        for w, width, n, across in zip(s.lens.size, _wide(s, seen, lit), s.screen.resolution, s.screen.size, strict=True)
    )


def _wide(s: Settings, seen: Resolution, lit: tuple[float, float]) -> list[float]:
    """Widths of the blurred bright region, mm."""
    return [part * t + 4.0 * seen.diffraction for t, part in zip(s.target.size, lit, strict=True)]
