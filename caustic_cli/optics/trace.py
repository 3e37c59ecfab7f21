"""Sequential ray tracing from the sources to the screens (thesis 4.3.1).

    trace(system, rays, {surface name: heights}) = fold over the elements of
        intersect -> before_interaction -> interact -> after_interaction
    image = splat(land(trace(...)))

    intersect            ray transfer to the element's surface, in its own frame
    before_interaction   effects on the path and at the surface: absorption, roughness
    interact             refraction with Fresnel losses, or reflection by a mirror
    after_interaction    effects behind the surface
    stray light          non-sequential paths, traced afterwards: ghosts, secondary intersections

Elements in front of the first free-form surface do not depend on heights and are traced once, when a `Tracer` is constructed.  The
rest is *lowered* to one fused kernel where it is a single upright B-spline in front of an upright screen, without effects other
than refraction and Fresnel losses (decided in `_lowered` alone).  Everything else uses the stages of the device's backend.

Powers are fractions of the sources' power.  Energy is conserved: image + every entry of `lost` = 1.
"""

from __future__ import annotations

import weakref
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from types import MappingProxyType
from typing import cast

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.effects import EFFECTS, NO_REQUESTS, Action, Requests
from caustic_cli.optics.emission import Rays, of_member, rays_of
from caustic_cli.optics.frames import IDENTITY, Pose, advance, rotate_to_global, rotate_to_local, to_global, to_local
from caustic_cli.optics.gradient.fields import IndexField
from caustic_cli.optics.gradient.transfer import index_at, transfer
from caustic_cli.optics.image import Image
from caustic_cli.optics.interaction import Interaction, Parameters
from caustic_cli.optics.interface import interact
from caustic_cli.optics.memory import with_smaller_chunks
from caustic_cli.optics.rays import LOSSES, RayState, Status
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.screen_shape import reach, shape_of
from caustic_cli.optics.surfaces import HeightField, SurfaceIntersection
from caustic_cli.optics.system import EXIT, Element, PlacedScreen, System
from caustic_cli.scene import Aperture, Light, PlaneWave, Points, Scene, Screen

#: Rays per chunk, which bounds the memory.
CHUNK = 1 << 19
#: No parameters at all.
NOTHING: Parameters = MappingProxyType({})


def index_name(element: Element) -> str:
    """Key in `Parameters` of the coefficients of the gradient-index field behind an element."""
    return f"{element.name}.index"


