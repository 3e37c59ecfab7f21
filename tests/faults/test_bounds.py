"""Readers and writers keep to bounds of time and memory whatever file they are given, and touch nothing but regular files.

Each case is run by a process of its own (`fuzz.bounded`) that may take so many seconds and bytes and no more.
"""

import io
import os
import shutil
import socket
import struct
import zipfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from fuzz import bounded, kinds
from helpers import write_blob
from PIL import Image

from caustic_cli import cli
from caustic_cli.config import settings
from caustic_cli.errors import InputError
from caustic_cli.io import arrays, files, surfaces
from caustic_cli.io.archive import open_archive
from caustic_cli.io.picture import MAX_BYTES, read_picture
from caustic_cli.io.surfaces import read_surface
from caustic_cli.project import attachments, checkpoint

pytestmark = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")

HALF = (5.0, 4.0)
MEGABYTES = 1 << 20
#: Seconds that a reader may take here; exponential or quadratic ones take minutes.
SECONDS = 30


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a project `a.caustic` of a designed lens, and a valid file of every kind by its name."""
    folder = tmp_path_factory.mktemp("bounds")
    found = {kind.name: kind.valid[0] for kind in kinds(folder)}
    (folder / "a.caustic" / "project.toml").write_bytes(found["project.toml"])
    (folder / "a.caustic" / "checkpoints.h5").write_bytes(found["checkpoints.h5"])
    return folder, found


@pytest.fixture
def here(made, tmp_path, monkeypatch):
    """A copy of that project in an empty current directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAUSTIC_KERNELS", "torch")
    shutil.copytree(made[0] / "a.caustic", tmp_path / "a.caustic")
    return made[1]


def command(*arguments: str) -> str:
    """Exit status and what is said on stderr."""
    with redirect_stderr(io.StringIO()) as said, redirect_stdout(io.StringIO()) as out:
        status = cli.run([*arguments, "--quiet"])
    return f"{status} {out.getvalue()}{said.getvalue()}"


def refused_command(*arguments: str) -> str:
    """The one line of a command that must end with 2."""
    found = bounded(lambda: command(*arguments), 60)
    assert found.startswith("2 caustic: ") and found.count("\n") == 1, found
    return found


def refused_commands(*orders: list[str]) -> None:
    """Commands, in one process, that must each end with 2 and one line."""
    found = bounded(lambda: "".join(command(*order) for order in orders), 60).splitlines()
    assert len(found) == len(orders) and all(line.startswith("2 caustic: ") for line in found), found


def refused(read, data: int = 200 * MEGABYTES, seconds: int = SECONDS) -> str:
    """The one line in which a reader refuses within its bounds."""
    found = bounded(read, seconds, data)
    assert found.startswith("refused: "), found
    return found


def sparse(path: Path, head: bytes, size: int) -> Path:
    """A file of so many bytes that takes no room on the disk."""
    with open(path, "wb") as file:
        file.write(head)
        file.truncate(size)
    return path


# STEP

HEAD = "ISO-10303-21; (SI_UNIT(.MILLI.,.METRE.));\n"
TAIL = ",.U.,.F.,.F.,.F.,(4,4),(4,4),(0.,1.),(0.,1.),.U.);"


def surface(rows: str = "(#1,#1),(#1,#1)", degrees: str = "3,3", tail: str = TAIL) -> str:
    return f"{HEAD}#1=CARTESIAN_POINT('',(0.,0.,0.));\n#2=B_SPLINE_SURFACE_WITH_KNOTS('',{degrees},({rows}){tail}"


