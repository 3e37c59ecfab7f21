"""The phase of a lens for its first wavelength, wrapped: for a phase modulator, or as the relief of a diffractive plate (kinoform).

    phi = 2 pi / lambda (v - v_in)  mod 2 pi

with v the optical path to the plane at the mean height of its surface and v_in that to its pupil, at the same point
(`optics.waves.wavefront`, with a plane that touches the surface in place of the screen): what a thin element there adds to the
light, whose field it multiplies by exp(i phi).  Of a mirror both are in the plane of its pupil.  Whatever is behind it, screen or
other elements, does not matter.  Each of several sources has files of its own, of which those of the second end in -2.

    NAME.phase.png      16 bits, of which LEVELS values are 2 pi; columns run along +x, rows along -y, as seen from +z
    NAME.phase.npy      rad, (n, m) float64, [i, j] with i along +x and j along +y, at the centres of the pixels
    NAME.phase.json     pixel pitch, mm, wavelength, nm, levels, and the largest step between neighbouring pixels, rad
    NAME.phase.stl      the relief of height phi lambda / 2 pi (n - 1) on a plate of the lens' glass and least thickness, or of a
                        reflecting surface of height phi lambda / 4 pi, mm
    NAME.phase.clear.png    255 where a round lens, or one of round lenslets, is clear, and 0 where light is stopped

With fewer levels all of them hold the nearest of so many phases, evenly spaced in a turn: of a kinoform of N steps, whose
efficiency is sinc^2(1 / N), as the rest goes to other orders.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, PngImagePlugin
from torch import Tensor

from caustic_cli.errors import InputError
from caustic_cli.export.mesh import solid
from caustic_cli.export.stl import write_mesh
from caustic_cli.io.files import SOFTWARE, atomic_file, write_bytes
from caustic_cli.optics.emission.coherent import central_mode
from caustic_cli.optics.frames import IDENTITY
from caustic_cli.optics.receiver import NormalPlane
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import ENTRANCE, EXIT
from caustic_cli.optics.waves.image import lines_of
from caustic_cli.optics.waves.wavefront import Optics, survey, wavefront
from caustic_cli.scene import Lens, Scene, Screen
from caustic_cli.schema import checks

#: Values of a picture's pixel, one turn of the phase.
LEVELS = 1 << 16
#: Distance of the plane behind a surface from it, over the lens' semi-aperture.
CLOSE = 1e-4
#: Pixels along an axis, at least and at most, by default: so many that the phase turns by less than half between neighbours.
LEAST, MOST = 512, 8192


def companions(path: Path, scene: Scene) -> list[Path]:
    """The files beside the first picture."""
    files = _each(path, scene)
    return [*files[1:], *(found for file in files for found in _beside(file, scene.lens))]


def _each(path: Path, scene: Scene) -> list[Path]:
    """The picture of each source."""
    return [path if k == 1 else path.with_stem(f"{path.stem}-{k}") for k in range(1, len(scene.by_source) + 1)]


def _beside(path: Path, lens: Lens) -> list[Path]:
    """The files beside a picture: array, description, relief, and what is clear of the aperture."""
    return [path.with_suffix(suffix) for suffix in (".npy", ".json", ".stl", *[".clear.png"] * _partly(lens))]


def _partly(lens: Lens) -> bool:
    """Whether only a part of the rectangle around the aperture is clear."""
    return lens.opening.round or lens.round_lenslets


def phase_of(scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | int | None = None) -> np.ndarray:
    """phi - that at the centre, not wrapped, rad, at the centres of pixels over the aperture: (n, m) float64; of the first source.

    Raises:
        InputError: there are too many pixels.
        NoWaveImage: rays cross in front of the plane.
    """
    return _turned(_behind(scene, field, heights), scene.lens, samples)


def _turned(optics: Optics, lens: Lens, samples: tuple[int, int] | int | None) -> np.ndarray:
    """The same of light behind the lens."""
    seen, half = survey(optics), lens.opening.half_size
    count = (samples, samples) if isinstance(samples, int) else samples or _enough(optics, half)
    if max(count) > MOST:
        raise InputError(f"⟨samples⟩ must be at most {MOST} along an axis, got {max(count)}: with fewer the phase is not resolved")
    step = 2.0 * half[0] / count[0], 2.0 * half[1] / count[1]
    with torch.no_grad():
        path = wavefront(optics, seen, (-half[0], -half[1]), step, count).path - _path_in_front(optics, lens, step, count)
    path = path - path[count[0] // 2, count[1] // 2]
    return path.numpy() * (2.0 * math.pi / optics.wavelength)


def _behind(scene: Scene, field: HeightField, heights: Tensor) -> Optics:
    """The light of the first source right behind the lens, on a plane that touches its surface; what follows does not matter."""
    scene, lens, heights = scene.by_source[0], scene.lens, heights.detach().double().cpu()
    side = lens.interaction.side
    z = side * (float((side * heights).max()) + CLOSE * lens.opening.reach)
    line = lines_of(replace(scene, screen=Screen(lens.size, z), second_target=None, elements=scene.in_front), field)[0]
    at = lens.interaction.first(float(heights.mean()), lambda: lens.pupil.z)
    plane, mode = NormalPlane(IDENTITY, z), central_mode(line.system)
    return Optics(line.system, mode, {EXIT: heights}, line.length, line.label, plane, side * (z - at))


def _path_in_front(behind: Optics, lens: Lens, step: tuple[float, float], count: tuple[int, int]) -> Tensor:
    """Optical path to the lens' pupil at the middles of pixels, (n, m) mm, but for a constant."""
    names = [e.name for e in behind.system.elements]
    first = names.index(ENTRANCE) if ENTRANCE in names else names.index(EXIT)
    if first:  # through the elements in front
        system = replace(behind.system, elements=behind.system.elements[:first])
        plane = NormalPlane(IDENTITY, lens.pupil.z)
        there = replace(behind, system=system, mode=central_mode(system), plane=plane, distance=0.0)
        half = lens.opening.half_size
        return wavefront(there, survey(there), (-half[0], -half[1]), step, count).path
    lines = ((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in count)
    u, v = (c.reshape(-1) for c in torch.meshgrid(*lines, indexing="ij"))
    path = behind.mode.through(u, v).path
    return path.view(count) if isinstance(path, Tensor) else torch.full(count, float(path))


def _enough(optics: Optics, half_size: tuple[float, float]) -> tuple[int, int]:
    """Pixels between which the phase turns by less than half, by the rays of a survey."""
    line = torch.linspace(0.0, 1.0, 65, dtype=torch.float64)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    found = optics.intercepts(u, v)
    lit = found.power > 0
    steepest = [float(q[lit].abs().max()) for q in (found.qx, found.qy)]
    x, y = (max(LEAST, 2 * math.ceil(2.2 * half * q / optics.wavelength)) for half, q in zip(half_size, steepest, strict=True))
    return x, y


def write_phase(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | int | None = None,
    levels: int = LEVELS,
) -> None:
    """Write the files of each source, each atomically; samples: pixels along x and y; levels: of the phase, 2 to LEVELS.

    Raises:
        InputError, NoWaveImage: as of `phase_of`; the levels are out of range; or a file cannot be written there.
    """
    path, levels = Path(path), checks.whole("⟨levels⟩", levels, 2, LEVELS)
    for file, one in zip(_each(path, scene), scene.by_source, strict=True):
        optics = _behind(one, field, heights)
        _write(file, one.lens, _turned(optics, one.lens, samples), optics.wavelength, levels)


def _write(path: Path, lens: Lens, phase: np.ndarray, length: float, levels: int) -> None:
    """The files of one source; length: of a wave, mm."""
    wrapped = phase % (2.0 * math.pi)
    if levels < LEVELS:
        wrapped = np.rint(wrapped * (levels / (2.0 * math.pi))) % levels * (2.0 * math.pi / levels)
    counts = (np.rint(wrapped * (LEVELS / (2.0 * math.pi))).astype(np.int64) % LEVELS).astype(np.uint16)
    _write_picture(path, counts)
    array, said, relief, *clear = _beside(path, lens)
    held = io.BytesIO()
    np.save(held, wrapped)
    write_bytes(array, held.getvalue())
    pitch = [2.0 * half / n for half, n in zip(lens.opening.half_size, phase.shape, strict=True)]
    x, y = (p * (np.arange(n) + 0.5 - 0.5 * n) for p, n in zip(pitch, phase.shape, strict=True))
    x, y = np.meshgrid(x, y, indexing="ij")
    for file in clear:
        _write_picture(file, (255 * (lens.opening.contains(x, y) & lens.clear.contains(x, y))).astype(np.uint8))
    high = length / abs(lens.effective_index - 1.0)
    about = {
        "created_by": SOFTWARE,
        "file": path.name,
        "wavelength_nm": 1e6 * length,
        "pixels": list(phase.shape),
        "pixel_pitch_mm": pitch,
        "levels": levels,
        "values_of_a_turn": LEVELS,
        "orientation": "seen from +z: columns run along +x, rows along -y; the field is multiplied by exp(i phase)",
        "largest_step_rad": max(float(np.abs(np.diff(phase, axis=k)).max()) for k in (0, 1)),
        "relief_height_mm": high,
        **({"clear": clear[0].name} if clear else {}),
    }
    write_bytes(said, (json.dumps(about, indent=1, allow_nan=False) + "\n").encode())
    side = lens.interaction.side
    base = lens.z_in + side * max(lens.min_thickness, length) + min(0, side) * high
    write_mesh(relief, *solid(np.stack([x, y, base + wrapped * (high / (2.0 * math.pi))], -1), lens))


def _write_picture(path: Path, values: np.ndarray) -> None:
    """A grey picture of values (n, m), [i, j] with i along +x and j along +y."""
    info = PngImagePlugin.PngInfo()
    info.add_text("Software", SOFTWARE)
    with atomic_file(path) as file:
        Image.fromarray(np.ascontiguousarray(values.T[::-1])).save(file, format="PNG", pnginfo=info)
