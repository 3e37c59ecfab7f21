"""CPU kernel for random sample points of the aperture; its reference is `sampling.random_numbers`."""

from __future__ import annotations

import numpy as np

from caustic_cli.optics.kernels.jit import njit, prange

_M = np.uint64(0xFFFFFFFF)


@njit(inline="always")
def _mix(x):
    x ^= x >> np.uint64(16)
    x = (x * np.uint64(0x7FEB352D)) & _M
    x ^= x >> np.uint64(15)
    x = (x * np.uint64(0x846CA68B)) & _M
    return x ^ (x >> np.uint64(16))


@njit(inline="always")
def _number(key, salt, index):
    """A uniform number strictly inside (0, 1): see sampling.random_numbers."""
    return (float(_mix((_mix((index & _M) ^ key) + salt + (index >> np.uint64(32))) & _M)) + 0.5) * 2.0**-32


@njit(parallel=True)
def scatter(keys, salts, start, stop, nu, nv, stratified):
    """Points u, v (stop - start,) of rays start..stop; stratified in nu x nv cells over and over, or independent."""
    u, v = np.empty(stop - start), np.empty(stop - start)
    for k in prange(stop - start):
        index = np.uint64(start + k)
        a, b = _number(keys[0], salts[0], index), _number(keys[1], salts[1], index)
        if stratified:
            cell = (start + k) % (nu * nv)
            a, b = (cell // nv + a) / nu, (cell % nv + b) / nv
        u[k], v[k] = a, b
    return u, v
