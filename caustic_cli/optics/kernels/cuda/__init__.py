"""CUDA kernels: loops of their own around the per-ray functions of the CPU kernels; called by `backends.cuda`.

    launch      how a function of the CPU's kernels becomes one of the device, and how a kernel is started
    sums        sums that repeat bitwise whatever order they are taken in
    surface     evaluation of a height field and ray intersections with it
    image       refraction, landing and splat in one, and the splat alone
    rays        refraction, mirror and landing, ray by ray

The per-ray functions (`spline`, `intersect`, `refraction`, `filter_weights` and so on) are those of the CPU kernels, with batches
of one ray.  Defined here are the distribution of rays to threads and the accumulation of sums.  Everything is float64.
"""
