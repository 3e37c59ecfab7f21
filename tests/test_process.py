"""What a process loads and how it ends: derivatives without SymPy, and an end without taking down the libraries."""

from __future__ import annotations

import subprocess
import sys

import torch

from caustic_cli.optics.pullback import pull_back

DERIVATIVE = """
import sys, torch
from caustic_cli.optics.pullback import pull_back
x, before = torch.ones(3, requires_grad=True), "sympy" in sys.modules  # which some versions of torch load at once
print(pull_back([x * x], [x], [torch.ones(3)])[0].tolist(), ("sympy" in sys.modules) == before)
"""
LOADED = """
import sys
from caustic_cli.workflow import library
print(sorted({"scipy.interpolate", "scipy.optimize", "matplotlib", "caustic_cli.workflow.lamp"} & set(sys.modules)))
"""
END = """
import atexit, sys
from caustic_cli.loading import leave
class Late:
    def __del__(self):
        print("taken down")
late = Late()
atexit.register(print, "exit function")
print("work")
leave(3)
"""


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_the_library_loads_what_every_design_needs():
    """scipy.interpolate, with scipy.optimize, takes half the time that all of scipy does."""
    done = run(LOADED)
    assert done.stdout == "[]\n", done.stderr


def test_a_vector_jacobian_product_is_that_of_torch():
    """Of several outputs, one without an input among them; also where a derivative is being computed, which records no others."""
    x, y, unused = (torch.linspace(k, 2.0, 4, dtype=torch.float64, requires_grad=True) for k in (0.5, 1.0, 1.5))
    outputs, by = (x * y, (x**3).sum()), (torch.arange(4.0, dtype=torch.float64), torch.tensor(2.0, dtype=torch.float64))
    theirs = torch.autograd.grad(outputs, (x, y), by, retain_graph=True)
    with torch.no_grad():
        first, second, third = pull_back(outputs, (x, y, unused), by)
    assert torch.equal(first, theirs[0]) and torch.equal(second, theirs[1]) and third is None


def test_a_derivative_loads_no_sympy():
    assert run(DERIVATIVE).stdout.split("]") == ["[2.0, 2.0, 2.0", " True\n"]


def test_a_process_ends_after_its_exit_functions_with_all_that_it_has_said():
    done = run(END)
    assert (done.returncode, done.stdout) == (3, "work\nexit function\n")
