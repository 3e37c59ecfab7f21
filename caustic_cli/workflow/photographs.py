"""A photograph of the caustic of a part, judged: where its screen is, what it shows of the picture, and errors of the part."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.project import correction
from caustic_cli.scene.traits import Capability
from caustic_cli.studies.photograph import comparison, inference, registration
from caustic_cli.studies.photograph.camera import DISPLACEMENTS
from caustic_cli.studies.photograph.model import PartModel
from caustic_cli.workflow.lens import Lens
from caustic_cli.workflow.reporter import Reporter

#: Rays of the model along each side of the aperture.
RAYS = 320
#: Fraction of its prior standard deviation down to which an unknown must be determined in order to count as told apart.
TOLD = 0.5
#: Correlation from which on two unknowns count as one.
ALIKE = 0.9

_MESSAGE = "⟨photo⟩ judges a single lens of uniform index and one surface to be made, in parallel light, and this one has {}"
PHOTOGRAPHS = Capability(
    "photographs of a part",
    dict.fromkeys(
        (
            "mirror",
            "gradient index",
            "two sides",
            "other elements",
            "lenslet array",
            "coloured picture",
            "curved screen",
            "far field",
            "several sources",
            "ray file",
            "near source",
            "light not parallel",
        ),
        _MESSAGE,
    ),
)


@dataclass(frozen=True, eq=False)
class Judged:
    """A photograph of a part, with what it shows and what was inferred from it."""

    photograph: registration.Photograph
    found: inference.Inference
    shown: comparison.ComparedPhotograph
    #: What is known from earlier photographs.
    before: correction.Correction | None
    #: Correlation of the photograph and the image of the lens, blurred.
    like: float

    @property
    def figures(self) -> dict[str, Any]:
        """As of the key `photo` of the table in JSON."""
        p, f, s = self.photograph, self.found, self.shown
        camera, response = p.camera, f.guess.response
        scale, left = f.scale
        rms, rms_left = f.rms()
        rx = f.model.scene.screen.half_size[0]
        kept = np.sqrt(np.diag(f.covariance))[4:13] * rx
        return {
            "file": str(p.path),
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
            "correlation": self.like,
            "camera": {
                "gamma": math.exp(response.log_gamma),
                "background": response.background,
                "gain": math.exp(response.log_gain),
                "blur_mm": math.exp(response.log_blur) * rx,
                "displacements_mm": {
                    name: [float(c * rx), float(e)] for name, c, e in zip(DISPLACEMENTS, f.guess.camera, kept, strict=True)
                },
            },
            "part": {
                "deviation_rms_um": 1e3 * rms,
                "deviation_rms_sigma_um": 1e3 * rms_left,
                "uncertainty_um": 1e3 * f.uncertainty(),
                "relief_scale": scale,
                "relief_scale_sigma": left,
                "prior": {"amplitude_mm": f.prior.amplitude, "power": f.prior.power, "corner": f.prior.corner},
                "explained": f.explained,
                "residual_codes": f.residual,
                "correlated_px": f.correlated,
                "not_told_apart": not_told_apart(f, camera.marks > 0),
                "rounds_before": 0 if self.before is None else len(self.before.history),
            },
        }


def not_told_apart(found: inference.Inference, marked: bool) -> list[str]:
    """What a photograph does not tell apart, always or by the uncertainty of this fit, in sentences; marked: whether
    marks say where the screen is."""
    words = [
        "piston: a surface that is higher all over gives the same picture",
        "tilt of the surface and tilt of the part where it was mounted: both shift the picture",
        "scale of the relief, throw and index less one: the picture depends on their product",
    ]
    sigma = np.sqrt(np.diag(found.covariance))
    alike = found.covariance / np.maximum(np.outer(sigma, sigma), 1e-300)
    count = len(found.guess.modes)
    quadratics = [14 + k for k in (2, 2 * count, count + 1) if count > 2]  # (0, 2), (2, 0), (1, 1)
    if sigma[13] > TOLD * inference.SCALE:
        words.append("scale of the relief: the photograph says no more of it than was known before")
    if any(abs(alike[13, k]) > ALIKE for k in (*quadratics, *range(6, 10))):
        words.append("scale of the relief, and curvature of the part or size of the picture on the wall")
    if any(abs(alike[k, c]) > ALIKE for k in quadratics for c in range(6, 10)):
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
    return PHOTOGRAPHS.why_not(lens.scene)


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


def judge(
    lens: Lens, photo: Path, marks: str | None, corners: tuple[str, ...] | None, say: Reporter, codes: np.ndarray | None = None
) -> Judged:
    """Judge a photograph; marks: a file of marks, or "auto"; corners: of the screen, as of `corners_of`.

    Raises:
        InputError: the photograph cannot be read, or is not one of the caustic of this lens.
    """
    assert lens.target is not None
    codes = registration.read_codes(photo) if codes is None else codes
    places = corners_of(corners)
    heights, before = known_heights(lens)
    model = PartModel(lens.scene, lens.field, heights, RAYS**2)
    expected = image_of(model, lens.target.shape)
    if lens.by_waves:
        say.say("the lens was refined on its wave image, and the photograph is compared with rays: diffraction counts as blur")
    screen = lens.scene.screen
    file = None if marks in (None, "auto") else Path(str(marks))
    seen = registration.register(photo, codes, expected, screen.half_size, screen.shift, marks=file, corners=places)
    known = inference.Knowledge(seen.camera.covariance)
    with say.progress(None) as show:
        found = inference.infer(
            model,
            seen.on_screen,
            known,
            show=lambda done, whole: show("photograph", "inferring the part", done, whole),
        )
    shown = comparison.compare(seen, found, lens.target, expected)
    return Judged(seen, found, shown, before, registration.refuse_unlike(seen, expected))


def image_of(model: PartModel, shape: tuple[int, int]) -> np.ndarray:
    """E of the designed surface on n x m pixels of the screen."""
    at, edges = model.designed, [np.linspace(-1.0, 1.0, n + 1) for n in shape]
    light = np.histogram2d(at.x, at.y, edges, weights=at.power)[0]
    return light / light.mean()
