"""Photographs of the caustic of a part, judged: where their screen is, what they show of the picture, and errors of the part.

A photograph in another light or on another screen than the project's is named by a TOML file, with the sections of project.toml:

    photo = "far.jpg"            beside that file
    marks = "far.csv"            or screen_corners = ["C,R", "C,R", "C,R", "C,R"], or neither
    throw = 400                  mm, for screen.z
    [source]                     wavelengths, tilt, angle, ...
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from caustic_cli.config import settings
from caustic_cli.config.settings import read_text
from caustic_cli.errors import InputError
from caustic_cli.io.colorimetry import XYZ_OF_RGB
from caustic_cli.io.files import naming
from caustic_cli.optics.screen_shape import areas
from caustic_cli.optics.waves.image import wave_image
from caustic_cli.optics.waves.unsupported import NoWaveImage
from caustic_cli.project import correction
from caustic_cli.scene import Scene, Screen
from caustic_cli.studies.photograph import comparison, inference, registration
from caustic_cli.studies.photograph.camera import DISPLACEMENTS
from caustic_cli.studies.photograph.model import PartModel
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.reporter import Reporter

#: Rays of the model along each side of the aperture.
RAYS = 320
#: Fraction of its prior standard deviation down to which an unknown must be determined in order to count as told apart.
TOLD = 0.5
#: Sections of project.toml that a photograph may differ in.
TAKEN = ("source", "screen")
#: Correlation from which on two unknowns count as one.
ALIKE = 0.9

#: Channels of a photograph in colour.
CHANNELS = ("red", "green", "blue")
#: Part of the light from which on that of a colour is judged.
WORTH = 0.01


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph as it is given: its file and codes (rows, columns), in colour (3, rows, columns), marks (a file) or corners of
    the screen (4, 2), and the light and the screen by path in `schema.table` -> value, where they are not the project's; throw: for
    that of the screen, mm."""

    path: Path
    codes: np.ndarray
    marks: Path | None = None
    corners: np.ndarray | None = None
    given: Mapping[str, Any] = field(default_factory=dict)
    throw: float | None = None

    def lens(self, lens: Lens) -> Lens:
        """The lens in the light and before the screen of the photograph."""
        given = dict(self.given)
        if self.throw is not None:
            given["screen.z"] = math.copysign(self.throw, lens.scene.screen.z)
        return lens.under(given)


