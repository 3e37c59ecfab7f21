"""Numerical tolerances of ray tracing, with their reasons; shared by the plain-torch reference and the CPU kernels."""

#: Radicand of Snell's law below which a ray counts as totally reflected.  The refracted ray would leave within 1e-8 rad of the
#: tangent plane, where its derivative (about 1 / s) carries no digits.
CRITICAL = 1e-16
#: A direction cosine to the normal below this counts as parallel to the plane: the ray does not reach it.
PARALLEL = 1e-9
#: Cosine (times |N|) below which incidence is grazing: inside glass such a ray is totally reflected and transmits no power.
LEAST_COSINE = 1e-12
#: Error of a root in roundings of the heights and of t, and largest number of Newton iterations.
FEW_ULP, MOST_STEPS = 4.0 * 2.220446049250313e-16, 100
#: Distance below which two roots are not separated, as a fraction of the path through the surface's box: the surface then rises
#: above the ray by no more than some 1e-12 of that path, and the ray may be taken to pass.  And largest number of probes for the
#: first root.
FINEST, MOST_PROBES = 1e-6, 20_000
#: |d x N|^2 below which incidence counts as normal: R_s and R_p then differ by less than a rounding.
NORMAL = 1e-30
