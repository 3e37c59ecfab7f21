"""Kernels for a CUDA device: the loops of the CPU's kernels anew, around the same functions of a ray; `backends.cuda` calls them.

    launch      how a function of the CPU's kernels becomes one of the device, and how a kernel is started
    sums        sums that repeat bitwise whatever order they are taken in
    surface     the height field at points and where rays meet it
    image       refraction, landing and splat in one, and the splat alone
    rays        refraction, mirror and landing, ray by ray

What a ray does (`spline`, `intersect`, `refraction`, `filter_weights` and so on) stands once, with the CPU's kernels: on the device
a batch is one ray.  New here is who does which ray, and who adds where.  All in float64.
"""
