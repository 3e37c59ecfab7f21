"""The table of settings: the single definition of every parameter of a project.

A section of project.toml is a class, and a setting one of its attributes: the row that declares it gives its type, unit, range and
default with its reason, its meaning, and its command-line option.  project.toml (`config.settings`), the defaults of the scene's
dataclasses, the commands' options, the manual pages and the reference are generated from these rows.  They import errors and checks
only, so that every other package may import them.

A path consists of a section and a key: `lens.size` is `[lens] size` in project.toml.  A path without a section is a parameter from
which settings are derived and which is not stored in a project: `mag` determines `target.size`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from caustic_cli.errors import InputError
from caustic_cli.schema import checks

#: Bounds of lengths on the lens, of distances and of sizes on the screen, mm.
LENS, DISTANCE, SCREEN = (1e-6, 1e6), (-1e12, 1e12), (1e-6, 1e9)
WAVELENGTHS = (100.0, 20_000.0)


@dataclass(frozen=True)
class Option:
    """The command-line option of a setting."""

    name: str
    #: The placeholder of its value.
    metavar: str | None = None
    #: The commands that have it.
    commands: tuple[str, ...] = ("design",)
    #: The value that a flag stands for.
    constant: Any = None
    #: Whether it is an option of every command, which is not generated from this table.
    common: bool = False


@dataclass(frozen=True)
class Setting:
    """A row of the table.  As an attribute of a section it is read as the value there, or the default; None without either."""

    #: Section and key, see the module.
    path: str
    #: number, whole, text, flag, numbers (a pair), wholes (a pair), list (of numbers), points ([x, y, z] or a list of such), tables
    #: (a list of tables as text).
    kind: str
    #: Description, for comments, options and the reference.
    help: str
    unit: str = ""
    #: Range of each number, without `low` itself if `above`.
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    #: Of a text.
    choices: tuple[str, ...] = ()
    #: None if there is none or if it is derived.
    default: Any = None
    #: How the default is derived.
    derived: str = ""
    #: The reason for the default.
    why: str = ""
    #: Whether a new project's file contains the default.
    written: bool = True
    #: Of the command line.
    option: Option | None = None
    #: Other paths that the same option sets.
    speaks_for: tuple[str, ...] = ()
    #: Name in a project, without suffix, of the file that it names.
    file: str = ""
    #: Path of the row before which a parameter is listed.
    before: str = ""

    def __set_name__(self, owner: type[Section], name: str) -> None:
        object.__setattr__(self, "path", f"{owner.section}.{name}".lstrip("."))
        object.__setattr__(self, "kind", KINDS[owner.__annotations__[name].removesuffix(" | None")])

    def __get__(self, section: Section | None, owner: type[Section]) -> Any:
        return self if section is None else section.get(self.key, _frozen(self.default))

    def __set__(self, section: Section, value: Any) -> None:
        raise AttributeError(f"{self.path} is not to be changed: `changed` returns another section")

    @property
    def section(self) -> str:
        """The part of the path before its last dot; "" for a parameter that is not stored in a project."""
        return self.path.rpartition(".")[0]

    @property
    def key(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]

    @property
    def both(self) -> int:
        """How many numbers a single one stands for, where its option takes one or two: both of a pair, or the first of a parameter
        whose second is derived; 0 where two must be given."""
        single = self.kind in ("numbers", "wholes") and self.option is not None and "[" in (self.option.metavar or "")
        return (2 if self.section else 1) if single else 0

    @property
    def worded(self) -> bool:
        """Whether a value may be a word; one that names a file then has a suffix."""
        return bool(self.default) or (self.option is not None and "|" in (self.option.metavar or ""))

    @property
    def note(self) -> str:
        """The comment in project.toml: unit and description."""
        return ", ".join(filter(None, (self.unit, self.help)))

    def check(self, value: Any) -> Any:
        """The validated value; pairs as tuples.

        Raises:
            InputError: naming the setting and what would be accepted.
        """
        where = f"⟨{self.path}⟩"
        if self.choices:
            return checks.choice(where, value, self.choices)
        if self.kind == "number":
            return self._number(where, value)
        if self.kind == "whole":
            return checks.whole(where, value, self.low, self.high)
        if self.kind == "numbers":
            return checks.pair(where, value, self._number)
        if self.kind == "wholes":
            return checks.pair(where, value, lambda w, n: checks.whole(w, n, self.low, self.high))
        if self.kind == "list":
            return tuple(self._number(where, v) for v in value)
        if self.kind == "points":
            if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 3:
                raise InputError(f"{where} must be three numbers x, y, z in mm, got {value!r}")
            return tuple(self._number(where, v) for v in value)
        return value

    def _number(self, where: str, value: Any) -> float:
        return checks.number(where, value, self.low, self.high, open_low=self.above)


def setting(help: str, unit: str = "", low: float = -math.inf, high: float = math.inf, **row: Any) -> Any:
    """A setting as an attribute of a section, whose name and annotation are its key and kind (`KINDS`)."""
    return Setting("", "", help, unit, low, high, **row)


class Section(Mapping[str, Any]):
    """The settings of a section: attributes are their values or defaults, and as a mapping it holds those that are set.

    Its values cannot be changed; lists become tuples.
    """

    section = ""

    def __init__(self, *given: Mapping[str, Any], **values: Any):
        self._values = {key: _frozen(value) for table in (*given, values) for key, value in table.items()}

    def __getitem__(self, key: str) -> Any:
        return self._values[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def changed(self, **values: Any) -> Self:
        """The section with other values."""
        return type(self)(self, values)

    def filled(self, **values: Any) -> Self:
        """The section with values of the keys that are not set."""
        return type(self)(values, self)

    def without(self, *keys: str) -> Self:
        """The section in which keys are not set."""
        return type(self)({key: value for key, value in self.items() if key not in keys})

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """The section of a new project, in which the defaults are set that its file contains."""
        rows = (row for row in vars(cls).values() if isinstance(row, Setting))
        return cls({row.key: row.default for row in rows if row.written and row.default is not None}, given)


def _frozen(value: Any) -> Any:
    """A value without lists, which could be changed."""
    return tuple(map(_frozen, value)) if isinstance(value, list | tuple) else value


Pair = tuple[float, float]
Wholes = tuple[int, int]
Numbers = tuple[float, ...]
Point = tuple[float, float, float]
Points = tuple[Point, ...]
Tables = tuple[dict[str, Any], ...]
#: Kinds of settings by their annotations, None aside.
KINDS = {"float": "number", "int": "whole", "str": "text", "bool": "flag", "Pair": "numbers", "Wholes": "wholes", "Numbers": "list"}
KINDS |= {"Point": "points", "Points": "points", "Tables": "tables"}
BOTH = ("design", "render")


# fmt: off
class SourceSettings(Section):
    """[source]: a light source."""

    section = "source"

    @property
    def also(self) -> tuple[SourceSettings, ...]:
        """The sources after the first."""
        return self.get("also", ())

    type: str = setting("plane: collimated light along +z over the aperture; point; grid of points; disc, an extended source; rays,"
            " a ray file; gaussian, the beam of a laser; measured, a beam by its phase", default="plane", why="the thesis' first"
            " source, section 4.2.1",
            option=Option("--source", commands=BOTH))
    power: float = setting("total power of the source, through the aperture or into the cone; in lm, images are in lux", "W", 0.0,
            checks.POWER, above=True, default=1.0, why="images are fractions of the source's power",
            option=Option("--power", "NUMBER[W|lm]", BOTH), speaks_for=("source.power_unit",))
    power_unit: str = setting("W, or lm for images in lux", choices=("W", "lm"), default="W", written=False)
    profile: str | None = setting("plane: file in this directory with the relative irradiance over the aperture", file="profile")
    file: str | None = setting("ray file (IES TM-25 .tm25ray, Zemax .dat or .sdf, LightTools .ray or .txt), of which the project"
            " keeps a copy; for a disc, a picture of its brightness, for a plane wave or a measured beam one of the irradiance over"
            " the aperture, all with linear values",
            option=Option("--source-file", "FILE", BOTH), file="source")
    phase_file: str | None = setting("measured: file of the phase over the aperture, in rad at the wavelength, not wrapped, which"
            " increases along the light; a 2-D .npy [i, j], of which the project keeps a copy",
            option=Option("--source-phase", "FILE", BOTH), file="phase")
    position: Points | None = setting("point: one or several [x, y, z]; grid, disc: the centre; rays: the file's origin", "mm",
            *DISTANCE, derived="on the axis, five lens widths in front of the lens",
            option=Option("--source-position", "X,Y,Z", BOTH))
    each: bool = setting("point, grid or disc: one such source behind every lenslet of an array, at this position from the"
            " lenslet's centre and with this power; all shine at once, and each lenslet is designed for its own", default=False,
            written=False, option=Option("--source-each", commands=BOTH))
    powers: Numbers | None = setting("point: relative power of each position", low=0.0, high=checks.POWER, derived="equal")
    size: Pair | None = setting("full width and height of a grid or disc", "mm", 0.0, 1e9, derived="a fifth of the lens",
            option=Option("--source-size", "W[xH]", BOTH))
    grid: Wholes | None = setting("points of a grid along x and y", low=1, high=1000, derived="25 x 25", why="figure 6.4.1 of the"
            " thesis", option=Option("--source-grid", "N[xM]", BOTH))
    cone: float | None = setting("half-angle of the cone about +z", "degrees", 1e-9, 90.0, derived="the narrowest that covers the"
            " lens", option=Option("--cone", "DEG", BOTH))
    angle: float | None = setting("disc at infinity (the sun: 0.533): angular diameter", "degrees", 0.0, 170.0,
            derived="a disc at a finite distance", option=Option("--source-angle", "DEG", BOTH))
    tilt: Pair = setting("direction of a plane wave or of a disc at infinity: +z turned about the x axis, then about the y axis,"
            " as a ray file is, with its position, about the lens' origin; the screen of a new design stands square to it unless"
            " told otherwise, that of a finished lens stays", "degrees", -80.0, 80.0, default=[0.0, 0.0], written=False,
            option=Option("--source-tilt", "A,B", BOTH))
    waist: Pair | None = setting("gaussian: radius of the waist, at which the irradiance is 1/e² of its peak", "mm", 0.0, 1e6,
            above=True, option=Option("--waist", "W0[xWY]", BOTH))
    waist_at: float = setting("gaussian: distance of the waist behind the entrance, negative in front of it", "mm", *DISTANCE,
            default=0.0, written=False, why="a collimated beam",
            option=Option("--waist-at", "Z", BOTH))
    m2: float = setting("gaussian: beam quality factor M² along both axes, of an incoherent superposition of beams of one waist"
            " (Gaussian Schell model)", "", 1.0, 1000.0, default=1.0, written=False, why="the beam of a single-mode laser",
            option=Option("--m2", "NUMBER", BOTH))
    direction: Point | None = setting("that direction as a vector [x, y, z] of any length, z > 0, instead of tilt, as which a"
            " project keeps it")
    intensity: str = setting("angular distribution of a point, grid or disc: uniform in solid angle, lambertian, a .csv of"
            " degrees from +z and relative intensity, or a photometric file (.ies, .ldt) symmetric about its axis",
            default="uniform", why="an isotropic source, the simplest",
            option=Option("--intensity", "uniform|lambertian|FILE", BOTH), file="intensity")
    aim: bool = setting("sample rays over the lens instead of the whole cone", default=True, why="no rays that miss the lens")
    polarisation: float | None = setting("direction of linear polarisation from +x", "degrees", -360.0, 360.0,
            derived="unpolarised", option=Option("--polarisation", "DEG", BOTH))
    wavelengths: Numbers | None = setting("wavelengths of the source's spectrum; a glass has its own index at each", "nm",
            *WAVELENGTHS, derived="one wavelength", option=Option("--wavelengths", "NM[:W],...", BOTH),
            speaks_for=("source.weights",))
    weights: Numbers | None = setting("relative power at each wavelength", low=0.0, high=checks.POWER,
            derived="equal; of a coloured picture, those that give its colours")
    spectrum: str | None = setting("continuous spectrum: equal (energy), daylight (D65), sun (AM1.5), led-3000, led-4000, led-6500,"
            " halogen, or a .csv of nm and relative power per nm; wavelengths are then samples of it", derived="equal, for waves"
            " where no wavelengths are given", option=Option("--spectrum", "NAME|FILE.csv", BOTH), file="spectrum")
    detector: str | None = setting("what the light is measured by: eye (luminous flux) or power", choices=("eye", "power"),
            derived="eye for a spectrum, white light and lumens; power for wavelengths", option=Option("--detector", "eye|power",
            BOTH))


class RoomSettings(Section):
    """[room]: the window in which the lens stands, in sunlight, from which the direction and the width of the light follow."""

    section = "room"
    place: Pair | None = setting("latitude to the north and longitude to the east", "degrees", -180.0, 180.0,
            option=Option("--sun", "LAT,LON,TIME", BOTH), speaks_for=("room.time",))
    time: str | None = setting("date and time with its offset from UTC (ISO 8601), like 2026-06-21T12:00+02:00; of a sundial an"
            " interval, like 2026-06-21T11:00+02:00/13:00, divided evenly among its lenslets, row by row as a sheet is read")
    faces: float = setting("azimuth to which the outer side of the pane looks, clockwise from north", "degrees", -360.0, 360.0,
            default=180.0, why="a south window", option=Option("--faces", "AZIMUTH", BOTH))
    slope: float = setting("angle between pane and horizontal: 90 for an upright window, 0 for a skylight", "degrees", 0.0, 180.0,
            default=90.0, why="windows are upright", option=Option("--slope", "DEG", BOTH))


class LampSettings(Section):
    """[lamp]: a lens around a light-emitting chip, instead of one in front of a source; of the other sections it takes the index,
    the picture, the distance of the screen and the seed alone."""

    section = "lamp"
    radius: float | None = setting("design a lamp: a lens around a Lambertian chip at the origin that emits along +z, for all its"
            " light; greatest distance of the free-form surface from the chip", "mm", *LENS, derived="no lamp",
            option=Option("--lamp", "MM"))
    inner: float | None = setting("radius of the hemisphere around the chip that is the inner side of the lens, or of the cavity"
            " below a flat one", "mm", *LENS, derived="4/15 of lamp.radius, 2/15 with two free-form surfaces",
            option=Option("--lamp-inner", "MM"))
    flat: float | None = setting("height above the chip of a flat inner side instead of the hemisphere: the roof of a cylindrical"
            " cavity of the radius lamp.inner, whose side is matt", "mm", *LENS, derived="a hemisphere",
            option=Option("--lamp-flat", "MM"))
    surfaces: int = setting("free-form surfaces: 1, around a hemisphere, or 2, which share the deflection; lamp.inner is then the"
            " least radius of the inner one", low=1, high=2, default=1, why="one is cheaper to make", written=False,
            option=Option("--lamp-surfaces", "1|2"))
    wall: float = setting("least distance between hemisphere and free-form surface", "mm", *LENS, default=1.0, why="injection"
            " moulding of acrylic", option=Option("--lamp-wall", "MM"))
    base: float = setting("thickness of the foot of the lens, below the plane of the chip; of an array of its board, 2 mm", "mm",
            0.0, 1e6, default=0.0, why="a base in that plane", written=False, option=Option("--lamp-base", "MM"))
    flange: float = setting("width of a flange around the foot for holding, beyond the rim of the lens", "mm", 0.0, 1e6,
            default=0.0, why="none", written=False, option=Option("--lamp-flange", "MM"))
    pitch: Pair = setting("distances of the lamps of an array along x and y, which are one part on a board as thick as its base",
            "mm", *LENS, derived="twice lamp.radius and lamp.wall together", option=Option("--pitch", "MM[xMM]"))
    chip: Pair = setting("full width and height of the chip, 0 for a point", "mm", 0.0, 1e6, default=[0.0, 0.0], why="the limit"
            " that a small chip approaches", option=Option("--chip", "W[xH]"))
    shape: str = setting("shape of the chip: rectangle or disc", choices=("rectangle", "disc"), default="rectangle", written=False,
            option=Option("--chip-shape", "rectangle|disc"))
    intensity: str | None = setting("angular distribution of the chip instead of Lambert's law: a .csv of degrees from +z and"
            " relative intensity, or a photometric file (.ies, .ldt) symmetric about its axis", derived="Lambert's law",
            option=Option("--chip-intensity", "FILE"), file="chip")
    file: str | None = setting("ray file (TM-25 and others, as of a source) of the chip instead, in the frame of the lamp",
            derived="a chip by its size", option=Option("--chip-rays", "FILE"), file="chip-rays")
    reflectance: float = setting("part of the light reflected back to the chip by the lens that the chip reflects diffusely; above"
            " 0, reflected light is followed in the judgement", low=0.0, high=1.0, default=0.0, why="it is booked as lost",
            written=False, option=Option("--chip-reflectance"))
    angles: Pair | None = setting("full width and height of the picture in the far field, its values being intensities", "degrees",
            0.0, 178.0, above=True, derived="a picture on a screen", option=Option("--angles", "W[xH]"))
    projection: str = setting("coordinates of the picture in the far field: longitude about the vertical and latitude (type A"
            " photometry); gnomonic, as on a plane; stereographic; or polar, the angle gamma towards C (type C photometry)",
            choices=("latitude", "gnomonic", "stereographic", "polar"), default="latitude", written=False,
            option=Option("--projection", "latitude|gnomonic|stereographic|polar"))


class LensSettings(Section):
    """[lens]: the lens."""

    section = "lens"
    size: Pair = setting("full width and height of the lens' aperture", "mm", *LENS, default=[10.0, 10.0], why="table D.2 of the"
            " thesis, in millimetres", option=Option("--lens-size", "W[xH]"))
    z_in: float = setting("position of the plane entrance, or reference plane of a free-form one", "mm", -checks.LENGTH,
            checks.LENGTH, default=0.0, why="the origin of the lens")
    thickness: float = setting("centre height of the base surface above the lens' origin", "mm", -checks.LENGTH, checks.LENGTH,
            derived="half the width of a lens up to 20 mm; for a wider one, a least wall of 3 mm; with a parallel entrance a wall"
            " of 3 mm; with two free-form sides twice the width; 0 of a mirror", why="table D.2 of the thesis; a plate is thin; two"
            " sides need a distance",
            option=Option("--thickness", "MM"))
    radius: Pair = setting("radii of curvature of the base surface along x and y: the same for a sphere, inf along one axis for a"
            " cylinder; positive is diverging, with edges towards +z, negative the outer side of a tube or dome", "mm",
            derived="the sphere that spreads the light over the picture", why="table 6.1 of the thesis",
            option=Option("--base-radius", "R[,RY]"))
    base_file: str | None = setting("STEP file of the base surface, of which the project keeps a copy: one cylindrical, spherical"
            " or B-spline face, whose vertex is moved to the thickness", derived="the base surface of lens.radius",
            option=Option("--base-file", "FILE.step"), file="base")
    height_range: Pair = setting("limits of the relief: least and largest height of the exit above the base surface", "mm",
            -checks.LENGTH, checks.LENGTH, derived="a tenth of the lens' width, or what the first surface needs",
            option=Option("--relief", "LOW,HIGH"))
    entrance: str = setting("inner side of the lens: flat, or parallel to the base surface (concentric), at the wall's thickness,"
            " like that of a tube, a dome or a bent pane", choices=("flat", "parallel"), default="flat", written=False,
            option=Option("--entrance", "flat|parallel"))
    min_thickness: float = setting("least wall thickness, from z_in to the exit", "mm", 0.0, checks.LENGTH, default=1.0,
            why="a wall that can be machined and mounted", option=Option("--min-thickness", "MM"))
    index: float = setting("refractive index", low=1.0, high=5.0, above=True, default=1.5443, written=False,
            why="table D.2 of the thesis", option=Option("--index"))
    glass: str | None = setting("material instead of an index, by its common name: acrylic, polycarbonate, BK7, resin, water, ..."
            " (list: all of them); N-BK7 for a coloured picture", option=Option("--glass", "NAME"))
    wavelength: float = setting("wavelength of the glass' index", "nm", *WAVELENGTHS, default=587.5618, written=False,
            why="the d line, for which catalogues give indices")
    fresnel: str = setting("reflection losses: none, schlick or exact", choices=("none", "schlick", "exact"), default="exact",
            why="every uncoated surface reflects")
    absorption: float = setting("absorption coefficient a: transmittance exp(-a t) of t mm of glass (Beer-Lambert)", "1/mm", 0.0,
            1e6, default=0.0, written=False, option=Option("--absorption", "PER_MM", BOTH))
    roughness: float = setting("standard deviation of the exit's microfacet slopes along an axis, mm per mm", low=0.0, high=1.0,
            default=0.0, written=False, option=Option("--roughness", "SLOPE", BOTH))
    finish: str = setting("how the part is finished, for which the surface to be made is corrected: sanded:GRIT[,GRIT...],"
            " polished:UM, coated:UM or printed:LAYER,PIXEL[,COAT] (µm), joined by +; empty: it is made as designed", default="",
            written=False, option=Option("--finish", "STEP[+STEP...]"))
    mirror: bool = setting("the surface is a mirror, with the screen on the source's side, beside its light", default=False,
            written=False, option=Option("--mirror"))
    crossing: bool = setting("the light crosses over on its way to the screen: a surface that is convex where the other one,"
            " without it, is concave, or less convex", default=False, written=False, option=Option("--crossing"))
    aperture: str = setting("shape of the lens: rectangle, or circle, the largest within size", choices=("rectangle", "circle"),
            default="rectangle", written=False, option=Option("--aperture", "rectangle|circle"))
    border: float = setting("width of a mounting rim around the aperture in exported solids", "mm", 0.0, 1e6, default=0.0,
            written=False, option=Option("--border", "MM"))
    array: Wholes = setting("lenslets along x and y, each of which projects the whole picture, or lamps on a board", low=1,
            high=100, default=[1, 1], written=False, option=Option("--array", "N[xM]"))
    packing: str = setting("how lenslets are packed: square, or hexagonal, in rows of which every second one is displaced by half a"
            " lenslet", choices=("square", "hexagonal"), default="square", written=False,
            option=Option("--packing", "square|hexagonal"))
    lenslets: str = setting("shape of lenslets: filled, cells without gaps, or round, the largest circles within the cells, in an"
            " opaque mask", choices=("filled", "round"), default="filled", written=False,
            option=Option("--lenslets", "filled|round"))
    gradient: str | None = setting("gradient index of the lens: selfoc, radial or axial, with gradient_terms; volume, with an"
            " index_file; free, designed instead of the surface, between flat sides, or"
            " together with it (with_surface)",
            choices=("selfoc", "radial", "axial", "volume", "free"), derived="homogeneous",
            option=Option("--gradient", "selfoc|radial|axial|volume|free"))
    gradient_terms: Numbers | None = setting("selfoc: g of n^2 = index^2 (1 - (g r)^2), 1/mm; radial: a, b, ... of index + a r^2 +"
            " b r^4 + ...; axial: of index + a z + b z^2 + ..., z from the entrance; r and z in mm",
            option=Option("--gradient-terms", "A[,B...]"))
    index_file: str | None = setting("control values (n, m) or (n, m, k) of a B-spline volume of refractive index over aperture and"
            " thickness, .npy, of which the project keeps a copy; for a free gradient, the result",
            option=Option("--index-file", "FILE"), file="index")
    index_range: Pair = setting("least and largest control value of a free gradient", low=1.0, high=5.0,
            derived="the index, 0.05 less to 0.05 more", why="the range of gradients in glass and printed polymers",
            option=Option("--index-range", "LEAST,MOST"))
    index_control: Wholes = setting("control values of a free gradient along x and y", low=4, high=1024,
            derived="two knot spans per pixel, eight for pictures with dark gaps", why="as for a surface: finer than the"
            " picture, and than the creases of dark gaps", option=Option("--index-control", "N[xM]"))
    index_layers: int = setting("control values of a free gradient along z; for light inclined to the axis by default as many,"
            " at most 8, as follow it to the detail of those along x and y", low=1, high=64, default=1, written=False,
            why="in a thin blank only the integral of the index along a ray matters")
    with_surface: bool = setting("the exit of a lens with a free gradient is designed together with its index, instead of two flat"
            " sides; the index begins with half of the deflection, or as much as its range allows", default=False, written=False,
            option=Option("--with-surface"))
    control: Wholes = setting("control points of the finished lens", low=2, high=4096, derived="by picture and quality: two knot"
            " spans per pixel", why="finer than the picture, so that it is no limit", option=Option("--control", "N[xM]"))
    degree: Wholes = setting("spline degrees, 1 to 15", low=1, high=15, default=[3, 3], why="the least with continuous curvature",
            option=Option("--degree", "P[xQ]"))
    knots_u: Numbers | None = setting("knot vector on [0, 1] along x", derived="open, equispaced")
    knots_v: Numbers | None = setting("knot vector on [0, 1] along y", derived="open, equispaced")


class ScreenSettings(Section):
    """[screen]: the screen."""

    section = "screen"
    z: float = setting("distance from the lens' origin", "mm", *DISTANCE, default=300.0, why="table D.2 of the thesis, in"
            " millimetres")
    size: Pair = setting("full width and height", "mm", *SCREEN, derived="picture plus margin")
    resolution: Wholes = setting("pixels along x and y", low=2, high=16384, derived="250 across")
    tilt: Numbers = setting("rotation of the screen about its own centre: about the fixed x axis, then about the fixed y axis;"
            " before both, by a third angle, about its normal", "degrees", -180.0, 180.0, default=[0.0, 0.0], written=False,
            option=Option("--screen-tilt", "A,B[,C]", BOTH))
    shift: Pair = setting("decentre of the screen; by default on light that is tilted, and beside the light of the source of a"
            " mirror", "mm", -1e9, 1e9, default=[0.0, 0.0], written=False, option=Option("--screen-shift", "X,Y", BOTH))
    radius: Pair | None = setting("radii of curvature of a curved screen along x and y: the same for a sphere, inf along one axis"
            " for a cylinder; positive bends the edges towards +z, away from a lens", "mm", derived="plane", written=False,
            option=Option("--screen-radius", "R[,RY]", BOTH))
    far: bool = setting("the picture in the far field, as in the focus of an ideal lens of focal length z; at 1000 mm all lengths"
            " on the screen are mrad", default=False, written=False)
    shape_file: str | None = setting("file of a screen's shape, of which the project keeps a copy: heights in mm along +z on a"
            " uniform grid over the screen, borders included; a 2-D .npy [i, j] or a .tif of 32-bit floats",
            option=Option("--screen-shape", "FILE", BOTH), file="screen")


class TargetSettings(Section):
    """[target]: the picture."""

    section = "target"
    file: str = setting("the picture, in this directory")
    size: Pair = setting("width and height of the picture on the screen", "mm", *SCREEN, derived="mag times the lens' width")
    encoding: str = setting("encoding of the picture's values: srgb, or linear (irradiance)", choices=("srgb", "linear"),
            default="srgb", why="the encoding of image files", option=Option("--linear", constant="linear"))
    flip: str = setting("mirror the picture along x, y or xy, for a viewer on the lens' side; empty for none",
            choices=("", "x", "y", "xy"), default="", option=Option("--flip", "x|y|xy"))
    sheet: bool = setting("the picture is a contact sheet with a separate picture for each lenslet of an array", default=False,
            written=False, option=Option("--sheet"))
    color: bool = setting("the picture in colour: light of three wavelengths (611, 549, 464 nm), with the glass' index for each,"
            " that looks like its sRGB colours (CIE 1931)", default=False, written=False, option=Option("--color"))


class SecondSettings(Section):
    """[second]: the second target, behind the picture: the lens then has two free-form sides."""

    section = "second"
    file: str | None = setting("second picture, formed by the same light on a screen farther away; in this directory",
            option=Option("--second", "PICTURE"), file="second")
    z: float = setting("distance of that screen from the lens' origin", "mm", *DISTANCE, option=Option("--second-at", "MM"))
    size: Pair = setting("width and height of that picture", "mm", *SCREEN, derived="that of a beam from the lens' edge through"
            " that of the first picture", option=Option("--second-size", "W[xH]"))
    collimate: bool = setting("collimate the light behind the picture, square to its screen", default=False, written=False,
            option=Option("--collimate"))
    focus: Point | None = setting("focus of the light behind the picture", "mm", *DISTANCE, option=Option("--focus", "X,Y,Z"))


class ElementSettings(Section):
    """[[element]]: another lens or a fold mirror."""

    section = "element"
    type: str = setting("singlet lens, or mirror, which folds the axis", choices=("lens", "mirror"), derived="lens")
    z: float = setting("position of its first vertex; behind a mirror measured along the folded axis", "mm", *DISTANCE)
    thickness: float = setting("centre thickness of a lens", "mm", 0.0, checks.LENGTH, above=True, default=4.0, written=False,
            why="a common small lens")
    radius: Pair | None = setting("radii of curvature of front and back, for a mirror the first only; positive if the centre lies"
            " behind the surface, inf for flat", "mm", derived="flat")
    index: float = setting("refractive index of a lens", low=1.0, high=5.0, above=True, default=1.5168, written=False,
            why="N-BK7 at the d line")
    glass: str | None = setting("material instead of an index, as lens.glass")
    absorption: float = setting("absorption coefficient a: transmittance exp(-a t) of t mm of its glass", "1/mm", 0.0, 1e6,
            default=0.0, written=False)
    size: Pair = setting("full width and height of its aperture", "mm", *LENS, derived="that of the lens in front of it; behind it"
            " a fifth more than a straight beam to the picture needs")
    aperture: str = setting("shape of its aperture: rectangle, or circle, the largest within size", choices=("rectangle", "circle"),
            default="rectangle", written=False)
    tilt: Pair | None = setting("rotation of a mirror about x or about y", "degrees", -85.0, 85.0)
    free: str = setting("free-form surfaces to be designed: none, front, back or both", choices=("none", "front", "back", "both"),
            default="none", written=False, why="stock lenses are spherical")

    @property
    def reshapes(self) -> bool:
        """Whether it does more than fold the axis, as lenses and curved mirrors do."""
        flat = self.radius is None or math.isinf(self.radius[0])
        return not (self.type == "mirror" and flat and self.free == "none")


class StageSettings(Section):
    """[[design.stages]]: a stage of the design."""

    section = "design.stages"
    source: str | None = setting("source type in this stage, with the other keys of [source]")
    control: Wholes = setting("control points", low=2, high=4096, derived="the lens'")
    rays: int = setting("rays per iteration", low=1, high=10**12, derived="9 per pixel", why="750 x 750 on 250 x 250 pixels, tables"
            " D.1 and D.2 of the thesis")
    sampler: str = setting("grid, lines, stratified, uniform or sobol", derived="by the source")
    reconstruction: str = setting("bincount, gaussian or cosine", derived="cosine")
    filter_size: Wholes = setting("filter size in pixels, odd", derived="3 x 3")
    alpha_per_mm2: float | None = setting("alpha of the gaussian (eq. 4.4.5)", "1/mm^2")
    alpha_per_pixel2: float | None = setting("alpha of the gaussian, instead of alpha_per_mm2", "1/pixel^2")
    spread: bool = setting("trace rays of the source's centre, and convolve the image with the source's point-spread function",
            default=False, written=False)
    lenslets: bool = setting("array: compare the image of every lenslet with its own picture, with its share of the rays",
            default=False, written=False)
    spare: bool = setting("leave this stage out if a later one can refine the wave image", default=False, written=False)
    oversample: int = setting("subdivide pixels for the filter by this factor, and sum them: sharper than the filter on pixels",
            low=1, high=8, default=1)
    blur: float = setting("blur of render and target in the loss", "pixels", 0.0, 1000.0, default=0.0)
    apron: int = setting("guard band: dark pixels around the screen that detect stray light", low=0, high=4096, default=0)
    iterations: int = setting("largest number of iterations", low=0, high=10**9, default=1000, why="section 6.2.1 of the thesis")
    tolerance: float = setting("end the stage when 10 iterations reduce the loss by less than this fraction; 0: never", low=0.0,
            high=1.0, default=0.0)
    waves: Numbers | None = setting("refine the wave image at these wavelengths, unless the source has lines, instead of the ray"
            " image",
            "nm", *WAVELENGTHS)


class DesignSettings(Section):
    """[design]: the design."""

    section = "design"

    @property
    def stages(self) -> tuple[StageSettings, ...]:
        """The [[design.stages]]."""
        return self.get("stages", ())

    loss: str = setting("weighted sum of rms (eq. 5.2.1), rms-light (including light off the screen), throughput, light (light off"
            " the screen), diffusion, uniformity, laplacian, curvature: 'rms-light + 0.01 laplacian'; or log-rms, for a laser beam"
            " the least relative error within the picture at a given fraction of the light (design.efficiency), the rest of which"
            " may lie anywhere", default="rms-light",
            why="eq. 5.2.1 alone is reduced by sending light off the screen", option=Option("--loss"))
    efficiency: float = setting("log-rms: fraction of the light behind the lens that is to land in the region, over what the"
            " picture itself has there: 1 of an image that is the picture", "", 0.0, 1.0,
            above=True, default=0.97, written=False, why="the error falls steeply down to there, and slowly below",
            option=Option("--efficiency", "FRACTION"))
    region: str = setting("log-rms: the region in which light is free to depart from the picture: a number of pixels by which the"
            " picture above 10 % of its peak is dilated, or a picture as wide as the screen whose lit pixels are the region",
            default="0", written=False, why="all the light is to be in the picture", option=Option("--region", "PIXELS|FILE"),
            file="region")
    max_slope: float = setting("largest slope of the surface, mm per mm; 0 for no limit", low=0.0, default=0.0,
            option=Option("--max-slope"))
    min_radius: float = setting("least radius of curvature of concave regions, such as a tool's; 0 for no limit", "mm", 0.0,
            default=0.0, option=Option("--min-radius", "MM"))
    optimizer: str = setting("lbfgs or adam", choices=("lbfgs", "adam"), default="lbfgs", why="fewest evaluations for a given"
            " error: caustic convergence, study design; adam for a network", option=Option("--optimizer"))
    lr: float = setting("learning rate of adam", low=0.0, above=True, default=1e-3, why="table D.2 of the thesis",
            option=Option("--lr"))
    network: str = setting("parametrisation of the heights: none, sparse or dense", choices=("none", "sparse", "dense"),
            default="none", why="control heights converge fastest", option=Option("--network"))
    network_layers: int = setting("hidden layers of a dense network", low=1, high=16, default=2, written=False,
            why="three with the final tanh, as in the thesis", option=Option("--network-layers", "N"))
    network_width: int = setting("neurons per hidden layer of a dense network; 0 for the number of control points", low=0,
            high=1_000_000, default=0, written=False, why="as in the thesis", option=Option("--network-width", "N"))
    activation: str = setting("activation function of a dense network: tanh, relu, silu or sine",
            choices=("tanh", "relu", "silu", "sine"), default="tanh", written=False, why="as in the thesis",
            option=Option("--activation", "tanh|relu|silu|sine"))
    over: str = setting("ranges of network inputs, so that one trained network gives a lens for every value: throw, source.x,"
            " source.y, source.z = LOW:HIGH, separated by commas", "mm", default="", written=False,
            option=Option("--over", "KEY=LOW:HIGH[,...]"))
    initial: str = setting("initial parameters: zero, uniform (+-1e-4), random, or zero-last (random except for the last layer of a"
            " network, which is zero, so that it starts at the initial surface)",
            choices=("zero", "uniform", "random", "zero-last"), default="zero", derived="zero; zero-last of a preconditioned"
            " network")
    preconditioner: str = setting("none or laplacian", choices=("none", "laplacian"), derived="laplacian for heights with lbfgs"
            " without an exact transport start, and for a network trained over a range",
            option=Option("--preconditioner", "none|laplacian"))
    filter_target: bool = setting("filter the target like the render", default=True, why="otherwise the blur of the filter counts"
            " as an error")
    waves: str = setting("refine the wave image: auto (where diffraction matters and time allows), on or off",
            choices=("auto", "on", "off"), default="auto", why="effects are simulated where a scene needs them",
            option=Option("--waves", "auto|on|off"))
    robust: str = setting("file of manufacturing and alignment errors, such as examples/tolerances.toml, over which the loss of the"
            " last stage is averaged; empty for none", default="", written=False, option=Option("--robust", "FILE"),
            file="tolerances")
    start: str = setting("initial surface: transport (optimal transport of the light to the picture), offset (the base sphere given"
            " by the magnification), or the lens of another project or of a file: .npz, .step or height map as exported, .npy of"
            " heights in mm", derived="transport; offset for a network, adam, several points or a coarse net",
            option=Option("--start", "transport|offset|PROJECT|FILE"))
    iterations: int = setting("total number of iterations, including those before a resume; 0: as given by the stages", low=0,
            high=10**9, default=0, derived="as given by the stages", option=Option("--iterations"))
    time_limit: float = setting("time limit of the whole command, at least a quarter of it for the iterations; inf for none", "s",
            0.0, above=True, default=math.inf, option=Option("--time-limit", "SECONDS"))
    checkpoint_every: float = setting("time between checkpoints", "s", 0.0, above=True, default=10.0, why="work lost if the process"
            " is killed; checkpoints of large nets take seconds and are written less often")
    seed: int = setting("seed of all random numbers: the same seed gives the same bytes", low=0, high=2**31 - 1, default=0,
            option=Option("--seed", common=True))
    dtype: str = setting("precision of the rays: float32 or float64", choices=("float32", "float64"), default="float32",
            why="the sampling noise exceeds its rounding errors", option=Option("--dtype", common=True))


class Parameters(Section):
    """Parameters from which settings are derived, and which are not stored in a project.

    Raises:
        InputError: one is out of range.
    """

    def __init__(self, *given: Mapping[str, Any], **values: Any):
        super().__init__(*given, **values)
        for key in {"mag", "margin", "throw", "quality", "rays"} & {*self}:
            if (key, self[key]) != ("throw", math.inf):
                check(key, self[key])

    throw: float | None = setting("distance from the lens' origin to the screen, in front of a mirror; inf for the far field, in"
            " which sizes on the screen are in mrad", "mm", -1e12, 1e12, derived="300", option=Option("--throw", "MM"),
            speaks_for=("screen.z", "screen.far"), before="screen.z")
    screen_place: str | None = setting("part of a room as the screen, where the light meets it: floor:1m, ceiling:1m or wall:2m,"
            " which may have ,AZIMUTH of the picture's top or of the wall; or any plane, point=X,Y,Z;normal=X,Y,Z;up=X,Y,Z, the"
            " normal towards the viewer, with room; before it for east, north and up; far, the far field, of a lamp with"
            " lamp.angles", derived="square to the light", option=Option("--screen", "PLACE"),
            speaks_for=("screen.z", "screen.tilt", "screen.shift"), before="screen.z")
    screen_size: Pair | None = setting("full width and height of the screen; a single length keeps the picture's aspect ratio; in"
            " mrad or deg of one in the far field", "mm", derived="picture plus margin", option=Option("--screen-size", "W[xH]"),
            speaks_for=("screen.size",), before="screen.size")
    resolution: Wholes | None = setting("pixels of the whole screen; a single number is across, the rows follow from the aspect"
            " ratio", derived="250", why="table D.2 of the thesis", option=Option("--resolution", "N[xM]"),
            speaks_for=("screen.resolution",), before="screen.resolution")
    mag: float = setting("width of the picture in lens widths", low=1e-3, high=1e3, default=3.0, why="table 6.1 of the thesis",
            option=Option("--mag"), before="target.file")
    picture_size: Pair | None = setting("full width and height of the picture on the screen instead of a magnification; a single"
            " length keeps its aspect ratio; in mrad or deg of one in the far field", "mm", derived="by the magnification",
            option=Option("--picture-size", "W[xH]"), speaks_for=("target.size",), before="target.file")
    margin: float = setting("total width of the dark border relative to the picture", low=0.0, high=100.0, default=0.28,
            why="table 6.1 of the thesis: a screen 6.4 wide for a picture of 5, which shows stray light", option=Option("--margin"),
            before="target.file")
    invert: bool = setting("invert the picture, for drawings in black on white or on a transparent background", default=False,
            option=Option("--invert"), before="target.color")
    elements: Tables | None = setting("further lens or fold mirror on the axis, with the keys of an [[element]] table: 'lens z=-40"
            " thickness=4 radius=50,inf glass=N-BK7', 'mirror z=150 tilt=45,0'; may be repeated, in the order in which light"
            " reaches them", derived="none", option=Option("--element", "'TYPE KEY=VALUE...'"), speaks_for=("element",),
            before="element.type")
    quality: str | None = setting("quality of the default stages: draft, standard or fine", choices=("draft", "standard", "fine"),
            derived="standard, or by the time limit", option=Option("--quality"), before="design.loss")
    rays: int | None = setting("number of rays of the last default stage", low=1, high=10**12, derived="by quality",
            option=Option("--rays", "N"), before="design.loss")
# fmt: on
SECTIONS: tuple[type[Section], ...] = (SourceSettings, RoomSettings, LampSettings, LensSettings, ScreenSettings, TargetSettings)
SECTIONS += (SecondSettings, ElementSettings, DesignSettings, StageSettings)


def _listed() -> Iterator[Setting]:
    """All rows in the order of the sections, each parameter before the setting it determines."""
    parameters = [row for row in vars(Parameters).values() if isinstance(row, Setting)]
    for section in SECTIONS:
        for row in vars(section).values():
            if isinstance(row, Setting):
                yield from (parameter for parameter in parameters if parameter.before == row.path)
                yield row


TABLE: dict[str, Setting] = {row.path: row for row in _listed()}


def check(path: str, value: Any) -> Any:
    """The validated value of a setting, see `Setting.check`."""
    return TABLE[path].check(value)


def check_all(section: str, of: object, *keys: str) -> None:
    """Validate attributes of an object that are settings of one section, by name."""
    for key in keys:
        check(f"{section}.{key}", getattr(of, key))


def default(path: str) -> Any:
    """The default of a setting; pairs as tuples."""
    return _frozen(TABLE[path].default)


def in_section(section: str) -> dict[str, Setting]:
    """The settings of a section, by key."""
    return {row.key: row for row in TABLE.values() if row.section == section}


def options_of(command: str) -> Iterator[Setting]:
    """The settings that are options of a command, in the table's order."""
    return (row for row in TABLE.values() if row.option and not row.option.common and command in row.option.commands)
