"""What a design costs and how good it becomes, before it is computed.

Cost model: the time of a design is the sum of the work of its parts (`work_of`: rays, transforms, cells of the transport) times
the time of a unit of each on a reference machine (`SECONDS`), times how much slower this machine is: `slowness` measures that in
half a second and keeps it for an hour.  Memory likewise (`MIBS`).

Error model: the logarithm of the error, beside what is left of any picture (`LEAST`), is linear in figures of picture and scene
(`features_of`), with coefficients for each quality, by rays and by waves (`ERRORS`).  Both models are fitted to measured designs by
`tests/benchmarks/plan.py`, which also judges them by pictures left out.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from caustic_cli.config.default_stages import transport_cells
from caustic_cli.config.design import region_of
from caustic_cli.config.settings import build_source
from caustic_cli.config.wave_stages import transform_samples
from caustic_cli.errors import CausticError, InputError
from caustic_cli.inverse.accuracy_cost import Aim
from caustic_cli.inverse.target import grey
from caustic_cli.io.files import Piped, read_bytes, write_bytes
from caustic_cli.io.picture import Picture
from caustic_cli.kinds import OneSurface, kind_of
from caustic_cli.optics.kernels.cache import bases
from caustic_cli.optics.resolution import Resolution
from caustic_cli.project.new import new_project
from caustic_cli.project.packing import expected_bytes
from caustic_cli.project.project import Project
from caustic_cli.scene.light import WAVE_NODES
from caustic_cli.studies.judge import judge_of
from caustic_cli.studies.retrace import evaluation_rays
from caustic_cli.workflow.reporter import Reporter

#: Size of the pictures of a project, MiB.
PICTURES = 1.0
QUALITIES = ("draft", "standard", "fine")
#: Evaluations in which a stage on the wave image is prepared, beside its iterations.
PREPARED = 8
#: Retraces of an evaluation and of the curve of the error, of a design by rays and by waves.
RETRACES = {False: 11.0, True: 2.5}
#: Seconds that a calibration is valid, and that it takes.
VALID, CALIBRATION = 3600.0, 0.5
#: Size of the transform and number of the elements of the calibration, and their times on the reference machine, s.
SIDE, ELEMENTS, REFERENCE = 1024, 1 << 20, (0.0060, 0.0079)
SPEEDS, MOST_BYTES = "speed.json", 10_000
MIB = 2.0**20


class Work(NamedTuple):
    """The work of a design, in millions but for the first: a design at all; cells of the transport; rays times iterations; control
    points times iterations; samples of transforms, of iterations and of the evaluation; rays of the evaluation."""

    design: float
    cells: float
    rays: float
    control: float
    transforms: float
    verdict: float
    retraced: float


#: Seconds for a unit of each part on the reference machine.
SECONDS = Work(5.06, 0.537, 0.0327, 0.0281, 0.0151, 0.019, 0.00588)
#: MiB for a unit of each part of `memory_of`.
MIBS = (748.0, 106.0, 93.0)
#: Error of designs of the smoothest pictures, by judge.
LEAST = {"waves": 0.02, "rays": 0.0}
#: Judge and quality -> coefficients of `features_of`, and the standard deviation of the logarithm of the error about them.
ERRORS: dict[tuple[str, str], tuple[tuple[float, ...], float]] = {
    ("waves", "draft"): ((-1.124, 0.622, -0.03, -0.012, 0.0), 0.173),
    ("waves", "standard"): ((-3.08, 1.07, -0.1, 1.44, -0.78), 0.303),
    ("waves", "fine"): ((-0.64, 1.31, -0.14, 0.0, -1.14), 0.259),
    ("rays", "draft"): ((-2.342, 0.351, 0.323, 0.0, 0.221), 0.536),
    ("rays", "standard"): ((-1.73, 0.528, 0.499, 0.0, -0.132), 0.204),
    ("rays", "fine"): ((-2.165, 0.432, 0.386, 0.0, -0.142), 0.426),
}


def work_of(problem: OneSurface, samples: float) -> Work:
    """The work of a design; samples: of a transform at one wavelength."""
    stages = problem.stages
    by_waves = [s for s in stages if s.waves]
    by_rays = [s for s in stages if not s.waves and not (s.spare and by_waves)]
    spans = min(n - p for n, p in zip(stages[0].control, problem.scene.lens.degree, strict=True))
    cells = transport_cells(max(s.rays for s in stages), not problem.scene.source.collimated, spans, problem.effort.source_cells)
    rays = evaluation_rays(problem.scene, problem.effort.final_rays)
    last, million = stages[-1].control, 1e-6
    return Work(
        1.0,
        million * cells**2,
        million * sum(s.iterations * s.rays for s in by_rays),
        million * (sum(s.iterations * math.prod(s.control) for s in stages if s in by_rays) + math.prod(last)),
        million * samples * sum((s.iterations + PREPARED) * len(s.waves) for s in by_waves),
        million * samples * WAVE_NODES if by_waves else 0.0,
        million * rays * RETRACES[bool(by_waves)],
    )


def features_of(problem: OneSurface, size: tuple[float, float]) -> np.ndarray:
    """1, and logarithms of what decides how good a lens is: of the detail of the picture, its relative RMS difference to itself
    blurred by a pixel; of the bright part of it; of the blur by diffraction over the pixel; and of its contrast, the relative RMS
    difference to its mean.

    size: of the picture, mm.
    """
    target = grey(problem.target.numpy())
    detail = float(np.sqrt(np.mean((target - gaussian_filter(target, 1.0)) ** 2)) / target.mean())
    bright = float(np.mean(target > 0.02 * target.max()))
    seen = Resolution.before(problem.scene, size)
    blur, contrast = seen.diffraction / seen.pixel, float(target.std() / target.mean())
    return np.array([1.0, *(math.log(max(value, 1e-3)) for value in (detail, bright, blur, contrast))])


def expected_error(coefficients: Sequence[float], features: np.ndarray, by: str) -> float:
    """The error by a judge, from coefficients of `ERRORS` and `features_of`."""
    return math.hypot(math.exp(float(features @ np.array(coefficients))), LEAST[by])


def cut_off_error(problem: OneSurface) -> float:
    """The error that diffraction leaves to any lens: the part of the picture at spatial frequencies above w / (lambda L), the
    incoherent cut-off of a lens of width w at distance L, over the mean of the picture.  A bound for a picture that repeats itself
    beyond the screen; for others but for what their border adds."""
    target = grey(problem.target.numpy())
    scene = problem.scene
    shortest = 1e-6 * min(scene.light.lines()[0])
    limits = [w / (shortest * abs(scene.screen.z)) for w in scene.lens.size]
    fx, fy = (np.fft.fftfreq(n, d) for n, d in zip(target.shape, scene.screen.pixel, strict=True))
    beyond = (np.abs(fx)[:, None] > limits[0]) | (np.abs(fy) > limits[1])
    power = np.abs(np.fft.fft2(target)) ** 2
    return float(np.sqrt(power[beyond].sum() / power[0, 0])) if beyond.any() else 0.0


def slowness() -> tuple[float, float]:
    """Times of a transform and of arithmetic over those of the reference machine, measured now or within the last hour."""
    path = next((base / SPEEDS for base in bases()), None)
    with suppress(CausticError, OSError, ValueError, KeyError, TypeError):  # there is none, or it is damaged: it is measured
        kept = json.loads(read_bytes(path, MOST_BYTES, "speeds of this machine")) if path is not None else {}
        if 0 <= time.time() - kept["at"] < VALID and kept["threads"] == torch.get_num_threads():
            return float(kept["transform"]), float(kept["arithmetic"])
    found = measured_slowness()
    with suppress(OSError, CausticError):  # it cannot be kept: it is measured again the next time
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            kept = {"at": time.time(), "threads": torch.get_num_threads(), "transform": found[0], "arithmetic": found[1]}
            write_bytes(path, json.dumps(kept).encode())
    return found


def measured_slowness() -> tuple[float, float]:
    """The same, measured for CALIBRATION seconds: the least times on one thread, which other programs disturb least."""
    generator, threads = torch.Generator().manual_seed(0), torch.get_num_threads()
    field = torch.randn(SIDE, SIDE, generator=generator, dtype=torch.complex64)
    values = torch.rand(ELEMENTS, generator=generator, dtype=torch.float64)
    spectrum, sines, cosines = torch.empty_like(field), torch.empty_like(values), torch.empty_like(values)

    def transform() -> None:
        torch.fft.fft2(field, out=spectrum)

    def arithmetic() -> None:  # in place, since new pages may take twice as long as the work
        torch.sin(values, out=sines)
        torch.cos(values, out=cosines)
        sines.mul_(cosines).add_(1.0).sqrt_()

    times = [math.inf, math.inf]
    torch.set_num_threads(1)
    try:
        end = time.perf_counter() + CALIBRATION
        while time.perf_counter() < end:
            for k, work in enumerate((transform, arithmetic)):  # in turn, so that a pause of the machine hits one of many
                began = time.perf_counter()
                work()
                times[k] = min(times[k], time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads)
    return times[0] / REFERENCE[0], times[1] / REFERENCE[1]


class Estimate(NamedTuple):
    """What one design would cost: quality; judge, waves or rays; its error, and the range that holds two of three designs; seconds
    on this machine; memory, MiB; size of the project, MiB; and the bound below which no lens comes."""

    quality: str
    error_by: str
    relative_rms: float
    low: float
    high: float
    seconds: float
    memory_mib: float
    project_mib: float
    bound: float


def estimate(project: Project, quality: str, slow: tuple[float, float]) -> Estimate:
    """The estimate for a project, whose settings are those of this quality.

    Raises:
        InputError: designs of this kind have not been measured.
    """
    problem = problem_of_plan(project)
    s = project.settings
    by = "waves" if any(stage.waves for stage in problem.stages) else "rays"
    seen = Resolution.before(problem.scene, s.target.size)
    work = work_of(problem, transform_samples(s, seen, project.picture.lit))
    factors = Work(slow[1], slow[1], slow[1], slow[1], slow[0], slow[0], slow[1])
    seconds = sum(a * b * c for a, b, c in zip(SECONDS, work, factors, strict=True))
    coefficients, spread = ERRORS[by, quality]
    own = expected_error(coefficients, features_of(problem, s.target.size), by)
    bound = cut_off_error(problem) if by == "waves" else 0.0
    error = math.hypot(own, bound)
    net = problem.stages[-1].control
    memory = sum(a * b for a, b in zip(MIBS, memory_of(problem, work), strict=True))
    size = 2.0 * expected_bytes(math.prod(net)) / MIB + PICTURES
    return Estimate(quality, by, error, error * math.exp(-spread), error * math.exp(spread), seconds, memory, size, bound)


def memory_of(problem: OneSurface, work: Work) -> tuple[float, float, float]:
    """What memory is proportional to: 1; millions of control points; millions of samples of a transform times wavelengths kept."""
    most = max((len(s.waves) for s in problem.stages), default=0)
    samples = work.verdict / WAVE_NODES
    return 1.0, 1e-6 * math.prod(problem.stages[-1].control), samples * most


def problem_of_plan(project: Project) -> OneSurface:
    """The problem of a project of a kind that the models know.

    Raises:
        InputError: they do not.
    """
    kind, source = kind_of(project.settings), build_source(project.settings.source)
    if kind is not OneSurface or not source.collimated or source.extended or project.settings.design.network != "none":
        raise InputError(
            "⟨plan⟩ and ⟨error⟩ know designs of one surface for a plane wave, to which their models were fitted, and this is"
            " another; ⟨+quality⟩ or ⟨+design.time_limit⟩ chooses what to pay for"
        )
    if region_of(project.settings.design) is not None:
        raise InputError(
            "⟨plan⟩ and ⟨error⟩ do not know ⟨design.loss⟩ log-rms, whose error depends on the part of the light that is asked for:"
            " convergence ⟨study⟩ light measures it for a design"
        )
    return kind.of(project)


def plans(
    target: Path | Piped | Picture, given: Mapping[str, Any], *, preset: str | None = None, config: Path | None = None
) -> Iterator[Estimate]:
    """Estimates for each quality, by the judge that the settings choose and by rays alone where that is another.

    Raises:
        InputError: invalid input, or designs of this kind have not been measured.
    """
    slow = slowness()
    judges: set[str] = set()
    for changed in (dict[str, Any](), {"design.waves": "off"}):
        if changed and "waves" not in judges:
            break
        for quality in QUALITIES:
            settings = {**given, "quality": quality, **changed}
            project, _ = new_project(target, settings, preset, config, None, lambda _: None)
            found = estimate(project, quality, slow)
            judges.add(found.error_by)
            yield found


def cheapest(
    target: Path | Piped | Picture,
    given: Mapping[str, Any],
    error: float,
    say: Reporter,
    *,
    preset: str | None = None,
    config: Path | None = None,
) -> list[tuple[str, Aim]]:
    """The cheapest quality that should reach an error, and those after it; says so where none should.

    If a quality does not reach it, further iterations may take as long as the next one should, of the last as it should itself.

    Raises:
        InputError: as of `plans`.
    """
    found = list(islice(plans(target, given, preset=preset, config=config), len(QUALITIES)))
    good = [k for k, e in enumerate(found) if e.relative_rms <= error]
    first = good[0] if good else len(found) - 1
    e = found[first]
    between = f"{e.low:.2g} to {e.high:.2g}"
    say.say(f"{e.quality}: an error of {e.relative_rms:.2g} by {e.error_by} ({between}) in {e.seconds:.0f} s is expected")
    if e.low > error:
        say.say(f"an error of {error:g} is less than any quality is expected to reach")
    longest = [*(e.seconds for e in found[first + 1 :]), found[-1].seconds]
    return [(e.quality, Aim(error, seconds)) for e, seconds in zip(found[first:], longest, strict=True)]


def noise_of(figures: Mapping[str, Any]) -> float:
    """What the judge's own light leaves uncertain of an error, by the figures of a design."""
    return figures.get(judge_of(figures).unsure) or 0.0


def reached(figures: Mapping[str, Any], error: float, quality: str, say: Reporter) -> bool:
    """Whether a lens has at most this error, within its noise; if not, says what follows."""
    if figures["error"] <= error + noise_of(figures):
        return True
    last = quality == QUALITIES[-1]
    say.say(f"{quality}: error of {figures['error']:.3g}, more than {error:g}" + (": no quality reaches it" if last else ""))
    return False