STEPS = {
    "rows without an end": surface("(#1,#1)," * 24, tail=""),
    "blanks": surface("(" + " " * 2_000_000, tail=""),
    "references": surface("(" + "#1," * 1_000_000, tail=""),
    "rows": surface("(#1)," * 500_000, tail=""),
    "points that do not end": HEAD + "#1=CARTESIAN_POINT('',(" * 150_000 + surface(),
    "points of many digits": surface() + "#" + "1" * 3_000_000,
    "quotes": surface() + "'" * 999_999,
    "comments that do not end": surface() + "/*" * 1_000_000,
    "units": HEAD.replace("MILLI", "$") + "SI_UNIT(" * 300_000 + surface(),
    "a multiplicity of a thousand million": surface(tail=TAIL.replace("(4,4)", "(4,1000000000)")),
    "a multiplicity of 1e30": surface(tail=TAIL.replace("(4,4)", "(4,1" + "0" * 30 + ")")),
    "a multiplicity of -4": surface(tail=TAIL.replace("(4,4)", "(4,-4)")),
    "a multiplicity of 5,000 digits": surface(tail=TAIL.replace("(4,4)", f"(4,{'9' * 5000})")),
    "a degree of 5,000 digits": surface(degrees=f"3,{'9' * 5000}"),
    "a reference of 5,000 digits": surface(f"(#{'9' * 5000})"),
    "a knot beyond all numbers": surface(tail=TAIL.replace("(0.,1.)", "(-1e308,1e308)")),
    "a knot that is none": surface(tail=TAIL.replace("(0.,1.)", "(nan,1.)")),
    "multiplicities without end": surface(tail=TAIL.replace("(4,4)", "(4" + ",4" * 500_000 + ")")),
    "rows of unequal length": surface("(#1,#1),(#1)"),
    "a point that is not there": surface("(#1,#7),(#1,#1)"),
}


@pytest.mark.parametrize("name", STEPS)
def test_a_step_file_takes_time_in_proportion_to_its_length(name, tmp_path):
    path = tmp_path / "a.step"
    path.write_text(STEPS[name])
    assert "a.step: " in refused(lambda: read_surface(path, HALF))


def test_what_strings_and_comments_of_a_step_file_say_is_no_part_of_it(here):
    text = here["lens.step"].decode()
    Path("a.step").write_text(text)
    words = "'B_SPLINE_SURFACE_WITH_KNOTS; ''(/*'"
    Path("b.step").write_text(text.replace("''", words).replace("DATA;", "DATA; /* it's #1=CARTESIAN_POINT('',(1.,1.,1.)); **/"))
    assert (read_surface("a.step", HALF)[1] == read_surface("b.step", HALF)[1]).all()


def test_a_large_step_file_is_refused_by_its_size(tmp_path):
    path = sparse(tmp_path / "a.step", HEAD.encode(), surfaces.MAX_STEP_BYTES + 1)
    assert "268,435,456 are read" in refused(lambda: read_surface(path, HALF), 20 * MEGABYTES)


# arrays


