"""Multithreading of kernels: functions that are called with 0, 1, ... for their first argument, in no particular order.

Numba turns every parallel loop into a function in four nested modules, and LLVM optimises everything that the loop calls in each of
them.  Here is the only such loop; it calls functions by their addresses, so that each is optimised once.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from caustic_cli.optics.kernels import blocks
from caustic_cli.optics.kernels.jit import njit, prange

# Threads have to run before the first kernel.  numba starts them for a function that has a parallel loop, but not for one that was
# compiled, and kept, around a loop that itself came from the cache.
blocks()

#: First argument of a kernel that processes all blocks.
ALL = -1
#: What is called by its address: (arguments, number) -> whether it failed.
BITS = types.intp.bitwidth  # type: ignore[attr-defined]  # of numba's own integers, which are not numpy's
CALLED = ir.FunctionType(ir.IntType(8), [cgutils.voidptr_t, ir.IntType(BITS)])


@intrinsic
def _call(_, address, arguments, number):
    def generate(context, builder, signature, values):
        called, packed, k = values
        return builder.call(builder.inttoptr(called, CALLED.as_pointer()), [builder.inttoptr(packed, cgutils.voidptr_t), k])

    return types.uint8(types.uintp, types.uintp, types.intp), generate


@njit(parallel=True)
def _loop(address, arguments, count):
    failed = np.zeros(count, np.uint8)
    for k in prange(count):
        failed[k] = _call(address, arguments, k)
    for k in range(count):
        if failed[k]:
            raise MemoryError


def _start(address, arguments, count):
    _loop(address, arguments, count)


def _lent(context, builder, kind, value):
    """A value whose arrays have no owner, so that nothing counts the references to them: each view of a row would be two more."""
    if isinstance(kind, types.Array):
        array = context.make_array(kind)(context, builder, value)
        array.meminfo, array.parent = (cgutils.get_null_value(p.type) for p in (array.meminfo, array.parent))
        return array._getvalue()
    if isinstance(kind, types.BaseTuple):
        parts = zip(kind, cgutils.unpack_tuple(builder, value), strict=True)
        return context.make_tuple(builder, kind, [_lent(context, builder, k, v) for k, v in parts])
    return value


@intrinsic
def on_threads(_, block, count, arguments):
    """If `block` is ALL, call the function that calls this, which returns nothing, as (k, *arguments) for every k < count; whether
    it is.

    Raises:
        MemoryError: one of the calls failed; kernels raise nothing else.
    """

    def generate(context, builder, signature, values):
        number, many, packed_ = values
        every = builder.icmp_signed("==", number, ir.Constant(number.type, ALL))
        with builder.if_then(every):
            place = cgutils.alloca_once_value(builder, packed_)
            called = ir.Function(builder.module, CALLED, builder.module.get_unique_name("on_threads"))
            called.linkage = "internal"
            inside, (packed, k) = ir.IRBuilder(called.append_basic_block()), called.args
            lent = _lent(context, inside, arguments, inside.load(inside.bitcast(packed, place.type)))
            status, _ = context.call_conv.call_function(
                inside, builder.function, types.none, (types.intp, *arguments.types), [k, *cgutils.unpack_tuple(inside, lent)]
            )
            inside.ret(inside.zext(status.is_error, CALLED.return_type))
            addresses = [builder.ptrtoint(p, context.get_value_type(types.uintp)) for p in (called, place)]
            context.compile_internal(builder, _start, types.void(types.uintp, types.uintp, types.intp), [*addresses, many])
        return every

    return types.boolean(types.intp, types.intp, arguments), generate
