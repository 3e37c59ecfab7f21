"""What a photograph shows of the picture: the irradiance that it recorded, its errors, and where light is missing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from scipy.optimize import least_squares

from caustic_cli.io.files import SOFTWARE, atomic_file
from caustic_cli.io.picture import to_linear
from caustic_cli.studies.metrics import relative_rms
from caustic_cli.studies.photograph.camera import displacements
from caustic_cli.studies.photograph.inference import Inference
from caustic_cli.studies.photograph.model import View, cosines, heights_at
from caustic_cli.studies.photograph.registration import Photograph

#: Points along each side of surface files, borders included.
POINTS = 257


@dataclass(frozen=True, eq=False)
class ComparedPhotograph:
    """A photograph on the pixels of the screen, (n, m), in units of its mean, and its errors, relative RMS.

    as_photographed: of codes taken for sRGB; in_frame: after response and camera were fitted; registered: also moved, stretched and
    sheared onto the picture as well as possible; against_lens: the same against the image of the lens as designed.
    """

    irradiance: np.ndarray
    registered_irradiance: np.ndarray
    as_photographed: float
    in_frame: float
    registered: float
    against_lens: float
    #: Picture minus registered photograph where that is positive, and its part of the picture's light.
    missing: np.ndarray
    missing_light: float


def compare(photograph: Photograph, view: View, target: np.ndarray, image: np.ndarray) -> ComparedPhotograph:
    """Compare a photograph with the target and the image of the lens as designed, (n, m) each; view: what was fitted of it."""
    n, m = target.shape
    codes = photograph.on_screen((n, m))
    codes = np.where(np.isfinite(codes), codes, np.nanmedian(codes))
    light = np.clip(view.response.irradiance(codes), 0.0, None)
    x, y = np.meshgrid(*(2.0 * (np.arange(k) + 0.5) / k - 1.0 for k in (n, m)), indexing="ij")
    moved = np.einsum("k,kin->in", view.camera, displacements(x.ravel(), y.ravel())).reshape(2, n, m)
    light = _at(light, x + moved[0], y + moved[1])
    light /= light.mean()
    aim, own = target / target.mean(), image / image.mean()
    onto = registered(light, aim)
    missing = np.clip(aim - onto, 0.0, None)
    return ComparedPhotograph(
        light,
        onto,
        relative_rms(to_linear(codes), aim),
        relative_rms(light, aim),
        relative_rms(onto, aim),
        relative_rms(registered(light, own), own),
        missing,
        float(missing.sum() / aim.sum()),
    )


def _at(image: np.ndarray, x: np.ndarray, y: np.ndarray, prefilter: bool = True) -> np.ndarray:
    """An image (n, m) at points (X, Y); prefilter: False for the coefficients of its spline."""
    places = [(c + 1.0) * 0.5 * k - 0.5 for c, k in zip((x, y), image.shape, strict=True)]
    return map_coordinates(image, places, order=3, mode="nearest", prefilter=prefilter)


def registered(image: np.ndarray, aim: np.ndarray) -> np.ndarray:
    """An image (n, m), displaced by the affine map that brings it closest to another, over its mean."""
    n, m = aim.shape
    x, y = np.meshgrid(*(2.0 * (np.arange(k) + 0.5) / k - 1.0 for k in (n, m)), indexing="ij")
    coefficients = spline_filter(image, order=3, mode="nearest")

    def moved(p: np.ndarray) -> np.ndarray:
        found = _at(coefficients, x + p[0] + p[1] * x + p[2] * y, y + p[3] + p[4] * x + p[5] * y, prefilter=False)
        return found / found.mean()

    how = {"diff_step": 1e-4, "x_scale": 0.01, "max_nfev": 20, "ftol": 1e-5, "xtol": 1e-4}
    best = least_squares(lambda p: (moved(p) - aim).ravel(), np.zeros(6), **how)
    return moved(best.x)


def surfaces(found: Inference) -> tuple[np.ndarray, np.ndarray]:
    """The part as made, and its deviation with that by the relief's scale, (POINTS, POINTS) mm over the aperture, [i, j]."""
    u = np.linspace(0.0, 1.0, POINTS)
    model, guess = found.model, found.guess
    c = cosines(u, len(guess.modes))
    (rx, ry), at = model.field.half_size, (2.0 * u - 1.0)
    heights = heights_at(model.field, model.heights, at * rx, at * ry)
    relief = heights - float(model.heights.mean())
    off = c @ guess.modes @ c.T + guess.scale * relief
    return heights + off, off


def write_plot(path: Path, seen: ComparedPhotograph, target: np.ndarray, found: Inference, encoding: str) -> None:
    """Write a PNG: target, photograph on the screen, where light is missing; deviation of the part and its uncertainty."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(15.0, 8.4), dpi=100, layout="constrained")
    axes = figure.subplots(2, 3)
    aim, (rx, ry) = target / target.mean(), found.model.scene.screen.half_size
    white, power = float(aim.max()), 1.0 / 2.2 if encoding == "srgb" else 1.0
    place: dict[str, Any] = {"origin": "lower", "extent": (-rx, rx, -ry, ry)}
    for axis, image, title in (
        (axes[0, 0], aim, "picture"),
        (axes[0, 1], seen.irradiance, f"photograph on the screen: error {seen.in_frame:.3f}"),
    ):
        axis.imshow((np.clip(image / white, 0.0, 1.0) ** power).T, cmap="gray", vmin=0, vmax=1, **place)
        axis.set_title(title, loc="left")
    off = seen.registered_irradiance - aim
    most = float(np.percentile(np.abs(off), 99.5)) or 1.0
    shown = axes[0, 2].imshow(off.T, cmap="RdBu", vmin=-most, vmax=most, **place)
    missing = f"red: {seen.missing_light:.1%} of light is missing"
    axes[0, 2].set_title(f"{missing}\nerror once registered: {seen.registered:.3f}", loc="left")
    figure.colorbar(shown, ax=axes[0, 2], label="photograph - picture (means)")
    ax, ay = found.model.field.half_size
    part = {"origin": "lower", "extent": (-ax, ax, -ay, ay)}
    _, deviation = surfaces(found)
    deviation = 1e3 * (deviation - deviation.mean())
    most = float(np.abs(deviation).max()) or 1.0
    for axis, image, low, title in (
        (axes[1, 0], deviation, -most, f"deviation of the part: RMS {deviation.std():.2f} µm"),
        (axes[1, 1], 1e3 * found.spread, 0.0, "its standard deviation"),
    ):
        shown = axis.imshow(image.T, cmap="RdBu" if low else "viridis", vmin=low, vmax=most if low else None, **part)
        axis.set_title(title, loc="left")
        figure.colorbar(shown, ax=axis, label="µm")
    fit = found.fits[0]
    miss = fit.seen - fit.predicted
    most = float(np.percentile(np.abs(miss), 99.5)) or 1.0
    (left_x, right_x), (low_y, high_y) = fit.window
    place["extent"] = (left_x * rx, right_x * rx, low_y * ry, high_y * ry)
    shown = axes[1, 2].imshow(miss.T, cmap="RdBu", vmin=-most, vmax=most, **place)
    axes[1, 2].set_title(f"photograph - model: {fit.explained:.2%} explained", loc="left")
    figure.colorbar(shown, ax=axes[1, 2], label="codes, 1 saturates")
    for axis in axes.ravel():
        axis.set(xlabel="x (mm)", ylabel="y (mm)")
    with atomic_file(path) as file:
        figure.savefig(file, format="png", metadata={"Software": SOFTWARE})
