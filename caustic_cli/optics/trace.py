"""Sequential ray tracing from the sources to the screens (thesis 4.3.1).

    trace(system, rays, {surface name: heights}) = fold over the elements of
        carry -> before_interaction -> interact -> after_interaction
    image = splat(land(trace(...)))

    carry                ray transfer through the medium to the element's surface
    before_interaction   effects on the path and at the surface: absorption, roughness
    interact             refraction with Fresnel losses, or reflection by a mirror
    after_interaction    effects behind the surface
    stray light          non-sequential paths, traced afterwards: ghosts, secondary intersections

Elements in front of the first free-form surface do not depend on heights and are traced once, when a `Tracer` is constructed.  The
rest is *lowered* to one fused kernel where there is one for it (decided in `lowering` alone).  Everything else uses the stages of
the device's backend.  Media carry the rays from surface to surface (`media`).

Powers are fractions of the sources' power.  Energy is conserved: image + every entry of `lost` = 1.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import repeat
from types import MappingProxyType
from typing import cast

import torch
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.optics.backends import Fused, backend_for, in_forward_mode, usable
from caustic_cli.optics.effects import EFFECTS, NO_REQUESTS, Action, Requests
from caustic_cli.optics.emission import Emission, Rays, of_member, rays_of
from caustic_cli.optics.frames import rotate_to_global, rotate_to_local
from caustic_cli.optics.image import Image, with_colour
from caustic_cli.optics.interaction import Interaction, Parameters
from caustic_cli.optics.interface import OutgoingRays, interact
from caustic_cli.optics.lowering import covers, lowered
from caustic_cli.optics.memory import with_smaller_chunks
from caustic_cli.optics.pencil import Bundle
from caustic_cli.optics.ray_transfer import prepared_intersection
from caustic_cli.optics.rays import LOSSES, RayState, RayStatus
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.reconstruction import Filter
from caustic_cli.optics.sampling import Sample
from caustic_cli.optics.screen_shape import reach
from caustic_cli.optics.surfaces import HeightField, SurfaceIntersection
from caustic_cli.optics.system import EXIT, Element, PlacedScreen, System
from caustic_cli.scene import Scene, Screen

#: Rays per chunk, which bounds the memory.
CHUNK = 1 << 19
#: Rays by which the treatment of all is decided.
FEW = 1 << 12
#: No parameters at all.
NOTHING: Parameters = MappingProxyType({})


@dataclass(frozen=True)
class Front:
    """Rays in front of the first free-form surface, and how they got there."""

    #: The rays, and the index of the first element that they have not met.
    start: RayState
    first: int
    #: All interactions, if they are recorded, and the last.
    interactions: list[Interaction]
    behind: Interaction | None
    #: Power through the pupil, ().
    entering: Tensor


class Tracer:
    """Traces a set of rays through a system: prepared once, then called for any heights.

    Args:
        system: the system.
        rays: on the pupil, in front of the first element: sampled points of a plane wave, or a ray state; or a pencil, which is
            traced from there unless it can be lowered.
        dtype: precision of the ray arithmetic, where the backend has a choice.  Intersections are always computed in float64.
        requests: of a plan, on effects that the system does not express.
        like: the tracer of the previous chunk through the same system, whose prepared arrays are reused where they are equal.
        weight, channel: fraction of the total power of this light, and its colour channel.
        wavelength: nm, at which the indices of glasses are evaluated; None for the indices of the media.
        track: record the outcome of every ray (`RayState.status`), and its way (`interactions`).
    """

    def __init__(
        self,
        system: System,
        rays: Sample | RayState | Bundle,
        dtype: torch.dtype = torch.float64,
        requests: Requests = NO_REQUESTS,
        like: Tracer | None = None,
        *,
        weight: float = 1.0,
        channel: int | None = None,
        wavelength: float | None = None,
        track: bool = False,
    ):
        self.system, self.requests, self.weight, self.track = system, requests, weight, track
        self.channel = channel
        #: As of a `scene.Band`.
        self.colour: tuple[float, float, float] | None = None
        self.media, self.sides = system.media(), system.sides()
        #: Of gradient-index media: numbers of integration steps by (medium, element, forward), with the parameters they are for.
        self.steps: dict[tuple[int, int, bool], tuple[int, list]] = {} if like is None else dict(like.steps)
        self.rays, self.wavelength = rays, wavelength
        self._backend = backend_for(rays.power.device if isinstance(rays, RayState) else rays.device)
        self._prepared: dict[str, Callable[[Tensor], SurfaceIntersection] | None] = {}
        self.dtype = self._backend.precision(dtype)
        self._acting = EFFECTS.acting(system, requests)
        made = (effect.action(system, requests) for effect in self._acting)
        self.actions: tuple[Action, ...] = tuple(a for a in made if a is not None)
        self.recorded = track or any(a.stray for a in self.actions)
        self.fused: Fused | None = lowered(self, None if like is None else like.fused)
        #: Power through the pupil, (), where a fused pencil knows it without a trace of the rays in front of the lens.
        self.lit: Tensor | None = getattr(self.fused, "entering", None)
        #: Power through the pupil, () or, with colours, (3,).
        self.entering = self.of_color(weight * (self._front.entering if self.lit is None else self.lit))

    @cached_property
    def _front(self) -> Front:
        """The trace up to the first free-form surface, made when it is first asked for."""
        system, state = self.system, self.emitted
        state = replace(state, lost=dict(state.lost), wavelength=self.wavelength)
        for effect in self._acting:
            state = effect.prepare(system, state, self.requests)
        shape = state.power.shape if state.sample is None else state.sample.shape
        entering = state.power.expand(shape).sum(dtype=torch.float64)
        interactions, first, behind = [], 0, None
        with torch.no_grad():
            while (
                first < len(system.elements)
                and system.elements[first].surface.shape is None
                and not any(medium.varies for medium in self.media[first : first + 2])
            ):
                behind = self.trace_element(first, state, None)
                if self.recorded:
                    interactions.append(behind)
                state, first = behind.state, first + 1
        return Front(state, first, interactions, behind, entering)

    @property
    def emitted(self) -> RayState:
        """The rays in front of the first element."""
        rays, pupil = self.rays, self.system.pupil
        state = rays.at_pupil() if isinstance(rays, Bundle) else rays
        return state if isinstance(state, RayState) else RayState.on_axis(state, pupil.half_size, pupil.z)

    @property
    def start(self) -> RayState:
        """The rays in front of the first free-form surface."""
        return self._front.start

    @property
    def begun(self) -> RayState | None:
        """`start`, or None while it is being made."""
        front = self.__dict__.get("_front")
        return None if front is None else front.start

    @property
    def first(self) -> int:
        """Index of the first element that `start` has not met."""
        return self._front.first

    @property
    def count(self) -> int:
        """Number of rays."""
        return self.rays.count

    def __call__(self, parameters: Parameters) -> list[RayState]:
        """Heights {name: (n, m) mm float64} -> rays behind the last element: the direct light, then stray light."""
        state, interactions = self.start, list(self._front.interactions)
        for interaction in self._interactions(parameters):
            state = interaction.state
            if self.recorded:
                interactions.append(interaction)
        states = [state]
        for action in self.actions:
            if action.stray:
                states += action.stray_light(self, parameters, interactions)
        return states

    def owner(self, medium: int) -> Element:
        """The element in front of a medium, by its number."""
        owner = self._owners[medium]
        assert owner is not None
        return self.system.elements[owner]

    @cached_property
    def _owners(self) -> tuple[int | None, ...]:
        return self.system.owners()

    @property
    def backend(self):
        """The implementation of the stages: in forward mode the reference."""
        return usable(self._backend)

    @property
    def prepared_intersection(self) -> Callable[[Tensor], SurfaceIntersection] | None:
        """See `ray_transfer.prepared_intersection`; made once by each backend."""
        name = self.backend.name
        if name not in self._prepared:
            self._prepared[name] = prepared_intersection(self)
        return self._prepared[name]

    def _interactions(self, parameters: Parameters) -> Iterator[Interaction]:
        """The sequential trace from the first free surface to the last element."""
        state = self.start
        for k in range(self.first, len(self.system.elements)):
            interaction = self.trace_element(k, state, parameters.get(self.system.elements[k].name), parameters=parameters)
            yield interaction
            state = interaction.state

    def interactions(self, parameters: Parameters) -> list[Interaction]:
        """The direct light at every element; only of a tracer that tracks its rays."""
        return [*self._front.interactions, *self._interactions(parameters)]

    def at(self, name: str, parameters: Parameters) -> Interaction:
        """The direct light at the element of this name, behind the first free-form surface; nothing behind it is traced."""
        return next(m for m in self._interactions(parameters) if m.element.name == name)

    def last(self, parameters: Parameters) -> Interaction:
        """The direct light at the last element."""
        return cast(Interaction, [self._front.behind, *self._interactions(parameters)][-1])  # a system has at least one element

    def ends(self, parameters: Parameters) -> tuple[Interaction, Interaction]:
        """The direct light at a lens' exit, at the last element if there is none, and at the last element."""
        exit, last = None, self._front.behind
        for last in self._interactions(parameters):
            exit = last if last.element.name == EXIT else exit
        assert last is not None  # a system has at least one element
        return exit or last, last

    @torch.no_grad()
    def exit_of(self, parameters: Parameters) -> tuple[tuple, tuple, Tensor]:
        """Rays at a lens' exit in its frame: slopes of the surface, directions in front of it, powers in front of it."""
        exit, _ = self.ends(parameters)
        assert exit.power_in is not None
        return exit.hit.slopes, exit.hit.incoming, exit.power_in

    def land(self, parameters: Parameters, screen: Screen | PlacedScreen) -> list[RayState]:
        """Rays on a screen: x and y of their origins are the screen's coordinates, mm."""
        return [self.onto(state, screen) for state in self(parameters)]

    def onto(self, state: RayState, screen: Screen | PlacedScreen) -> RayState:
        """Ray transfer to a screen; x and y of the origins are then the screen's coordinates, mm."""
        return self._land(state, Receiver.of(self.system, screen))

    def _land(self, state: RayState, receiver: Receiver) -> RayState:
        ray, arrives = receiver.land(self.backend, state)
        if self.track:
            ray.mark(~arrives, RayStatus.AWAY_FROM_SCREEN)
        return ray

    def expose(self, parameters: Parameters, screen: Screen | PlacedScreen, filter: Filter) -> Image[Tensor]:
        """Heights {name: (n, m) mm float64} -> image and energy balance on a screen."""
        if self.fused is not None and covers(screen, self.fused) and not in_forward_mode():
            image, leaving, lost = self.fused(parameters[self.system.elements[-1].name], screen, filter)
            if self.lit is None:
                for name, value in self.start.lost.items():
                    lost[name] = lost.get(name, 0.0) + value
            return self._weighed(image, leaving, lost)
        return self.collect(self(parameters), screen, filter)

    def collect(self, states: list[RayState], screen: Screen | PlacedScreen, filter: Filter) -> Image[Tensor]:
        """Image and energy balance on a screen, from rays behind the last element."""
        image: Tensor | float = 0.0
        leaving: Tensor | float = 0.0
        lost: dict[str, Tensor | float] = {}
        receiver = Receiver.of(self.system, screen)
        for state in states:
            ray = self._land(state, receiver)
            splat, off = self.backend.splat(*ray.origin[:2], ray.power, receiver.screen, filter)
            assert ray.leaving is not None
            image, leaving = image + splat, leaving + ray.leaving
            ray.book("off_screen", off)
            for name, value in ray.lost.items():
                lost[name] = lost.get(name, 0.0) + (value.detach() if isinstance(value, Tensor) else value)
        return self._weighed(cast(Tensor, image), cast(Tensor, leaving), lost)

    def _weighed(self, image: Tensor, leaving: Tensor, lost: dict) -> Image[Tensor]:
        w = self.weight
        if w != 1.0:
            image, leaving, lost = w * image, w * leaving, {name: w * value for name, value in lost.items()}
        return Image(self.of_color(image), self.of_color(leaving), lost, self.count)

    def of_color(self, value: Tensor) -> Tensor:
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
        below, above = (medium.index_at(state.wavelength) for medium in self.media[k : k + 2])
        proxy = weakref.proxy(self)  # it refers to the last interaction: a reference cycle would delay the release of its arrays
        m = Interaction(proxy, k, forward, direct, state, *((below, above) if forward else (above, below)))
        self.media[m.ahead].carry(self, m, heights, parameters)
        self.media[m.beyond].receive(self, m, parameters)
        for action in self.actions:
            action.before_interaction(m)
        m.power_in = m.state.power
        m.out = self._interact(m)
        m.state.power = m.out.power
        for action in self.actions:
            action.after_interaction(m)
        return m

    def keep(self, state: RayState, hits: Tensor) -> None:
        """Keep the rays that meet a surface, the `hits`, and count the power of the others as lost."""
        kept = torch.where(hits, state.power, torch.zeros_like(state.power))
        state.lose("missed_surface", (state.power - kept).detach())
        if self.track:
            state.mark(~hits, RayStatus.MISSED_SURFACE)
        state.power = kept

    def _interact(self, m: Interaction) -> OutgoingRays:
        """Refract or reflect the rays."""
        state, element, power_in = m.state, m.element, m.power_in
        assert power_in is not None
        polarised = None
        if state.polarised is not None:
            polarised = rotate_to_local(element.pose, state.polarised)
        eta = m.n_in / m.n_out
        outgoing = (self.backend.interact if isinstance(eta, float) else interact)(
            m.hit.incoming,
            m.hit.slopes,
            power_in,
            eta=eta,
            reflects=m.reflects,
            fresnel=element.fresnel,
            polarised=polarised,
            side=m.side,
        )
        state.direction = rotate_to_global(element.pose, outgoing.direction)
        if not m.reflects:
            with torch.no_grad():
                lost = power_in - outgoing.power
                if bool(outgoing.passes.all()):
                    state.lose("fresnel", lost)
                else:
                    totally = torch.where(outgoing.passes, torch.zeros_like(lost), lost)
                    state.lose("fresnel", lost - totally)
                    state.lose("total_internal_reflection", totally)
            if self.track:
                state.mark(~outgoing.passes & (power_in > 0), RayStatus.TOTAL_INTERNAL_REFLECTION)
        if any(isinstance(c, Tensor) for c in state.direction) or state.direction != (0.0, 0.0, 1.0):
            state.sample = None
        return outgoing


