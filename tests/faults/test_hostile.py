"""Files made to harm: whatever is in them, a reader gives a value or an InputError, and nothing is written elsewhere.

CAUSTIC_EXAMPLES says how many files each property looks at (40 unless set).
"""

import io
import os
import shutil
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import tomli_w
from helpers import write_blob
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from caustic_cli import cli
from caustic_cli.config import settings as toml
from caustic_cli.errors import InputError
from caustic_cli.io.picture import read_picture
from caustic_cli.project import checkpoint

EXAMPLES = int(os.environ.get("CAUSTIC_EXAMPLES", "40"))
many = settings(max_examples=EXAMPLES)


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    """A finished little design, and the bytes of its parts."""
    folder = tmp_path_factory.mktemp("hostile")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_blob("blob.png", 16, (5, 6), 15.0)
        assert (
            cli.run(
                [
                    "design",
                    "blob.png",
                    "--resolution",
                    "16",
                    "--control",
                    "9",
                    "--rays",
                    "2000",
                    "--start",
                    "offset",
                    "--iterations",
                    "2",
                    "--quiet",
                    "--threads",
                    "1",
                ]
            )
            == 0
        )
    return folder / "blob.caustic"


@pytest.fixture
def copy(designed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(designed, tmp_path / "blob.caustic")).relative_to(tmp_path)


def changes(data: bytes):
    """What may be done to `data` (see `changed`): bytes set, cut out or repeated, the end lost."""
    return st.lists(
        st.tuples(st.integers(0, len(data) - 1), st.sampled_from(["set", "cut", "repeat", "end"]), st.integers(0, 255)),
        min_size=1,
        max_size=6,
    )


def changed(data: bytes, how) -> bytes:
    out = bytearray(data)
    for at, kind, value in how:
        at = min(at, len(out))
        if kind == "set" and at < len(out):
            out[at] = value
        elif kind == "cut":
            del out[at : at + value % 9]
        elif kind == "repeat":
            out[at:at] = out[at : at + value]
        elif value < 64:
            del out[at:]
    return bytes(out)


def reads(reader, path, data):
    """The reader's value, or None when it refused in one line that names the file."""
    path.write_bytes(data)
    try:
        return reader(path)
    except InputError as error:
        assert path.name in str(error)
        return None


def image(kind: str, mode: str = "RGB", **options) -> bytes:
    out = io.BytesIO()
    i, j = np.mgrid[0:12, 0:9]
    picture = Image.fromarray(np.stack([20 * i, 25 * j, 10 * (i + j)], -1).astype(np.uint8)).convert(mode)
    picture.save(out, format=kind, **options)
    return out.getvalue()


def array(value, **options) -> bytes:
    out = io.BytesIO()
    np.save(out, value, **options)
    return out.getvalue()


