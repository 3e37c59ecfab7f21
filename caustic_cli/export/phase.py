"""The phase of a lens for its first wavelength, wrapped: for a phase modulator, or as the relief of a diffractive plate (kinoform).

    phi = 2 pi / lambda (v - v_in)  mod 2 pi

with v the optical path to the plane behind the lens and v_in that to its pupil, at the same point (`optics.waves.wavefront`): what
a thin element there adds to the light, whose field it multiplies by exp(i phi).

    NAME.phase.png      16 bits, of which LEVELS values are 2 pi; columns run along +x, rows along -y, as seen from +z
    NAME.phase.npy      rad, (n, m) float64, [i, j] with i along +x and j along +y, at the centres of the pixels
    NAME.phase.json     pixel pitch, mm, wavelength, nm, levels, and the largest step between neighbouring pixels, rad
    NAME.phase.stl      the relief of height phi lambda / 2 pi (n - 1) on a plate of the lens' glass and least thickness, mm

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
from caustic_cli.optics.receiver import Receiver
from caustic_cli.optics.surfaces.heightfield import HeightField
from caustic_cli.optics.system import EXIT
from caustic_cli.optics.waves.image import lines_of
from caustic_cli.optics.waves.wavefront import Optics, distance_of, survey, wavefront
from caustic_cli.scene import Scene
from caustic_cli.schema import checks

#: Values of a picture's pixel, one turn of the phase.
LEVELS = 1 << 16
#: Pixels along an axis, at least and at most, by default: so many that the phase turns by less than half between neighbours.
LEAST, MOST = 512, 8192


def companions(path: Path) -> list[Path]:
    """The files beside the picture."""
    return [path.with_suffix(suffix) for suffix in (".npy", ".json", ".stl")]


def phase_of(scene: Scene, field: HeightField, heights: Tensor, samples: tuple[int, int] | int | None = None) -> np.ndarray:
    """phi - that at the centre, not wrapped, rad, at the centres of pixels over the aperture: (n, m) float64.

    Raises:
        InputError: there are too many pixels.
        NoWaveImage: rays cross in front of the plane.
    """
    scene = scene.onto(replace(scene.screen, far=False))  # the phase is that of the lens, whatever is behind it
    line = lines_of(scene, field)[0]
    plane, parameters = Receiver.of(line.system, scene.screen).plane, {EXIT: heights.double()}
    mode = central_mode(line.system)
    optics = Optics(line.system, mode, parameters, line.length, line.label, plane, distance_of(line.system, parameters, plane))
    seen, half = survey(optics), scene.lens.opening.half_size
    count = (samples, samples) if isinstance(samples, int) else samples or _enough(optics, line.length)
    if max(count) > MOST:
        raise InputError(f"⟨samples⟩ must be at most {MOST} along an axis, got {max(count)}: with fewer the phase is not resolved")
    step = 2.0 * half[0] / count[0], 2.0 * half[1] / count[1]
    with torch.no_grad():
        path = wavefront(optics, seen, (-half[0], -half[1]), step, count).path
        u, v = (
            c.reshape(-1) for c in torch.meshgrid(*((torch.arange(n, dtype=torch.float64) + 0.5) / n for n in count), indexing="ij")
        )
        before = mode.through(u, v).path
    path = path - (before.view(count) if isinstance(before, Tensor) else before)
    path = path - path[count[0] // 2, count[1] // 2]
    return path.numpy() * (2.0 * math.pi / line.length)


def _enough(optics: Optics, length: float) -> tuple[int, int]:
    """Pixels between which the phase turns by less than half, by the rays of a survey."""
    line = torch.linspace(0.0, 1.0, 65, dtype=torch.float64)
    u, v = (c.reshape(-1) for c in torch.meshgrid(line, line, indexing="ij"))
    found = optics.intercepts(u, v)
    lit = found.power > 0
    steepest = [float(q[lit].abs().max()) for q in (found.qx, found.qy)]
    x, y = (
        max(LEAST, 2 * math.ceil(2.2 * half * q / length))
        for half, q in zip(optics.mode.scene.pupil.half_size, steepest, strict=True)
    )
    return x, y


def write_phase(
    path: str | Path,
    scene: Scene,
    field: HeightField,
    heights: Tensor,
    samples: tuple[int, int] | int | None = None,
    levels: int = LEVELS,
) -> None:
    """Write the four files, each atomically; samples: pixels along x and y; levels: of the phase, 2 to LEVELS.

    Raises:
        InputError, NoWaveImage: as of `phase_of`; the levels are out of range; or a file cannot be written there.
    """
    path, levels = Path(path), checks.whole("⟨levels⟩", levels, 2, LEVELS)
    phase, length = phase_of(scene, field, heights, samples), 1e-6 * lines_of(scene, field)[0].wavelength
    wrapped = phase % (2.0 * math.pi)
    if levels < LEVELS:
        wrapped = np.rint(wrapped * (levels / (2.0 * math.pi))) % levels * (2.0 * math.pi / levels)
    info = PngImagePlugin.PngInfo()
    info.add_text("Software", SOFTWARE)
    counts = (np.rint(wrapped * (LEVELS / (2.0 * math.pi))).astype(np.int64) % LEVELS).astype(np.uint16)
    with atomic_file(path) as file:
        Image.fromarray(np.ascontiguousarray(counts.T[::-1])).save(file, format="PNG", pnginfo=info)
    array, said, relief = companions(path)
    held = io.BytesIO()
    np.save(held, wrapped)
    write_bytes(array, held.getvalue())
    pitch = [2.0 * half / n for half, n in zip(scene.lens.opening.half_size, phase.shape, strict=True)]
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
        "relief_height_mm": length / (scene.lens.inside - 1.0),
    }
    write_bytes(said, (json.dumps(about, indent=1, allow_nan=False) + "\n").encode())
    base = scene.lens.z_in + max(scene.lens.min_thickness, length)
    z = base + wrapped * (length / (2.0 * math.pi * (scene.lens.inside - 1.0)))
    x, y = (p * (np.arange(n) + 0.5 - 0.5 * n) for p, n in zip(pitch, phase.shape, strict=True))
    write_mesh(relief, *solid(np.stack([*np.meshgrid(x, y, indexing="ij"), z], -1), scene.lens))