def is_lowered(scene: Scene, field: HeightField, requests: Requests = NO_REQUESTS) -> bool:
    """Whether a scene is traced by a fused kernel."""
    few = next(tracers(scene, field, rays_of(scene, "grid", 4), torch.float64, FEW, requests))
    return covers(scene.screen, few.fused)


def is_by_rows(scene: Scene, field: HeightField, rays: Rays, onto: Screen | None = None) -> bool:
    """Whether rays are traced by a fused kernel that evaluates the surface at a tensor product of its points; onto: and splats onto
    this screen."""
    first = next(tracers(scene, field, rays, torch.float64, FEW), None)
    if first is None or first.fused is None or (onto is not None and not covers(onto, first.fused)):
        return False
    return first.rays.sample.tensor if isinstance(first.rays, Bundle) and first.lit is not None else first.start.along_axis


def evaluates_by_rows(scene: Scene) -> bool:
    """Whether a regular grid of rays of a scene's source is traced in this way, whatever the surface."""
    p, q = scene.lens.degree
    lens = replace(scene.lens, control=(p + 1, q + 1), knots=None, array=(1, 1))
    scene = replace(scene, lens=lens)
    return is_by_rows(scene, HeightField.of(lens), rays_of(scene, "grid", 4))


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
    **options,
) -> Iterator[Tracer]:
    """Tracers of all rays of a sampler through a scene, chunk by chunk, band by band."""
    return (made for made in dealt_tracers(scene, field, sampler, dtype, chunk, requests, **options) if made is not None)