class Tracer:
    """Traces a set of rays through a system: prepared once, then called for any heights.

    Args:
        system: the system.
        rays: on the pupil, in front of the first element: sampled points of a plane wave, or a ray state.
        dtype: precision of the ray arithmetic, where the backend has a choice.  Intersections are always computed in float64.
        requests: of a plan, on effects that the system does not express.
        like: the tracer of the previous chunk through the same system, whose prepared arrays are reused where they are equal.
        weight, channel: fraction of the total power of this light, and its colour channel.
        wavelength: nm, at which the indices of glasses are evaluated; None for the indices of the media.
        track: record the outcome of every ray (`RayState.status`).
    """

    def __init__(
        self,
        system: System,
        rays: Sample | RayState,
        dtype: torch.dtype = torch.float64,
        requests: Requests = NO_REQUESTS,
        like: Tracer | None = None,
        *,
        weight: float = 1.0,
        channel: int | None = None,
        wavelength: float | None = None,
        track: bool = False,
    ):
        self.system, self.requests, self.weight, self.channel, self.track = system, requests, weight, channel, track
        self.media, self.sides = system.media(), system.sides()
        #: Numbers of integration steps by (medium, element, forward), and the parameters for which they were chosen.
        self.steps: dict[tuple[int, int, bool], tuple[int, list]] = {} if like is None else dict(like.steps)
        pupil = system.pupil
        state = rays if isinstance(rays, RayState) else RayState.on_axis(rays, pupil.half_size, pupil.z)
        state = replace(state, lost=dict(state.lost), wavelength=wavelength)
        self.backend = backend_for(state.power.device)
        self.dtype = self.backend.precision(dtype)
        for effect in EFFECTS:
            state = effect.prepare(system, state, requests)
        made = (effect.action(system, requests) for effect in EFFECTS)
        #: Power through the pupil, () or, with colours, (3,).
        shape = state.power.shape if state.sample is None else state.sample.shape
        self.entering = self._of_color(weight * state.power.expand(shape).sum(dtype=torch.float64))
        self.actions: tuple[Action, ...] = tuple(a for a in made if a is not None)
        self.recorded = any(a.stray for a in self.actions)
        self.before: list[Interaction] = []
        self.first = 0
        self._behind: Interaction | None = None
        with torch.no_grad():
            while (
                self.first < len(system.elements)
                and system.elements[self.first].surface.shape is None
                and not any(medium.gradient for medium in self.media[self.first : self.first + 2])
            ):
                interaction = self.trace_element(self.first, state, None)
                if self.recorded:
                    self.before.append(interaction)
                state, self.first, self._behind = interaction.state, self.first + 1, interaction
        self.start = state
        self.fused = None if requests.stages else self._lowered(like)

    def __call__(self, parameters: Parameters) -> list[RayState]:
        """Heights {name: (n, m) mm float64} -> rays behind the last element: the direct light, then stray light."""
        state, interactions = self.start, list(self.before)
        for interaction in self._interactions(parameters):
            state = interaction.state
            if self.recorded:
                interactions.append(interaction)
        states = [state]
        for action in self.actions:
            if action.stray:
                states += action.stray_light(self, parameters, interactions)
        return states

    @cached_property
    def owners(self) -> tuple[int | None, ...]:
        """See `System.owners`."""
        return self.system.owners()

    def _interactions(self, parameters: Parameters) -> Iterator[Interaction]:
        """The sequential trace from the first free surface to the last element."""
        state = self.start
        for k in range(self.first, len(self.system.elements)):
            interaction = self.trace_element(k, state, parameters.get(self.system.elements[k].name), parameters=parameters)
            yield interaction
            state = interaction.state

    def last(self, parameters: Parameters) -> Interaction:
        """The direct light at the last element."""
        return cast(Interaction, [self._behind, *self._interactions(parameters)][-1])  # a system has at least one element

    @torch.no_grad()
    def exit_of(self, parameters: Parameters) -> tuple[tuple, tuple, Tensor]:
        """Rays at a lens' exit in its frame: slopes of the surface, directions in front of it, powers in front of it."""
        exit = next((m for m in self._interactions(parameters) if m.element.name == EXIT), None) or self.last(parameters)
        assert exit.power_in is not None
        return exit.slopes, exit.incoming, exit.power_in

    def land(self, parameters: Parameters, screen: Screen | PlacedScreen) -> list[RayState]:
        """Rays on a screen: x and y of their origins are the screen's coordinates, mm."""
        return [self.onto(state, screen) for state in self(parameters)]

    def expose(self, parameters: Parameters, screen: Screen | PlacedScreen, filter: Filter) -> Image[Tensor]:
        """Heights {name: (n, m) mm float64} -> image and energy balance on a screen."""
        if self.fused is not None and isinstance(screen, Screen) and screen.upright:
            image, leaving, lost = self.fused(parameters[self.system.elements[-1].name], screen, filter)
            for name, value in self.start.lost.items():
                lost[name] = lost.get(name, 0.0) + value
            return self._weighed(image, leaving, lost)
        return self.collect(self(parameters), screen, filter)

    def collect(self, states: list[RayState], screen: Screen | PlacedScreen, filter: Filter) -> Image[Tensor]:
        """Image and energy balance on a screen, from rays behind the last element."""
        image: Tensor | float = 0.0
        leaving: Tensor | float = 0.0
        lost: dict[str, Tensor | float] = {}
        for state in states:
            ray = self.onto(state, screen)
            frame = screen if isinstance(screen, Screen) else screen.screen
            part, off = self.backend.splat(*ray.origin[:2], ray.power, frame, filter)
            assert ray.leaving is not None
            image, leaving = image + part, leaving + ray.leaving
            ray.book("off_screen", off)
            for name, value in ray.lost.items():
                lost[name] = lost.get(name, 0.0) + (value.detach() if isinstance(value, Tensor) else value)
        return self._weighed(cast(Tensor, image), cast(Tensor, leaving), lost)

    def _weighed(self, image: Tensor, leaving: Tensor, lost: dict) -> Image[Tensor]:
        w = self.weight
        if w != 1.0:
            image, leaving, lost = w * image, w * leaving, {name: w * value for name, value in lost.items()}
        return Image(self._of_color(image), self._of_color(leaving), lost, self.start.count)

    def _of_color(self, value: Tensor) -> Tensor:
        """`value` in this light's colour channel of three; unchanged without colours."""
        if self.channel is None:
            return value
        return torch.stack([value if k == self.channel else torch.zeros_like(value) for k in range(3)])

    # One element.

    def trace_element(
        self,
        k: int,
        state: RayState,
        heights: Tensor | None,
        *,
        forward: bool = True,
        direct: bool = True,
        parameters: Parameters = NOTHING,
    ) -> Interaction:
        """Trace rays to element k and through it.

        Args:
            heights: control heights of its surface, None if it has none.
            forward: in the nominal direction of light, or backwards.
            direct: whether this is the nominal path, or stray light.
            parameters: those of gradient-index media, see `index_name`; a medium's own where they are missing.
        """
        element = self.system.elements[k]
        n = [medium.index_at(state.wavelength) for medium in self.media[k : k + 2]]
        n_in, n_out = n if forward else n[::-1]
        side = self.sides[k] if forward else -self.sides[k]
        m = Interaction(
            weakref.proxy(self),  # which refers to the last interaction: a reference cycle would delay the release of its arrays
            k,
            element,
            forward,
            side,
            n_in,
            n_out,
            direct,
            state,
        )
        self._meet(m, heights, parameters)
        for action in self.actions:
            action.before_interaction(m)
        m.power_in = m.state.power
        m.power_out = m.state.power = self._interact(m)
        for action in self.actions:
            action.after_interaction(m)
        return m

    def _meet(self, m: Interaction, heights: Tensor | None, parameters: Parameters) -> None:
        """Ray transfer to the surface of an interaction's element."""
        element = m.element
        ahead, behind = (m.index, m.index + 1) if m.forward else (m.index + 1, m.index)
        if self.media[ahead].gradient is not None:
            self._intersect_through_gradient(m, ahead, heights, parameters)
            self._set_index_behind(m, behind, parameters)
            return
        prepared = self.prepared_intersection if m.state is getattr(self, "start", None) else None  # valid for these rays only
        state = replace(m.state, lost=dict(m.state.lost))
        if m.index == self.first and m.forward and heights is not None:
            state = state.counted_from(element.pose.position[2] + element.surface.centred(heights)[1])
        if self._at_pupil(m):
            state = state if self.media[behind].gradient is None else state.expanded()
            o, d = to_local(element.pose, state.origin, state.direction, state.datum)
            m.state, m.local, m.incoming, m.slopes = state, o, d, (0.0, 0.0)
            self._set_index_behind(m, behind, parameters)
            return
        state = state.expanded()
        o, d = to_local(element.pose, state.origin, state.direction, state.datum)
        if m.index == 0 and m.forward and prepared is None and self.system.lit is None and not element.surface.flat:
            o, state = self._moved_before_surface(o, d, state, element, heights)
        hit = next((h for a in self.actions if (h := a.intersect(m, o, d, heights)) is not None), None)
        if hit is None:
            hit = prepared(heights) if prepared else element.surface.intersect(heights, o, d, m.side)
        if state.power.dtype != self.dtype:  # the first intersection is always computed in float64
            t, gx, gy = (_cast(c, self.dtype) for c in hit[:3])
            state, hit = state.to(self.dtype), SurfaceIntersection(t, gx, gy, hit.found)
            o, d = (tuple(_cast(c, self.dtype) for c in v) for v in (o, d))
        m.local, m.incoming, m.slopes, m.length = advance(o, d, hit.t), d, (hit.gx, hit.gy), hit.t
        aperture, pupil = element.aperture, self.system.pupil
        on_it = prepared is not None and state.sample is not None and aperture == pupil.aperture
        if not on_it:  # a sample of the same aperture lies on the surface
            found = hit.found
            if aperture != Aperture(element.surface.half_size):
                found = found & aperture.contains(*m.local[:2])
            kept = torch.where(found, state.power, torch.zeros_like(state.power))
            state.lose("missed_surface", (state.power - kept).detach())
            if self.track:
                state.mark(~found, Status.MISSED_SURFACE)
            state.power = kept
        state.origin = to_global(element.pose, m.local, state.datum)
        state.path = state.path + m.n_in * hit.t
        m.state = state
        self._set_index_behind(m, behind, parameters)

    def _intersect_through_gradient(self, m: Interaction, medium: int, heights: Tensor | None, parameters: Parameters) -> None:
        """Ray transfer through a gradient-index medium to the surface (`gradient.transfer`)."""
        element, state = m.element, replace(m.state, lost=dict(m.state.lost)).expanded()
        name, pose, field, scale = self._medium(medium, state.wavelength)
        point, direction = (
            tuple(c.double() for c in state.full(v)) for v in to_local(pose, state.origin, state.direction, state.datum)
        )

        def seen(points, vectors):
            o, d = to_global(pose, points, state.datum), rotate_to_global(pose, vectors)
            return to_local(element.pose, o, d, state.datum)

        way, given = (medium, m.index, m.forward), [None if c is None else c.detach() for c in (parameters.get(name), heights)]
        steps, before = self.steps.get(way, (None, given))
        if not all(a is b or (a is not None and b is not None and torch.equal(a, b)) for a, b in zip(given, before, strict=True)):
            steps = None  # the number for other parameters may be too small
        found = transfer(
            self.backend.flow,
            field,
            parameters.get(name),
            point,
            direction,
            element.surface,
            heights,
            seen,
            m.side,
            steps,
        )
        if steps is None:
            self.steps[way] = found.steps, [None if c is None else c.clone() for c in given]
        m.local, m.incoming = seen(found.point, found.direction)
        m.slopes, m.length, m.n_in = found.slopes, found.length, scale * found.n
        met = found.found & element.aperture.contains(*m.local[:2])
        kept = torch.where(met, state.power, torch.zeros_like(state.power))
        state.lose("missed_surface", (state.power - kept).detach())
        if self.track:
            state.mark(~met, Status.MISSED_SURFACE)
        state.power, state.sample = kept, None
        state.origin = to_global(element.pose, m.local, state.datum)
        state.path = state.path + scale * found.path
        m.state = state

    def _set_index_behind(self, m: Interaction, medium: int, parameters: Parameters) -> None:
        """Set the index behind the surface where the medium has a gradient."""
        if self.media[medium].gradient is None or m.reflects:
            return
        state = m.state
        name, pose, field, scale = self._medium(medium, state.wavelength)
        point = to_local(pose, tuple(c.double() for c in state.full(state.origin)), (0.0, 0.0, 1.0), state.datum)[0]
        m.incoming = state.full(m.incoming)
        m.n_out = scale * index_at(self.backend.flow, field, parameters.get(name), point)

    def _medium(self, medium: int, wavelength: float | None) -> tuple[str, Pose, IndexField, float]:
        """Of a gradient-index medium: key of its coefficients, frame, field, and scale factor of the index at this wavelength."""
        owner, is_of = self.owners[medium], self.media[medium]
        assert owner is not None and is_of.gradient is not None
        element = self.system.elements[owner]
        return index_name(element), element.pose, is_of.gradient, is_of.index_at(wavelength) / is_of.index

    def _interact(self, m: Interaction) -> Tensor:
        """Refract or reflect the rays; returns the power behind the surface."""
        state, element, power_in = m.state, m.element, m.power_in
        assert power_in is not None
        polarised = None
        if state.polarised is not None:
            polarised = rotate_to_local(element.pose, state.polarised)
        eta = m.n_in / m.n_out
        found = (self.backend.interact if isinstance(eta, float) else interact)(
            m.incoming,
            m.slopes,
            power_in,
            eta=eta,
            reflects=m.reflects,
            fresnel=element.fresnel,
            polarised=polarised,
            side=m.side,
        )
        m.passes = found.passes
        state.direction = rotate_to_global(element.pose, found.direction)
        if not m.reflects:
            with torch.no_grad():
                gone = power_in - found.power
                if bool(found.passes.all()):
                    state.lose("fresnel", gone)
                else:
                    totally = torch.where(found.passes, torch.zeros_like(gone), gone)
                    state.lose("fresnel", gone - totally)
                    state.lose("total_internal_reflection", totally)
            if self.track:
                state.mark(~found.passes & (power_in > 0), Status.TOTAL_INTERNAL_REFLECTION)
        if not any(isinstance(c, Tensor) for c in state.direction) and state.direction == (0.0, 0.0, 1.0):
            return found.power
        state.sample = None
        return found.power

    def _at_pupil(self, m: Interaction) -> bool:
        """Whether the rays lie on this plane first element already, without any that miss it, as their source emits them."""
        e, pupil, z = m.element, self.system.pupil, m.state.origin[2]
        if m.index or not m.forward or not isinstance(z, float) or z + m.state.datum != pupil.z:
            return False
        return e.surface.flat and e.pose.upright and e.pose.position == (0.0, 0.0, pupil.z) and e.aperture == pupil.aperture

    def _moved_before_surface(self, o, d, state: RayState, element: Element, heights) -> tuple[tuple, RayState]:
        """Rays on a pupil that intersects the first surface, moved back in front of it."""
        low = element.surface.hull(heights)[0]
        back = max(0.0, float(torch.as_tensor(o[2], dtype=torch.float64).max()) - low)
        if back == 0.0:
            return o, state
        way = -back * (1.0 + 1e-9) / d[2]
        moved = (torch.as_tensor(c + way * v, dtype=torch.float64) for c, v in zip(o, d, strict=True))
        path = state.path + self.media[0].index_at(state.wavelength) * way
        return tuple(c.expand(state.power.shape) for c in moved), replace(state, path=path)

    @cached_property
    def prepared_intersection(self):
        """Intersections of the rays `start` with the first free surface as a prepared function of its heights; None if that case is
        not covered."""
        if self.first == len(self.system.elements) or self.requests.off & {"intersection"}:
            return None
        element, start = self.system.elements[self.first], self.start
        surface, pupil = element.surface, self.system.pupil
        if not isinstance(surface, HeightField) or self.sides[self.first] < 0 or not element.pose.upright:
            return None
        if self.first == 0 and self.system.lit is None and start.sample is None:
            return None
        px, py, pz = element.pose.position
        centred = (px, py) == (0.0, 0.0)
        on_axis = start.sample is not None and start.direction == (0.0, 0.0, 1.0)
        if on_axis and centred and surface.half_size == pupil.half_size:
            evaluate = self.backend.spline_on(surface, start.sample, self.dtype)

            def sampled(heights: Tensor) -> SurfaceIntersection:
                sag, gx, gy = evaluate(surface.centred(heights)[0])
                below = start.origin[2] - pz - float(heights.detach().double().mean()) - start.datum
                found = torch.ones((), dtype=torch.bool, device=sag.device).expand(sag.shape)
                return SurfaceIntersection(sag - below, gx, gy, found)

            return sampled
        spread = start.expanded()
        full = spread.full((*spread.origin, *spread.direction))
        origin = (full[0] - px, full[1] - py, full[2] + (start.datum - pz))
        return self.backend.intersect_fixed(surface, origin, full[3:])

    def _lowered(self, like: Tracer | None):
        """The rest of the system as one fused kernel, a function of heights, screen and filter; None where it does not apply."""
        if any(medium.gradient for medium in self.media):
            return None
        if self.first != len(self.system.elements) - 1 or self.actions or self.track or self.start.polarised is not None:
            return None
        element = self.system.elements[-1]
        surface, start, m = element.surface, self.start, self.media
        plain = (
            isinstance(surface, HeightField)
            and not element.reflects
            and element.pose == Pose()
            and self.sides[-1] > 0
            and element.aperture.half_size == surface.half_size
            and isinstance(start.origin[2], float)
            and self.system.pupil.half_size == surface.half_size
            and (self.system.lit is not None or self.first > 0)
        )
        if not plain:
            return None
        eta = m[-2].index_at(start.wavelength) / m[-1].index_at(start.wavelength)
        if element.fresnel == "schlick" and eta < 1.0:  # the fused kernels use the cosine behind the surface
            return None
        if start.along_axis and element.aperture != self.system.pupil.aperture:
            return None
        before = None if like is None else like.fused
        if start.along_axis:
            return self.backend.plane_image(surface, start, eta, element.fresnel, before)
        return self.backend.ray_image(surface, start, eta, element.fresnel, element.aperture.radius, before)

    def onto(self, state: RayState, screen: Screen | PlacedScreen) -> RayState:
        """Ray transfer to a screen; x and y of the origins are then the screen's coordinates, mm."""
        state = state.expanded()
        if isinstance(screen, Screen) and self.system.leg is not None:
            screen = self.system.placed(screen)
        frame = screen if isinstance(screen, Screen) else screen.screen
        (sx, sy), shape = frame.shift, shape_of(frame)
        if isinstance(screen, PlacedScreen):
            axes, middle = screen.pose.axes, screen.pose.position
            if shape is not None:  # defined relative to the screen's centre
                px, py, pz = (m + sx * a + sy * b for m, a, b in zip(middle, *axes[:2], strict=True))
                middle = (px, py, pz)
        else:
            axes = IDENTITY if screen.upright else screen.axes
            middle = (0.0, 0.0, screen.z) if screen.upright else (sx, sy, screen.z)
        point = (middle[0], middle[1], middle[2] - state.datum)
        along = sum(a * b for a, b in zip(self.system.axis, axes[2], strict=True))
        land = self.backend.land if shape is None else shape.land
        x, y, on_way = land(state.origin, state.direction, point, axes, 1.0 if along >= 0 else -1.0)
        if shape is not None or (isinstance(screen, Screen) and not screen.upright):
            x, y = x + sx, y + sy
        weight = torch.where(on_way, state.power, torch.zeros_like(state.power))
        out = replace(state, origin=(x, y, 0.0), power=weight, lost=dict(state.lost), leaving=state.power.sum(dtype=torch.float64))
        out.lose("off_screen", (state.power - weight).detach())
        if self.track:
            out.mark(~on_way, Status.AWAY_FROM_SCREEN)
        return out


