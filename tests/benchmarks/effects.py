"""What a plane wave pays for effects that it does not have, and what every effect costs where a scene has it.

    python tests/benchmarks/effects.py [CHECKOUT]      about three minutes on two cores; writes results/effects.md

The setting is table D.2's, see speed.py.  An iteration is image, loss and gradient.  The path that a plan has compiled takes turns
with one put together by hand (a `Tracer` lowered to the fused kernel, and nothing else), and with the same iteration of another
CHECKOUT of this program, in a process of its own with that checkout's own benchmark, if one is given: say, one from before there
were effects.  The order within a round alternates.  Times are
processor time of one thread, which other programs on the machine disturb least.  Ratios are medians of the rounds' ratios, with
their quartiles.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch
from speed import BASE, Filter, Objective, Sampler, scene

ROUNDS, EFFECT_ROUNDS = 60, 3
ONE = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


def iteration(s=None, bare: bool = False):
    """A function that does one iteration of scene `s`, by default the setting's own."""
    own, field, heights = scene(BASE["control"], BASE["degree"], BASE["pixels"])
    s = s or own
    f = Filter(BASE["kind"], (BASE["filter"],) * 2, (BASE["alpha"],) * 2)
    target = torch.rand((250, 250), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    from caustic_cli.inverse.schedule import LossImage  # noqa: PLC0415
    from caustic_cli.optics.emission import rays_of  # noqa: PLC0415
    from caustic_cli.optics.system import System  # noqa: PLC0415
    from caustic_cli.optics.trace import Tracer  # noqa: PLC0415

    made = Objective(s, field, rays_of(s, "grid", BASE["rays"]), target, "rms-light", LossImage(f))
    if bare:
        (sample,) = Sampler.of_size("grid", BASE["rays"]).chunks()
        made.kept = [Tracer(System.of(s, field), sample, torch.float32)]
        assert made.kept[0].fused is not None
    return lambda: made(heights)


def timed(run) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began


class Elsewhere:
    """The same iteration in another process, of the program in `checkout`, as its own copy of this file does it."""

    def __init__(self, checkout: Path):
        benchmarks = checkout / "tests" / "benchmarks"
        paths = f"{checkout}{os.pathsep}{benchmarks}"
        self.process = subprocess.Popen(
            [sys.executable, str(benchmarks / "effects.py"), "--worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": paths, **ONE},
            cwd=checkout,
        )

    def __call__(self) -> float:
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


def in_turns(work: dict, rounds: int) -> dict[str, list[float]]:
    """Seconds of each piece of work; the order alternates, and the first two rounds warm up."""
    times: dict[str, list[float]] = {name: [] for name in work}
    for k in range(rounds + 2):
        for name in list(work)[:: 1 if k % 2 else -1]:
            seconds = work[name]()
            if k > 1:
                times[name].append(seconds)
    return times


def ratio(times: dict, name: str, base: str) -> str:
    low, middle, high = statistics.quantiles([a / b for a, b in zip(times[name], times[base], strict=True)], n=4)
    return f"{middle:.3f} ({low:.3f} to {high:.3f})"


def main(checkout: Path | None) -> None:
    from caustic_cli.optics.effects import EFFECTS  # noqa: PLC0415
    from caustic_cli.optics.plan import compile_plan  # noqa: PLC0415
    from caustic_cli.studies.effects import run_effects  # noqa: PLC0415

    own, field, heights = scene(BASE["control"], BASE["degree"], BASE["pixels"])
    compiling = timed(lambda: compile_plan(own, field, heights))
    plan = compile_plan(own, field, heights)
    planned, bare = iteration(plan.scene), iteration(bare=True)
    work = {"by a plan": lambda: timed(planned), "bare": lambda: timed(bare)}
    other = Elsewhere(checkout.resolve()) if checkout else None
    if other:
        here = Elsewhere(Path(__file__).resolve().parents[2])
        work |= {"this program, own process": here, "other checkout": other}
    times = in_turns(work, ROUNDS)
    out = [
        f"Table D.2's setting, {BASE['rays']:,} rays, one thread, Python {platform.python_version()},"
        f" torch {torch.__version__}; {ROUNDS} rounds. Compiling the plan, once: {1e3 * compiling:.1f} ms.",
        "",
        "| iteration | ms of processor time, median | ratio of each round, median (quartiles) |",
        "| --- | --- | --- |",
    ]
    for name, base in (
        ("bare", "bare"),
        ("by a plan", "bare"),
        ("other checkout", "other checkout"),
        ("this program, own process", "other checkout"),
    ):
        if name in times:
            out.append(f"| {name} | {1e3 * statistics.median(times[name]):.2f} | {ratio(times, name, base)} to {base} |")
    if other:
        other.close()
        here.close()
    out += ["", "| effect put in | iteration, ms | ratio to bare |", "| --- | --- | --- |"]
    for effect in EFFECTS:
        with_it = effect.probe(own, heights)
        if with_it is None or effect.name == "mirror":
            continue
        changed = iteration(with_it.scene)
        times = in_turns({"changed": lambda run=changed: timed(run), "bare": lambda: timed(bare)}, EFFECT_ROUNDS)
        median = 1e3 * statistics.median(times["changed"])
        out.append(f"| {effect.name}, {with_it.words} | {median:.1f} | {ratio(times, 'changed', 'bare')} |")
    study = run_effects(own, field, heights, rays=BASE["rays"], repeats=EFFECT_ROUNDS)
    out += [
        "",
        "| effect | in this scene | measured with | cost of a float64 image, ms | error of leaving it out | power |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    out += [
        f"| {r['series']} | {'on' if r['on'] else 'off'} | {r['amount']} | {1e3 * r['seconds']:.1f} | {r['error']:.2g} |"
        f" {r['power']:+.2%} |"
        for r in study.rows
    ]
    text = "\n".join(out) + "\n"
    path = Path(__file__).parent / "results" / "effects.md"
    path.write_text(text, encoding="utf-8")
    print(text)


def worker() -> None:
    """One iteration for every line on stdin; its seconds on stdout."""
    run = iteration()
    for _ in sys.stdin:
        print(timed(run), flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("other", type=Path, nargs="?", help="another checkout to compare with")
    parser.add_argument("--worker", action="store_true", help="one iteration for every line on stdin")
    options = parser.parse_args()
    worker() if options.worker else main(options.other)