def dealt_tracers(
    scene: Scene,
    field: HeightField,
    sampler: Rays,
    dtype: torch.dtype,
    chunk: int,
    requests: Requests = NO_REQUESTS,
    own: Iterator[bool] | None = None,
    **options,
) -> Iterator[Tracer | None]:
    """The same, with None for chunks that are not this process's own, of which one item is taken for each chunk."""
    mine = repeat(True) if own is None else own
    for band in scene.bands:
        system, traced = System.of(band.scene, field), None
        for rays, wanted in zip(_chunks(of_member(sampler, band.member), chunk), mine, strict=False):
            if not wanted:
                yield None
                continue
            traced = Tracer(system, rays, dtype, requests, traced, weight=band.weight, channel=band.channel, **options)
            traced.colour = band.colour
            yield traced


def _chunks(sampler: Rays, size: int) -> Iterator[Sample | RayState | Bundle]:
    """The rays of a sampler, as pencils where they are."""
    if isinstance(sampler, Emission) and sampler.homocentric:
        return sampler.pencils(size)
    return sampler.chunks(size)


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
    shape = (*scene.light.planes, *screen.resolution)

    def traced_by(size: int) -> Image[float]:
        chunks = tracers(scene, field, sampler, dtype, size, requests)
        return _total(chunks, {EXIT: heights}, [screen], [shape], filter, sampler.count, sampler.device)[0]

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
    if shapes != system.shapes:
        raise InputError(f"a system's heights must be {system.shapes}, got {shapes}")
    parameters = {name: heights.detach().to(device, torch.float64) for name, heights in parameters.items()}
    samplers = [rays_of(system.with_source(s), kind, rays, seed, device) for s in system.sources]
    screens = [s.screen if isinstance(s, PlacedScreen) else s for s in system.screens]

    def traced_by(size: int) -> list[Image[float]]:
        chunks = (
            t
            for sampler, fraction in zip(samplers, system.fractions, strict=True)
            for t in system_tracers(system, sampler, fraction, dtype, size, requests)
        )
        return _total(
            chunks,
            parameters,
            system.screens,
            [s.resolution for s in screens],
            filter or Filter(),
            sum(s.count for s in samplers),
            device,
        )

    return with_smaller_chunks(traced_by, chunk)