def _cast(value, dtype: torch.dtype):
    return value.to(dtype) if isinstance(value, Tensor) else value


def is_lowered(scene: Scene, field: HeightField, requests: Requests = NO_REQUESTS) -> bool:
    """Whether a scene is traced by a fused kernel."""
    few = next(iter(rays_of(scene, "grid", 4).chunks()))
    return scene.screen.upright and Tracer(System.of(scene, field), few, requests=requests).fused is not None


def warm_up(scene: Scene, requests: Requests = NO_REQUESTS, gradient: bool = False) -> None:
    """Trace a few rays of a scene, so that all kernels that it needs are compiled.

    Net and image are small, and a plane wave or a point represents the source.  gradient: compile the adjoints, too.
    """
    lens = replace(scene.lens, control=(4, 4), degree=(3, 3), knots=None, array=(1, 1))
    source = PlaneWave() if scene.source.collimated else Points(((0.0, 0.0, lens.z_in - 5.0 * max(lens.size)),))
    scene, field = Scene(source, lens, scene.screen, Light(scene.light.polarisation)), HeightField.of(lens)
    heights = torch.full((4, 4), lens.offset.thickness, dtype=torch.float64, requires_grad=gradient)
    screen = replace(scene.screen, resolution=(4, 4))
    with torch.set_grad_enabled(gradient):
        for kind in ("lines", "stratified") if scene.source.collimated else ("stratified",):
            traced = next(tracers(scene, field, rays_of(scene, kind, 16), torch.float64, 1 << 10, requests))
            image = traced.expose({EXIT: heights}, screen, Filter("cosine", (3, 3)))
            if gradient:
                (image.image.sum() + image.leaving.sum()).backward()


