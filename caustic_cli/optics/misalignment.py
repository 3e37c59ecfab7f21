"""Ray tracing of a scene with given manufacturing and alignment errors.

Everything is traced in the frame of what the source illuminates first.  That is the lens, if no other element is in front of it:
source, screen and other elements are transformed into its frame, p' = R (p - c - d) + c, with the lens' axes as rows of R, its
decentre d and the centre c of its entrance.  Behind other elements the lens itself is moved (`Scene.mounting`).  Rays
are sampled on the aperture of that first element as usual, and rays of one seed have the same points there for all errors (common
random numbers), so the difference of two images is due to the errors alone.

Light from infinity arrives in the direction given by its own and the lens' tilt, over the whole aperture.  A profile of its
irradiance belongs to the beam: it moves over the aperture by the decentre of the source less that of the lens (to first order in
the tilts, which foreshorten it by their cosine), and the power through the aperture changes accordingly.  Likewise the axis of a
near source's emission keeps its direction where the lens is tilted, and its radiant intensity is kept.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.effects import NO_REQUESTS, Requests
from caustic_cli.optics.emission import Rays, of_member
from caustic_cli.optics.emission.base import relative_flux
from caustic_cli.optics.frames import AxisSegment, Pose, rotate_to_global, rotate_to_local
from caustic_cli.optics.rays import RayState
from caustic_cli.optics.resampling import displaced
from caustic_cli.optics.screen_shape import shape_of
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, System
from caustic_cli.optics.trace import CHUNK, Tracer
from caustic_cli.scene import Pupil, Scene, Screen, Source
from caustic_cli.scene.room import tilt_of
from caustic_cli.scene.screen import Window, passed_by
from caustic_cli.scene.sources.rays import Measured
from caustic_cli.scene.sources.several import Several


@dataclass(frozen=True)
class Misalignment:
    """One set of errors, see `scene.tolerances.KINDS`; mm and degrees, source_size, wavelength and aperture relative to
    themselves."""

    index: float = 0.0
    thickness: float = 0.0
    throw: float = 0.0
    source_shift: tuple[float, float] = (0.0, 0.0)
    source_distance: float = 0.0
    source_size: float = 0.0
    source_tilt: tuple[float, float] = (0.0, 0.0)
    lens_shift: tuple[float, float] = (0.0, 0.0)
    lens_tilt: tuple[float, float] = (0.0, 0.0)
    screen_shift: tuple[float, float] = (0.0, 0.0)
    screen_tilt: tuple[float, float] = (0.0, 0.0)
    wavelength: float = 0.0
    aperture: float = 0.0

    @classmethod
    def of(cls, values: Mapping[tuple[str, int], float]) -> Misalignment:
        """From values by (error, axis); errors of other kinds are ignored."""
        found: dict[str, Any] = {}
        for f in fields(cls):
            if isinstance(f.default, tuple):
                found[f.name] = tuple(float(values.get((f.name, k), 0.0)) for k in (0, 1))
            else:
                found[f.name] = float(values.get((f.name, 0), 0.0))
        return cls(**found)

    def frame(self, scene: Scene) -> Pose:
        """Pose, with the centre of the lens' entrance as origin, of the frame in which everything is traced: that of the lens,
        rotated about this point, and decentred; without errors, if other elements are in front of the lens."""
        centre = 0.0, 0.0, scene.lens.z_in
        return Pose(centre) if scene.in_front else Pose((*self.lens_shift, centre[2]), self.lens_tilt)

    def point(self, scene: Scene, point: Sequence[float]) -> tuple[float, float, float]:
        """A point of the scene in that frame, mm."""
        pose = self.frame(scene)
        x, y, z = rotate_to_local(pose, tuple(p - o for p, o in zip(point, pose.position, strict=True)))
        return x, y, z + scene.lens.z_in

    def away(self, scene: Scene) -> tuple[float, float, float]:
        """Displacement of the screen by the error of its distance, in its frame: along the light, towards +z; none of the far
        field."""
        if scene.screen.far:
            return 0.0, 0.0, 0.0
        x, y, z = (math.copysign(self.throw, self.throw * scene.undeviated[2]) * c for c in scene.undeviated)
        return x, y, z

    def screen(self, scene: Scene) -> tuple[tuple[float, float, float], tuple]:
        """Centre, mm, and axes of the screen in the frame of the trace."""
        s, pose, away = scene.screen, self.frame(scene), self.away(scene)
        leg = System.of(scene).leg or AxisSegment()
        tilt = (s.tilt[0] + self.screen_tilt[0], s.tilt[1] + self.screen_tilt[1], *s.tilt[2:])
        centre = (s.shift[0] + self.screen_shift[0] + away[0], s.shift[1] + self.screen_shift[1] + away[1], s.z + away[2])
        axes = tuple(rotate_to_local(pose, s.in_space(axis)) for axis in Pose(tilt=tilt, frame=leg.frame).axes)
        return self.point(scene, s.in_space(leg.at(*centre))), axes

    def windows(self, scene: Scene) -> list[Window]:
        """The windows in front of the screen in the frame of the trace."""
        pose = self.frame(scene)
        return [
            replace(w, vertex=self.point(scene, w.vertex), axes=cast(Any, tuple(rotate_to_local(pose, axis) for axis in w.axes)))
            for w in scene.screen.windows
        ]

    def scene(self, scene: Scene) -> Scene:
        """The scene with the erroneous index, wavelength, source position and source size, and, among other elements, place of the
        lens, in the frame of the trace; the direction of light from infinity and the screen are unchanged.

        Raises:
            InputError: the scene is invalid with these errors.
        """
        lens = scene.lens.denser(self.index) if self.index else scene.lens
        light = replace(scene.light, wavelengths=tuple((1.0 + self.wavelength) * w for w in scene.light.wavelengths))
        try:
            moved = scene.elements and any((*self.lens_shift, *self.lens_tilt))
            mounting = (self.lens_shift, self.lens_tilt) if moved else scene.mounting
            return replace(scene, lens=lens, light=light, source=self._source(scene, scene.source), mounting=mounting)
        except InputError as error:
            raise InputError(f"with these errors the scene is invalid: {error}") from error

    def _source(self, scene: Scene, source: Source) -> Source:
        shift = (*self.source_shift, self.source_distance)

        def moved(position: Sequence[float]) -> tuple[float, float, float]:
            return self.point(scene, tuple(p + s for p, s in zip(position, shift, strict=True)))

        scale = 1.0 + self.source_size
        if isinstance(source, Several):
            return replace(source, members=tuple(self._source(scene, one) for one in source.members))
        if source.profile is not None:
            aside = [s - d for s, d in zip(self.source_shift, self.frame(scene).position, strict=False)]
            if not any(aside):
                return source
            across, along = (d / (2.0 * r) for d, r in zip(aside, scene.pupil.half_size, strict=True))
            return replace(cast(Any, source), profile=displaced(source.profile, (across, along)))
        if isinstance(source, Measured):
            rays = source.turned
            if any(self.frame(scene).tilt):
                rays = rays.turned(np.array(self.frame(scene).axes).T)
            return replace(source, rays=rays, position=moved(source.origin.tolist()), tilt=(0.0, 0.0))
        return source.displaced(moved, scale, rotate_to_local(self.frame(scene), source.axis))

    def upright(self, scene: Scene) -> Scene:
        """An approximately equivalent scene with the lens in its nominal position, without the thickness error.

        Light from infinity along the axis stays parallel to it, and the screen is decentred by the shift of the picture that its
        direction causes, without additional tilt; the same holds for a second picture and a focus.  Light at an angle is turned
        itself.  Among other elements the lens stands where it does; light from infinity that a thin lens receives at an angle is
        replaced by a rotation of all that is behind, and that which other elements receive so is parallel to the axis.

        Raises:
            InputError: as of `scene`.
        """
        changed, ahead = self.scene(scene), self._ahead(scene)
        if scene.source.lean:
            changed, ahead = replace(changed, source=self._turned(scene, changed.source)), (0.0, 0.0)
        if scene.elements:
            turned = self.source_tilt if scene.source.distant and not scene.in_front else self.lens_tilt
            (sx, sy), (dx, dy), (x, y, z) = scene.screen.shift, self.screen_shift, self.away(scene)
            screen = replace(scene.screen, z=scene.screen.z + z, shift=(sx + dx + x, sy + dy + y))
            return replace(changed, screen=screen, mounting=(self.lens_shift, turned))

        def seen(point: Sequence[float]) -> tuple[float, float, float]:
            x, y, z = point
            reach = abs(z - scene.lens.offset.thickness)  # light from a mirror returns, with the same lateral shift
            return x - reach * ahead[0], y - reach * ahead[1], z

        def moved(screen: Screen) -> Screen:
            x, y, z = seen(self.screen(scene.onto(screen))[0])
            return replace(screen, z=z, shift=screen.in_space((x, y, z))[:2])

        second = scene.second_target
        if second is not None and second.screen is not None:
            second = replace(second, screen=moved(second.screen))
        elif second is not None and second.focus is not None:
            second = replace(second, focus=seen(self.point(scene, second.focus)))
        return replace(changed, screen=moved(scene.screen), second_target=second)

    def _turned(self, scene: Scene, source: Source) -> Source:
        """A source at infinity whose light has the tilts of source and lens, in the frame of the trace."""
        if isinstance(source, Several):
            return replace(source, members=tuple(self._turned(scene, one) for one in source.members))
        direction = rotate_to_local(self.frame(scene), rotate_to_global(Pose(tilt=self.source_tilt), source.axis))
        return replace(cast(Any, source), tilt=tilt_of(direction))

    def _ahead(self, scene: Scene) -> tuple[float, float]:
        """Slopes of light from infinity by the tilts of source and lens, in the frame of the trace; 0 of other light."""
        if not scene.source.distant:
            return 0.0, 0.0
        x, y, z = rotate_to_local(self.frame(scene), rotate_to_global(Pose(tilt=self.source_tilt), (0.0, 0.0, 1.0)))
        return x / z, y / z

    def brightness(self, scene: Scene, changed: Scene) -> float:
        """Factor of the power, of a scene with a single source, that keeps the irradiance of a beam with a profile, of which
        another part passes the aperture; or the radiant intensity of a near source whose cone is the narrowest that covers the
        lens, since that cone changes with the source's position."""
        before = scene.source
        if before.uneven:
            return changed.source.passed(scene.pupil) / before.passed(scene.pupil)
        if before.distant or before.cone is not None or before.rays is not None:
            return 1.0
        after, whole = (relative_flux(s.source, s.source.cone_over(s.pupil)) for s in (changed, scene))
        return after / whole

    def stopped(self, pupil: Pupil, state: RayState) -> RayState:
        """Rays without those beside a narrower aperture."""
        if not self.aperture < 0:
            return state
        state = state.expanded()
        x, y, z, dx, dy, dz = state.full((*state.origin, *state.direction))
        t = (pupil.z - z - state.datum) / dz
        u, v = ((c + t * d) / (r * (1.0 + self.aperture)) for c, d, r in zip((x, y), (dx, dy), pupil.half_size, strict=True))
        return replace(
            state, power=torch.where(pupil.aperture.covers(u, v), state.power, torch.zeros_like(state.power)), sample=None
        )

    def directed(self, scene: Scene, source: Source, state: RayState) -> RayState:
        """Rays of light from infinity rotated by the tilts of source and lens; other rays unchanged."""
        frame = self.frame(scene)
        if not source.distant or not (any(self.source_tilt) or any(frame.tilt)):
            return state
        state = state.expanded()
        direction = rotate_to_local(frame, rotate_to_global(Pose(tilt=self.source_tilt), state.direction))
        return replace(state, direction=direction, sample=None)


