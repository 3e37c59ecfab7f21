"""SIGINT and SIGTERM at any moment: one line, exit status 130 or 143, and nothing left running."""

import os
import signal
import subprocess
import sys
import time
from itertools import cycle
from pathlib import Path

import pytest
from helpers import write_blob

from caustic_cli import cli

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
SIGNALS = pytest.mark.parametrize("number", list(WORDS), ids=["SIGINT", "SIGTERM"])
COMMANDS = {
    "design": ["design", "blob.png"],
    "render": ["render", "blob.caustic"],
    "gradmap": ["gradmap", "blob.caustic"],
    "export": ["export", "blob.caustic"],
    "convergence": ["convergence"],
}
#: Runs a command that is sent a signal when it comes to load a module.
AT_IMPORT = """
import os, sys
module, number = sys.argv[1], int(sys.argv[2])

class Moment:
    def find_spec(name, *rest):
        if name == module:
            sys.meta_path.remove(Moment)
            os.kill(os.getpid(), number)

assert module not in sys.modules
sys.meta_path.insert(0, Moment)
sys.argv[1:] = sys.argv[3:]
from caustic_cli.cli import main
main()
"""
#: A command that is sent a signal while C calls back, from where no exception comes out.
IN_CALLBACK = """
import ctypes, os, sys, time
from caustic_cli import cli

def work(arguments):
    ctypes.CFUNCTYPE(None)(lambda: os.kill(os.getpid(), int(arguments[0])))()
    time.sleep(20)
    return 0

cli._run = work
cli.main()
"""
#: One that answers an interruption with another error, as numba's compiler does.
WRAPPED = """
import os, sys, typer
from caustic_cli import cli
from caustic_cli.commands import parser

class Program:
    def main(self, arguments, **rest):
        try:
            os.kill(os.getpid(), int(arguments[0]))
        finally:
            raise RuntimeError("no compiled object yet")

parser.parser = Program
cli.main()
"""


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 16, (5, 6), 15.0)


def ended(arguments, number) -> None:
    """Run Python, and check how the signal it was sent ended it."""
    began = time.monotonic()
    done = subprocess.run([sys.executable, *map(str, arguments)], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (128 + number, "", f"caustic: {WORDS[number]}\n")
    assert time.monotonic() - began < 15


@SIGNALS
@pytest.mark.parametrize("module", ["typer", "rich.console", "caustic_cli.commands.parser", "caustic_cli.errors"])
def test_a_signal_while_the_command_line_is_loaded(module, number):
    ended(["-c", AT_IMPORT, module, int(number), "--version"], number)


@pytest.mark.parametrize(("command", "number"), [*zip(COMMANDS, cycle(WORDS), strict=False)], ids=COMMANDS)
def test_a_signal_while_torch_is_loaded(command, number):
    """Every command, the two signals in turn, since one handler has both."""
    if command in {"render", "gradmap", "export"}:  # which look for a project before they load torch
        Path("blob.caustic").mkdir()
        Path("blob.caustic/project.toml").touch()
    before = {*Path().rglob("*")}
    ended(["-c", AT_IMPORT, "torch.nn", int(number), *COMMANDS[command]], number)
    assert {*Path().rglob("*")} == before


@SIGNALS
@pytest.mark.parametrize("program", [IN_CALLBACK, WRAPPED], ids=["lost", "wrapped"])
def test_an_interruption_that_is_not_passed_on_is_one(program, number):
    ended(["-c", program, int(number)], number)


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.skipif(not Path(f"/proc/self/task/{os.getpid()}/children").exists(), reason="this system has no list of children")
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2 if hasattr(os, "sched_getaffinity") else True, reason="one core")
def test_a_signal_while_kernels_are_compiled_leaves_nobody_at_work(tmp_path):
    number = signal.SIGTERM  # one handler has both
    with subprocess.Popen(
        [sys.executable, "-m", "caustic_cli", "convergence", "--quiet"],
        env=ENVIRONMENT | {"NUMBA_CACHE_DIR": str(tmp_path / "kept")},
        stderr=subprocess.PIPE,
        text=True,
    ) as command:
        until = time.monotonic() + 60
        started: list[int] = []
        while not started or started != children(command.pid):  # the compilers stay; others, as git's, are gone a second later
            assert time.monotonic() < until and command.poll() is None
            started = children(command.pid)
            time.sleep(1.0)
        command.send_signal(number)
        assert command.communicate()[1] == f"caustic: {WORDS[number]}\n" and command.returncode == 128 + number
    assert not [p for p in started if Path(f"/proc/{p}").exists()]
