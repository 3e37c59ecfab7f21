"""Limits of the ray arithmetic, with their reasons; the plain-torch reference and the CPU kernels share them."""

#: Radicand of Snell's law below which a ray counts as totally reflected.  The refracted ray would leave within 1e-8 rad of the
#: tangent plane, where its derivative (about 1 / s) carries no digits.
CRITICAL = 1e-16
#: A direction cosine to the screen's normal below this counts as parallel to it: the ray never arrives.
PARALLEL = 1e-9
#: Cosine (times |N|) below which a hit is grazing: inside glass such a ray is totally reflected and carries no power on.
LEAST_COSINE = 1e-12
#: Roundings of the heights and of t that a root may be off by, and most steps of Newton's iteration.
FEW_ULP, MOST_STEPS = 4.0 * 2.220446049250313e-16, 100
#: Part of the way through the surface's box below which two roots are not told apart: the surface then rises above the ray by
#: no more than some 1e-12 of that way, and the ray may as well pass.  And most probes for the first root.
FINEST, MOST_PROBES = 1e-6, 20_000
#: |d x N|^2 below which a ray counts as normal to the surface: R_s and R_p then differ by less than any rounding.
NORMAL = 1e-30