def trace(system: System, rays: Sample | RayState, parameters: Parameters, **options) -> list[RayState]:
    """Rays behind the last element of a system: the direct light, then stray light.  options: of a `Tracer`."""
    return Tracer(system, rays, **options)(parameters)


def tracers(
    scene: Scene,
    field: HeightField,
    sampler: Rays,
    dtype: torch.dtype,
    chunk: int,
    requests: Requests = NO_REQUESTS,
    part: tuple[int, int] = (0, 1),
    **options,
) -> Iterator[Tracer]:
    """Tracers of all rays of a sampler through a scene, chunk by chunk, band by band.

    part: (k, n) takes every n-th chunk from number k on, the share of one of n processes.
    """
    bands = scene.bands
    for band in bands:
        system, traced = System.of(band.scene, field), None
        for rays in of_member(sampler, band.member).chunks(chunk, *part):
            traced = Tracer(system, rays, dtype, requests, traced, weight=band.weight, channel=band.channel, **options)
            yield traced


def expose(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    sampler: Rays,
    filter: Filter | None = None,
    dtype: torch.dtype = torch.float64,
    screen: Screen | None = None,
    chunk: int = CHUNK,
    requests: Requests = NO_REQUESTS,
) -> Image[float]:
    """The image of a scene: all rays of a sampler, traced and accumulated.

    Chunks are accumulated in float64, so neither memory nor rounding errors grow with the number of rays.  Smaller chunks are used
    if memory runs out.

    Raises:
        InputError: the surface reaches the screen.
        CausticError: out of memory.
    """
    screen, filter = screen or scene.screen, filter or Filter()
    heights = heights.detach().to(sampler.device, torch.float64)
    check_clearance(scene, heights, screen)
    shape = (3, *screen.resolution) if scene.colored else screen.resolution

    def traced_by(size: int) -> Image[float]:
        parts = tracers(scene, field, sampler, dtype, size, requests)
        return _total(parts, {EXIT: heights}, [screen], [shape], filter, sampler.count, sampler.device)[0]

    return with_smaller_chunks(traced_by, chunk)


