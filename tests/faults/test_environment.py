"""What surrounds a command: closed streams, values in the environment, names too long, libraries that speak by themselves."""

import io
import os
import shlex
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import write_blob
from PIL import Image

from caustic_cli import __version__, cli
from caustic_cli.errors import LONGEST, InputError, is_unloadable
from caustic_cli.io import files
from caustic_cli.io.picture import read_picture

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parents[1])}
RANKS = {"MASTER_ADDR": "127.0.0.1", "RANK": "0", "WORLD_SIZE": "2"}
LONG = 300 * "n"


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_blob("blob.png", 16, (5, 6), 15.0)


def run(arguments, redirections="", before="", **variables):
    """A command in a process and a shell of its own."""
    line = f"{before}{shlex.join([sys.executable, '-m', 'caustic_cli', *arguments])} {redirections}"
    return subprocess.run(
        ["bash", "-c", line], env=ENVIRONMENT | variables, capture_output=True, text=True, check=False, timeout=60
    )


@pytest.mark.parametrize("redirections", [">&-", "2>&-", "<&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams(redirections):
    done = run(["--version"], redirections)
    out = "" if ">&- 2" in redirections or redirections == ">&-" else f"caustic {__version__}\n"
    assert (done.returncode, done.stdout, done.stderr) == (0, out, "")
    done = run(["render", "absent", "--quiet"], redirections)
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == ("2>&-" not in redirections)


@pytest.mark.parametrize("arguments", [["--version"], ["--help"], ["design", "--help"], ["design", "--glass", "list", "--json"]])
def test_a_full_standard_output_is_named(arguments):
    done = run(arguments, "> /dev/full")
    assert (done.returncode, done.stderr) == (1, "caustic: standard output: No space left on device\n")


def test_a_full_standard_error_loses_messages_and_nothing_else():
    assert run(["design", "none.png"], "2> /dev/full").returncode == 2
    done = run(["design", "--glass", "list"], "2> /dev/full")
    assert done.returncode == 0 and done.stdout.startswith("NAME")


@pytest.mark.parametrize("kilobytes", [100_000, 400_000])
def test_libraries_that_do_not_fit_into_memory(kilobytes):
    done = run(["convergence", "--study", "rays"], before=f"ulimit -v {kilobytes}; ")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1) and "caustic: out of memory" in done.stderr


def test_a_library_that_another_library_could_not_load():
    """llvmlite raises its own error from that of the loader."""
    problem = OSError("Could not find/load shared object file")
    problem.__cause__ = OSError("libllvmlite.so: failed to map segment from shared object")
    assert is_unloadable(problem) and not is_unloadable(OSError("failed"))


def test_no_file_takes_the_number_of_a_closed_stream():
    program = "import os, sys; from caustic_cli import cli; cli.run = lambda a: os.open('blob.png', os.O_RDONLY); cli.main()"
    done = subprocess.run(
        ["bash", "-c", f"{shlex.join([sys.executable, '-c', program])} <&- >&- 2>&-"], env=ENVIRONMENT, check=False
    )
    assert done.returncode > 2


ECHOED = {
    "a value of a file": "design blob.png --config values.toml",
    "a text of a file": "design blob.png --config text.toml",
    "a key": "design blob.png --config key.toml",
    "a value": f"design blob.png --source-position {','.join(5000 * '1')}",
    "a name": f"design blob.png --loss {5000 * 'a'}",
    "an option": f"design blob.png --{5000 * 'a'}",
    "a command": 5000 * "a",
    "a path": f"render {5000 * 'a'}",
    "a line of a table": "design blob.png --source point --intensity table.csv",
}


@pytest.mark.parametrize("name", ECHOED)
def test_no_message_repeats_all_that_it_was_given(name, capfd):
    Path("values.toml").write_text(f"[source]\nposition = {[1.5] * 5000}\n")
    Path("text.toml").write_text(f'[lens]\ndegree = "{5000 * "x"}"\n')
    Path("key.toml").write_text(f"[lens]\n{5000 * 'x'} = 3\n")
    Path("table.csv").write_text(f"0 1\n1 {5000 * 'x'}\n")
    assert cli.run(ECHOED[name].split()) == 2
    err = capfd.readouterr().err
    assert err.startswith("caustic: ") and err.count("\n") == 1 and 200 < len(err) < LONGEST and "characters] ..." in err


def test_a_shortened_message_says_what_is_wrong_and_what_is_accepted():
    wrong = InputError(f"a.nc: line 3: {5000 * 'x'!r} is no block of words; a program is needed")
    assert str(wrong).startswith("a.nc: line 3: 'xxx") and str(wrong).endswith("is no block of words; a program is needed")
    assert len(str(wrong)) < LONGEST and f"b: {wrong}".count("x") == 5000 and str(InputError(f"b: {wrong}")).count("[") == 1


BAD = [
    {"RANK": "x"},
    {"WORLD_SIZE": "banana"},
    {"WORLD_SIZE": "0"},
    RANKS | {"RANK": "-1"},
    RANKS | {"RANK": "2"},
    RANKS | {"MASTER_PORT": "x"},
    RANKS | {"MASTER_PORT": "70000"},
    {"CAUSTIC_EFFORT": "superb"},
    {"CAUSTIC_EFFORT": "test rays=3"},
    {"CAUSTIC_EFFORT": "test final_rays"},
]


def in_one_line(variables, status: int, out: str, err: str) -> None:
    assert (status, out, err.count("\n")) == (2, "", 1), err
    assert err.startswith("caustic: ") and any(name in err for name in variables) and "internal" not in err


@pytest.mark.parametrize("variables", BAD, ids=lambda v: " ".join("=".join(pair) for pair in v.items()))
def test_a_bad_value_in_the_environment_is_one_line(variables, monkeypatch, capfd):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    in_one_line(variables, cli.run(["design", "blob.png", "--quiet"]), *capfd.readouterr())


@pytest.mark.parametrize("variables", [BAD[0], {"NUMBA_DISABLE_JIT": "1"}, {"NUMBA_NUM_THREADS": "0"}], ids=min)
def test_a_bad_value_ends_a_process_with_one_line(variables):
    done = run(["design", "blob.png", "--quiet"], **variables)
    in_one_line(variables, done.returncode, done.stdout, done.stderr)


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="torch listens on both")
def test_a_port_in_use_is_one_line():
    with socket.create_server(("::", 0), family=socket.AF_INET6, dualstack_ipv6=True) as server:
        port = str(server.getsockname()[1])
        done = run(["design", "blob.png", "--quiet"], **RANKS, MASTER_PORT=port, CAUSTIC_KERNELS="torch")
    assert (done.returncode, done.stdout) == (2, "") and done.stderr.count("\n") == 1
    assert f"127.0.0.1:{port}: is in use" in done.stderr and "MASTER_PORT" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ["design", "blob.png", "-o", LONG],
        ["design", "--resume", LONG],
        ["design", f"{LONG}.png"],
        ["render", LONG],
        ["export", LONG],
        ["gradmap", LONG],
        ["convergence", "-o", LONG],
    ],
    ids=lambda a: " ".join(a)[:20],
)
def test_a_name_that_is_too_long_is_bad_usage(arguments, capfd, monkeypatch):
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    assert cli.run([*arguments, "--quiet"]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and "too long" in err
    assert [p.name for p in Path().iterdir()] == ["blob.png"]


@pytest.mark.parametrize("name", [251 * "n" + ".npy", 127 * "é", "n." + 250 * "s"])
def test_a_name_as_long_as_may_be_is_written(name):
    for data in (b"one", b"two"):
        files.write_bytes(name, data)
        assert Path(name).read_bytes() == data
    assert sorted(p.name for p in Path().iterdir()) == sorted([name, "blob.png"])


def test_a_hostile_tiff_speaks_by_our_line_alone(capfd):
    whole = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (40, 40)).astype(np.uint8)
    Image.fromarray(noise).save(whole, format="TIFF", compression="tiff_lzw")
    refused = 0
    for k in range(8, len(whole.getvalue()), 23):
        data = bytearray(whole.getvalue())
        data[k : k + 3] = b"\xff\xff\xff"
        Path("a.tif").write_bytes(data)
        try:
            read_picture(Path("a.tif"), False)
        except InputError:
            refused += 1
    out, err = capfd.readouterr()
    assert refused > 0 and (out, err) == ("", "")
    os.write(2, b"heard")
    assert capfd.readouterr().err == "heard"