@dataclass(frozen=True, eq=False)
class Judged:
    """Photographs of a part, with what they show and what was inferred from them.  One in colour counts as one in the light of each
    colour."""

    photographs: tuple[registration.Photograph, ...]
    found: inference.Inference
    #: Of each photograph.
    shown: tuple[comparison.ComparedPhotograph, ...]
    #: What is known from earlier photographs.
    before: correction.Correction | None
    #: Correlation of each photograph and the image of the lens, blurred.
    like: tuple[float, ...]
    #: The scene of each photograph, and the colour of its light, None for all of it.
    scenes: tuple[Scene, ...]
    channels: tuple[int | None, ...]
    #: Irradiance of the picture, (n, m), of each.
    targets: tuple[np.ndarray, ...]

    @property
    def marked(self) -> bool:
        """Whether marks say where the screen is in each photograph."""
        return all(one.camera.marks > 0 for one in self.photographs)

    @property
    def figures(self) -> dict[str, Any]:
        """As of the key `photo` of the table in JSON."""
        f = self.found
        scale, left = f.scale
        rms, rms_left = f.rms()
        part = {
            "deviation_rms_um": 1e3 * rms,
            "deviation_rms_sigma_um": 1e3 * rms_left,
            "uncertainty_um": 1e3 * f.uncertainty(),
            "relief_scale": scale,
            "relief_scale_sigma": left,
            "prior": {"amplitude_mm": f.prior.amplitude, "power": f.prior.power, "corner": f.prior.corner},
            "explained": f.explained,
            "found": f.ended,
            "residual_codes": f.fits[0].residual,
            "correlated_px": f.fits[0].correlated,
            "not_told_apart": not_told_apart(f, self.marked, self.scenes[0].two_sided or bool(self.scenes[0].unfolded.elements)),
            "rounds_before": 0 if self.before is None else len(self.before.history),
        }
        first, *others = map(self._of, range(len(self.photographs)))
        return first | {"part": part} | ({"others": others} if others else {})

    @property
    def of_first(self) -> np.ndarray:
        """The first photograph on the screen, irradiance over its mean, (n, m), or (3, n, m) in the parts of the light of each
        colour."""
        first, parts = self.shown[0].irradiance, self.scenes[0].light.fractions
        if not self.scenes[0].colored:
            return first
        found = np.zeros((len(CHANNELS), *first.shape))
        for one, channel in zip(self.shown, channels_of(self.scenes[0]), strict=False):
            found[channel] = parts[channel or 0] * one.irradiance
        return found

    def _of(self, number: int) -> dict[str, Any]:
        """Figures of one photograph."""
        p, s, view = self.photographs[number], self.shown[number], self.found.guess.views[number]
        channel = self.channels[number]
        camera, response, rx = p.camera, view.response, self.scenes[number].screen.half_size[0]
        kept = self.found.of_view(number)
        return {
            "file": f"{p.path}" + ("" if channel is None else f" ({CHANNELS[channel]})"),
            "registered_by": camera.found,
            "marks": camera.marks,
            "mark_sigma_px": camera.sigma if camera.marks else None,
            "distortion": camera.k,
            "seen_from_lens_side": camera.mirrored,
            "as_photographed": s.as_photographed,
            "error": s.in_frame,
            "registered": s.registered,
            "against_lens": s.against_lens,
            "missing_light": s.missing_light,
            "correlation": self.like[number],
            "explained": self.found.fits[number].explained,
            "screen_farther_mm": [view.throw, float(kept[13])] if self.found.throws_free else None,
            "camera": {
                "gamma": math.exp(response.log_gamma),
                "background": response.background,
                "gain": math.exp(response.log_gain),
                "blur_mm": math.exp(response.log_blur) * rx,
                "displacements_mm": {
                    name: [float(c * rx), float(e * rx)] for name, c, e in zip(DISPLACEMENTS, view.camera, kept[4:13], strict=True)
                },
            },
        }


def not_told_apart(found: inference.Inference, marked: bool, others: bool = False) -> list[str]:
    """What photographs do not tell apart, always or by the uncertainty of this fit, in sentences; marked: whether
    marks say where the screen is; others: whether other surfaces bend the light, too."""
    several, shared = found.throws_free, inference.OWN * len(found.fits)
    words = [
        "piston: a surface that is higher all over gives the same picture",
        "tilt of the surface and tilt of the part where it was mounted: both shift the picture",
        f"scale of the relief{' and' if several else ', throw and'} index less one: the picture depends on their product",
    ]
    if others:
        words.append("errors of the exit and of other surfaces: all are taken for the exit's, which can correct them")
    sigma = np.sqrt(np.diag(found.covariance))
    alike = np.abs(found.covariance / np.maximum(np.outer(sigma, sigma), 1e-300))
    count = len(found.guess.modes)
    quadratics = [shared + 1 + k for k in (2, 2 * count, count + 1) if count > 2]  # (0, 2), (2, 0), (1, 1)
    affine = [inference.OWN * k + c for k in range(len(found.fits)) for c in range(6, 10)]
    if sigma[shared] > TOLD * inference.SCALE:
        words.append("scale of the relief: no more is known of it than before")
    if (alike[shared, [*quadratics, *affine]] > ALIKE).any():
        words.append("scale of the relief, and curvature of the part or size of the picture on the wall")
    if (alike[np.ix_(quadratics, affine)] > ALIKE).any():
        words.append("curvature and astigmatism of the part, and size and shear of the picture on the wall")
    if not marked:
        words.append("without marks: tilt, curvature and astigmatism of the part from where and how large the picture should be")
    return words