def render(
    system: System,
    parameters: Parameters,
    rays: int,
    filter: Filter | None = None,
    *,
    kind: str = "stratified",
    seed: int = 0,
    device: str | torch.device = "cpu",
    dtype: torch.dtype = torch.float64,
    chunk: int = CHUNK,
    requests: Requests = NO_REQUESTS,
) -> list[Image[float]]:
    """The image on every screen of a system, from about `rays` rays of every source at every wavelength.

    Args:
        parameters: heights {name: (n, m) mm} of all free-form surfaces.
        kind: sampler, see `sampling`.

    Raises:
        InputError: heights are missing, unknown or of the wrong shape.
        CausticError: out of memory.
    """
    shapes = {name: tuple(heights.shape) for name, heights in parameters.items()}
    if shapes != system.free:
        raise InputError(f"a system's heights must be {system.free}, got {shapes}")
    parameters = {name: heights.detach().to(device, torch.float64) for name, heights in parameters.items()}
    samplers = [rays_of(system.with_source(s), kind, rays, seed, device) for s in system.sources]
    screens = [s.screen if isinstance(s, PlacedScreen) else s for s in system.screens]

    def traced_by(size: int) -> list[Image[float]]:
        parts = (
            t
            for sampler, part in zip(samplers, system.parts, strict=True)
            for t in system_tracers(system, sampler, part, dtype, size, requests)
        )
        return _total(
            parts,
            parameters,
            system.screens,
            [s.resolution for s in screens],
            filter or Filter(),
            sum(s.count for s in samplers),
            device,
        )

    return with_smaller_chunks(traced_by, chunk)