IMAGES = {
    "png": image("PNG"),
    "l.png": image("PNG", "LA"),
    "p.png": image("PNG", "P"),
    "16.png": image("PNG", "I;16"),
    "jpg": image("JPEG"),
    "tif": image("TIFF", compression="tiff_lzw"),
    "f.tif": image("TIFF", "F"),
    "gif": image("GIF"),
    "bmp": image("BMP"),
    "ppm": image("PPM"),
    "webp": image("WEBP"),
    "ico": image("ICO"),
    "tga": image("TGA"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", IMAGES)
def test_images(tmp_path_factory, kind):
    folder, seen = tmp_path_factory.mktemp("images"), [0, 0]

    @settings(max_examples=max(20, EXAMPLES // 2))
    @given(changes(IMAGES[kind]))
    @example([])
    def check(how):
        picture = reads(read_picture, folder / f"a.{kind}", changed(IMAGES[kind], how))
        seen[picture is None] += 1
        if picture is not None:
            light = picture.irradiance()
            assert light.ndim == 2 and np.isfinite(light).all() and light.min() >= 0 < light.max()

    check()
    assert seen[0] > 0 and [p.name for p in folder.iterdir()] == [f"a.{kind}"]


@pytest.mark.filterwarnings("ignore")
def test_arrays(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arrays")
    good = array(np.arange(1.0, 13.0).reshape(3, 4))

    @many
    @given(st.one_of(changes(good), st.binary(max_size=200), st.binary(max_size=100).map(lambda b: b"\x93NUMPY\x01\x00v\x00" + b)))
    @example([])
    def check(data):
        picture = reads(read_picture, folder / "a.npy", data if isinstance(data, bytes) else changed(good, data))
        assert picture is None or np.isfinite(picture.irradiance()).all()

    check()


class Bomb:
    """What a pickle would run."""

    def __reduce__(self):
        return Path.touch, (Path("pickled"),)


def header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def png(width: int, height: int) -> bytes:
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = zlib.compress(bytes(10**6), 9)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
        + chunk(b"IDAT", rows)
        + chunk(b"IEND", b"")
    )


def archive() -> bytes:
    out = io.BytesIO()
    np.savez(out, a=np.ones((3, 3)))
    return out.getvalue()


TRAPS = {
    "pickle.npy": array(np.array([[Bomb()]]), allow_pickle=True),
    "archive.npy": archive(),
    "vast.npy": header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 1000000000000), }\n"),
    "negative.npy": header("{'descr': '<f8', 'fortran_order': False, 'shape': (-3, -3), }\n"),
    "deep.npy": header("(" * 9000 + "\n"),
    "record.npy": array(np.zeros(3, [("a", "f8")])),
    "bomb.png": png(30000, 30000),
    "wide.png": png(2**31 - 1, 2),
    "text.png": png(9, 9)[:33] + struct.pack(">I", 50) + b"zTXt" + b"a\0\0" + zlib.compress(bytes(10**8))[:47] + bytes(4),
    "drawing.png": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n(pickled) (w) file\nshowpage\n%%EOF\n",
}


@pytest.mark.parametrize("name", TRAPS)
def test_traps_for_readers_of_pictures(name, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(TRAPS[name])
    assert cli.run(["design", name, "--quiet"]) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("caustic: ") and err.count("\n") == 1 and name in err
    assert [p.name for p in Path().iterdir()] == [name]


def test_pipes_and_devices_are_no_pictures(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe.png")
    for name in ("pipe.png", "/dev/zero", "x" * 300, "a\0b"):
        assert cli.run(["design", name, "--quiet"]) == 2
        assert capfd.readouterr().err.count("\n") == 1
    assert cli.run(["design", "pipe.png", "--config", "/dev/zero", "--quiet"]) == 2
    capfd.readouterr()


# TOML

NASTY = st.one_of(
    st.sampled_from(
        [
            0,
            -1,
            1,
            2,
            3,
            10**6,
            2**63 - 1,
            -(2**63),
            0.0,
            -0.0,
            1e-320,
            1e308,
            -1e308,
            float("inf"),
            float("-inf"),
            float("nan"),
            True,
            False,
            "",
            "/etc/passwd",
            "../x.png",
            "target.png",
            "a\0b",
            "\x1b[31m",
            "ü" * 300,
            "rms",
            [],
            [[]],
            {},
            [0, 0],
            [1, -1],
            [10**6, 10**6],
            [1e308, 1e308],
            [float("nan")] * 2,
            ["a", "b"],
            [[0, 0, -50]],
            [[0, 0, 0]],
            {"a": {"b": 1}},
            "project.toml",
            "checkpoints.h5",
            "grid",
            "point",
            "disc",
            "linear",
            "exact",
        ]
    ),
    st.floats(),
    st.integers(-(2**63), 2**63 - 1),
    st.lists(st.floats(-10, 10), max_size=4),
    st.text(max_size=9),
)
KEYS = (
    [(s, k) for s, keys in toml.SCHEMA.items() for k in keys]
    + [("stage", k) for k in toml.STAGE]
    + [("design", "stages"), ("moon", "x"), ("lens", "moon"), ("format_version", None)]
)


def test_project_toml(copy, capfd):
    """Any value for any key: render and export end in 0 or 2, with one line or none, and write nothing but their output."""
    path, codes = copy / "project.toml", []
    whole = toml.parse(path.read_text(), "here")
    before = sorted(p.name for p in Path().iterdir())

    @many
    @given(st.lists(st.tuples(st.sampled_from(KEYS), NASTY), min_size=1, max_size=2), st.booleans())
    @example([(("target", "file"), "../blob.png")], True)
    @example([(("design", "iterations"), -5)], True)
    @example([(("stage", "rays"), 0)], True)
    @example([(("design", "seed"), 1)], True)
    @example([(("target", "flip"), "x")], False)
    def check(changes, render):
        text = {s: dict(v) for s, v in whole.items()}
        text["design"]["stages"] = [dict(s) for s in text["design"]["stages"]]
        for (section, key), value in sorted(changes, key=lambda c: c[0][0] != "stage"):
            if section == "stage":
                text["design"]["stages"][-1][key] = value
            elif key is None:
                text[section] = value
            else:
                text.setdefault(section, {})[key] = value
        path.write_text(tomli_w.dumps(text), encoding="utf-8")
        command = (
            ["render", str(copy), "--rays", "300"]
            if render
            else ["export", str(copy), "--samples", "3", "--format", "stl", "-o", "lens.stl"]
        )
        codes.append(cli.run([*command, "--quiet"]))
        out, err = capfd.readouterr()
        assert (
            codes[-1] in (0, 2) and (out != "") == (codes[-1] == 0) and err.count("\n") == (codes[-1] == 2) and "\x1b" not in err
        ), err

    check()
    assert {0, 2} <= set(codes)
    assert set(p.name for p in Path().iterdir()) <= {*before, "lens.stl"}
    assert set(p.name for p in copy.iterdir()) == {"project.toml", "checkpoints.h5", "target.png", "render.png", ".outputs.json"}


@many
@given(
    st.one_of(
        st.text(max_size=60),
        st.binary(max_size=60).map(lambda b: b.decode("latin1")),
        st.lists(
            st.sampled_from(
                [
                    "[lens]",
                    "[[design.stages]]",
                    "size",
                    "=",
                    "[",
                    "]",
                    "{",
                    "}",
                    "1",
                    '"',
                    "'''",
                    "\n",
                    ".",
                    "0x" + "f" * 40,
                    "1" * 5000,
                    "1979-05-27",
                    "nan",
                ]
            ),
            max_size=12,
        ).map("".join),
    )
)
@example("a=" + "[" * 5000)
@example("[lens]\nsize = 0x" + "f" * 5000)
@example("[source]\ntype = " + "9" * 5000)
def test_toml_text(text):
    try:
        assert isinstance(toml.parse(text, "here"), dict)
    except InputError as error:
        assert str(error).startswith("here")


@pytest.mark.parametrize("file", ["../secret.png", "/etc/passwd", "..", "", ".", "sub/target.png", "project.toml", "render.png"])
def test_no_picture_beyond_the_project_is_opened(copy, capfd, file):
    shutil.copy(copy / "target.png", "secret.png")
    (copy / "sub").mkdir()
    shutil.copy(copy / "target.png", copy / "sub")
    path = copy / "project.toml"
    for key in ("file", "profile"):
        text = path.read_text()
        text = (
            text.replace('file = "target.png"', f"file = {file!r}")
            if key == "file"
            else text.replace("[source]", f"[source]\nprofile = {file!r}")
        )
        if key == "profile" and file == "":  # says that there is none
            continue
        folder = Path(shutil.copytree(copy, f"{key}.caustic"))
        (folder / "project.toml").write_text(text)
        assert cli.run(["render", str(folder), "--rays", "300", "--quiet"]) == 2
        assert "within the project" in capfd.readouterr().err


def test_resuming_rewrites_no_picture(copy, capfd, monkeypatch):
    """project.toml may name a picture of the user's own; it is read."""
    (copy / "mine.jpg").write_bytes(image("JPEG"))
    path = copy / "project.toml"
    path.write_text(path.read_text().replace('"target.png"', '"mine.jpg"'))
    assert cli.run(["design", "--resume", str(copy), "--iterations", "3", "--quiet"]) == 0
    assert (copy / "mine.jpg").read_bytes() == image("JPEG")


# HDF5


def sealed(image: bytes) -> bytes:
    return checkpoint.seal(image) + image


def test_checkpoints(designed, tmp_path_factory):
    """Broken HDF5 data without a checksum, as files of earlier versions are."""
    folder = tmp_path_factory.mktemp("checkpoints")
    data = (designed / "checkpoints.h5").read_bytes()[checkpoint.SEAL :]

    @settings(max_examples=max(8, EXAMPLES // 8))
    @given(changes(data))
    @example([])
    @example([(2144, "set", 9)])
    def check(how):
        found = reads(checkpoint.load, folder / "checkpoints.h5", changed(data, how))
        assert found is None or bool(found.state.heights.isfinite().all())

    check()


def test_a_reader_that_dies_over_a_file_dies_alone(copy, capfd, monkeypatch):
    """HDF5's library has crashed over damaged heaps; such a file is read in a process of its own first."""
    path = copy / "checkpoints.h5"
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    assert cli.run(["export", str(copy), "--quiet", "--samples", "3"]) == 0
    monkeypatch.setattr(checkpoint, "PROBE", "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)")
    assert cli.run(["export", str(copy), "--quiet", "--samples", "4"]) == 2
    assert "damaged" in capfd.readouterr().err


def _huge(f):
    del f["history"]
    f.create_dataset("history", (10**7, 10**5), chunks=(1000, 5), dtype="f8")


def _squeezed(f):
    del f["history"]
    f.create_dataset("history", data=np.zeros((10**6, 5)), compression="gzip")


def _outside(f):
    del f["history"]
    f.create_dataset("history", (2, 5), dtype="f8", external=[("../secret", 0, 80)])


def _linked(kind):
    def change(f):
        del f["history"]
        f["history"] = kind

    return change


def _pickled(f):
    f["state/parameters/bomb"] = np.void(b"\x80\x04c__main__\nBomb\n.")


CHECKPOINTS = {
    "a dataset of terabytes": _huge,
    "a compressed one": _squeezed,
    "data in another file": _outside,
    "a link to another file": _linked(h5py.ExternalLink("../secret.h5", "history")),
    "a link to itself": _linked(h5py.SoftLink("/history")),
    "opaque bytes": _pickled,
    "a state that is no whole number": lambda f: f["state"].attrs.__setitem__("stage", "x"),
    "endless heights": lambda f: f["lens/heights"].__setitem__((0, 0), np.inf),
    "a degree of -1": lambda f: f["lens"].attrs.__setitem__("degree", [-1, 3]),
}


@pytest.mark.parametrize("kind", CHECKPOINTS)
def test_a_checkpoint_with_a_valid_checksum_may_still_be_hostile(copy, capfd, kind):
    with h5py.File("secret.h5", "w") as f:
        f["history"] = np.zeros((2, 5))
    Path("secret").write_bytes(bytes(80))
    path = copy / "checkpoints.h5"
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    with h5py.File(path, "r+") as f:
        CHECKPOINTS[kind](f)
    path.write_bytes(sealed(path.read_bytes()))
    assert cli.run(["export", str(copy), "--quiet"]) == 2
    out, err = capfd.readouterr()
    assert out == "" and "checkpoints.h5" in err and err.count("\n") == 1


def _shape(name):
    def change(f):
        del f[name]
        f[name] = np.zeros((7, 7))

    return change


UNFIT = {
    "parameters of another net": lambda f: [_shape(f"state/parameters/{name}")(f) for name in [*f["state/parameters"]]],
    "parameters without a name of ours": lambda f: f["state/parameters"].__setitem__("more", np.zeros(3)),
    "another number of unknowns": _shape("state/optimizer/x"),
    "another optimiser": lambda f: f["state/optimizer"].__setitem__("0.exp_avg", np.zeros(3)),
    "pairs of another length": _shape("state/optimizer/s0"),
    "a start on another net": _shape("start"),
}


@pytest.mark.parametrize("kind", UNFIT)
def test_a_state_that_does_not_fit_the_design_is_refused(copy, capfd, kind):
    path = copy / "checkpoints.h5"
    path.write_bytes(path.read_bytes()[checkpoint.SEAL :])
    with h5py.File(path, "r+") as f:
        UNFIT[kind](f)
    path.write_bytes(sealed(path.read_bytes()))
    assert cli.run(["design", "--resume", str(copy), "--iterations", "4", "--quiet"]) == 2
    assert capfd.readouterr().err.count("\n") == 1


def test_a_design_goes_on_with_no_other_optimiser(copy, capfd):
    path = copy / "project.toml"
    path.write_text(path.read_text().replace('optimizer = "lbfgs"', 'optimizer = "adam"'))
    assert cli.run(["design", "--resume", str(copy), "--iterations", "4", "--quiet"]) == 2
    _out, err = capfd.readouterr()
    assert "optimizer" in err and err.count("\n") == 1