def npy_header(shape: tuple, kind: str = "<f8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def with_member(archive: bytes, name: str, head: bytes, zeros: int) -> bytes:
    """An archive with one more member, or another one of that name, that unpacks to so many zeros."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(out, "w") as new:
        for each in old.namelist():
            if each != name:
                new.writestr(each, old.read(each))
        with new.open(zipfile.ZipInfo(name), "w", force_zip64=True) if not zeros else _deflated(new, name) as member:
            member.write(head)
            for _ in range(zeros >> 20):
                member.write(bytes(1 << 20))
            member.write(bytes(zeros % (1 << 20)))
    return out.getvalue()


def _deflated(archive: zipfile.ZipFile, name: str):
    info = zipfile.ZipInfo(name)
    info.compress_type = zipfile.ZIP_DEFLATED
    return archive.open(info, "w", force_zip64=True)


def test_members_that_nobody_needs_are_not_unpacked(here):
    path = Path("a.npz")
    path.write_bytes(with_member(here["archive.npz"], "more.npy", npy_header((1 << 26,)), 1 << 29))
    assert path.stat().st_size < MEGABYTES
    assert bounded(lambda: open_archive(path), SECONDS, 200 * MEGABYTES) == ""


@pytest.mark.parametrize(("member", "shape"), [("control_points", (4097, 5000, 3)), ("knots_u", (1 << 26,))])
def test_members_that_are_needed_are_measured_first(member, shape, here):
    Path("a.npz").write_bytes(with_member(here["archive.npz"], f"{member}.npy", npy_header(shape), 8 * int(np.prod(shape))))
    assert "must be of at most" in refused(lambda: open_archive("a.npz"))


def test_an_archive_of_a_thousand_million_members(tmp_path):
    """Its table of contents, as long as it says, is not read."""
    path, size = tmp_path / "a.npz", 1 << 30
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, size - 22, 0, 0)
    sparse(path, b"", size - 22)
    with open(path, "ab") as file:
        file.write(end)
    assert "table of contents" in refused(lambda: open_archive(path))


def _changed(member: str, value) -> bytes:
    """The archive with one array replaced, by bytes or by an array."""

    def change(archive: bytes) -> bytes:
        out = io.BytesIO()
        if not isinstance(value, bytes):
            np.save(out, value)
        return with_member(archive, f"{member}.npy", value if isinstance(value, bytes) else out.getvalue(), 0)

    return change


def _compressed(way: int):
    def change(archive: bytes) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(archive)) as old, zipfile.ZipFile(out, "w", way) as new:
            for each in old.namelist():
                new.writestr(each, old.read(each))
        return out.getvalue()

    return change


def _poked(*pokes: tuple[bytes, int, int]):
    """The archive, packed, with a 16-bit number written so far behind each place where these bytes begin."""

    def change(archive: bytes) -> bytes:
        data = bytearray(_compressed(zipfile.ZIP_DEFLATED)(archive))
        for begin, after, value in pokes:
            at = data.find(begin)
            while at >= 0:
                struct.pack_into("<H", data, at + after, value)
                at = data.find(begin, at + 1)
        return bytes(data)

    return change


ARCHIVES = {
    "LZMA": _compressed(zipfile.ZIP_LZMA),
    "bzip2": _compressed(zipfile.ZIP_BZIP2),
    "unknown compression": _poked((b"PK\1\2", 10, 77), (b"PK\3\4", 8, 77)),
    "encrypted": _poked((b"PK\1\2", 8, 1), (b"PK\3\4", 6, 1)),
    "strongly encrypted": _poked((b"PK\1\2", 8, 64), (b"PK\3\4", 6, 64)),
    "corrupt deflate": _poked((b"PK\3\4", 50, 65535)),
    "a member that is no array": _changed("z_in", b"hello"),
    "a header that does not parse": _changed("z_in", npy_header((), "<f8").replace(b"'shape'", b"'shap'") + bytes(8)),
    "a header without end": _changed("z_in", b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{"),
    "an unknown type": _changed("z_in", npy_header((), "<f3") + bytes(3)),
    "a record": _changed("z_in", npy_header((), "<f8,<f8") + bytes(16)),
    "a shape of many digits": _changed("z_in", npy_header((10**4000,))),
    "an array cut off": _changed("control_points", npy_header((8, 6, 3)) + bytes(80)),
    "knots as text": _changed("knots_u", np.array(["a"] * 12)),
    "sizes as text": _changed("lens_half_size", np.array(["a", "b"])),
    "a text as a number": _changed("source_type", np.array(7)),
    "a text that is none": _changed("source_type", npy_header((), "<U1") + b"\0\xd8\0\0"),
    "resolution = inf": _changed("resolution", np.array([np.inf, np.inf])),
    "a resolution of 1e300": _changed("resolution", np.array([1e300, 2.0])),
    "complex knots": _changed("knots_v", np.ones(10, complex)),
    "power of nothing": _changed("source_power", np.ones(0)),
    "an index of NaN": _changed("refractive_index", np.array(np.nan)),
    "two indices": _changed("refractive_index", np.ones(2)),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_damaged_archives_are_refused(name, here):
    Path("a.npz").write_bytes(ARCHIVES[name](here["archive.npz"]))
    assert "a.npz: " in refused(lambda: open_archive("a.npz"))
    assert "internal error" not in refused_command("render", "a.npz", "--rays", "100")


def test_the_archive_itself_is_read(here):
    for way in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        Path("a.npz").write_bytes(_compressed(way)(here["archive.npz"]))
        assert open_archive("a.npz")[2].shape == (8, 6)


ARRAYS = {
    "sparse, of 5 GB": (npy_header((25000, 25000)), 128 + 8 * 25000**2),
    "zeros, of 5 GB": (b"", 5 << 30),
    "a header of 2 GB": (b"\x93NUMPY\x02\x00\xff\xff\xff\x7f{", 3 << 30),
    "a deep header": (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535, 1 << 20),
    "more data than there are": (npy_header((4000, 4000)), 1 << 20),
    "text": (npy_header((4, 4), "<U9"), 1 << 20),
    "times": (npy_header((4, 4), "<M8"), 1 << 20),
    "objects": (npy_header((4, 4), "|O"), 1 << 20),
}


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("color", [False, True])
def test_arrays_are_measured_before_they_are_read(name, color, tmp_path):
    path = sparse(tmp_path / "a.npy", *ARRAYS[name])
    assert "a.npy: " in refused(lambda: read_surface(path, HALF), 20 * MEGABYTES)
    assert "a.npy: " in refused(lambda: read_picture(path, color=color), 20 * MEGABYTES)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("kind", ["<f8", ">f4", "<f2", "<i8", ">u2", "|u1", "|b1"])
def test_arrays_are_read_as_numpy_reads_them(order, kind, tmp_path):
    array = np.asarray(np.random.default_rng(0).uniform(0, 90, (5, 7)), kind, order=order)
    for version in ((1, 0), (2, 0), (3, 0)):
        with open(tmp_path / "a.npy", "wb") as file:
            np.lib.format.write_array(file, array, version=version)
        with arrays.open_npy(tmp_path / "a.npy", "an array") as stored:
            assert stored.shape == array.shape and (stored.read() == array).all()


# pictures, checkpoints, tables


def test_a_picture_is_refused_by_its_size(tmp_path):
    path = sparse(tmp_path / "a.tif", b"II*\0\x08\0\0\0", MAX_BYTES + 1)
    assert "1,073,741,824 are read" in refused(lambda: read_picture(path), 20 * MEGABYTES)


def test_an_image_that_a_library_complains_of_is_one_line(here):
    """libtiff says itself what it stumbles over."""
    Image.new("RGB", (9, 9), "red").save("a.tif", compression="jpeg")
    data, ends = Path("a.tif").read_bytes(), set()
    for at in range(8, len(data), 8):
        Path("a.tif").write_bytes(data[:at] + b"\xff\xc0\0" + data[at + 3 :])
        found = bounded(lambda: read_picture("a.tif"))
        assert not found or found.startswith("refused: "), found
        ends.add(found)
    assert len(ends) > 1


def test_a_checkpoint_is_not_read_whole_to_be_refused(here):
    path = Path("a.caustic/checkpoints.h5")
    data = path.read_bytes()
    for head, size in ((b"", 6 << 30), (checkpoint.SIGNATURE, 1 << 30), (data, 1 << 30), (data, checkpoint.MAX_BYTES + 1)):
        sparse(path, head, size)
        assert "checkpoints.h5: is " in refused(lambda: checkpoint.load(path), 100 * MEGABYTES, 100)


def test_no_dataset_is_read_twice(here):
    """Hard links make many names of one dataset; together they may not hold more than the file."""
    import h5py  # noqa: PLC0415

    path = Path("a.caustic/checkpoints.h5")
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    with h5py.File(path, "r+") as f:
        f["large"] = np.zeros(1 << 20)
        for k in range(500):
            f[f"state/parameters/{k}"] = f["large"]
    path.write_bytes(checkpoint.seal(path.read_bytes()) + path.read_bytes())
    assert "damaged" in refused(lambda: checkpoint.load(path))


@pytest.mark.parametrize("name", ["stage", "iteration", "total", "seconds"])
def test_a_state_before_the_beginning(here, name):
    import h5py  # noqa: PLC0415

    path = Path("a.caustic/checkpoints.h5")
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    with h5py.File(path, "r+") as f:
        f["state"].attrs[name] = -1
    path.write_bytes(checkpoint.seal(path.read_bytes()) + path.read_bytes())
    with pytest.raises(InputError, match="damaged"):
        checkpoint.load(path)


def test_a_line_without_end_in_a_table_of_intensities(tmp_path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"1 " * (1 << 22))
    assert "a.csv: line 1" in refused(lambda: attachments.attached({"source": {"intensity": str(path)}}))


# TOML

TOMLS = {
    "a thousand names": "a" + ".a" * 1000 + " = 1",
    "forty thousand names": "a" + ".a" * 40_000 + " = 1",
    "names with blanks": "a" + " .\ta" * 1000 + " = 1",
    "names in quotes": '"a\\"b"' + '."a"' * 1000 + " = 1",
    "names in a heading": "[lens" + ".a" * 1000 + "]",
    "names in a table": "lens = {size" + ".a" * 1000 + " = 1}",
    "names behind a string": 'a = {b = """ " """, c' + ".a" * 1000 + ' = " "}',
    "names behind an escape": 'a = {b = "\\\\", c' + ".a" * 1000 + ' = "\\""}',
    "names behind a comment": "# '''\n" + "a" + ".a" * 1000 + " = 1",
    "brackets": "a = " + "[" * 3000 + "]" * 3000,
    "braces": "a = " + "{a=" * 3000,
    "a million headings": "[[design.stages]]\n" * 400_000,
    "a million keys": "".join(f"k{k}=1\n" for k in range(500_000)),
    "a million keys in a line": "lens={" + ",".join(f"k{k}=1" for k in range(500_000)) + "}",
    "a string without end": 'a = """' + '"" ' * 2_000_000,
    "quotes": "'\"" * 4_000_000,
}