def system_tracers(
    system: System, sampler: Rays, part: float, dtype: torch.dtype, chunk: int, requests: Requests = NO_REQUESTS
) -> Iterator[Tracer]:
    """Tracers of all rays of one source, with the fraction `part` of the total power, at every wavelength, chunk by chunk."""
    lines = zip(system.light.wavelengths, system.light.parts, strict=True) if system.light.wavelengths else [(None, 1.0)]
    for wavelength, weight in lines:
        traced = None
        for rays in sampler.chunks(chunk):
            traced = Tracer(system, rays, dtype, requests, traced, weight=part * weight, wavelength=wavelength)
            yield traced


def _total(
    parts: Iterator[Tracer], parameters: Parameters, screens, shapes, filter: Filter, rays: int, device: str | torch.device
) -> list[Image[float]]:
    """Sums over tracers, without derivatives: an image for each screen, from one trace of the rays."""
    images = [torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes]
    accounts, leaving = [dict.fromkeys(LOSSES, 0.0) for _ in screens], [0.0] * len(images)
    with torch.no_grad():
        for traced in parts:
            states = traced(parameters) if len(images) > 1 else None
            for k, screen in enumerate(screens):
                part = traced.expose(parameters, screen, filter) if states is None else traced.collect(states, screen, filter)
                images[k] += part.image
                leaving[k] += float(part.leaving.sum())
                for name, value in part.lost.items():
                    accounts[k][name] += float(value)
    return [Image(*of, rays) for of in zip(images, leaving, accounts, strict=True)]


def check_clearance(scene: Scene, heights: Tensor, screen: Screen) -> None:
    """Check that the surface does not reach the screen, including the corners of a tilted or curved one.

    Raises:
        InputError: giving the extreme height of the surface.
    """
    lens, side = scene.lens, scene.lens.interaction.side
    nearer = max(-side * bound for bound in reach(screen))
    lean = f" and its {'shape' if screen.curved else 'tilt'} takes it {nearer:.4g} mm nearer" if nearer else ""
    top = side * float((side * heights).max())
    if side * (screen.z - top) <= nearer:
        raise InputError(
            f"⟨screen.z⟩ must lie {lens.interaction.beyond} the {lens.kind}, whose surface reaches {top:.6g} mm,"
            f" got {screen.z:g} mm{lean}"
        )
