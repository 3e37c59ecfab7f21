"""Figures of a shaped laser beam, in the mask and the region of its picture (`optics.region`), as the loss sees it: pixels that
resolve the light, as those of the field's own tables do, are taken at their middles.

error               e, the relative error in the mask
in_mask, in_region  fractions of the light behind the lens
peak_to_valley      (max - min) / (max + min) of I / T in the mask
rms                 standard deviation of I / T in the mask over its mean
edge_width          mm or mrad: area where the irradiance is between 1 / e^2 and 1 - 1 / e^2 of its mean in the brighter half of the
                    picture's mask, over the length of the picture's contour at half its peak
vortices            zeros of the field within the mask, about which its phase turns once
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from caustic_cli.optics.image import Image
from caustic_cli.optics.region import Bright, Region
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import Imager, WaveImage, lines_of
from caustic_cli.optics.waves.propagation import PrunedExposure
from caustic_cli.optics.waves.unsupported import receiver_of
from caustic_cli.scene import Scene

#: Oversampling of the field for the figures; samples of each of its Nyquist intervals for vortices.
FINER, PIECES = 2.0, 4


def beam_figures(image: Tensor, leaving: float, bright: Bright, pixel: tuple[float, float]) -> dict[str, float]:
    """Those of an image (n_x, n_y) that do not need its field; leaving: power behind the lens; pixel: widths, mm."""
    image = image.detach().to(bright.target)
    ratio = image[bright.mask] / bright.target[bright.mask]
    low, high = float(ratio.min()), float(ratio.max())
    return {
        "error": float(bright.error(image)),
        "in_mask": float(image[bright.mask].sum()) / leaving,
        "in_region": float(bright.light(image)) / leaving,
        "peak_to_valley": (high - low) / (high + low),
        "rms": float(ratio.std(correction=0) / ratio.mean()),
        "edge_width": edge_width(image.cpu().numpy(), bright.target.cpu().numpy(), pixel),
    }


def shaped_figures(
    scene: Scene, field: HeightField, heights: Tensor, target: np.ndarray, region: Region | None, light: WaveImage | Image | None
) -> dict[str, dict[str, float]]:
    """The figure beam of a lens with heights (n, m) mm, of its image of a target (n_x, n_y), where a region is given; with vortices
    if it is a wave image, on an upright screen."""
    if region is None or light is None or target.ndim > 2:
        return {}
    bright = region.on(torch.from_numpy(target))
    image, more = light.image, {}
    if isinstance(light, WaveImage) and (scene.screen.upright or scene.screen.far):
        lens = scene, field, heights
        if (found := image_at(*lens, (bright.mask | bright.region).cpu().numpy())) is not None:
            image, more = found, {"vortices": vortices(*lens, bright.mask.cpu().numpy())}
    return {"beam": beam_figures(image, float(light.leaving), bright, scene.screen.pixel) | more}


def edge_width(image: np.ndarray, target: np.ndarray, pixel: tuple[float, float]) -> float:
    """See the module; the length of the contour by Crofton's formula, from its crossings of the lines of the pixels."""
    inside = target > 0.5 * target.max()
    full, low = float(image[inside].mean()), math.exp(-2.0)
    area = float(((image > low * full) & (image < (1.0 - low) * full)).sum()) * pixel[0] * pixel[1]
    crossings = [int((np.diff(np.pad(inside, 1), axis=k)).sum()) for k in (0, 1)]
    return area / (0.25 * math.pi * (crossings[0] * pixel[1] + crossings[1] * pixel[0]))


@torch.no_grad()
def field_at(
    scene: Scene, field: HeightField, heights: Tensor, mask: np.ndarray, pieces: int = 0, finer: float = 1.0
) -> tuple[PrunedExposure, Tensor, int] | None:
    """The light of the pixels around those of `mask` on the screen, in double precision; a zero change of its paths; and the number
    of parts along each axis into which pixels are cut, at least so many `pieces` for each Nyquist interval of the field.  finer: as
    of an `Imager`.  None for light of several wavelengths or modes."""
    lines, parameters = lines_of(scene.unfolded, field), {EXIT: heights.double()}
    imager = Imager.of(lines, parameters, receiver_of(lines[0].system, scene.screen), finer, dense=finer > 1.0)
    if len(lines) > 1 or imager.spreading or len(modes := imager.modes(lines[0].system)) > 1:
        return None
    phase, amplitude = imager.field(lines[0], imager.front(lines[0], modes[0], parameters), torch.float64)
    shape, edges = imager.sampling.padded, imager.edges(lines[0])
    cut = max(
        1, *(math.ceil(pieces * n / size * float(e.diff().max())) for n, size, e in zip(phase.shape, shape, edges, strict=True))
    )
    rows, columns = (np.nonzero(mask.any(k))[0] for k in (1, 0))
    box = (cut * int(rows[0]), cut * int(rows[-1] + 1)), (cut * int(columns[0]), cut * int(columns[-1] + 1))
    part = PrunedExposure(phase, amplitude, 0.0, shape, (_cut(edges[0], cut), _cut(edges[1], cut)), box, True)
    return part, torch.zeros_like(phase), cut


def _cut(edges: Tensor, pieces: int) -> Tensor:
    """Edges of the pieces of pixels."""
    parts = torch.arange(pieces, dtype=edges.dtype, device=edges.device) / pieces
    return torch.cat([(edges[:-1, None] + edges.diff()[:, None] * parts).reshape(-1), edges[-1:]])


def image_at(scene: Scene, field: HeightField, heights: Tensor, mask: np.ndarray) -> Tensor | None:
    """Power (n_x, n_y) on the pixels around those of `mask`, as the loss takes it but from other rays; None as of `field_at`."""
    found = field_at(scene, field, heights, mask, finer=FINER)
    return None if found is None else found[0].image(found[1])


def vortices(scene: Scene, field: HeightField, heights: Tensor, mask: np.ndarray) -> int | None:
    """Number of vortices of the light within pixels `mask` of the screen; None as of `field_at`."""
    found = field_at(scene, field, heights, mask, PIECES)
    if found is None:
        return None
    part, still, cut = found
    inside = mask.repeat(cut, 0).repeat(cut, 1)[tuple(part.pixels)]
    for axis, weight in enumerate(part.weights):
        inside = inside.repeat(weight.shape[1], axis)
    return turns(part.field(still).angle().numpy(), inside)


def turns(phase: np.ndarray, mask: np.ndarray) -> int:
    """Number of cells between samples, all four in the mask, about which a phase (n, m), rad, turns once."""

    def step(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (b - a + math.pi) % (2.0 * math.pi) - math.pi

    corners = phase[:-1, :-1], phase[1:, :-1], phase[1:, 1:], phase[:-1, 1:]
    total = sum(step(a, b) for a, b in zip(corners, (*corners[1:], corners[0]), strict=True))
    inside = mask[:-1, :-1] & mask[1:, :-1] & mask[1:, 1:] & mask[:-1, 1:]
    return int((np.abs(np.rint(total / (2.0 * math.pi)))[inside]).sum())
