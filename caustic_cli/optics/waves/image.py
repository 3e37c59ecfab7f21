"""The wave image: irradiance on a screen including diffraction.

Wavelengths and source points are mutually incoherent, so their irradiances are added.  If an extended source only shifts the image
of its centre, within a fraction of the resolution, its image is that of the centre convolved with the point-spread function of the
source; otherwise the source is represented by several points, each with the point-spread function of its part.

Fresnel losses, absorption, dispersion and polarisation are included.  Stray light (ghosts, secondary intersections) and surface
roughness are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import torch
from torch import Tensor

from caustic_cli.optics.backends import backend_for
from caustic_cli.optics.emission.coherent import Mode, central_mode, modes, outermost_modes, spots
from caustic_cli.optics.image import with_colour
from caustic_cli.optics.interaction import Parameters
from caustic_cli.optics.pullback import pull_back
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.spread import Convolution, Spread, in_parts
from caustic_cli.optics.surfaces import HeightField
from caustic_cli.optics.system import EXIT, PlacedScreen, System
from caustic_cli.optics.waves.planes import PlanesExposure, power_by_planes
from caustic_cli.optics.waves.propagation import (
    TURN,
    Exposure,
    PrunedExposure,
    cells,
    phase_of,
    pixel_edges,
    power_by_blocks,
    power_on_pixels,
    pruning_pays,
)
from caustic_cli.optics.waves.sampling import Sampling, memory_free
from caustic_cli.optics.waves.unsupported import NoWaveImage, receiver_of, refuse_without_image
from caustic_cli.optics.waves.wavefront import Optics, Survey, Wavefront, device_of, survey, wavefront
from caustic_cli.scene import Light, Scene, Screen, Source
from caustic_cli.scene.materials import nearest_index

NM = 1e-6
#: Transform samples per second on two cores; largest number of samples of a wave image that was not requested explicitly.
A_SECOND, UNASKED = 1e8, 120e8
#: Most samples of a transform that is computed whole, with about 50 bytes each; others are by blocks, of which one sample takes as
#: long as so many (22,000 x 22,000: 26 s).
WHOLE, BY_BLOCKS = 1 << 24, 5.0
#: Least number of samples of the field per knot span of the finest surface: its finest structure sends light aside, which would
#: otherwise be aliased into the picture.
SAMPLES_A_SPAN = 2
#: Traced nodes per knot span of the finest surface, and their least number along an axis.
A_SPAN, LEAST_NODES = 3, 384
#: Largest margin of the computed region on each side of the screen, relative to the screen's width.
BESIDE = 0.5
#: Margin of the computed region beyond the landing points of rays, in diffraction blurs.
BLURS = 2.0
#: Most light of a wave image over that which leaves the lens; the sum over the samples of smooth wavefronts is within 1 % of it.
MOST_LIGHT = 1.1

#: Height perturbation of a surface: points (N,) mm -> additional height, mm.
Perturbation = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Line:
    """One spectral line: wavelength, nm; fraction of the power; the system at this wavelength; label, the wavelength at which media
    are evaluated (None if the system has the indices already); the channel of a coloured image; the colour of the light that it
    represents, as of `scene.Band`; and of a continuous spectrum the half of its wavelengths that it belongs to, of which every
    second one is in the other."""

    wavelength: float
    part: float
    system: System
    label: float | None = None
    channel: int | None = None
    colour: tuple[float, float, float] | None = None
    half: int | None = None

    @property
    def length(self) -> float:
        """The wavelength in vacuum, mm."""
        return self.wavelength * NM

    @property
    def behind(self) -> float:
        """The wavelength in the image space, the medium in front of the screen, mm."""
        return self.length / self.system.media()[-1].index_at(self.label)


@dataclass(frozen=True)
class WaveImage:
    """Power on pixels (n_x, n_y), or (3, n_x, n_y) with colours, as fractions of the source's power.

    image: float64, differentiable if the heights were; leaving: power behind the system; off_screen: power outside the pixels;
    wavelengths: nm; points: number of source points; spread_error: displacement error of the point-spread approximation, mm;
    samples: of the largest transform along each axis; xyz: tristimulus values, as of `optics.image.Image`; halves: the images of
    either half of the wavelengths that represent a continuous spectrum, of which it is the sum; None for spectral lines.
    """

    image: Tensor
    leaving: float
    off_screen: float
    wavelengths: tuple[float, ...]
    points: int
    spread_error: float
    samples: tuple[int, int]
    xyz: Tensor | None = None
    halves: tuple[Tensor, Tensor] | None = None


def lines_of(scene: Scene, field: HeightField, wavelengths: tuple[float, ...] | None = None) -> list[Line]:
    """Spectral lines of a scene, by wavelength and polarisation: its own, those that represent its continuous spectrum, or those
    at the given wavelengths, see `Light.lines`; of several sources only those with a continuous spectrum take the given ones.

    Raises:
        NoWaveImage: the scene has none.
    """
    refuse_without_image(scene)
    scene = scene.unfolded
    if len(scene.source.members) > 1:
        return [
            replace(line, part=fraction * line.part)
            for one, fraction in zip(scene.by_source, scene.source.fractions, strict=True)
            for line in lines_of(one, field, wavelengths if one.light.continuum is not None else None)
        ]
    found, systems = [], {}
    continuous = scene.light.continuum is not None
    given, parts = scene.light.lines(wavelengths or ())
    channels = scene.light.channels if given is scene.light.wavelengths else (None,) * len(given)
    states = scene.light.states
    of_each = zip(given, parts, channels, scene.light.colours_of(given), strict=True)
    for k, (wavelength, part, channel, colour) in enumerate(of_each):
        lens, label = replace(scene.lens, roughness=0.0), None
        if (glass := lens.interior.glass) is not None and lens.gradient is not None:
            label = wavelength  # its medium scales the whole field
        elif glass is not None:
            lens = replace(lens, index=nearest_index(glass, wavelength))
        elements = tuple(e.at(wavelength) for e in scene.elements)
        indices = (lens.index, *(e.index for e in elements))
        for state in states:
            if (indices, state) not in systems:  # light of the same indices and polarisation takes the same paths
                one = replace(scene, lens=lens, elements=elements, light=Light(state))
                systems[indices, state] = System.of(one, field)
            found.append(
                Line(wavelength, part / len(states), systems[indices, state], label, channel, colour, k % 2 if continuous else None)
            )
    return found


def wave_image(
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    *,
    wavelengths: tuple[float, ...] | None = None,
    screen: Screen | None = None,
    finer: float = 1.0,
    dtype: torch.dtype = torch.float32,
    perturbation: Perturbation | None = None,
    most: float = math.inf,
) -> WaveImage:
    """The wave image of a scene at heights (n, m) mm; differentiable by them.

    Args:
        wavelengths: nm, instead of the scene's, see `Light.lines`.
        finer: oversampling factor along each axis of both planes.
        dtype: of the field; optical paths are float64.
        perturbation: of the exit's height, see `Imager`.
        most: largest total number of samples of its transforms.

    Raises:
        NoWaveImage: no light reaches the screen, rays cross in front of the reference plane, or memory or `most` is insufficient.
    """
    scene = (scene if screen is None else scene.onto(screen)).unfolded
    lines = lines_of(scene, field, wavelengths)
    parameters = {EXIT: heights.double()}
    return image_of(lines, parameters, scene.screen, finer=finer, dtype=dtype, perturbation=perturbation, most=most)


def image_of(
    lines: list[Line],
    parameters: Parameters,
    screen: Screen | PlacedScreen,
    *,
    finer: float = 1.0,
    dtype: torch.dtype = torch.float32,
    perturbation: Perturbation | None = None,
    most: float = math.inf,
) -> WaveImage:
    """The wave image of spectral lines on one screen, source by source; see `wave_image`."""
    exact, found = any(h.requires_grad for h in parameters.values()), []
    device = next((heights.device for heights in parameters.values()), "cpu")
    with backend_for(device).keeping_surfaces():
        for light in by_source(lines):
            imager = Imager.of(
                light, parameters, receiver_of(light[0].system, screen), finer, exact, dense=perturbation is not None
            )
            imager = replace(imager, perturbation=perturbation)
            each = imager.sampling.samples * (1.0 if imager.sampling.samples <= WHOLE else BY_BLOCKS)
            if (samples := each * len(light) * len(imager.modes(light[0].system))) > most:
                raise NoWaveImage(
                    f"a wave image of this scene takes about {samples / A_SECOND / 60:.0f} minutes on two cores; the effect"
                    " diffraction, requested by name, computes it"
                )
            found.append(_checked(imager.expose(light, parameters, dtype)))
    return (
        found[0]
        if len(found) == 1
        else WaveImage(
            cast(Tensor, sum(w.image for w in found)),
            sum(w.leaving for w in found),
            sum(w.off_screen for w in found),
            tuple(dict.fromkeys(w for one in found for w in one.wavelengths)),
            sum(w.points for w in found),
            max(w.spread_error for w in found),
            max(w.samples for w in found),
            cast(Tensor, sum(w.xyz for w in found)) if all(w.xyz is not None for w in found) else None,
            _summed([w.halves for w in found]),
        )
    )


def _checked(found: WaveImage) -> WaveImage:
    """A wave image that has no more light than leaves the lens.

    Raises:
        NoWaveImage: it has, as of steps between lenslets, whose wavefront is torn between samples.
    """
    seen = float(found.image.detach().sum())
    if seen > MOST_LIGHT * found.leaving:
        raise NoWaveImage(
            f"the surface has steps or creases that the samples of its wave image do not resolve: the screen would have"
            f" {seen / found.leaving:.3g} times the light that leaves the lens"
        )
    return found


def _summed(pairs: list[tuple[Tensor, Tensor] | None]) -> tuple[Tensor, Tensor] | None:
    """The sum of pairs of images; None if one is missing."""
    known = [pair for pair in pairs if pair is not None]
    if len(known) < len(pairs):
        return None
    return cast(Tensor, sum(a for a, _ in known)), cast(Tensor, sum(b for _, b in known))


def by_source(lines: list[Line]) -> list[list[Line]]:
    """Lines grouped by the source of their light."""
    groups: dict[int, list[Line]] = {}
    for line in lines:
        groups.setdefault(id(line.system.source), []).append(line)
    return list(groups.values())


def _alike(lines: list[Line]) -> list[list[Line]]:
    """Lines grouped by ray paths; the shortest wavelength, which needs the finest sampling, comes first."""
    groups: dict[tuple, list[Line]] = {}
    for line in sorted(lines, key=lambda k: k.wavelength):
        groups.setdefault((id(line.system), line.label), []).append(line)
    return list(groups.values())


def _region(receiver: Receiver, surveys: list[Survey], watched: tuple | None, spread: Spread, blur: float) -> tuple[tuple, tuple]:
    """Limits of the computed region on the receiver's plane, mm; watched: see `Imager.of`."""
    low, high = receiver.extent()
    lows, highs = (list(c) for c in (watched if watched and receiver.across else (low, high)))
    for seen in surveys:
        lands = seen.mostly if watched else seen.landing
        for k in (0, 1):
            room = max(BESIDE * (high[k] - low[k]), spread.reach()[k] + receiver.pixel[k])
            lows[k] = min(lows[k], max(lands[0][k] - BLURS * blur, low[k] - room))
            highs[k] = max(highs[k], min(lands[1][k] + BLURS * blur, high[k] + room))
    return tuple(lows), tuple(highs)


