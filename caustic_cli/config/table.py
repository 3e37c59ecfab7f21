"""The table of settings: the single definition of every parameter of a project.

A row defines the name of a setting, its type, unit, range and default with its reason, its meaning, and its command-line option.
project.toml (`config.settings`), the defaults of the scene's dataclasses, the commands' options, the manual pages and the reference
are generated from it.  It is plain data that imports errors and checks only, so that every other package may import it.

A path consists of a section and a key: `lens.size` is `[lens] size` in project.toml.  A path without a section is a parameter from
which settings are derived and which is not stored in a project: `mag` determines `target.size`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from caustic_cli.config import checks
from caustic_cli.errors import InputError

#: Bounds of lengths on the lens, of distances and of sizes on the screen, mm.
LENS, DISTANCE, SCREEN = (1e-6, 1e6), (-1e12, 1e12), (1e-6, 1e9)
WAVELENGTHS = (100.0, 20_000.0)


@dataclass(frozen=True)
class Option:
    """The command-line option of a setting: its name, the placeholder of its value, and the commands that have it.

    constant: the value that a flag stands for; common: whether it is an option of every command, which is not generated from this
    table.
    """

    name: str
    metavar: str | None = None
    commands: tuple[str, ...] = ("design",)
    constant: Any = None
    common: bool = False


@dataclass(frozen=True)
class Setting:
    """A row of the table.

    path: see the module; kind: number, whole, text, flag, numbers (a pair), wholes (a pair), list (of numbers), points ([x, y, z]
    or a list of such), tables (a list of tables as text); help: description, for comments, options and the reference; unit; low,
    high,
    above: range of each number, `above` if low itself is excluded; choices: of a text; default: None if there is none or if it is
    derived; derived: how it is derived; why: the reason for the default; written: whether a new project's file contains the
    default;
    option: of the command line; speaks_for: other paths that the same option sets.
    """

    path: str
    kind: str
    help: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    choices: tuple[str, ...] = ()
    default: Any = None
    derived: str = ""
    why: str = ""
    written: bool = True
    option: Option | None = None
    speaks_for: tuple[str, ...] = ()

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


BOTH = ("design", "render")
# fmt: off
_ROWS = (
    # The light source
    Setting("source.type", "text", "plane: collimated light along +z over the aperture; point; grid of points; disc, an extended"
            " source; rays, a ray file", default="plane", why="the thesis' first source, section 4.2.1",
            option=Option("--source", commands=BOTH)),
    Setting("source.power", "number", "total power of the source, through the aperture or into the cone; in lm, images are in lux",
            "W",
            0.0, checks.POWER, above=True, default=1.0, why="images are fractions of the source's power",
            option=Option("--power", "NUMBER[W|lm]", BOTH), speaks_for=("source.power_unit",)),
    Setting("source.power_unit", "text", "W, or lm for images in lux", choices=("W", "lm"), default="W", written=False),
    Setting("source.profile", "text", "plane: file in this directory with the relative irradiance over the aperture"),
    Setting("source.file", "text", "ray file (IES TM-25 .tm25ray, Zemax .dat or .sdf, LightTools .ray or .txt), of which the"
            " project keeps a copy; for a disc, a picture of its brightness with linear values",
            option=Option("--source-file", "FILE", BOTH)),
    Setting("source.position", "points", "point: one or several [x, y, z]; grid, disc: the centre; rays: the file's origin", "mm",
            *DISTANCE, derived="on the axis, five lens widths in front of the lens", option=Option("--source-position", "X,Y,Z",
            BOTH)),
    Setting("source.powers", "list", "point: relative power of each position", low=0.0, high=checks.POWER, derived="equal"),
    Setting("source.size", "numbers", "full width and height of a grid or disc", "mm", 0.0, 1e9, derived="a fifth of the lens",
            option=Option("--source-size", "W[xH]", BOTH)),
    Setting("source.grid", "wholes", "points of a grid along x and y", low=1, high=1000, derived="25 x 25",
            why="figure 6.4.1 of the thesis", option=Option("--source-grid", "N[xM]", BOTH)),
    Setting("source.cone", "number", "half-angle of the cone about +z", "degrees", 1e-9, 90.0,
            derived="the narrowest that covers the lens", option=Option("--cone", "DEG", BOTH)),
    Setting("source.angle", "number", "disc at infinity (the sun: 0.533): angular diameter", "degrees", 0.0, 170.0,
            derived="a disc at a finite distance", option=Option("--source-angle", "DEG", BOTH)),
    Setting("source.intensity", "text",
            "angular distribution of a point, grid or disc: uniform in solid angle, lambertian, or a .csv of"
            " degrees from +z and relative intensity", default="uniform", why="an isotropic source, the simplest",
            option=Option("--intensity", "uniform|lambertian|FILE", BOTH)),
    Setting("source.aim", "flag", "sample rays over the lens instead of the whole cone", default=True,
            why="no rays that miss the lens"),
    Setting("source.polarisation", "number", "direction of linear polarisation from +x", "degrees", -360.0, 360.0,
            derived="unpolarised", option=Option("--polarisation", "DEG", BOTH)),
    Setting("source.wavelengths", "list", "wavelengths of the source's spectrum; a glass has its own index at each", "nm",
            *WAVELENGTHS, derived="one wavelength", option=Option("--wavelengths", "NM[:W],...", BOTH),
            speaks_for=("source.weights",)),
    Setting("source.weights", "list", "relative power at each wavelength", low=0.0, high=checks.POWER, derived="equal"),
    # The lens
    Setting("lens.size", "numbers", "full width and height of the lens' aperture", "mm", *LENS, default=[10.0, 10.0],
            why="table D.2 of the thesis, in millimetres", option=Option("--lens-size", "W[xH]")),
    Setting("lens.z_in", "number", "position of the plane entrance, or reference plane of a free-form one", "mm",
            -checks.LENGTH, checks.LENGTH, default=0.0,
            why="the origin of the lens"),
    Setting("lens.thickness", "number", "centre height of the base surface above the lens' origin", "mm", -checks.LENGTH,
            checks.LENGTH, derived="half the width of a lens up to 20 mm; for a wider one, a least wall of 3 mm; with two"
            " free-form sides twice the width", why="table D.2 of the thesis; a plate is thin; two sides need a distance",
            option=Option("--thickness", "MM")),
    Setting("lens.radius", "numbers", "radii of the base surface along x and y; inf is flat, positive is diverging", "mm",
            derived="the sphere that spreads the light over the picture", why="table 6.1 of the thesis"),
    Setting("lens.height_range", "numbers", "least and largest height above the base surface", "mm", -checks.LENGTH, checks.LENGTH,
            derived="a tenth of the lens' width, or what the first surface needs"),
    Setting("lens.min_thickness", "number", "least wall thickness, from z_in to the exit", "mm", 0.0, checks.LENGTH, default=1.0,
            why="a wall that can be machined and mounted", option=Option("--min-thickness", "MM")),
    Setting("lens.index", "number", "refractive index", low=1.0, high=5.0, above=True, default=1.5443, written=False,
            why="table D.2 of the thesis", option=Option("--index")),
    Setting("lens.glass", "text", "material instead of an index, by its common name: acrylic, polycarbonate, BK7, resin,"
            " water, ... (list: all of them); N-BK7 for a coloured picture", option=Option("--glass", "NAME")),
    Setting("lens.wavelength", "number", "wavelength of the glass' index", "nm", *WAVELENGTHS, default=587.5618, written=False,
            why="the d line, for which catalogues give indices"),
    Setting("lens.fresnel", "text", "reflection losses: none, schlick or exact", choices=("none", "schlick", "exact"),
            default="exact", why="every uncoated surface reflects"),
    Setting("lens.absorption", "number", "absorption coefficient a: transmittance exp(-a t) of t mm of glass (Beer-Lambert)",
            "1/mm", 0.0, 1e6, default=0.0,
            written=False, option=Option("--absorption", "PER_MM", BOTH)),
    Setting("lens.roughness", "number", "standard deviation of the exit's microfacet slopes along an axis, mm per mm",
            low=0.0, high=1.0, default=0.0, written=False, option=Option("--roughness", "SLOPE", BOTH)),
    Setting("lens.mirror", "flag", "the surface is a mirror, with the screen on the source's side, beside its light",
            default=False, written=False, option=Option("--mirror")),
    Setting("lens.aperture", "text", "shape of the lens: rectangle, or circle, the largest within size",
            choices=("rectangle", "circle"), default="rectangle", written=False,
            option=Option("--aperture", "rectangle|circle")),
    Setting("lens.border", "number", "width of a mounting rim around the aperture in exported solids", "mm", 0.0,
            1e6, default=0.0, written=False, option=Option("--border", "MM")),
    Setting("lens.array", "wholes", "lenslets along x and y, each of which projects the whole picture", low=1, high=100,
            default=[1, 1], written=False, option=Option("--array", "N[xM]")),
    Setting("lens.gradient", "text", "gradient index of the lens: selfoc, radial or axial, with gradient_terms; volume, with an"
            " index_file; free, designed instead of the surface, between flat sides",
            choices=("selfoc", "radial", "axial", "volume", "free"), derived="homogeneous",
            option=Option("--gradient", "selfoc|radial|axial|volume|free")),
    Setting("lens.gradient_terms", "list", "selfoc: g of n^2 = index^2 (1 - (g r)^2), 1/mm; radial: a, b, ... of index + a r^2"
            " + b r^4 + ...; axial: of index + a z + b z^2 + ..., z from the entrance; r and z in mm",
            option=Option("--gradient-terms", "A[,B...]")),
    Setting("lens.index_file", "text", "control values (n, m) or (n, m, k) of a B-spline volume of refractive index over aperture"
            " and thickness, .npy, of which the project keeps a copy; for a free gradient, the result",
            option=Option("--index-file", "FILE")),
    Setting("lens.index_range", "numbers", "least and largest control value of a free gradient", low=1.0, high=5.0,
            derived="the index, 0.05 less to 0.05 more", why="the range of gradients in glass and printed polymers",
            option=Option("--index-range", "LEAST,MOST")),
    Setting("lens.index_control", "wholes", "control values of a free gradient along x and y", low=4, high=1024,
            derived="two knot spans per pixel", why="as for a surface", option=Option("--index-control", "N[xM]")),
    Setting("lens.index_layers", "whole", "control values of a free gradient along z", low=1, high=64, default=1, written=False,
            why="in a thin blank only the integral of the index along a ray matters"),
    Setting("lens.control", "wholes", "control points of the finished lens", low=2, high=4096,
            derived="by picture and quality: two knot spans per pixel", why="finer than the picture, so that it is no limit",
            option=Option("--control", "N[xM]")),
    Setting("lens.degree", "wholes", "spline degrees, 1 to 15", low=1, high=15, default=[3, 3],
            why="the least with continuous curvature", option=Option("--degree", "P[xQ]")),
    Setting("lens.knots_u", "list", "knot vector on [0, 1] along x", derived="open, equispaced"),
    Setting("lens.knots_v", "list", "knot vector on [0, 1] along y", derived="open, equispaced"),
    # The screen
    Setting("throw", "number", "distance from the lens' origin to the screen, in front of a mirror", "mm", -1e12, 1e12,
            derived="300", option=Option("--throw", "MM"), speaks_for=("screen.z",)),
    Setting("screen.z", "number", "distance from the lens' origin", "mm", *DISTANCE, default=300.0,
            why="table D.2 of the thesis, in millimetres"),
    Setting("screen_size", "numbers", "full width and height of the screen; a single length keeps the picture's aspect ratio", "mm",
            derived="picture plus margin", option=Option("--screen-size", "W[xH]"), speaks_for=("screen.size",)),
    Setting("screen.size", "numbers", "full width and height", "mm", *SCREEN, derived="picture plus margin"),
    Setting("resolution", "wholes", "pixels of the whole screen; a single number is across, the rows follow from the aspect ratio",
            derived="250",
            why="table D.2 of the thesis", option=Option("--resolution", "N[xM]"), speaks_for=("screen.resolution",)),
    Setting("screen.resolution", "wholes", "pixels along x and y", low=2, high=16384, derived="250 across"),
    Setting("screen.tilt", "numbers", "rotation of the screen about its own centre: about the fixed x axis, then about the"
            " fixed y axis", "degrees", -85.0, 85.0, default=[0.0, 0.0], written=False,
            option=Option("--screen-tilt", "A,B", BOTH)),
    Setting("screen.shift", "numbers", "decentre of the screen; by default that of a mirror is shifted out of the light of its"
            " source", "mm", -1e9, 1e9, default=[0.0, 0.0], written=False, option=Option("--screen-shift", "X,Y", BOTH)),
    Setting("screen.radius", "numbers", "radii of curvature of a curved screen along x and y: the same for a sphere, inf along"
            " one axis for a cylinder; positive bends the edges towards +z, away from a lens", "mm", derived="plane", written=False,
            option=Option("--screen-radius", "R[,RY]", BOTH)),
    Setting("screen.shape_file", "text", "file of a screen's shape, of which the project keeps a copy: heights in mm along +z on a"
            " uniform grid over the screen, borders included; a 2-D .npy [i, j] or a .tif of 32-bit floats",
            option=Option("--screen-shape", "FILE", BOTH)),
    # The target
    Setting("mag", "number", "width of the picture in lens widths", low=1e-3, high=1e3, default=3.0,
            why="table 6.1 of the thesis", option=Option("--mag")),
    Setting("margin", "number", "total width of the dark border relative to the picture", low=0.0, high=100.0, default=0.28,
            why="table 6.1 of the thesis: a screen 6.4 wide for a picture of 5, which shows stray light",
            option=Option("--margin")),
    Setting("target.file", "text", "the picture, in this directory"),
    Setting("target.size", "numbers", "width and height of the picture on the screen", "mm", *SCREEN,
            derived="mag times the lens' width"),
    Setting("target.encoding", "text", "encoding of the picture's values: srgb, or linear (irradiance)", choices=("srgb", "linear"),
            default="srgb", why="the encoding of image files", option=Option("--linear", constant="linear")),
    Setting("target.flip", "text", "mirror the picture along x, y or xy, for a viewer on the lens' side; empty for none",
            choices=("", "x", "y", "xy"), default="", option=Option("--flip", "x|y|xy")),
    Setting("target.sheet", "flag", "the picture is a contact sheet with a separate picture for each lenslet of an"
            " array", default=False, written=False, option=Option("--sheet")),
    Setting("invert", "flag", "invert the picture, for drawings in black on white or on a transparent background",
            default=False, option=Option("--invert")),
    Setting("target.color", "flag", "three colour channels (611, 549, 464 nm), with the glass' index for each", default=False,
            written=False, option=Option("--color")),
    # The second target, behind the picture: the lens then has two free-form sides
    Setting("second.file", "text", "second picture, formed by the same light on a screen farther away; in this directory",
            option=Option("--second", "PICTURE")),
    Setting("second.z", "number", "distance of that screen from the lens' origin", "mm", *DISTANCE,
            option=Option("--second-at", "MM")),
    Setting("second.size", "numbers", "width and height of that picture", "mm", *SCREEN,
            derived="that of a beam from the lens' edge through that of the first picture", option=Option("--second-size",
            "W[xH]")),
    Setting("second.collimate", "flag", "collimate the light behind the picture, parallel to the axis", default=False,
            written=False,
            option=Option("--collimate")),
    Setting("second.focus", "points", "focus of the light behind the picture", "mm", *DISTANCE,
            option=Option("--focus", "X,Y,Z")),
    # Other lenses and fold mirrors, [[element]]
    Setting("elements", "tables", "further lens or fold mirror on the axis, with the keys of an [[element]] table:"
            " 'lens z=-40 thickness=4 radius=50,inf glass=N-BK7', 'mirror z=150 tilt=45,0'; may be repeated, in the order in which"
            " light reaches them", derived="none", option=Option("--element", "'TYPE KEY=VALUE...'"), speaks_for=("element",)),
    Setting("element.type", "text", "singlet lens, or mirror, which folds the axis", choices=("lens", "mirror"),
            derived="lens"),
    Setting("element.z", "number", "position of its first vertex; behind a mirror measured along the folded axis", "mm", *DISTANCE),
    Setting("element.thickness", "number", "centre thickness of a lens", "mm", 0.0, checks.LENGTH, above=True, default=4.0,
            written=False, why="a common small lens"),
    Setting("element.radius", "numbers", "radii of curvature of front and back, for a mirror the first only; positive if the"
            " centre lies behind the surface, inf for flat", "mm", derived="flat"),
    Setting("element.index", "number", "refractive index of a lens", low=1.0, high=5.0, above=True, default=1.5168, written=False,
            why="N-BK7 at the d line"),
    Setting("element.glass", "text", "material instead of an index, as lens.glass"),
    Setting("element.absorption", "number", "absorption coefficient a: transmittance exp(-a t) of t mm of its glass", "1/mm", 0.0,
            1e6, default=0.0,
            written=False),
    Setting("element.size", "numbers", "full width and height of its aperture", "mm", *LENS,
            derived="that of the lens in front of it; behind it a fifth more than a straight beam to the picture needs"),
    Setting("element.aperture", "text", "shape of its aperture: rectangle, or circle, the largest within size",
            choices=("rectangle", "circle"), default="rectangle", written=False),
    Setting("element.tilt", "numbers", "rotation of a mirror about x or about y", "degrees", -85.0, 85.0),
    Setting("element.free", "text", "free-form surfaces to be designed: none, front, back or both",
            choices=("none", "front", "back", "both"), default="none", written=False, why="stock lenses are spherical"),
    # The design
    Setting("quality", "text", "quality of the default stages: draft, standard or fine", choices=("draft", "standard", "fine"),
            derived="standard, or by the time limit", option=Option("--quality")),
    Setting("rays", "whole", "number of rays of the last default stage", low=1, high=10**12, derived="by quality",
            option=Option("--rays", "N")),
    Setting("design.loss", "text", "weighted sum of rms (eq. 5.2.1), rms-light (including light off the screen), throughput, light"
            " (light off the screen), diffusion, uniformity, laplacian, curvature: 'rms-light + 0.01 laplacian'",
            default="rms-light", why="eq. 5.2.1 alone is reduced by sending light off the screen", option=Option("--loss")),
    Setting("design.max_slope", "number", "largest slope of the surface, mm per mm; 0 for no limit", low=0.0, default=0.0,
            option=Option("--max-slope")),
    Setting("design.min_radius", "number", "least radius of curvature of concave regions, such as a tool's; 0 for no limit", "mm",
            0.0,
            default=0.0, option=Option("--min-radius", "MM")),
    Setting("design.optimizer", "text", "lbfgs or adam", choices=("lbfgs", "adam"), default="lbfgs",
            why="fewest evaluations for a given error: caustic convergence, study design; adam for a network",
            option=Option("--optimizer")),
    Setting("design.lr", "number", "learning rate of adam", low=0.0, above=True, default=1e-3, why="table D.2 of the thesis",
            option=Option("--lr")),
    Setting("design.network", "text", "parametrisation of the heights: none, sparse or dense", choices=("none", "sparse", "dense"),
            default="none", why="control heights converge fastest", option=Option("--network")),
    Setting("design.network_layers", "whole", "hidden layers of a dense network", low=1, high=16, default=2, written=False,
            why="three with the final tanh, as in the thesis", option=Option("--network-layers", "N")),
    Setting("design.network_width", "whole", "neurons per hidden layer of a dense network; 0 for the number of control points",
            low=0, high=1_000_000, default=0, written=False, why="as in the thesis", option=Option("--network-width", "N")),
    Setting("design.activation", "text", "activation function of a dense network: tanh, relu, silu or sine", choices=("tanh",
            "relu", "silu", "sine"),
            default="tanh", written=False, why="as in the thesis", option=Option("--activation", "tanh|relu|silu|sine")),
    Setting("design.over", "text", "ranges of network inputs, so that one trained network gives a lens for every value: throw,"
            " source.x, source.y, source.z = LOW:HIGH, separated by commas", "mm", default="", written=False,
            option=Option("--over", "KEY=LOW:HIGH[,...]")),
    Setting("design.initial", "text", "initial parameters: zero, uniform (+-1e-4), random, or zero-last (random except for the last"
            " layer of a network, which is zero, so that it starts at the initial surface)",
            choices=("zero", "uniform", "random", "zero-last"), default="zero",
            derived="zero; zero-last of a preconditioned network"),
    Setting("design.preconditioner", "text", "none or laplacian", choices=("none", "laplacian"),
            derived="laplacian for heights with lbfgs, and for a network trained over a range",
            option=Option("--preconditioner", "none|laplacian")),
    Setting("design.filter_target", "flag", "filter the target like the render", default=True,
            why="otherwise the blur of the filter counts as an error"),
    Setting("design.waves", "text", "refine the wave image after the ray image: auto (where diffraction matters and time allows),"
            " on or off", choices=("auto", "on", "off"), default="auto", why="effects are simulated where a scene needs them",
            option=Option("--waves", "auto|on|off")),
    Setting("design.robust", "text", "file of manufacturing and alignment errors, such as examples/tolerances.toml, over which the"
            " loss of the last stage is averaged; empty for none", default="", written=False, option=Option("--robust", "FILE")),
    Setting("design.start", "text", "initial surface: transport (optimal transport of the light to the picture), offset (the base"
            " sphere given by the magnification), or the lens of another project or of a file: .npz, .step or height map as"
            " exported, .npy of heights in mm", derived="transport; offset for a network, adam, several points or a coarse net",
            option=Option("--start", "transport|offset|PROJECT|FILE")),
    Setting("design.iterations", "whole", "total number of iterations, including those before a resume; 0: as given by the stages",
            low=0, high=10**9,
            default=0, derived="as given by the stages", option=Option("--iterations")),
    Setting("design.time_limit", "number",
            "time limit of the whole command, at least a quarter of it for the iterations; inf for none",
            "s", 0.0, above=True, default=math.inf,
            option=Option("--time-limit", "SECONDS")),
    Setting("design.checkpoint_every", "number", "time between checkpoints", "s", 0.0, above=True, default=10.0,
            why="work lost if the process is killed; checkpoints of large nets take seconds and are written less often"),
    Setting("design.seed", "whole", "seed of all random numbers: the same seed gives the same bytes", low=0, high=2**31 - 1,
            default=0,
            option=Option("--seed", common=True)),
    Setting("design.dtype", "text", "precision of the rays: float32 or float64", choices=("float32", "float64"), default="float32",
            why="the sampling noise exceeds its rounding errors", option=Option("--dtype", common=True)),
    # A stage of the design
    Setting("design.stages.source", "text", "source type in this stage, with the other keys of [source]"),
    Setting("design.stages.control", "wholes", "control points", low=2, high=4096, derived="the lens'"),
    Setting("design.stages.rays", "whole", "rays per iteration", low=1, high=10**12, derived="9 per pixel",
            why="750 x 750 on 250 x 250 pixels, tables D.1 and D.2 of the thesis"),
    Setting("design.stages.sampler", "text", "grid, lines, stratified, uniform or sobol", derived="by the source"),
    Setting("design.stages.reconstruction", "text", "bincount, gaussian or cosine", derived="cosine"),
    Setting("design.stages.filter_size", "wholes", "filter size in pixels, odd", derived="3 x 3"),
    Setting("design.stages.alpha_per_mm2", "number", "alpha of the gaussian (eq. 4.4.5)", "1/mm^2"),
    Setting("design.stages.alpha_per_pixel2", "number", "alpha of the gaussian, instead of alpha_per_mm2", "1/pixel^2"),
    Setting("design.stages.spread", "flag",
            "trace rays of the source's centre, and convolve the image with the source's point-spread function",
            default=False, written=False),
    Setting("design.stages.lenslets", "flag",
            "array: compare the image of every lenslet with its own picture, with its share of the rays",
            default=False, written=False),
    Setting("design.stages.oversample", "whole",
            "subdivide pixels for the filter by this factor, and sum them: sharper than the filter on pixels",
            low=1, high=8, default=1),
    Setting("design.stages.blur", "number", "blur of render and target in the loss", "pixels", 0.0, 1000.0, default=0.0),
    Setting("design.stages.apron", "whole", "guard band: dark pixels around the screen that detect stray light", low=0, high=4096,
            default=0),
    Setting("design.stages.iterations", "whole", "largest number of iterations", low=0, high=10**9, default=1000,
            why="section 6.2.1 of the thesis"),
    Setting("design.stages.tolerance", "number",
            "end the stage when 10 iterations reduce the loss by less than this fraction; 0: never", low=0.0,
            high=1.0, default=0.0),
    Setting("design.stages.waves", "list",
            "refine the wave image at these wavelengths, if the source has none, instead of the ray image",
            "nm", *WAVELENGTHS),
)
# fmt: on
TABLE: dict[str, Setting] = {row.path: row for row in _ROWS}


def check(path: str, value: Any) -> Any:
    """The validated value of a setting, see `Setting.check`."""
    return TABLE[path].check(value)


def check_all(section: str, of: object, *keys: str) -> None:
    """Validate attributes of an object that are settings of one section, by name."""
    for key in keys:
        check(f"{section}.{key}", getattr(of, key))


def default(path: str) -> Any:
    """The default of a setting; pairs as tuples."""
    value = TABLE[path].default
    return tuple(value) if isinstance(value, list) else value


def in_section(section: str) -> dict[str, Setting]:
    """The settings of a section, by key."""
    return {row.key: row for row in _ROWS if row.section == section}


def options_of(command: str) -> Iterator[Setting]:
    """The settings that are options of a command, in the table's order."""
    return (row for row in _ROWS if row.option and not row.option.common and command in row.option.commands)
