"""The lens for other programs: sampled surfaces, solids and archives.  Writes files, traces no light."""

#: Format -> suffix of its default file, where its `write_<format>` is, what the file is.
FORMATS = {
    "lighttools": (".npz", "lighttools", "point cloud with normals and the exact spline"),
    "zemax": (".dat", "zemax", "Grid Sag with exact derivatives"),
    "step": (".step", "step", "the exact spline as a solid"),
    "stl": (".stl", "stl", "closed mesh"),
    "ply": (".ply", "ply", "closed mesh"),
    "obj": (".obj", "obj", "closed mesh"),
    "csv": (".csv", "points", "points of the exit surface"),
    "xyz": (".xyz", "points", "points of the exit surface"),
    "heightmap": (".png", "heightmap", "16-bit PNG, or .tif of 32-bit floats, with a JSON of its scale"),
    "gcode": (".nc", "milling.gcode", "program for a three-axis mill"),
    "mitsuba": (".xml", "mitsuba", "the whole scene for Mitsuba 3, ready to run, with two meshes beside it"),
}
MESHES = ("stl", "ply", "obj", "mitsuba")
#: Formats whose tolerance says how finely they are sampled, and those that have no samples.
WITHIN, UNSAMPLED = (*MESHES, "heightmap", "gcode"), ("step", "gcode")
#: The format that a file's suffix stands for.
BY_SUFFIX = {suffix: name for name, (suffix, _, _) in FORMATS.items()} | {".tif": "heightmap", ".tiff": "heightmap"}