def known_heights(lens: Lens) -> tuple[Tensor, correction.Correction | None]:
    """Control heights of the part as far as they are known: of the lens, with the deviation known from earlier photographs."""
    path = None if lens.project is None else lens.project.path
    before = correction.read(path, tuple(lens.heights.shape))
    return (lens.heights if before is None else lens.heights + before.deviation), before


def refuse_lens(lens: Lens) -> str:
    """Why no photograph of a lens can be judged, "" if it can."""
    if lens.target is None:
        return "⟨photo⟩ compares with the picture, which an archive does not hold; give its project"
    return ""


def corners_of(texts: tuple[str, ...] | None) -> np.ndarray | None:
    """Pixels (4, 2) of the corners of the screen, from "column,row" each.

    Raises:
        InputError: one is no such pair.
    """
    if not texts or not any(texts):
        return None
    found = []
    for text in texts:
        try:
            pair = [float(part) for part in text.split(",")]
        except ValueError:
            pair = []
        if len(pair) != 2 or not np.isfinite(pair).all():
            raise InputError(
                f"⟨screen_corners⟩ must be four points column,row in pixels: upper left, upper right, lower right, lower left of"
                f" the screen, got {text!r}"
            )
        found.append(pair)
    return np.array(found)


def shots(
    photos: Sequence[Path], marks: str | None = None, corners: tuple[str, ...] | None = None, color: bool = False
) -> tuple[Shot, ...]:
    """Photographs by their files, or by TOML files that name them; marks and corners: of a single one that names none; color: with
    their colours.

    Raises:
        InputError: a file cannot be read, or marks and corners do not belong to one photograph.
    """
    file, places = None if marks in (None, "auto") else Path(str(marks)), corners_of(corners)
    if file is not None and places is not None:
        raise InputError("⟨marks⟩ and ⟨screen_corners⟩ both say where the screen is: leave one out")
    found = []
    for path in photos:
        if path.suffix.lower() == ".toml":
            found.append(_named_by(path, color))
        else:
            found.append(Shot(path, registration.read_codes(path, color), file, places))
    if len(found) > 1 and not (file is None and places is None):
        which = "marks" if places is None else "screen_corners"
        raise InputError(f"⟨{which}⟩ are of one photograph, and there are {len(found)}; name each in a TOML file with its own")
    return tuple(found)


def files_of(path: Path) -> list[Path]:
    """The files that a photograph is read from: its own, or a TOML file with those that it names, as far as it can be read."""
    if path.suffix.lower() != ".toml":
        return [path]
    try:
        named = settings.toml_of(read_text(path), f"{path}")
    except InputError:
        return [path]
    return [path, *(path.parent / str(named[key]) for key in ("photo", "marks") if key in named)]


def _named_by(path: Path, color: bool) -> Shot:
    """The photograph that a TOML file names, see the module."""
    given = settings.toml_of(read_text(path), f"{path}")
    own = {key: given.pop(key, None) for key in ("photo", "marks", "screen_corners", "throw")}
    with naming(path):
        _check_named(**own)
    scene = settings.checked(given, f"{path}")
    if others := [section for section in scene if section not in TAKEN]:
        raise InputError(f"{path}: [{others[0]}] is not of a photograph, whose sections are {', '.join(f'[{s}]' for s in TAKEN)}")
    flat = {f"{section}.{key}": value for section, table in scene.items() for key, value in table.items()}
    photo, marks = (None if own[key] is None else path.parent / own[key] for key in ("photo", "marks"))
    return Shot(photo, registration.read_codes(photo, color), marks, corners_of(own["screen_corners"]), flat, own["throw"])


