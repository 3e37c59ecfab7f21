"""Pictures and files: what is read, how it lies, what is refused, and that a file is written whole or not at all."""

import os
import re
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from caustic_cli.errors import InputError
from caustic_cli.io import files
from caustic_cli.io.files import Piped
from caustic_cli.io.picture import Picture, read_picture, write_image, write_npy

CODE_8 = 0.5 / 255 + 1e-12  # half a step of an 8-bit code
CODE_16 = 2.0 / 65535  # rounding of a 16-bit sRGB code, at the curve's steepest


def decode(code: float) -> float:
    """IEC 61966-2-1, written out again."""
    return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4


def save(path: Path, array, mode: str | None = None, **options) -> Path:
    Image.fromarray(np.asarray(array)).convert(mode).save(path, **options) if mode else Image.fromarray(np.asarray(array)).save(
        path, **options
    )
    return path


def ramp(dtype=np.uint8, shape=(3, 4)) -> np.ndarray:
    """Rows from the top, all different, so that any mirroring or transposition shows."""
    return (np.arange(shape[0] * shape[1]).reshape(shape) * 7 + 1).astype(dtype)


def placed(rows: np.ndarray) -> np.ndarray:
    """Rows from the top to [i, j] from the -x, -y corner, cell by cell."""
    height, width = rows.shape
    return np.array([[rows[height - 1 - j, i] for j in range(height)] for i in range(width)])


def png(width: int, height: int, *, idat: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", idat or zlib.compress(b"\0")) + chunk(b"IEND", b"")


# what is read


def test_8_bit_grey_keeps_its_codes(tmp_path):
    picture = read_picture(save(tmp_path / "a.png", ramp()))
    assert picture.values.dtype == np.uint8 and picture.encoding == "srgb" and picture.suffix == ".png"
    assert np.array_equal(picture.values, ramp())
    assert picture.irradiance() == pytest.approx(np.vectorize(decode)(placed(ramp()) / 255), rel=1e-12)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_16_bit_grey_keeps_its_codes(tmp_path, name):
    codes = (ramp(np.uint16) * 800).astype(np.uint16)
    picture = read_picture(save(tmp_path / name, codes))
    assert picture.values.dtype == np.uint16
    assert np.array_equal(picture.values, codes)


def test_linear_takes_codes_as_they_are(tmp_path):
    picture = read_picture(save(tmp_path / "a.png", ramp()), linear=True)
    assert picture.encoding == "linear"
    assert picture.irradiance() == pytest.approx(placed(ramp()) / 255, rel=1e-14)


@pytest.mark.parametrize("linear", [False, True])
def test_colour_becomes_luminance_in_linear_light(tmp_path, linear):
    codes = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]], [[255, 255, 255], [10, 100, 200], [0, 0, 0]]], dtype=np.uint8)
    got = read_picture(save(tmp_path / "a.png", codes), linear).irradiance()
    curve = (lambda c: c) if linear else decode
    expected = np.array(
        [[sum(w * curve(c / 255) for w, c in zip((0.2126, 0.7152, 0.0722), pixel, strict=True)) for pixel in row] for row in codes]
    )
    assert got == pytest.approx(placed(expected), abs=CODE_16)


def test_alpha_lies_over_black(tmp_path):
    codes = np.array([[[255, 255, 255, 255], [255, 255, 255, 128]], [[255, 255, 255, 0], [0, 0, 0, 255]]], dtype=np.uint8)
    got = read_picture(save(tmp_path / "a.png", codes)).irradiance()
    assert got == pytest.approx(placed(np.array([[1.0, 128 / 255], [0.0, 0.0]])), abs=CODE_16)


def test_grey_with_alpha(tmp_path):
    codes = np.array([[[200, 255], [200, 51]], [[0, 255], [90, 0]]], dtype=np.uint8)
    Image.fromarray(codes).save(tmp_path / "a.png")
    got = read_picture(tmp_path / "a.png").irradiance()
    light = decode(200 / 255)
    assert got == pytest.approx(placed(np.array([[light, light * 0.2], [0.0, 0.0]])), abs=CODE_16)


