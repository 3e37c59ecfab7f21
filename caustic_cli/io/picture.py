"""Reading of target pictures and writing of images.

A picture file is the screen seen from +z: column 0 is the -x edge, row 0 the +y edge.  Arrays are [i, j], i along +x and
j along +y.  Pixel values are sRGB-encoded or linear; irradiance is always linear.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps, PngImagePlugin, UnidentifiedImageError
from scipy.ndimage import binary_closing

from caustic_cli.errors import InputError
from caustic_cli.io.arrays import open_npy
from caustic_cli.io.files import NPY_HEADER, NPY_MAGIC, SOFTWARE, Piped, naming, open_regular, write_bytes

#: Largest picture read, in pixels: a float64 copy of it is half a gigabyte.
MAX_PIXELS = 8192 * 8192
#: Largest image file read: its decoders may take in all of it at once.
MAX_BYTES = 1 << 30
#: Least number of columns of an image for viewing.
WIDE = 800
ACCEPTED = "an image (PNG, JPEG, TIFF, ...) or a 2-D .npy array is needed"
#: Luminance of linear sRGB primaries (IEC 61966-2-1, Rec. 709).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
#: Fraction of the peak below which a picture counts as dark, and fraction of its width below which a dark gap is ignored.
DARK, NARROW = 0.01, 0.01


def to_linear(value: np.ndarray) -> np.ndarray:
    """sRGB-encoded values in [0, 1] to linear ones (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def to_srgb(value: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] to sRGB-encoded ones."""
    return np.where(value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 1e-12) ** (1 / 2.4) - 0.055)


def _disc() -> np.ndarray:
    """A uniform disc: the part of each pixel that lies within it, by DISC_POINTS^2 points."""
    n = DISC * DISC_POINTS
    x = (np.arange(n) + 0.5) / n - 0.5
    within = x[:, None] ** 2 + x[None, :] ** 2 <= 0.25
    return within.reshape(DISC, DISC_POINTS, DISC, DISC_POINTS).mean((1, 3))


def _headlamp() -> np.ndarray:
    """Intensity of a passing beam: brightest below a horizontal cut-off, 0 above it."""
    x = (2.0 * np.arange(DISC) + 1.0) / DISC - 1.0
    falling = np.where(x < CUT_OFF, np.exp(1.5 * (x - CUT_OFF)), 0.0)
    return np.exp(-1.5 * x * x)[:, None] * falling[None, :]


#: Pictures by name, where there is no such file: a uniform rectangle, a disc and a passing beam; pixels across the latter two, and
#: height of the cut-off, 1 being the upper edge.
NAMED, DISC, CUT_OFF = {"uniform": lambda: np.ones((2, 2)), "disc": _disc, "headlamp": _headlamp}, 500, 0.8
#: Points of a pixel of the disc along both axes.
DISC_POINTS = 8
#: Name of one that follows from where a lamp throws it, see `project.road_target`.
ROAD = "road"


@dataclass(frozen=True, eq=False)
class Picture:
    """A target picture as stored in a project.

    values: uint8 or uint16 codes in image order (rows from the top), uint8 (rows, columns, 3) in colour, or float64 irradiance in
    array order [i, j], (3, n_x, n_y) in colour; encoding: srgb or linear.
    """

    values: np.ndarray
    encoding: str

    @property
    def suffix(self) -> str:
        """.png, or .npy for floating-point irradiance."""
        return ".npy" if self.values.dtype == np.float64 else ".png"

    @property
    def aspect(self) -> float:
        """Height over width."""
        a, b = self.irradiance_shape
        return b / a

    @property
    def irradiance_shape(self) -> tuple[int, int]:
        """Cells along x and y."""
        return self.values.shape[-2:] if self.values.dtype == np.float64 else self.values.shape[1::-1]

    def irradiance(self) -> np.ndarray:
        """Linear irradiance (a, b), [i, j], float64, or linear R, G, B (3, a, b) in colour; codes are scaled to [0, 1], of which 1
        is white, and so are colours in floating point."""
        if self.values.dtype == np.float64:
            return self.values if self.values.ndim == 2 else self.values / (self.values.max() or 1.0)
        top = np.iinfo(self.values.dtype).max
        table = np.arange(top + 1) / top
        if self.encoding == "srgb":
            table = to_linear(table)
        return np.ascontiguousarray(np.moveaxis(table[self.values][::-1], (0, 1), (-1, -2)))

    @property
    def lit(self) -> tuple[float, float]:
        """Width and height of the bounding box of all non-zero pixels, over those of the picture; 1 for a black picture."""
        light = self.irradiance()
        bright = (light if light.ndim == 2 else light.sum(0)) > 0
        found = []
        for k in (0, 1):
            at = np.flatnonzero(bright.any(1 - k))
            found.append(float(at[-1] - at[0] + 1) / bright.shape[k] if at.size else 1.0)
        return found[0], found[1]

    @property
    def gaps(self) -> float:
        """Mean number of dark gaps between bright regions along a row plus that along a column: 0 for a photograph or a disc.

        Dark means below a hundredth of the peak, and a gap is at least a hundredth of the picture wide.
        """
        light = self.irradiance()
        light = light if light.ndim == 2 else light.sum(0)
        bright, found = light > DARK * light.max(), 0.0
        for lines in (bright, bright.T):
            width = max(1, round(NARROW * lines.shape[1]))
            joined = binary_closing(np.pad(lines, ((0, 0), (2 * width, 2 * width))), np.ones((1, width)))
            found += float(np.maximum((joined[:, 1:] & ~joined[:, :-1]).sum(1) - 1, 0).mean())
        return found

    def encoded(self) -> bytes:
        """The picture as a lossless file whose name ends in `suffix`."""
        return _npy(self.values) if self.suffix == ".npy" else _png(Image.fromarray(self.values))


def is_road(path: Path | Piped) -> bool:
    """Whether a target is ROAD, and no file of that name."""
    return not isinstance(path, Piped) and f"{path}" == ROAD and not path.exists()


def read_picture(path: str | Path | Piped, linear: bool = False, color: bool = False, invert: bool = False) -> Picture:
    """Read a picture, reduced to luminance, or with `color` as 8-bit RGB.

    8- and 16-bit grey codes are kept unchanged.  Colour is converted to luminance, alpha is composited over black, and an EXIF
    orientation is applied.  A .npy array, and a floating-point image, is linear irradiance.

    Args:
        invert: exchange dark and bright; alpha is then composited over white.

    Raises:
        InputError: the picture cannot be read, or is too large, too small, black, negative or not finite.
    """
    if str(path) in NAMED and not Path(path).exists():
        if color:
            raise InputError(f"{path}: has no colours; the file of a picture is needed")
        return Picture(NAMED[f"{path}"](), "linear")
    if isinstance(path, Piped):
        array = path.startswith(NPY_MAGIC)
    else:
        path = Path(path)
        array = path.suffix.lower() == ".npy"
    picture = _read_npy(path, color) if array else _read_image(path, linear, color, invert)
    if invert:
        values = picture.values
        top = values.max() if values.dtype == np.float64 else np.iinfo(values.dtype).max
        picture = Picture(top - values, picture.encoding)
    a, b = picture.irradiance_shape
    if min(a, b) < 2:
        raise InputError(f"{path}: is {a} x {b} pixels; a picture of at least 2 x 2 is needed")
    if not picture.values.any():
        raise InputError(f"{path}: is {'white' if invert else 'black'} all over; a picture with some light in it is needed")
    return picture


def _check_size(width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise InputError(f"is {width} x {height} pixels; at most {MAX_PIXELS} pixels (8192 x 8192) are read")


def _read_npy(path: Path | Piped, color: bool) -> Picture:
    with open_npy(path, ACCEPTED) as stored:
        shape = stored.shape
        if not (len(shape) == 3 and shape[0] == 3 if color else len(shape) == 2) or stored.dtype.kind not in "fiub":
            kind = "an array (3, n_x, n_y)" if color else "a 2-D array"
            raise InputError(f"a .npy target must be {kind} of real numbers")
        _check_size(*shape[-2:])
        values = stored.read_reals()
        if not np.isfinite(values).all():
            raise InputError(
                f"holds {int((~np.isfinite(values)).sum())} values that are NaN or infinite; finite irradiance is needed"
            )
        if (values < 0).any():
            raise InputError(f"holds negative values (least {values.min():g}); irradiance must be at least 0")
        if values.max() > 1e300:
            raise InputError(f"holds values up to {values.max():g}; irradiance must be at most 1e300")
    return Picture(values, "linear")


def _decoded(path: Path | Piped) -> Image.Image:
    """The pixels of a file, upright."""
    with open_regular(path, ACCEPTED, MAX_BYTES) as file, naming(path):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about sizes, which are checked below, and metadata
                with Image.open(file) as image:
                    _check_size(*image.size)
                    if image.format == "EPS":  # which Pillow would pass to Ghostscript
                        raise InputError(f"is a drawing, not pixels; {ACCEPTED}")
                    with _silent() if image.format == "TIFF" else nullcontext():
                        image = ImageOps.exif_transpose(image)
                        image.load()
                return image
        except InputError:
            raise
        except Image.DecompressionBombError as error:
            raise InputError(f"is too large; at most {MAX_PIXELS} pixels (8192 x 8192) are read") from error
        except Exception as error:  # a damaged file may cause any exception in a decoder
            raise InputError(f"{undecoded(error)}; {ACCEPTED}") from error


def _read_image(path: Path | Piped, linear: bool, color: bool, white: bool) -> Picture:
    image, encoding = _decoded(path), "linear" if linear else "srgb"
    if color:
        if image.mode.startswith(("F", "I")):
            raise InputError(f"{path}: has no colours (mode {image.mode}); a colour image of 8 bits is needed")
        return _lit(path, image, Picture(_over_ground(image, linear, white), encoding))
    if image.mode == "F":
        values = np.asarray(image, dtype=np.float64)
        if not np.isfinite(values).all() or (values < 0).any():
            raise InputError(f"{path}: holds values that are negative, NaN or infinite; irradiance must be finite")
        return Picture(np.ascontiguousarray(values[::-1].T), "linear")
    if image.mode.startswith("I"):
        codes = np.asarray(image.convert("I"))
        if codes.min(initial=0) < 0 or codes.max(initial=0) > 65535:
            raise InputError(f"{path}: holds integers outside 0 to 65535; an 8- or 16-bit picture is needed")
        return Picture(codes.astype(np.uint16), encoding)
    transparent = "transparency" in image.info or image.mode in ("LA", "La", "PA", "RGBA", "RGBa")
    if image.mode in ("1", "L") and not transparent:
        return Picture(np.array(image.convert("L")), encoding)
    return _lit(path, image, Picture(_luminance(image, linear, transparent, white), encoding))


def undecoded(error: Exception, kind: str = "an image of a known format") -> str:
    """Why a file is no picture of this kind, from the exception of its decoder, as a predicate."""
    if isinstance(error, UnidentifiedImageError):  # its message names an object of Python
        return f"is not {kind}"
    return f"is an image that cannot be decoded ({str(error) or type(error).__name__})"


def _lit(path: Path | Piped, image: Image.Image, picture: Picture) -> Picture:
    """The picture; refused if it is black on a transparent ground."""
    if not picture.values.any() and len(set(image.convert("RGBA").getchannel("A").getextrema())) == 2:
        raise InputError(f"{path}: is black on nothing, so that none of it is bright; ⟨invert⟩ takes dark as bright")
    return picture


@contextmanager
def _silent() -> Iterator[None]:
    """Redirect stderr to the null device within the block: libtiff writes warnings to it directly."""
    try:
        before = os.dup(2)
    except OSError:  # closed
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


def _over_ground(image: Image.Image, linear: bool, white: bool) -> np.ndarray:
    """8-bit codes (rows, columns, 3) of a colour picture, composited over black or white."""
    codes = np.asarray(image.convert("RGBA"))
    if codes[..., 3].min() == 255:
        return codes[..., :3].copy()
    table = np.arange(256) / 255.0
    opaque = codes[..., 3:] / 255.0
    light = (table if linear else to_linear(table))[codes[..., :3]] * opaque + white * (1.0 - opaque)
    return np.rint((light if linear else to_srgb(light)) * 255.0).astype(np.uint8)


def _luminance(image: Image.Image, linear: bool, transparent: bool, white: bool) -> np.ndarray:
    """16-bit codes of the luminance of a colour or transparent picture, composited over black or white: (rows, columns) uint16."""
    codes = np.asarray(image.convert("RGBA" if transparent else "RGB"))
    table = np.arange(256) / 255.0
    table = table if linear else to_linear(table)
    out = np.empty(codes.shape[:2], dtype=np.uint16)
    for k in range(0, len(codes), 256):  # in strips, which bounds the memory
        strip = codes[k : k + 256]
        light = table[strip[..., :3]] @ LUMINANCE
        if transparent:
            opaque = strip[..., 3] / 255.0
            light = light * opaque + white * (1.0 - opaque)
        light = np.clip(light, 0.0, 1.0)
        out[k : k + 256] = np.rint((light if linear else to_srgb(light)) * 65535.0)
    return out


def write_image(
    path: str | Path,
    irradiance: np.ndarray,
    white: float,
    encoding: str,
    wide: int = 1,
    said: Mapping[str, str] | None = None,
) -> None:
    """Write irradiance (n_x, n_y), [i, j], as an 8-bit grey PNG with `white` (and everything above) at 255; (3, n_x, n_y), RGB.

    wide: least number of columns, reached by integer upscaling; said: text entries, see `said_of`.
    """
    codes = codes_of(irradiance, white, encoding)
    times = -(-wide // codes.shape[1])
    write_bytes(path, _png(Image.fromarray(codes.repeat(times, 0).repeat(times, 1)), said))


def said_of(path: str | Path) -> dict[str, str]:
    """Text entries of a PNG; empty if it cannot be read."""
    try:
        with open_regular(path, ACCEPTED, MAX_BYTES) as file, Image.open(file) as image:
            return {key: value for key, value in image.info.items() if isinstance(value, str)}
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # no readable picture
        return {}


def codes_of(irradiance: np.ndarray, white: float, encoding: str) -> np.ndarray:
    """Irradiance as 8-bit codes in image order, (rows, columns) or (rows, columns, 3), as written by `write_image`."""
    value = np.clip(irradiance / white if white > 0 else np.zeros_like(irradiance), 0.0, 1.0)
    value = to_srgb(value) if encoding == "srgb" else value
    return np.ascontiguousarray(np.moveaxis(np.rint(value * 255.0).astype(np.uint8), (-1, -2), (0, 1))[::-1])


def write_npy(path: str | Path, array: np.ndarray) -> None:
    """Write a .npy (format 1.0) whose header is padded to NPY_HEADER bytes, by which the program recognises its own files."""
    write_bytes(path, _npy(array))


def _npy(array: np.ndarray) -> bytes:
    array = np.ascontiguousarray(array)
    text = repr({"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape})
    header = text.ljust(NPY_HEADER - 11) + "\n"
    return NPY_MAGIC + b"\x01\x00" + len(header).to_bytes(2, "little") + header.encode("latin1") + array.tobytes()


def _png(image: Image.Image, said: Mapping[str, str] | None = None) -> bytes:
    info = PngImagePlugin.PngInfo()
    info.add_text("Software", SOFTWARE)
    for key, text in (said or {}).items():
        info.add_text(key, text)
    held = io.BytesIO()
    image.save(held, format="PNG", pnginfo=info)
    return held.getvalue()