def system_tracers(
    system: System, sampler: Rays, fraction: float, dtype: torch.dtype, chunk: int, requests: Requests = NO_REQUESTS
) -> Iterator[Tracer]:
    """Tracers of all rays of one source, with this fraction of the total power, at every wavelength, chunk by chunk."""
    lines = zip(system.light.wavelengths, system.light.fractions, strict=True) if system.light.wavelengths else [(None, 1.0)]
    for wavelength, weight in lines:
        traced = None
        for rays in sampler.chunks(chunk):
            traced = Tracer(system, rays, dtype, requests, traced, weight=fraction * weight, wavelength=wavelength)
            yield traced


def _total(
    chunks: Iterator[Tracer], parameters: Parameters, screens, shapes, filter: Filter, rays: int, device: str | torch.device
) -> list[Image[float]]:
    """Sums over tracers, without derivatives: an image for each screen, from one trace of the rays."""
    images = [torch.zeros(shape, dtype=torch.float64, device=device) for shape in shapes]
    accounts, leaving = [dict.fromkeys(LOSSES, 0.0) for _ in screens], [0.0] * len(images)
    coloured: list[Tensor | None] = [None] * len(images)
    with torch.no_grad():
        for traced in chunks:
            states = traced(parameters) if len(images) > 1 else None
            for k, screen in enumerate(screens):
                exposure = traced.expose(parameters, screen, filter) if states is None else traced.collect(states, screen, filter)
                images[k] += exposure.image
                coloured[k] = with_colour(coloured[k], exposure.image, traced.colour)
                leaving[k] += float(exposure.leaving.sum())
                for name, value in exposure.lost.items():
                    accounts[k][name] += float(value)
    parts = zip(images, leaving, accounts, coloured, strict=True)
    return [Image(image, behind, lost, rays, xyz) for image, behind, lost, xyz in parts]


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