@pytest.mark.parametrize("name", TOMLS)
def test_a_toml_file_takes_time_in_proportion_to_its_length(name, tmp_path):
    path = tmp_path / "a.toml"
    path.write_text(TOMLS[name][: settings.MAX_BYTES])
    assert "a.toml: " in refused(lambda: settings.read(path))


def test_the_longest_toml_files_are_read_in_time(tmp_path):
    points = "[source]\nposition = [\n" + " [1.0, -2.5, -50.0],\n" * 100_000 + "]\n"
    for text in (points, "# " + "x.y" * 99 + "\n", "[target]\nfile = 'a.b.c.d.e.f.g.h.png'", "", "#" * settings.MAX_BYTES):
        (tmp_path / "a.toml").write_text(text)
        assert bounded(lambda: settings.read(tmp_path / "a.toml"), SECONDS, 500 * MEGABYTES) == ""
    sparse(tmp_path / "a.toml", b"", 1 << 40)
    assert "8,388,608 are read" in refused(lambda: settings.read(tmp_path / "a.toml"))


# what is no regular file


FIFOS = {
    "project.toml": ("a.caustic/project.toml", ["render", "a.caustic"]),
    "target.png": ("a.caustic/target.png", ["render", "a.caustic"]),
    "checkpoints.h5": ("a.caustic/checkpoints.h5", ["render", "a.caustic"]),
    "checkpoints.h5 of an export": ("a.caustic/checkpoints.h5", ["export", "a.caustic"]),
    "an archive": ("a.npz", ["render", "a.npz"]),
    "a picture": ("a.png", ["design", "a.png"]),
    "an array": ("a.npy", ["design", "a.npy"]),
    "a ray file": ("a.ray", ["render", "a.caustic", "--source", "rays", "--source-file", "a.ray"]),
    "a table of intensities": ("a.csv", ["render", "a.caustic", "--source", "point", "--intensity", "a.csv"]),
    "--config": ("a.toml", ["design", "a.caustic/target.png", "--config", "a.toml"]),
    "--start .npy": ("a.npy", ["design", "a.caustic/target.png", "--start", "a.npy"]),
    "--start .npz": ("a.npz", ["design", "a.caustic/target.png", "--start", "a.npz"]),
    "--start .step": ("a.step", ["design", "a.caustic/target.png", "--start", "a.step"]),
}


