"""How vslam compiles its kernels, and the bit arithmetic that several of them share.

A kernel is compiled once for each machine, kept in Numba's cache, and holds no GIL: threads of
the pipeline run kernels side by side. ``error_model="numpy"`` and fused multiply-add are the only
liberties; no re-association, so that a result never depends on how a loop was vectorised.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import types
from numba.extending import intrinsic

Function = TypeVar("Function", bound=Callable[..., Any])


_OPTIONS: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cfunc_wrapper": True,
}


def kernel(function: Function) -> Function:
    """Compile ``function`` as described above, on its first call."""
    return cast(Function, numba.njit(**_OPTIONS)(function))


def inner_kernel(function: Function) -> Function:
    """A kernel that only kernels call: it compiles faster, since Python cannot call it."""
    options = _OPTIONS | {"no_cpython_wrapper": True}
    return cast(Function, numba.njit(**options)(function))


def inline(function: Function) -> Function:
    """Compile ``function`` into the kernels that call it."""
    return cast(Function, numba.njit(inline="always", error_model="numpy")(function))


@intrinsic
def popcount(typing_context, value):
    """Number of bits set in a uint64: one instruction."""

    def generate(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def trailing_zeros(typing_context, value):
    """Number of the lowest bit set in a uint64 other than 0: one instruction."""

    def generate(context, builder, signature, arguments):
        never_zero = context.get_constant(types.boolean, True)
        return builder.cttz(arguments[0], never_zero)

    return types.uint64(types.uint64), generate


@intrinsic
def borrowed(typing_context, array):
    """The same array without its count of references, valid while a caller holds the original.

    Numba counts references where an array is handed to another function: an atomic operation each
    time, which costs more than a small function does.
    """

    def generate(context, builder, signature, arguments):
        seen = context.make_array(signature.return_type)(context, builder, arguments[0])
        seen.meminfo = seen.meminfo.type(None)
        seen.parent = seen.parent.type(None)
        return seen._getvalue()

    return array(array), generate


@inline
def hamming(a, b):
    """Hamming distance of two 256-bit descriptors given as ``(4,)`` uint64 rows."""
    return int(
        popcount(a[0] ^ b[0])
        + popcount(a[1] ^ b[1])
        + popcount(a[2] ^ b[2])
        + popcount(a[3] ^ b[3])
    )