@pytest.mark.parametrize("transparent", [False, True])
def test_palette(tmp_path, transparent):
    image = Image.new("P", (2, 2))
    image.putpalette([0, 0, 0, 255, 255, 255, 255, 0, 0])
    image.putdata([0, 1, 2, 1])
    image.save(tmp_path / "a.png", **({"transparency": 1} if transparent else {}))
    got = read_picture(tmp_path / "a.png").irradiance()
    white = 0.0 if transparent else 1.0
    assert got == pytest.approx(placed(np.array([[0.0, white], [0.2126, white]])), abs=CODE_16)


def test_1_bit(tmp_path):
    Image.fromarray(np.array([[0, 255, 0], [255, 255, 0]], dtype=np.uint8)).convert("1").save(tmp_path / "a.png")
    got = read_picture(tmp_path / "a.png").irradiance()
    assert np.array_equal(got, placed(np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])))


TURNS = {
    1: lambda a: a,
    2: np.fliplr,
    3: lambda a: np.rot90(a, 2),
    4: np.flipud,
    5: np.transpose,
    6: lambda a: np.rot90(a, -1),
    7: lambda a: np.rot90(a, 2).T,
    8: np.rot90,
}


@pytest.mark.parametrize("orientation", TURNS)
def test_exif_orientation_is_obeyed(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    got = read_picture(save(tmp_path / "a.png", ramp(), exif=exif)).values
    assert np.array_equal(got, TURNS[orientation](ramp()))


def test_inverted_codes(tmp_path):
    for dtype, top in ((np.uint8, 255), (np.uint16, 65535)):
        got = read_picture(save(tmp_path / "a.png", ramp(dtype)), invert=True).values
        assert np.array_equal(got, top - ramp(dtype))
    np.save(tmp_path / "a.npy", np.array([[0.0, 1.0], [0.5, 4.0]]))
    assert np.array_equal(read_picture(tmp_path / "a.npy", invert=True).irradiance(), [[4.0, 3.0], [3.5, 0.0]])


@pytest.mark.parametrize("color", [False, True])
@pytest.mark.parametrize("mode", ["LA", "RGBA", "PA"])
def test_a_black_drawing_on_nothing(tmp_path, mode, color):
    """Refused, with the way out; inverted, the drawing is bright and the ground dark."""
    alpha = np.array([[0, 255], [255, 0]], dtype=np.uint8)
    image = Image.merge("LA", [Image.new("L", (2, 2)), Image.fromarray(alpha)]).convert("RGBA")
    if mode == "PA":
        image = image.quantize(2)
    image.convert(mode if mode != "PA" else image.mode).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: is black on nothing, .*; invert takes dark as bright"):
        read_picture(tmp_path / "a.png", color=color)
    got = read_picture(tmp_path / "a.png", color=color, invert=True).irradiance()
    assert got == pytest.approx(np.broadcast_to(placed(alpha / 255.0), got.shape), abs=CODE_16)
    Image.new("RGBA", (2, 2), (255, 255, 255, 255)).save(tmp_path / "white.png")
    with pytest.raises(InputError, match="is white all over"):
        read_picture(tmp_path / "white.png", invert=True)


def test_a_picture_that_is_piped_in(tmp_path):
    save(tmp_path / "a.png", ramp())
    np.save(tmp_path / "a.npy", np.arange(1.0, 7.0).reshape(2, 3))
    for name in ("a.png", "a.npy"):
        piped = Piped((tmp_path / name).read_bytes())
        assert np.array_equal(read_picture(piped).irradiance(), read_picture(tmp_path / name).irradiance())
    for data in (b"nonsense", b"\x93NUMPY nonsense"):
        with pytest.raises(InputError, match=r"^standard input: .*image"):
            read_picture(Piped(data))


def test_npy_is_indexed_i_along_x(tmp_path):
    array = np.arange(12.0).reshape(3, 4) / 5
    np.save(tmp_path / "a.npy", array)
    picture = read_picture(tmp_path / "a.npy")
    assert picture.encoding == "linear" and picture.suffix == ".npy"
    assert np.array_equal(picture.irradiance(), array)
    assert picture.irradiance_shape == (3, 4) and picture.aspect == pytest.approx(4 / 3)


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.uint8, bool])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy_of_any_real_type_and_order(tmp_path, dtype, order):
    array = np.asarray(ramp() % 5 > 2 if dtype is bool else ramp(), dtype=dtype, order=order)
    np.save(tmp_path / "a.npy", array)
    assert np.array_equal(read_picture(tmp_path / "a.npy").irradiance(), array.astype(float))