@pytest.mark.parametrize("name", FIFOS)
def test_nobody_waits_for_a_pipe(name, here):
    place, arguments = FIFOS[name]
    Path(place).unlink(missing_ok=True)
    os.mkfifo(place)
    refused_command(*arguments)
    assert Path(place).is_fifo()


#: Options that name a file to be read, after a command that is valid without.
PLAIN = "design a.caustic/target.png -o new.caustic --resolution 8 --control 5 --rays 100 --iterations 1"
READ = {
    "--config": f"{PLAIN} --config @.toml",
    "--start": f"{PLAIN} --start @.npz",
    "--second": f"{PLAIN} --second-at 400 --second @.png",
    "--source-file": f"{PLAIN} --source disc --source-file @.png",
    "--intensity": f"{PLAIN} --source point --intensity @.csv",
    "--robust": f"{PLAIN} --robust @.toml",
    "--screen-shape": f"{PLAIN} --screen-shape @.npy",
    "--index-file": f"{PLAIN} --gradient volume --index-file @.npy",
    "design": "design @.png",
    "render": "render @.npz",
    "render --source-file": "render a.caustic --source rays --source-file @.ray",
    "render --intensity": "render a.caustic --source point --intensity @.csv",
    "render --screen-shape": "render a.caustic --screen-shape @.npy",
    "render --cut": "render a.caustic --cut @.nc",
    "render --finish": "render a.caustic --finish milled:@.nc",
    "render --tolerances": "render a.caustic --tolerances @.toml",
    "render --want": "render a.caustic --want @.png",
}


