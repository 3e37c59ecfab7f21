"""The lens for other programs: sampled surfaces, solids and archives.  Writes files, traces no light."""

from __future__ import annotations

from pathlib import Path

from caustic_cli.errors import InputError

#: Format -> suffix of its default file, where its `write_<format>` is, what the file is.
FORMATS = {
    "lighttools": (".npz", "lighttools", "point cloud with normals and the exact spline"),
    "zemax": (".dat", "zemax", "Grid Sag with exact derivatives"),
    "step": (".step", "step", "the spline as a solid"),
    "stl": (".stl", "stl", "closed mesh"),
    "ply": (".ply", "ply", "closed mesh"),
    "obj": (".obj", "obj", "closed mesh"),
    "csv": (".csv", "points", "points of the exit surface"),
    "xyz": (".xyz", "points", "points of the exit surface"),
    "heightmap": (".tif", "heightmap", "32-bit TIFF, or .png of 16 bits, with a JSON of its scale"),
    "gcode": (".nc", "milling.gcode", "program for a three-axis mill"),
    "mitsuba": (".xml", "mitsuba", "the whole scene for Mitsuba 3, ready to run, with two meshes beside it"),
}
#: Formats that say the lens' index.
ONE_INDEX = ("lighttools", "zemax", "mitsuba")
MESHES = ("stl", "ply", "obj", "mitsuba")
#: Formats of solids, whose back a mirror needs; those that lie as the part is cut; and those that can be its mould.
SOLIDS, AS_CUT = ("step", "stl", "ply", "obj"), ("heightmap", "gcode")
MOULDS = (*SOLIDS, *AS_CUT)
#: Formats that hold both sides where both are free-form.
TWO_SIDED = ("lighttools", *SOLIDS, "mitsuba")
#: Formats whose tolerance says how finely they are sampled, and those that have no samples.
WITHIN, UNSAMPLED = (*MESHES, "step", "heightmap", "gcode"), ("step", "gcode")
#: Further suffixes that a format goes by.
ALSO = {
    "step": (".stp",),
    "heightmap": (".tiff", ".png"),
    "gcode": (".ngc", ".tap", ".gcode", ".cnc"),
    "csv": (".txt",),
    "xyz": (".txt",),
}
#: The format that a file's suffix stands for.
BY_SUFFIX = {suffix: name for name, (suffix, _, _) in FORMATS.items()} | {
    suffix: name for name, suffixes in ALSO.items() for suffix in suffixes if suffix != ".txt"
}


def format_of(path: Path, named: str | None = None) -> str:
    """The format of a file by its suffix, or the one that is named.

    Raises:
        InputError: it is unknown, or the two contradict each other.
    """
    if named is not None and named not in FORMATS:
        raise InputError(f"⟨format⟩ must be one of {', '.join(FORMATS)}, got {named!r}")
    suffix = path.suffix.lower()
    if named is None:
        if suffix not in BY_SUFFIX:
            known = ", ".join(BY_SUFFIX)
            raise InputError(
                f"{path}: its suffix names no format; one of {known} is needed, or ⟨format⟩ beside a name without a suffix"
            )
        return BY_SUFFIX[suffix]
    own = (FORMATS[named][0], *ALSO.get(named, ()))
    if suffix and suffix not in own:
        raise InputError(f"{path}: ⟨format⟩ {named} is written to {' or '.join(own)}, not to {suffix}")
    return named