def test_npy_and_image_of_the_same_scene_agree(tmp_path):
    write_npy(tmp_path / "a.npy", placed(ramp()) / 255.0)
    image = read_picture(save(tmp_path / "a.png", ramp()), linear=True)
    assert read_picture(tmp_path / "a.npy").irradiance() == pytest.approx(image.irradiance(), rel=1e-14)


def test_floating_point_tiff_is_linear_irradiance(tmp_path):
    light = ramp().astype(np.float32) * 3
    assert np.array_equal(read_picture(save(tmp_path / "a.tif", light)).irradiance(), placed(light).astype(float))


# round trips

shapes = hnp.array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=6)


@given(
    st.one_of(
        hnp.arrays(np.uint8, shapes), hnp.arrays(np.uint16, shapes), hnp.arrays(np.float64, shapes, elements=st.floats(0, 1e300))
    ).filter(lambda a: a.any()),
    st.sampled_from(["srgb", "linear"]),
)
def test_write_then_read_is_lossless(values, encoding):
    encoding = "linear" if values.dtype == np.float64 else encoding
    before = Picture(values, encoding)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"target{before.suffix}"
        files.write_bytes(path, before.encoded())
        after = read_picture(path, linear=encoding == "linear")
        assert files.is_ours(path)
        assert [p.name for p in Path(folder).iterdir()] == [path.name]
    assert after.values.dtype == before.values.dtype and after.encoding == before.encoding
    assert np.array_equal(after.values, before.values)


def test_colour_survives_the_project(tmp_path):
    """What begin() keeps of a colour picture is read back as the same irradiance."""
    codes = np.random.default_rng(0).integers(0, 256, (5, 4, 3), dtype=np.uint8)
    first = read_picture(save(tmp_path / "a.png", codes))
    files.write_bytes(tmp_path / "target.png", first.encoded())
    assert np.array_equal(read_picture(tmp_path / "target.png").irradiance(), first.irradiance())


# what is refused


def _npy(array):
    return lambda path: np.save(path, array, allow_pickle=True)


def _image(array, mode="L"):
    return lambda path: Image.fromarray(np.asarray(array, dtype=np.uint8)).convert(mode).save(path)


def _bytes(data):
    return lambda path: path.write_bytes(data)


NOISE = np.random.default_rng(1).integers(1, 255, (64, 64), dtype=np.uint8)

