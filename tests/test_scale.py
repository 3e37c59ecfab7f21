"""What the benchmark of scale says of time, memory and order is so of work whose time, memory and order are known."""

import subprocess
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent / "benchmarks"))
from scale import MIB, alone, design_table, measured, order, ray_table


def busy(mebibytes: int, seconds: float) -> None:
    """A child process that fills so much memory and computes so long."""
    code = f"import time; held = bytearray(b'x' * ({mebibytes} << 20)); end = time.process_time() + {seconds}\n"
    subprocess.run([sys.executable, "-c", code + "while time.process_time() < end: pass"], check=True)


def test_resources_are_those_of_the_one_child():
    large, small = alone(measured, busy, 400, 0.3), alone(measured, busy, 1, 0.0)
    assert 400 * MIB < large["peak"] < 1000 * MIB  # the bytes and their copy, and the interpreter
    assert small["peak"] < 300 * MIB  # nothing of the child before
    assert large["processor"] >= 0.3 and large["wall"] >= 0.3


def test_order_of_a_power():
    assert order([1.0, 10.0, 100.0], [3.0, 3e1 * 10**0.5, 3e3]) == pytest.approx(1.5)


def test_tables_give_parts():
    row = {"pixels": 100, "control": (203, 203), "wall": 7.4, "processor": 12.0, "peak": 2.0**30, "size": 2.0**21}
    row |= {"relative_rms": 0.05, "noise": 0.001, "rays": 32_000_000}
    assert design_table([row]).splitlines()[-1] == (
        "| 100 x 100 | 203 x 203 | 7 | 12 | 1200 | 1.00 | 107374 | 2.0 | 0.0500 ± 0.0010 | 3.2e+07 |"
    )
    assert (
        ray_table([{"rays": 1000, "image": 2e-3, "iteration": 4e-3}]).splitlines()[-1] == "| 1,000 | 0.002 | 2000 | 0.004 | 4000 |"
    )
