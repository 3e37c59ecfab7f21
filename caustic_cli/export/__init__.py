"""Export of lenses for other programs: sampled surfaces, solids, archives and scenes."""

from __future__ import annotations

from pathlib import Path

from caustic_cli.errors import InputError

#: Format -> default suffix, module of `write_<format>`, description.
FORMATS = {
    "lighttools": (".npz", "lighttools", "point cloud with normals and the spline"),
    "zemax": (".dat", "zemax", "Grid Sag with exact derivatives"),
    "step": (".step", "step", "the spline as a solid"),
    "stl": (".stl", "stl", "closed mesh"),
    "ply": (".ply", "ply", "closed mesh"),
    "obj": (".obj", "obj", "closed mesh"),
    "3mf": (".3mf", "threemf", "closed mesh"),
    "csv": (".csv", "points", "points of the exit surface"),
    "xyz": (".xyz", "points", "points of the exit surface"),
    "heightmap": (".tif", "heightmap", "32-bit TIFF, or .png of 16 bits, with a JSON of its scale"),
    "phase": (".phase.png", "phase", "wrapped phase, 16 bits, with .npy, JSON and the relief of a kinoform beside it"),
    "gcode": (".nc", "milling.gcode", "program for a three-axis mill"),
    "mitsuba": (".xml", "mitsuba", "the whole scene for Mitsuba 3, ready to run, with two meshes beside it"),
}
MESHES = ("stl", "ply", "obj", "3mf", "mitsuba")
#: Formats of solids, in which a mirror gets a back; formats in the orientation of machining; and formats that support moulds.
SOLIDS, AS_CUT = ("step", "stl", "ply", "obj", "3mf"), ("heightmap", "gcode")
MOULDS = (*SOLIDS, *AS_CUT)
#: Formats of closed rings of panels.
RINGS = ("stl", "ply", "obj", "3mf", "gcode")
#: Formats that hold one surface: of a lens with two free-form sides, both are written side by side.
SIDE_BY_SIDE = (*AS_CUT, "csv", "xyz", "zemax")
#: Formats with a tolerance, and formats without samples.
WITHIN, UNSAMPLED = (*MESHES, "lighttools", "step", "heightmap", "gcode"), ("step", "gcode")
#: How a part stands on a printer's plate: face up, or on edge with x or y upright.
ORIENTATIONS = ("up", "edge-x", "edge-y")
#: Default limit of the file size, bytes.
MOST_BYTES = 100_000_000
#: Formats among which one that keeps the picture is looked for where another does not.
KEEPERS = ("lighttools", "step", "heightmap")
#: Further suffixes of formats.
ALSO = {
    "phase": (".png",),
    "step": (".stp",),
    "heightmap": (".tiff", ".png"),
    "gcode": (".ngc", ".tap", ".gcode", ".cnc"),
    "csv": (".txt",),
    "xyz": (".txt",),
}
#: Format by suffix.
BY_SUFFIX = {suffix: name for name, (suffix, _, _) in FORMATS.items()} | {
    suffix: name for name, suffixes in ALSO.items() for suffix in suffixes if suffix != ".txt"
}


def format_of(path: Path | None, named: str | None = None) -> str:
    """The format of a file, by its suffix unless it is named; path: None for a default name.

    Raises:
        InputError: the format is unknown, or contradicts the suffix, or the path has no name.
    """
    if named is not None and named not in FORMATS:
        raise InputError(f"⟨format⟩ must be one of {', '.join(FORMATS)}, got {named!r}")
    if path is not None and not path.name:
        raise InputError(f"{path}: is a directory; a file name is needed")
    suffix = "" if path is None else path.suffix.lower()
    if named is None:
        if suffix not in BY_SUFFIX:
            known = ", ".join(BY_SUFFIX)
            raise InputError(
                f"{path}: its suffix is not that of a format; one of {known} is needed, or ⟨format⟩ beside a name without a suffix"
            )
        return BY_SUFFIX[suffix]
    own = (FORMATS[named][0], *ALSO.get(named, ()))
    if suffix and suffix not in own:
        raise InputError(f"{path}: ⟨format⟩ {named} is written to {' or '.join(own)}, not to {suffix}")
    return named