def special_files(suffix: str) -> list[str]:
    """Names of what is no regular file: a pipe that nobody writes to, a directory, a socket, a loop of links, links to devices."""
    os.mkfifo(f"pipe{suffix}")
    Path(f"folder{suffix}").mkdir()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"socket{suffix}")
    Path(f"loop{suffix}").symlink_to(f"other{suffix}")
    Path(f"other{suffix}").symlink_to(f"loop{suffix}")
    for device in ("zero", "full"):
        Path(f"{device}{suffix}").symlink_to(f"/dev/{device}")
    return [f"{name}{suffix}" for name in ("pipe", "folder", "socket", "loop", "zero", "full")]


@pytest.mark.parametrize("name", READ)
def test_no_option_waits_for_what_is_no_file(name, here):
    suffix = "." + READ[name].rpartition("@.")[2]
    orders = [READ[name].replace(f"@{suffix}", file).split() for file in special_files(suffix)]
    refused_commands(*orders)
    assert not Path("new.caustic").exists()


def test_a_device_by_its_own_name_is_refused(here):
    options, devices = ("--cut", "--want", "--tolerances"), ("/dev/zero", "/dev/full")
    refused_commands(*(["render", "a.caustic", option, device] for option in options for device in devices))


def test_a_picture_from_the_standard_input(here):
    assert "not a regular file" in bounded(lambda: _from_a_pipe(lambda: command("design", "/dev/stdin")), 60)


def _from_a_pipe(work):
    os.dup2(os.pipe()[0], 0)
    return work()


OUTPUTS = {
    "render": ["render", "a.caustic", "--rays", "100", "-o"],
    "npy": ["render", "a.caustic", "--rays", "100", "-o", "a.png", "--npy"],
    "export": ["export", "a.caustic", "--format", "stl", "-o"],
}


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("force", [[], ["--force"]])
def test_an_output_replaces_no_device_and_no_pipe(name, force, here):
    os.mkfifo("pipe")
    Path("link").symlink_to("/dev/full")
    for output in ("pipe", "link"):
        assert "not a regular file" in refused_command(*OUTPUTS[name], output, *force)
    assert Path("pipe").is_fifo() and Path("link").is_symlink()
    assert "not a regular file" in refused_command(*OUTPUTS[name], "/dev/full")


