"""Which effects a scene calls for, and why: compiled once from the scene and the heights, by proof where there is one.

A plan holds the scene without the effects that are left out, and the steps to be done beyond what that scene says.  What is in
neither is not executed at all.  A design, whose heights change, goes by the scene alone: bounds proved for one surface say nothing
about the next, and the masks for total reflection and missed surfaces stay in its path, where they cost nothing.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.bounds import Bounds, bounds_of
from caustic_cli.optics.heightfield import HeightField
from caustic_cli.optics.stepwise import SEQUENTIAL, Steps
from caustic_cli.scene import Scene

#: Ghost light below this part of the source's power is left out: the other effects' own models are no better than that.
NEGLIGIBLE = 0.01
#: Effects by name, in the order in which light meets them.
EFFECTS = ("source-size", "polarisation", "dispersion", "entrance", "intersection", "missed-surface", "absorption", "roughness",
           "fresnel", "total-reflection", "mirror", "second-meeting", "ghosts", "screen-tilt", "screen-shift")
#: They cost nothing that could be saved: the first two are masks of the sequential path, the third an addend in a sum.
FREE = ("missed-surface", "total-reflection", "screen-shift")


@dataclass(frozen=True)
class Effect:
    """An effect in a plan.

    name: of EFFECTS; on: whether it is simulated; why: one clause; bound, limit: the number that decides and what it is compared
    with, or None; fixed: without it there is no image of this scene; present: False where the scene has nothing of it.
    """

    name: str
    on: bool
    why: str
    bound: float | None = None
    limit: float | None = None
    fixed: bool = False
    present: bool = True


@dataclass(frozen=True)
class Plan:
    """effects, all of EFFECTS; scene, what to trace; steps, how."""

    effects: tuple[Effect, ...]
    scene: Scene
    steps: Steps

    def __getitem__(self, name: str) -> Effect:
        return self.effects[EFFECTS.index(name)]

    @property
    def simulated(self) -> tuple[str, ...]:
        """Names of the effects that are on."""
        return tuple(e.name for e in self.effects if e.on)


def parse_effects(text: str) -> frozenset[str] | None:
    """What --effects says: None for auto, else the names.

    Raises:
        InputError: an unknown name.
    """
    if text.strip() == "auto":
        return None
    names = [] if text.strip() == "none" else [n.strip().replace("_", "-") for n in text.split(",")]
    for name in names:
        if name not in EFFECTS:
            near = difflib.get_close_matches(name, EFFECTS, 1, 0.4)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise InputError(f"--effects must be auto, none, or some of {', '.join(EFFECTS)}, got {name!r}{hint}")
    return frozenset(names)


def compile_plan(scene: Scene, field: HeightField, heights: Tensor, wanted: Iterable[str] | None = None) -> Plan:
    """The plan of a scene at heights (n, m) mm.

    Args:
        wanted: names of the effects to simulate instead of those that the scene calls for, or None; one without which there is
            no image stays on.
    """
    bounds = bounds_of(scene, field, heights)
    effects = [judge(scene, bounds) for judge in _JUDGES]
    if wanted is not None:
        chosen = frozenset(wanted)
        effects = [e if (e.name in chosen) == e.on or e.fixed else
                   replace(e, on=not e.on, why=f"{'asked for' if not e.on else 'left out as asked'}; by itself"
                           f" {'off' if not e.on else 'on'}: {e.why}") for e in effects]
    on = {e.name: e.on for e in effects}
    return Plan(tuple(effects), _without(scene, on), _steps(scene, on, bounds))


def _without(scene: Scene, on: dict[str, bool]) -> Scene:
    """The scene with nothing of what is off, and something of what is on."""
    source, lens, screen, light = scene.source, scene.lens, scene.screen, scene.light
    if not on["source-size"]:
        source = source.pointlike()
    if not on["fresnel"]:
        lens = replace(lens, fresnel="none")
    elif lens.fresnel == "none":
        lens = replace(lens, fresnel="exact")
    for name, value in (("absorption", 0.0), ("roughness", 0.0)):
        if not on[name] and getattr(lens, name):
            lens = replace(lens, **{name: value})
    if not on["dispersion"] and scene.dispersive:
        lens = replace(lens, glass=None)
        light = light if light.color else replace(light, wavelengths=(), weights=())
    if light.polarisation is not None and not on["polarisation"]:
        light = replace(light, polarisation=None)
    elif on["polarisation"] and light.polarisation is None:
        light = replace(light, tracked=True)
    if not on["screen-tilt"] and any(screen.tilt):
        screen = replace(screen, tilt=(0.0, 0.0))
    if not on["screen-shift"] and any(screen.shift):
        screen = replace(screen, shift=(0.0, 0.0))
    parts = source, lens, screen, light
    same = all(a is b for a, b in zip(parts, (scene.source, scene.lens, scene.screen, scene.light), strict=True))
    return scene if same else Scene(*parts)


def _steps(scene: Scene, on: dict[str, bool], bounds: Bounds) -> Steps:
    plane = scene.source.collimated
    steps = Steps(ghosts=on["ghosts"] and not scene.lens.mirror, again=on["second-meeting"],
                  general=plane and (on["entrance"] or on["intersection"]),
                  entrance=plane or on["entrance"], intersect=plane or on["intersection"],
                  reflects=on["total-reflection"] or bounds.critical < 1.0)
    return SEQUENTIAL if steps == SEQUENTIAL else steps


def _source_size(scene: Scene, _: Bounds) -> Effect:
    s, z_in = scene.source, scene.lens.z_in
    bound, limit = (float(len(s.points()[0])), 1.0) if s.several else (s.apparent_angle(z_in), 0.0)
    return Effect("source-size", s.extended, s.extent_words(z_in), bound, limit, present=s.extended)


def _polarisation(scene: Scene, b: Bounds) -> Effect:
    light, lens = scene.light, scene.lens
    if lens.mirror or lens.fresnel != "exact":
        why = "a mirror reflects all light alike" if lens.mirror else f"fresnel = {lens.fresnel} knows no polarisation"
        return Effect("polarisation", False, why, present=False)
    if light.polarisation is not None:
        return Effect("polarisation", True, f"the source is polarised at {light.polarisation:g} degrees")
    if b.incidence == 0:
        return Effect("polarisation", False, "unpolarised light, which normal incidence leaves so", 0.0, NEGLIGIBLE)
    some = b.polarised > NEGLIGIBLE
    return Effect("polarisation", some, "unpolarised light; what the entrance polarises changes what the exit reflects by"
                  f" {'up to' if some else 'at most'} {b.polarised:.1e}", b.polarised, NEGLIGIBLE)


def _dispersion(scene: Scene, _: Bounds) -> Effect:
    if scene.dispersive:
        indices = [band.scene.lens.index for band in scene.bands]
        return Effect("dispersion", True, f"{len(scene.light.wavelengths)} wavelengths in {scene.lens.glass}, whose index goes from"
                      f" {min(indices):.5f} to {max(indices):.5f}", max(indices) - min(indices), 0.0)
    why = "one wavelength" if not scene.light.wavelengths else "a mirror treats all wavelengths alike" if scene.lens.mirror else \
        "the lens has one index for all wavelengths"
    return Effect("dispersion", False, why, 0.0, 0.0, present=False)


def _entrance(scene: Scene, b: Bounds) -> Effect:
    angle = math.degrees(b.incidence)
    if scene.source.collimated or scene.lens.mirror or angle == 0:
        why = "there is no glass before a mirror" if scene.lens.mirror else "normal incidence on a flat entrance bends nothing"
        return Effect("entrance", not scene.source.collimated and not scene.lens.mirror, why, angle, 0.0)
    return Effect("entrance", True, f"rays meet the entrance at up to {angle:.3g} degrees", angle, 0.0)


def _intersection(scene: Scene, b: Bounds) -> Effect:
    if scene.source.collimated:
        return Effect("intersection", False, "rays of a plane wave are sampled on the surface itself", 0.0, 0.0)
    angle = math.degrees(b.inside)
    return Effect("intersection", True, f"rays cross the lens at up to {angle:.3g} degrees", angle, 0.0)


def _missed(scene: Scene, b: Bounds) -> Effect:
    if scene.source.collimated:
        return Effect("missed-surface", False, "every ray of a plane wave is on the surface", b.reach, 1.0)
    if b.reach <= 1.0:
        return Effect("missed-surface", False, f"no ray gets beyond {b.reach:.4g} of the aperture's half width", b.reach, 1.0)
    if math.isinf(b.reach):
        return Effect("missed-surface", True, "the surface may dip below the entrance", None, 1.0, fixed=True)
    why = f"rays may get to {b.reach:.4g} of the aperture's half width: its side takes them"
    return Effect("missed-surface", True, why, b.reach, 1.0, fixed=True)


def _absorption(scene: Scene, _: Bounds) -> Effect:
    a = 0.0 if scene.lens.mirror else scene.lens.absorption
    return Effect("absorption", a > 0, f"the glass absorbs {a:g} per mm" if a > 0 else "the glass is clear", a, 0.0, present=a > 0)


def _roughness(scene: Scene, _: Bounds) -> Effect:
    r = scene.lens.roughness
    return Effect("roughness", r > 0, f"microfacets of slopes {r:g}" if r > 0 else "the surface is smooth", r, 0.0, present=r > 0)


def _fresnel(scene: Scene, b: Bounds) -> Effect:
    if scene.lens.mirror:
        return Effect("fresnel", False, "a mirror is taken to reflect all light", present=False)
    if scene.lens.fresnel == "none":
        return Effect("fresnel", False, "fresnel = none: perfectly coated", 0.0, 0.0)
    normal = ((b.index - 1.0) / (b.index + 1.0)) ** 2
    return Effect("fresnel", True, f"each surface reflects {normal:.2%} of normal light; {scene.lens.fresnel}", normal, 0.0)


def _total(scene: Scene, b: Bounds) -> Effect:
    if scene.lens.mirror:
        return Effect("total-reflection", False, "a mirror has no critical angle", present=False)
    if b.critical < 1.0:
        return Effect("total-reflection", False, f"n sin i <= {b.critical:.4g} at slopes up to {b.slope:.3g}", b.critical, 1.0)
    return Effect("total-reflection", True, f"n sin i may reach {b.critical:.4g} at slopes up to {b.slope:.3g}", b.critical, 1.0)


def _mirror(scene: Scene, _: Bounds) -> Effect:
    if scene.lens.mirror:
        return Effect("mirror", True, "the surface is a mirror", fixed=True)
    return Effect("mirror", False, "the surface is glass", fixed=True, present=False)


def _second(scene: Scene, b: Bounds) -> Effect:
    if b.climb < 1.0:
        return Effect("second-meeting", False, f"slopes up to {b.slope:.3g} are {b.climb:.3g} of what rays leaving climb at",
                      b.climb, 1.0)
    return Effect("second-meeting", True, f"slopes up to {b.slope:.3g} may catch a ray that has left",
                  b.climb if math.isfinite(b.climb) else None, 1.0)


def _ghosts(scene: Scene, b: Bounds) -> Effect:
    if scene.lens.mirror:
        return Effect("ghosts", False, "there is no glass", present=False)
    if b.ghost <= NEGLIGIBLE:
        return Effect("ghosts", False, f"at most {b.ghost:.2%} of the power is reflected twice", b.ghost, NEGLIGIBLE)
    return Effect("ghosts", True, f"up to {b.ghost:.2%} of the power may be reflected twice", b.ghost, NEGLIGIBLE)


def _tilt(scene: Scene, _: Bounds) -> Effect:
    a, b = scene.screen.tilt
    some = any(scene.screen.tilt)
    return Effect("screen-tilt", some, f"the screen is tilted by {a:g} and {b:g} degrees" if some else "the screen is upright",
                  max(abs(a), abs(b)), 0.0, present=some)


def _shift(scene: Scene, _: Bounds) -> Effect:
    a, b = scene.screen.shift
    some = any(scene.screen.shift)
    return Effect("screen-shift", some, f"the screen is shifted by {a:g} and {b:g} mm" if some else "the screen is on the axis",
                  max(abs(a), abs(b)), 0.0, present=some)


_JUDGES = (_source_size, _polarisation, _dispersion, _entrance, _intersection, _missed, _absorption, _roughness, _fresnel, _total,
           _mirror, _second, _ghosts, _tilt, _shift)
