"""The keys of a LightTools archive, as the manual lists them; `lighttools` writes them and `io.archive` reads them.

Capital letters in a name stand for a number, K from 1, or for a word; letters in a shape are sizes, the same one wherever they
stand in one archive, save k, a and b, which belong to their key.
"""

from __future__ import annotations

from typing import NamedTuple


class Key(NamedTuple):
    """A key: its shape, "" for a single value; its unit, or what it holds if that is no quantity; its meaning; and whether every
    archive has it."""

    name: str
    shape: str
    unit: str
    meaning: str
    always: bool = False


#: By the part of the scene.  `whole` and `text` mark int64 and strings; all others are float64.
KEYS: dict[str, tuple[Key, ...]] = {
    "Exit surface": (
        Key("points", "(N, 3)", "mm", "points of the surface, N = nx ny, x varying slowest", True),
        Key("normals", "(N, 3)", "1", "unit normals at the points, towards +z", True),
        Key("shape", "(2,)", "whole", "numbers of points along x and y: nx, ny", True),
        Key("x", "(nx,)", "mm", "positions of the points along x", True),
        Key("y", "(ny,)", "mm", "positions of the points along y", True),
        Key("z", "(nx, ny)", "mm", "heights of the points", True),
        Key("control_points", "(n, m, 3)", "mm", "of the exact B-spline, with x and y at the Greville abscissae", True),
        Key("degrees", "(2,)", "whole", "of the B-spline along x and y", True),
        Key("knots_u", "(p,)", "1", "knots along x on [0, 1], p = n + degree + 1", True),
        Key("knots_v", "(q,)", "1", "knots along y on [0, 1], q = m + degree + 1", True),
    ),
    "Lens": (
        Key("lens_half_size", "(2,)", "mm", "half width and half height of the aperture", True),
        Key("z_in", "", "mm", "position of the flat entrance, or of the plane from which a free-form one departs", True),
        Key("refractive_index", "", "1", "of the glass", True),
        Key("glass", "", "text", "name of a dispersive material, whose index it has at every wavelength; only if it is one"),
        Key("absorption", "", "1/mm", "absorption coefficient of the glass; only if not 0"),
        Key("roughness", "", "1", "standard deviation of the slopes of microfacets; only if not 0"),
        Key("fresnel", "", "text", "none or schlick; only if reflection losses are not exact"),
        Key("aperture", "", "text", "circle; only if it is not a rectangle"),
        Key("mirror", "", "whole", "1; only if the surface reflects"),
        Key("gradient", "", "text", "selfoc, radial, axial or volume, whose terms and values are as of ⟨lens.gradient⟩; only if the"
            " index varies"),
        Key("gradient_terms", "(k,)", "mm^-i", "coefficients of its formula"),
        Key("gradient_volume", "(a, b, k)", "1", "control values of the index over aperture and thickness"),
        Key("lenslets", "(2,)", "whole", "numbers of round lenslets along x and y; only of such, between which it is opaque"),
        Key("lenslet_packing", "", "text", "square or hexagonal"),
        Key("lenslet_centres", "(k, 2)", "mm", "their centres"),
        Key("lenslet_radius", "", "mm", "radius of each"),
        Key("entrance_control_points", "(c, d, 3)", "mm", "of a free-form entrance, as of the exit; only with one, as the next 3"),
        Key("entrance_degrees", "(2,)", "whole", "of its B-spline along x and y"),
        Key("entrance_knots_u", "(e,)", "1", "its knots along x on [0, 1]"),
        Key("entrance_knots_v", "(f,)", "1", "its knots along y on [0, 1]"),
    ),
    "Screen": (
        Key("screen_half_size", "(2,)", "mm", "half width and half height", True),
        Key("z_screen", "", "mm", "position of its centre", True),
        Key("resolution", "(2,)", "whole", "pixels along x and y", True),
        Key("screen_far", "", "whole", "1; only of the far field, where light of the direction cosines q lands at |z_screen| q"),
        Key("screen_tilt", "(2,)", "degrees", "rotations about x, then about y; only if not 0"),
        Key("screen_turn", "", "degrees", "rotation about its normal, before its tilt; only if not 0"),
        Key("screen_shift", "(2,)", "mm", "decentre along x and y; only if not 0"),
        Key("screen_curvature", "(2,)", "1/mm", "along x and y, 0 along a cylinder; only of a sphere or a cylinder"),
        Key("screen_sag", "(a, b)", "mm", "heights along its normal on a regular grid, borders included; only of a measured shape"),
        Key("screen_sag_half_size", "(2,)", "mm", "half width and half height of that grid"),
    ),
    "Source": (
        Key("source_type", "", "text", "plane, point, grid, disc, rays, gaussian, measured, or several", True),
        Key("source_positions", "(k, 3)", "mm", "points, centre of a disc, or point where the rays of a file are closest to each"
            " other; none, k = 0, at infinity; not of several sources, as the next two"),
        Key("source_power", "(k,)", "W or lm", "of each point; k = 1 for all others, of which those at infinity have it through"
            " the aperture"),
        Key("cone_half_angle", "", "degrees", "half angle of the emission, 0 for a plane wave"),
        Key("source_tilt", "(2,)", "degrees", "rotations of +z about x, then y, to the axis of light from infinity or of"
            " a ray file; only if not 0"),
        Key("source_profile", "(a, b)", "1", "relative irradiance over the aperture; only of a plane wave that is not uniform"),
        Key("source_size", "(2,)", "mm", "full widths of a disc at a finite distance"),
        Key("source_angle", "", "degrees", "angular diameter of a disc at infinity"),
        Key("source_brightness", "(a, b)", "1", "relative radiance over the rectangle around a disc; only if a picture gives it"),
        Key("source_intensity", "", "text", "uniform, lambertian or table; of points and discs at a finite distance"),
        Key("source_intensity_table", "(k, 2)", "degrees and 1", "angles and relative intensities; only with table"),
        Key("source_wavelength", "", "nm", "of a laser beam, by which it diverges"),
        Key("source_waist", "(2,)", "mm", "radii of a Gaussian beam along x and y, where the irradiance is 1/e² of its peak"),
        Key("source_waist_at", "", "mm", "position of its waist behind the entrance"),
        Key("source_m2", "", "1", "its beam quality factor M²"),
        Key("source_phase", "(a, b)", "rad", "phase of a measured beam over the aperture, not wrapped"),
        Key("source_rays_sha256", "", "text", "SHA-256 of the rays of a file, which the archive does not contain"),
        Key("source_count", "(1,)", "whole", "number of sources; only of several"),
        Key("source_K_NAME", "", "as NAME", "of several sources the key source_NAME, or cone_half_angle, of the K-th, and its"
            " source_wavelengths, source_weights, source_spectrum and source_detector"),
    ),
    "Light": (
        Key("source_power_unit", "", "text", "unit of source_power, lm; only if it is not W"),
        Key("source_wavelengths", "(l,)", "nm", "wavelengths to be traced; only if the scene says some, as the next"),
        Key("source_weights", "(l,)", "1", "power at each wavelength, as fractions of the sum"),
        Key("source_spectrum", "(k, 2)", "nm and 1/nm", "wavelengths and relative power of a continuous spectrum; only with one"),
        Key("source_detector", "", "text", "eye or power, by which that spectrum is measured"),
        Key("source_efficacy", "", "lm/W", "luminous efficacy of radiation; only if known"),
        Key("source_color", "", "whole", "1; only if the wavelengths are those of a coloured picture"),
        Key("source_polarisation", "", "degrees", "direction of linear polarisation from +x; only of polarised light"),
    ),
    "Other lenses and mirrors": (
        Key("element_type", "", "text", "lens or mirror, g words separated by commas, in the order of the light; only with such"
            " elements, as all keys of this part"),
        Key("element_aperture", "", "text", "rectangle or circle, g words separated by commas"),
        Key("element_glass", "", "text", "names of materials, g words separated by commas, empty for an index; only with one"),
        Key("element_z", "(g,)", "mm", "position of the first vertex along the axis, which mirrors fold"),
        Key("element_thickness", "(g,)", "mm", "between the vertices of a lens"),
        Key("element_index", "(g,)", "1", "refractive index of a lens"),
        Key("element_absorption", "(g,)", "1/mm", "absorption coefficient of a lens"),
        Key("element_curvature", "(g, 2)", "1/mm", "of front and back, 0 for a plane"),
        Key("element_size", "(g, 2)", "mm", "full width and full height of the aperture"),
        Key("element_tilt", "(g, 2)", "degrees", "rotations of a mirror about x and about y"),
        Key("element_K_SIDE_heights", "(a, b)", "mm", "control heights above the plane of the vertex, of a designed surface of the"
            " K-th element; SIDE is front or back"),
        Key("element_K_SIDE_degrees", "(2,)", "whole", "of its B-spline along x and y"),
        Key("element_K_SIDE_knots_u", "(k,)", "1", "its knots along x on [0, 1]"),
        Key("element_K_SIDE_knots_v", "(k,)", "1", "its knots along y on [0, 1]"),
    ),
    "File": (
        Key("unit", "", "text", "unit of lengths, mm", True),
        Key("format_version", "", "whole", "version of the format, 1", True),
        Key("created_by", "", "text", "program and version", True),
    ),
}  # fmt: skip