def _check_named(photo: Any, marks: Any, screen_corners: Any, throw: Any) -> None:
    for key, name in (("photo", photo), ("marks", "" if marks is None else marks)):
        if not isinstance(name, str):
            raise InputError(f'{key} must name a file, {key} = "wall.{"jpg" if key == "photo" else "csv"}"')
    if screen_corners is not None and marks is not None:
        raise InputError("marks and screen_corners both say where the screen is: leave one out")
    types = [type(c) for c in screen_corners] if isinstance(screen_corners, list) else None
    if screen_corners is not None and types != [str] * 4:
        raise InputError('screen_corners must be four texts "column,row"')
    if throw is not None and not (type(throw) in (int, float) and 0 < throw < math.inf):
        raise InputError(f"throw must be greater than 0 mm, got {throw!r}")


def waves_of(lens: Lens, heights: Tensor) -> np.ndarray | None:
    """The wave image of a lens that was refined on it, with other heights, power per pixel, (n, m) or (3, n, m); None of others."""
    if not lens.by_waves:
        return None
    try:
        return wave_image(lens.scene, lens.field, heights.detach()).image.cpu().double().numpy()
    except NoWaveImage:
        return None


def channels_of(scene: Scene) -> tuple[int | None, ...]:
    """The colours in whose light a scene is photographed one by one, None for all light at once."""
    if not scene.colored:
        return (None,)
    return tuple(k for k, part in enumerate(scene.light.fractions) if part > WORTH)


def irradiance_of(image: np.ndarray, screen: Screen, channel: int | None) -> np.ndarray:
    """Irradiance of power per pixel, (n, m), or of a channel of (3, n, m), on pixels of unit area."""
    light, true = image if channel is None else image[channel], areas(screen)
    return light if true is None else light / true


def judge(lens: Lens, taken: Sequence[Shot], say: Reporter) -> Judged:
    """Judge photographs of one part.

    Raises:
        InputError: one is not of the caustic of this lens, or in a light in which none can be judged.
    """
    (heights, before), seen = known_heights(lens), []
    for shot in taken:
        own = shot.lens(lens)
        with naming(shot.path):
            if why := refuse_lens(own):
                raise InputError(why)
        seen += _seen(shot, own, heights)
    photographs, observations, scenes, targets, expected, channels = zip(*seen, strict=True)
    with say.progress(None) as show:
        found = inference.infer(observations, show=lambda done, whole: show("photograph", "inferring the part", done, whole))
    views = zip(photographs, found.guess.views, targets, expected, strict=True)
    shown = tuple(comparison.compare(one, view, target, image) for one, view, target, image in views)
    like = tuple(registration.refuse_unlike(one, image) for one, image in zip(photographs, expected, strict=True))
    return Judged(photographs, found, shown, before, like, scenes, channels, targets)


#: A photograph, what is inferred from it, its scene, target (n, m) and expected image (n, m), and the colour of its light.
_Seen = tuple[registration.Photograph, inference.Observation, Scene, np.ndarray, np.ndarray, int | None]


def _seen(shot: Shot, lens: Lens, heights: Tensor) -> Iterator[_Seen]:
    """A photograph of a lens of these heights in the light of each colour; lens: in its light and before its screen."""
    assert lens.target is not None
    scene, wave, places = lens.scene, waves_of(lens, heights), {"marks": shot.marks, "corners": shot.corners}
    codes = shot.codes
    if scene.colored:
        codes = registration.by_light(codes, np.linalg.solve(XYZ_OF_RGB, scene.light.primaries))
    for channel in channels_of(scene):
        part = 1.0 if channel is None else scene.light.fractions[channel]
        light = None if wave is None else irradiance_of(wave, scene.screen, channel) * (math.prod(scene.screen.resolution) / part)
        target = irradiance_of(lens.target, scene.screen, channel)
        model = PartModel(scene, lens.field, heights, RAYS**2, light, channel)
        image = model.image(target.shape) if light is None else light
        mine, (half, shift) = codes if channel is None else codes[channel], (scene.screen.half_size, scene.screen.shift)
        found = registration.register(shot.path, mine, image, half, shift, shape=model.shape, **places)
        yield found, inference.Observation(model, found.for_model, found.camera.covariance), scene, target, image, channel