REFUSED = {
    "missing.png": (lambda path: None, "no such file"),
    "missing.npy": (lambda path: None, "no such file"),
    "directory.png": (lambda path: path.mkdir(), "is a directory"),
    "text.png": (_bytes(b"not a picture\n"), "not an image"),
    "empty.png": (_bytes(b""), "not an image"),
    "empty.npy": (_bytes(b""), "not a readable .npy"),
    "text.npy": (_bytes(b"1 2 3\n"), "not a readable .npy"),
    "black.png": (_image(np.zeros((4, 4))), "black"),
    "black.npy": (_npy(np.zeros((4, 4))), "black"),
    "invisible.png": (lambda path: Image.new("RGBA", (4, 4), (255, 255, 255, 0)).save(path), "black"),
    "pixel.png": (_image([[9]]), "at least 2 x 2"),
    "row.npy": (_npy(np.ones((1, 9))), "at least 2 x 2"),
    "nothing.npy": (_npy(np.ones((0, 5))), None),
    "nan.npy": (_npy(np.array([[1.0, np.nan], [1, 1]])), "NaN"),
    "inf.npy": (_npy(np.array([[1.0, np.inf], [1, 1]])), "infinite"),
    "negative.npy": (_npy(np.array([[1.0, -0.5], [1, 1]])), "negative"),
    "flat.npy": (_npy(np.ones(4)), "2-D"),
    "volume.npy": (_npy(np.ones((2, 2, 2))), "2-D"),
    "object.npy": (_npy(np.array([[{}, {}]], dtype=object)), None),
    "complex.npy": (_npy(np.ones((2, 2), dtype=complex)), "real"),
    "text_array.npy": (_npy(np.array([["a", "b"], ["c", "d"]])), "real"),
    "huge.png": (_bytes(png(20000, 20000)), "8192 x 8192"),
    "large.png": (_bytes(png(10000, 10000)), "8192 x 8192"),
    "negative.tif": (lambda path: Image.fromarray(np.array([[-1.0, 1], [1, 1]], dtype=np.float32)).save(path), "negative"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_in_one_sentence(tmp_path, name):
    make, word = REFUSED[name]
    path = tmp_path / name
    make(path)
    with pytest.raises(InputError) as caught:
        read_picture(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert word is None or word in message


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"not a picture", "is not an image of a known format; an image (PNG, JPEG, TIFF, ...) or a 2-D .npy array is needed"),
        (b"P5 8 8 255\n...", "is an image that cannot be decoded (image file is truncated"),
        (b"P5 8 8 x\n", "cannot be decoded"),
        (b"\x93NUMPY???", "no header of a .npy array"),
    ],
)
def test_a_picture_that_is_piped_in_and_cannot_be_read(data, words):
    """What is wrong is said, not the type of an exception."""
    with pytest.raises(InputError) as refused:
        read_picture(files.Piped(data))
    assert str(refused.value).startswith("standard input: ") and words in str(refused.value)
    assert not re.search(r"\(\w*Error\)|0x", str(refused.value))


@pytest.mark.parametrize("kind", ["png", "jpg", "tif", "npy"])
def test_truncated_anywhere_is_refused(tmp_path, kind):
    whole = tmp_path / f"whole.{kind}"
    np.save(whole, NOISE) if kind == "npy" else Image.fromarray(NOISE).save(whole)
    data = whole.read_bytes()
    cut = tmp_path / f"cut.{kind}"
    lengths = np.linspace(1, len(data) * 0.9, 15).astype(int)
    for length in lengths:
        cut.write_bytes(data[:length])
        with pytest.raises(InputError):
            read_picture(cut)


def test_a_damaged_picture_never_ends_in_a_traceback(tmp_path):
    rng, refused = np.random.default_rng(2), 0
    whole = tmp_path / "whole.png"
    Image.fromarray(NOISE[:12, :12]).save(whole)
    path = tmp_path / "damaged.png"
    for _ in range(150):
        data = bytearray(whole.read_bytes())
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            read_picture(path)
        except InputError:
            refused += 1
    assert refused > 50


# images out


def test_image_file_is_the_screen_seen_from_plus_z(tmp_path):
    light = np.zeros((3, 4))  # [i, j]
    light[0, 3] = 1.0  # the -x, +y corner
    light[2, 0] = 0.5  # the +x, -y corner
    write_image(tmp_path / "a.png", light, 1.0, "linear")
    got = np.asarray(Image.open(tmp_path / "a.png"))
    assert got.shape == (4, 3) and got.dtype == np.uint8
    assert got[0, 0] == 255 and got[3, 2] == 128 and np.count_nonzero(got) == 2


def test_image_read_back_is_what_was_written(tmp_path):
    light = np.random.default_rng(0).random((7, 5))
    for encoding, linear in (("linear", True), ("srgb", False)):
        write_image(tmp_path / "a.png", light, 1.0, encoding)
        tolerance = CODE_8 if linear else 2.4 * CODE_8  # the sRGB curve is at most 2.4 times as steep
        assert read_picture(tmp_path / "a.png", linear).irradiance() == pytest.approx(light, abs=tolerance)


def test_white_level_clips_and_black_is_drawn(tmp_path):
    write_image(tmp_path / "a.png", np.array([[0.0, 1.0], [2.0, 9.0]]), 2.0, "linear")
    assert np.array_equal(placed(np.asarray(Image.open(tmp_path / "a.png"))), [[0, 128], [255, 255]])
    write_image(tmp_path / "a.png", np.zeros((2, 2)), 0.0, "srgb")
    assert not np.asarray(Image.open(tmp_path / "a.png")).any()