@dataclass(frozen=True)
class LandingPoints:
    """Landing points on the screen: x, y along its axes from its centre, mm, and power, (N,) float64; channel: of a coloured
    image."""

    x: Tensor
    y: Tensor
    power: Tensor
    channel: int | None = None


def landing_points(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    rays: Rays,
    errors: Misalignment,
    requests: Requests = NO_REQUESTS,
) -> Iterator[LandingPoints]:
    """Landing points of a scene with these errors, chunk by chunk.

    Args:
        heights: (n, m) mm, of the surface as manufactured; the thickness error is added here.
        rays: sampled for `errors.scene(scene)`.
        requests: of the plan of the nominal scene, whose proofs that an effect may be left out do not hold with errors.
    """
    changed, requests = errors.scene(scene), replace(requests, off=frozenset())
    (point, axes), shape, windows = errors.screen(scene), shape_of(scene.screen), errors.windows(scene)
    parameters = {EXIT: heights + errors.thickness}
    with torch.no_grad():
        for band, plain in zip(changed.bands, scene.bands, strict=True):
            if errors.index and band.scene.lens.index == plain.scene.lens.index:  # a glass, by its formula
                band = replace(band, scene=replace(band.scene, lens=band.scene.lens.denser(errors.index)))
            scale = band.weight * errors.brightness(plain.scene, band.scene)
            system = System.of(band.scene, field)
            for state in of_member(rays, band.member).chunks(CHUNK):
                if not isinstance(state, RayState):
                    state = RayState.on_axis(state, system.pupil.half_size, system.pupil.z).expanded()
                state = errors.directed(scene, band.scene.source, errors.stopped(system.pupil, state))
                tracer = Tracer(system, state, torch.float64, requests)
                forward = math.copysign(1.0, sum(a * b for a, b in zip(system.axis, axes[2], strict=True)))
                for out in tracer(parameters):
                    middle = (point[0], point[1], point[2] - out.datum)
                    x, y, there = shape.land(tracer.backend, out.origin, out.direction, middle, axes, forward)
                    there = there & passed_by(windows, (*out.origin[:2], out.origin[2] + out.datum), out.direction)
                    power = torch.where(there, out.power, torch.zeros_like(out.power)) * scale
                    yield LandingPoints(x.double(), y.double(), power.double(), band.channel)


def reason_ignored(scene: Scene, error: str) -> str:
    """Why an error has no effect in a scene; "" if it has one."""
    source = scene.source
    if error == "source_shift" and source.distant and not any(one.uneven for one in source.members):
        return "a source at infinity without a profile has no position; source_tilt is its direction"
    if error == "source_distance" and source.distant:
        return "a source at infinity has no position; source_tilt is its direction"
    if error == "source_tilt" and not source.distant:
        return "the source is at a finite distance; source_shift moves it"
    if error == "wavelength" and not scene.dispersive:
        return "no glass (⟨+lens.glass⟩) has an index that depends on it, at a given wavelength"
    if error == "source_size" and not any(one.sized for one in source.members):
        return f"{source.label} has no size"
    return scene.lens.interaction.lacks.get(error, "")
