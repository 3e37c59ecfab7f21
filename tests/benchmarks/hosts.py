"""How commands scale over the processes that `torchrun` starts, on one machine or several.

    python tests/benchmarks/hosts.py [--rounds 3] [--processes 1,2] [--only tolerances,study,batch,design]

Some twenty minutes on two cores; prints two Markdown tables.  Measured: medians of wall time, and of processor time of all
processes, over rounds in which the numbers of processes are taken in turn, with one thread each.  Simulated, for more processes
than a machine has cores: every process takes the next item when it is free, as `optics.ranks.mapped` does, with the times that the
items took in one process; what is not an item takes the time that it took there.  Times of transfer are left out.
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SIMULATED = (1, 2, 4, 8, 16, 32)
FLAME = [str(EXAMPLES / "flame.png"), "--quality", "draft", "--waves", "off", "--resolution", "64"]
#: A command in one process that writes the times of its items, s, and its whole time.
TIMED = """
import json, runpy, sys, time
began = time.perf_counter()
from caustic_cli.optics import ranks

def mapped(function, items, progress=lambda done: None):
    def timed(item):
        start = time.perf_counter()
        found = function(item)
        times[-1].append(time.perf_counter() - start)
        return found
    times.append([])
    return usual(timed, items, progress)

times, usual, ranks.mapped = [], ranks.mapped, mapped
sys.argv = sys.argv[2:]
run = runpy.run_path if sys.argv[0].endswith(".py") else runpy.run_module
try:
    run(sys.argv[0], run_name="__main__")
except SystemExit as stop:
    assert not stop.code, stop.code
print(json.dumps({"items": times, "whole": time.perf_counter() - began}), file=sys.stderr)
"""
#: Eight lenses of different magnifications.
BATCH = """
import sys
from caustic_cli import design, spread

def error(mag):
    return design(sys.argv[1], mag=mag, resolution=48, quality="draft", waves="off").figures["relative_rms"]

if __name__ == "__main__":
    print(spread(error, [1.0 + 0.25 * k for k in range(8)]))
"""
#: Errors of 24 draws.
ERRORS = "draws = 24\n[index]\nsigma = 1e-3\n[throw]\nsigma = 1.0\n[form_error]\nrms = 1e-4\nshortest = 2.0\n"
#: Shorter stages of a lamp, and rays of the last one that are five parts.
LAMP = "standard lamp_stages=((800,20000,20,0.1),(24000,600000,10,0.006))"


def commands(folder: Path) -> dict[str, tuple[list[str], str]]:
    """Commands by name, each with the environment's effort."""
    lens, out = folder / "lens.caustic", folder / "out"
    caustic = [sys.executable, "-m", "caustic_cli"]
    subprocess.run([*caustic, "design", *FLAME, "--quiet", "-o", str(lens)], check=True, stdout=subprocess.DEVNULL)
    (folder / "batch.py").write_text(BATCH)
    (folder / "errors.toml").write_text(ERRORS)
    errors = ["--tolerances", str(folder / "errors.toml"), "--rays", "1e5", "--effects", "none", "-o", str(out / "image.png")]
    lamp = ["uniform", "--lamp", "30", "--throw", "1m", "--picture-size", "1x1m", "-o", str(out / "lamp")]
    given = ["--quiet", "--threads", "1", "--force"]
    return {
        "tolerances": (["caustic_cli", "render", str(lens), *errors, *given], ""),
        "study": (
            ["caustic_cli", "convergence", str(lens), "--study", "rays", "--rays", "1e5", "--repeats", "6", "-o", str(out), *given],
            "",
        ),
        "batch": ([str(folder / "batch.py"), FLAME[0]], ""),
        "design": (["caustic_cli", "design", *lamp, *given], LAMP),
    }


def run(command: list[str], effort: str, processes: int) -> tuple[float, float]:
    """Wall and processor time, s."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **({"CAUSTIC_EFFORT": effort} if effort else {})}
    torchrun = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"] if processes > 1 else []
    own = ["--", *command] if processes > 1 and command[0] == "caustic_cli" else command
    if command[0].endswith(".py"):
        torchrun = torchrun[:-1]
    module = ["-m"] if torchrun or command[0] == "caustic_cli" else []
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, *module, *torchrun, *own], capture_output=True, text=True, check=False, env=environment)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        raise SystemExit(done.stderr)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def items_of(command: list[str]) -> tuple[list[list[float]], float]:
    """Times of the items of each list that is mapped, s, and of what is not an item."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", TIMED, "-", *command], capture_output=True, text=True, check=True, env=environment)
    said = json.loads(done.stderr.splitlines()[-1])
    return said["items"], said["whole"] - sum(map(sum, said["items"]))


def makespan(times: list[float], processes: int) -> float:
    """Time until the last of these items is done, each taken in its turn by the first process that is free."""
    free = [0.0] * processes
    for seconds in times:
        heapq.heappush(free, heapq.heappop(free) + seconds)
    return max(free)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--processes", default="1,2")
    parser.add_argument("--only", default="tolerances,study,batch,design")
    options = parser.parse_args()
    counts, names = [int(n) for n in options.processes.split(",")], options.only.split(",")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "out").mkdir()
        chosen = {name: command for name, command in commands(Path(folder)).items() if name in names}
        print("| command | processes | wall, s | processor, s | times as fast (least to most) |\n| --- | --- | --- | --- | --- |")
        for name, (command, effort) in chosen.items():
            rounds = [[run(command, effort, n) for n in counts] for _ in range(options.rounds)]
            for n, times in zip(counts, zip(*rounds, strict=True), strict=True):
                wall, processor = (statistics.median(column) for column in zip(*times, strict=True))
                faster = sorted(first[0][0] / own[0] for first, own in zip(rounds, times, strict=True))
                ratio = f"{statistics.median(faster):.2f} ({faster[0]:.2f} to {faster[-1]:.2f})"
                print(f"| {name} | {n} | {wall:.1f} | {processor:.1f} | {ratio} |", flush=True)
        print(f"\n| command | items, s | rest, s | {' | '.join(map(str, SIMULATED))} processes |")
        print("| --- | --- | --- |" + " --- |" * len(SIMULATED))
        for name, (command, _) in chosen.items():
            items, rest = items_of(command)
            if not any(items):
                continue
            whole = rest + sum(map(sum, items))
            faster = [whole / (rest + sum(makespan(times, n) for times in items)) for n in SIMULATED]
            told = " + ".join(f"{len(times)} of {min(times):.2f} to {max(times):.2f}" for times in items if times)
            print(f"| {name} | {told} | {rest:.1f} | {' | '.join(f'{f:.2f}' for f in faster)} |", flush=True)


if __name__ == "__main__":
    main()