@pytest.mark.parametrize(
    "array",
    [
        np.arange(6.0).reshape(2, 3),
        np.ones((400, 2), dtype=np.float32),
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(6.0).reshape(3, 2).T,
    ],
)
def test_npy_header_is_numpys_and_ours(tmp_path, array):
    write_npy(tmp_path / "a.npy", array)
    back = np.load(tmp_path / "a.npy", allow_pickle=False)
    assert back.dtype == array.dtype and np.array_equal(back, array)
    assert np.array_equal(np.load(tmp_path / "a.npy", mmap_mode="r"), array)
    assert files.is_ours(tmp_path / "a.npy")
    np.save(tmp_path / "b.npy", array)
    assert not files.is_ours(tmp_path / "b.npy")


# files


@pytest.mark.parametrize("problem", [RuntimeError, KeyboardInterrupt])
def test_a_failed_write_leaves_nothing_and_spares_the_old(tmp_path, problem):
    with pytest.raises(problem), files.atomic_path(tmp_path / "new.bin") as temporary:
        temporary.write_bytes(b"half")
        raise problem
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "old.bin").write_bytes(b"whole")
    with pytest.raises(problem), files.atomic_path(tmp_path / "old.bin") as temporary:
        temporary.write_bytes(b"half")
        raise problem
    assert [p.name for p in tmp_path.iterdir()] == ["old.bin"]
    assert (tmp_path / "old.bin").read_bytes() == b"whole"


def test_write_bytes_replaces_whole_and_obeys_the_umask(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"a longer text than the next")
    before = os.umask(0o027)
    try:
        files.write_bytes(path, b"short")
    finally:
        os.umask(before)
    assert path.read_bytes() == b"short" and path.stat().st_mode & 0o777 == 0o640
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_writing_into_no_directory_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_npy(tmp_path / "nowhere" / "a.npy", np.ones((2, 2)))


def test_foreign_files_are_refused_unless_forced(tmp_path):
    theirs = save(tmp_path / "theirs.png", ramp())
    before = theirs.read_bytes()
    with pytest.raises(InputError, match="force"):
        files.refuse_foreign(theirs)
    files.refuse_foreign(theirs, force=True)
    assert theirs.read_bytes() == before  # refusing writes nothing, nor does allowing

    write_image(tmp_path / "ours.png", np.ones((2, 2)), 1.0, "srgb")
    files.refuse_foreign(tmp_path / "ours.png")
    files.refuse_foreign(tmp_path / "new.png")
    (tmp_path / "empty.png").touch()
    for path, force in ((tmp_path, True), (tmp_path / "no" / "a.png", True), (tmp_path / "empty.png", False)):
        with pytest.raises(InputError):
            files.refuse_foreign(path, force)


def test_a_text_about_caustics_is_not_ours(tmp_path):
    """The user's own notes may well hold the word."""
    (tmp_path / "notes.txt").write_text("ideas for my caustic lens\n")
    assert not files.is_ours(tmp_path / "notes.txt")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_directory_is_refused(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="read-only"):
            files.refuse_foreign(tmp_path / "a.png")
    finally:
        tmp_path.chmod(0o700)


def test_gaps_between_bright_parts():
    """Bars across a picture: each row along x crosses the gaps between them, no column any; a disc and even light have none."""
    bars = np.zeros((60, 200))
    for k in range(4):
        bars[10:50, 20 + 40 * k : 40 + 40 * k] = 1.0
    assert Picture(bars, "linear").gaps == pytest.approx(3 * 40 / 60)
    x, y = np.meshgrid(np.linspace(-1, 1, 100), np.linspace(-1, 1, 100))
    assert Picture((x * x + y * y < 0.6).astype(float), "linear").gaps == 0
    assert Picture(np.ones((20, 30)), "linear").gaps == 0
    scratched = np.ones((300, 300))
    scratched[:, 100] = 0.0
    assert Picture(scratched, "linear").gaps == 0