@dataclass(frozen=True)
class Imager:
    """Common settings of the images of a source's lines and modes: the computed region and the sampling.

    spread: point-spread function of a mode; each: modes per position of the source, 0 for a single mode of the whole source;
    first: the optics of a line and a mode, of which those of others differ in nothing else;
    perturbation: additional height of the exit at points (N,), mm: fine structure of small amplitude, which changes optical
    paths to first order and does not deflect rays.
    """

    source: Source
    receiver: Receiver
    seen: Survey
    sampling: Sampling
    spread: Spread
    nodes: tuple[int, int]
    each: int
    first: Optics
    exact: bool = False
    tapered: bool = True
    perturbation: Perturbation | None = None

    @classmethod
    def of(
        cls,
        lines: list[Line],
        parameters: Parameters,
        receiver: Receiver,
        finer: float = 1.0,
        exact: bool = False,
        watched: tuple | None = None,
        dense: bool = False,
    ) -> Imager:
        """Determine the extent of the light, and choose the sampling.

        Args:
            exact: see `wavefront`.
            watched: lower and upper limits, mm, on an upright screen, of a region that must be covered together with nearly all of
                the light, whose remainder is then aliased; None to cover the whole screen and all light, tapering off the
                remainder.
            dense: trace a ray for every sample of the field.

        Raises:
            NoWaveImage: see `wave_image`.
        """
        ways = [group[0] for group in _alike(lines)]
        system, plane = ways[0].system, receiver.plane
        alike = [Optics.of(system, central_mode(system), parameters, ways[0], plane)]
        distance = alike[0].distance
        alike += [replace(alike[0], system=k.system, wavelength=k.length, label=k.label) for k in ways[1:]]
        outer = outermost_modes(system)
        surveys = [survey(replace(one, mode=mode)) for one in alike for mode in (one.mode, *outer)]
        lengths = tuple(k.behind for k in lines)
        blur = math.sqrt(max(lengths) * distance * surveys[0].magnification)
        spread, each = in_parts(system, alike[0].landing, receiver.across, max(blur, *receiver.pixel), device_of(alike[0]))
        light = (
            tuple(min(s.light[0][k] for s in surveys) for k in (0, 1)),
            tuple(max(s.light[1][k] for s in surveys) for k in (0, 1)),
        )
        spans = [[len(s.breaks) - 1 for s in e.surface.spaces] for e in system.elements if isinstance(e.surface, HeightField)]
        finest = [max((s[k] for s in spans), default=0) for k in (0, 1)]
        resolved = SAMPLES_A_SPAN * finest[0], SAMPLES_A_SPAN * finest[1]
        region = _region(receiver, surveys, watched, spread, blur)
        sampling = Sampling.of(light, region, receiver.pixel, distance, lengths, finer, resolved)
        nodes, enough = sampling.count, max(LEAST_NODES, A_SPAN * max(finest))
        if not dense:
            nodes = min(nodes[0], enough), min(nodes[1], enough)
        return cls(system.source, receiver, surveys[0], sampling, spread, nodes, each, alike[0], exact, watched is None)

    def expose(self, lines: list[Line], parameters: Parameters, dtype: torch.dtype = torch.float32) -> WaveImage:
        """The wave image of these lines, at heights {name: (n, m) mm} close to those for which the sampling was chosen."""
        colours = [line.channel for line in lines if line.channel is not None]
        images: dict[int | None, Tensor] = {}
        leaving, xyz, halves = 0.0, None, dict[int, Tensor]()
        for group in _alike(lines):
            for k, mode in enumerate(self.modes(group[0].system)):
                front = self.front(group[0], mode, parameters)
                for line in group:
                    part, power = self.image(line, front, k, dtype)
                    images[line.channel] = images.get(line.channel, 0.0) + line.part * part
                    leaving += line.part * power
                    xyz = with_colour(xyz, line.part * part, line.colour)
                    if line.half is not None:
                        halves[line.half] = halves.get(line.half, 0.0) + line.part * part.detach()
        some = next(iter(images.values()))
        image = torch.stack([images.get(k, torch.zeros_like(some)) for k in range(3)]) if colours else some
        return WaveImage(
            image,
            leaving,
            leaving - float(image.detach().sum()),
            tuple(dict.fromkeys(line.wavelength for line in lines)),
            len(self.modes(lines[0].system)),
            self.spread.error / math.sqrt(max(1, self.each)),
            self.sampling.padded,
            xyz,
            (halves[0], halves[1]) if len(halves) == 2 else None,
        )

    def modes(self, system: System) -> list[Mode]:
        """The modes that represent the source."""
        return modes(system, self.each) if self.each else [central_mode(system)]

    def optics(self, line: Line, mode: Mode, parameters: Parameters) -> Optics:
        """The wavefront computation of one mode."""
        first = self.first
        return replace(first, system=line.system, mode=mode, parameters=parameters, wavelength=line.length, label=line.label)

    def front(self, line: Line, mode: Mode, parameters: Parameters, sensitive: bool = False) -> Wavefront:
        """The wavefront of a mode behind the lens, on `nodes`."""
        optics, s = self.optics(line, mode, parameters), self.sampling
        dx, dy = (d * n / m for d, n, m in zip(s.step, s.count, self.nodes, strict=True))
        seen = survey(optics) if self.each else self.seen
        if self.perturbation is None:
            return wavefront(optics, seen, s.low, (dx, dy), self.nodes, sensitive, self.exact)
        found = wavefront(optics, seen, s.low, (dx, dy), self.nodes, True, self.exact)
        assert found.last is not None
        return replace(found, path=found.path + found.last.sensitivity * found.last.displacement(self.perturbation))

    def watched(self, front: Wavefront, length: float) -> Wavefront:
        """The wavefront restricted to light that lands inside the transform's field of view at a wavelength, mm."""
        if not self.tapered:
            return front
        wide, high = (length * self.sampling.distance / d for d in self.sampling.step)
        return front.within(self.sampling.middle, (wide, high))

    @cached_property
    def spreading(self) -> list[Convolution]:
        """Convolutions on the screen's pixels: of the whole source, or of each mode of a position; empty for point sources."""
        return self.spread.convolutions(self.receiver.pixel, spots(self.source, self.each) if self.each else [])

    def edges(self, line: Line) -> tuple[Tensor, Tensor]:
        """Edges of the (subdivided) pixels of an upright screen in samples, along each axis, see `pixel_edges`."""
        s, low = self.sampling, self.receiver.extent()[0]
        sub, beside = (self.spreading[0].cut, self.spreading[0].beside) if self.spreading else (1, (0, 0))
        first, spacing = s.first(line.behind), s.spacing(line.behind)
        rows, columns = (
            pixel_edges(
                low[k] - beside[k] * self.receiver.pixel[k] / sub,
                self.receiver.pixel[k] / sub,
                sub * self.receiver.resolution[k] + 2 * beside[k],
                first[k],
                spacing[k],
                s.padded[k],
            )
            for k in (0, 1)
        )
        return rows, columns

    def spread_out(self, image: Tensor, mode: int) -> Tensor:
        """An image of a mode on subdivided pixels -> that of its part of the source on the screen's pixels."""
        return self.spreading[mode % len(self.spreading)](image) if self.spreading else image

    def gathered(self, by_image: Tensor, mode: int, resolution: tuple[int, int]) -> Tensor:
        """The adjoint of `spread_out`, for images of this number of subdivided pixels."""
        if not self.spreading:
            return by_image
        with torch.enable_grad():
            image = torch.zeros(resolution, dtype=by_image.dtype, device=by_image.device, requires_grad=True)
            return pull_back([self.spread_out(image, mode)], [image], [by_image])[0]

    def field(self, line: Line, front: Wavefront, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """Phase, rad, including that of the Fresnel kernel, and amplitude of each sample of a wavefront, (n, m)."""
        s, front = self.sampling, self.watched(front, line.behind)
        path, amplitude = front.on(s.low, s.step, s.count).whole
        return phase_of(path, s, line.length, line.behind).to(dtype), amplitude.to(dtype)

    def exposure(self, line: Line, front: Wavefront, dtype: torch.dtype) -> Exposure | PlanesExposure:
        """Power on the (subdivided) pixels as a function of a change of the optical paths of a wavefront."""
        if not self.receiver.across:
            return PlanesExposure(self.receiver, self.sampling, self.watched(front, line.behind), line.length, line.behind, dtype)
        phase, amplitude = self.field(line, front, dtype)
        return backend_for(phase.device).exposure(phase, amplitude, TURN / line.length, self.sampling.padded, self.edges(line))

    def image(self, line: Line, front: Wavefront, mode: int, dtype: torch.dtype) -> tuple[Tensor, float]:
        """Power on pixels of one mode, by its number, at one wavelength, float64, and its total power."""
        s, wide = self.sampling, 8 if dtype == torch.float32 else 16
        if not self.receiver.across:
            found = power_by_planes(self.receiver, s, self.watched(front, line.behind), line.length, line.behind, dtype)
            return found, front.power
        if torch.is_grad_enabled() and front.path.requires_grad:
            self._check_memory(wide)
            found = power_on_pixels(*self.field(line, front, dtype), s.padded, *self._masks(line, front, dtype)).double()
        elif s.samples <= WHOLE:
            exposure = self.exposure(line, front, dtype)
            assert isinstance(exposure, Exposure)
            found = exposure.image(torch.zeros_like(exposure.phase)).double()
        elif pruning_pays(s.padded, s.count, edges := self.edges(line)):
            phase, amplitude = self.field(line, front, dtype)
            found = PrunedExposure(phase, amplitude, 0.0, s.padded, edges).image(torch.zeros_like(phase)).double()
        else:
            found = self._by_blocks(line, self.watched(front, line.behind), s.pieces(wide), dtype)
        return self.spread_out(found, mode), front.power

    def _masks(self, line: Line, front: Wavefront, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        rows, columns = (
            cells(e.to(front.path.device), n).to(dtype) for e, n in zip(self.edges(line), self.sampling.padded, strict=True)
        )
        return rows, columns

    @torch.no_grad()
    def _by_blocks(self, line: Line, front: Wavefront, pieces: int, dtype: torch.dtype) -> Tensor:
        s, fine = self.sampling, front.on(self.sampling.low, self.sampling.step, self.sampling.count)

        def field(part: slice) -> Tensor:
            path, root, lit = fine.rows(part)
            return torch.polar((root * lit).to(dtype), phase_of(path, s, line.length, line.behind, part).to(dtype))

        return power_by_blocks(field, s, pieces, *self._masks(line, front, dtype))[0]

    def _check_memory(self, wide: int) -> None:
        n, m = self.sampling.count
        needed = 4 * wide * self.sampling.samples + 48 * n * m + 160 * self.nodes[0] * self.nodes[1]
        if needed > memory_free():
            raise NoWaveImage(
                f"a wave image of this scene takes about {needed / 2**30:.1f} GiB of memory, and"
                f" {memory_free() / 2**30:.1f} GiB are free: fewer pixels, a smaller screen or lens need less"
            )