WRITTEN = {
    "render -o": "render a.caustic --rays 100 -o",
    "render --npy": "render a.caustic --rays 100 -o a.png --npy",
    "render --html": "render a.caustic --rays 100 -o a.png --html",
    "gradmap -o": "gradmap a.caustic --rays 100 -o",
    "export -o": "export a.caustic --format stl -o",
    "export -o of a height map": "export a.caustic --format heightmap -o",
    "export -o of a mesh": "export a.caustic --format mitsuba -o",
    "export -o of a script": "export a.caustic --format lighttools --script -o",
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_path_that_is_no_file_name_is_refused(name, here):
    Path("loop").symlink_to("other")
    Path("other").symlink_to("loop")
    Path("link").symlink_to("nowhere")
    before = sorted(p.name for p in Path().iterdir())
    outputs = (".", "/", "", "loop", "link", "a.caustic/checkpoints.h5/a")
    refused_commands(*([*WRITTEN[name].split(), output] for output in outputs))
    assert "--force" in refused_command(*WRITTEN["export -o"].split(), "link")
    assert sorted(p.name for p in Path().iterdir()) == before and os.readlink("link") == "nowhere"


@pytest.mark.parametrize("name", ["loop", "link", "file"])
def test_a_study_needs_a_directory_before_it_begins(name, here):
    Path("loop").symlink_to("loop")
    Path("link").symlink_to("nowhere")
    Path("file").touch()
    assert "is no directory" in refused_command("convergence", "--study", "rays", "--rays", "1000", "-o", name)


@pytest.mark.parametrize("link", ["/proc/self/fd/1", "/dev/fd/1", "first"])
def test_the_standard_output_is_not_replaced(link, here):
    """A descriptor that was redirected to a file leads to that file; the link is the device's, or the user's own."""
    Path("first").symlink_to("/proc/self/fd/1")
    Path("out").symlink_to(link)
    Path("log").write_text("begun\n")

    def redirected() -> str:
        with open("log", "a") as log:
            os.dup2(log.fileno(), 1)
        return command("export", "a.caustic", "--format", "stl", "-o", "out", "--force")

    found = bounded(redirected, 60)
    assert found.startswith("2 caustic: ") and "open stream" in found and os.readlink("out") == link
    assert Path("log").read_text() == "begun\n"


def test_an_output_is_written_where_its_link_leads(here):
    Path("folder").mkdir()
    Path("link.png").symlink_to("folder/lens.png")
    order = ["render", "a.caustic", "--rays", "400", "-o", "link.png"]
    Path("folder/lens.png").write_text("mine")
    assert "was not made by caustic" in refused_command(*order)
    assert bounded(lambda: command(*order, "--force"), 60).startswith("0")
    assert files.is_ours("folder/lens.png") and os.readlink("link.png") == "folder/lens.png"
    Path("link.png").unlink()
    Path("link.png").symlink_to("a.caustic/checkpoints.h5")
    assert "part of the project" in refused_command(*order, "--force")
    Path("link.png").unlink()
    Path("link.png").symlink_to("nowhere")
    assert bounded(lambda: command(*order, "--force"), 60).startswith("0")
    assert files.is_ours("link.png") and not Path("link.png").is_symlink() and not Path("nowhere").exists()


def test_a_new_design_spares_what_a_link_of_the_old_one_leads_to(here):
    shutil.move("a.caustic/target.png", "mine.png")
    before = Path("mine.png").read_bytes()
    Path("a.caustic/target.png").symlink_to("../mine.png")
    write_blob("other.png")
    order = f"{PLAIN} --start offset --waves off --force".replace("a.caustic/target.png", "other.png").replace("new.", "a.")
    assert bounded(lambda: command(*order.split()), 120, 1000 * MEGABYTES).startswith("0")
    assert Path("mine.png").read_bytes() == before and not Path("a.caustic/target.png").is_symlink()


def test_a_new_design_replaces_no_pipe(here):
    Path("a.caustic/checkpoints.h5").unlink()
    os.mkfifo("a.caustic/checkpoints.h5")
    before = sorted(p.name for p in Path("a.caustic").iterdir())
    shutil.copy("a.caustic/target.png", "a.png")
    order = ["design", "a.png", "-o", "a.caustic", "--force", "--resolution", "8", "--control", "5", "--rays", "100"]
    assert "not a regular file" in refused_command(*order, "--start", "offset", "--iterations", "1")
    assert sorted(p.name for p in Path("a.caustic").iterdir()) == before


def test_writers_and_their_questions_keep_to_regular_files(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/full"), Path("/dev/zero")):
        assert bounded(lambda path=path: f"{files.is_ours(path)}", SECONDS, 20 * MEGABYTES) == "False"
        assert " a file name is needed" in refused(lambda path=path: files.destination(path))
    assert "not a regular file" in refused(lambda: files.write_bytes(tmp_path / "pipe", b"x"))
    assert bounded(lambda: files.sha256_of(tmp_path / "pipe") or "none") == "none"
    assert (tmp_path / "pipe").is_fifo() and [p.name for p in tmp_path.iterdir()] == ["pipe"]


def test_a_link_to_a_regular_file_is_read(tmp_path):
    (tmp_path / "a").write_bytes(b"whole")
    (tmp_path / "link").symlink_to("a")
    assert files.read_bytes(tmp_path / "link", 5, "a file") == b"whole"
    with pytest.raises(InputError, match="is 5 bytes; at most 4 are read; a file"):
        files.read_bytes(tmp_path / "link", 4, "a file")
