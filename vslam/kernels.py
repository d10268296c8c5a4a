"""How vslam compiles its kernels, and the bit arithmetic that several of them share.

A kernel is compiled once for each machine, kept in Numba's cache, and holds no GIL: threads of
the pipeline run kernels side by side. ``error_model="numpy"`` and fused multiply-add are the only
liberties; no re-association, so that a result never depends on how a loop was vectorised.

Numba makes itself ready to compile before it looks into its cache: it imports all that it can
compile, and scipy for the linear algebra, 0.25 s of CPU time. With each kernel it loads the
environments of all functions in it, for which it imports their modules, and parses the code that
would be needed to inline the kernel into another one. A run that finds all kernels in the cache
compiles none, and needs none of these: ``_KernelCache`` leaves them out, or to when a kernel is
compiled. Loading takes a fifth of the time. What is written is in Numba's format. This uses inner
workings of Numba: with a release that it was not tested with, Numba's own cache is taken.

A cache never ends a run. Files that a power cut damaged are found by their checksum and written
again; code cut short would abort Python. Where no folder can be written to, neither beside the
source nor in the home, the process has a temporary cache.
"""

from __future__ import annotations

import atexit
import logging
import os
import shutil
import tempfile
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm
import numba
from numba.core import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.runtime import rtsys
from numba.extending import intrinsic

from vslam.errors import InputError

Function = TypeVar("Function", bound=Callable[..., Any])
TESTED_NUMBA = "0.68."
_DAMAGED = "Compiled kernels in the cache are damaged; they are compiled again."

_log = logging.getLogger(__name__)

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract"},
    "no_cfunc_wrapper": True,
}


class _KernelFormat(CompileResultCacheImpl):
    """What of a kernel is written, and how it is loaded."""

    def reduce(self, compiled: Any) -> tuple[Any, ...]:
        *parts, environments = super().reduce(compiled)
        # One without constants has nothing that code without Python objects could ask for.
        return *parts, tuple(one for one in environments if one.consts)

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> Any:
        (name, kind, (machine_code, bitcode)), function, *rest = payload
        # What Python calls; a kernel that only kernels call has none.
        entry = function.llvm_cpython_wrapper_name
        if entry.encode() in machine_code:
            target_context.codegen()._engine._defined_symbols.add(entry)
        bare = (name, kind, (machine_code, _no_bitcode()))
        compiled = super().rebuild(target_context, (bare, function, *rest))
        library = compiled.library
        library._shared_module = None
        library._get_module_for_linking = partial(_parsed, library, bitcode)
        return compiled


@cache
def _no_bitcode() -> bytes:
    return bytes(llvm.parse_assembly("").as_bitcode())


def _parsed(library: Any, bitcode: bytes) -> Any:
    """The module to inline a loaded kernel from, once another kernel that calls it is compiled."""
    if library._shared_module is None:
        module = llvm.parse_bitcode(bitcode)
        library.codegen._engine._load_defined_symbols(module)
        library._shared_module = module
    return library._shared_module


@cache
def _warn(message: str) -> None:
    """Log a message once."""
    _log.warning(message)


class _CheckedFiles(IndexDataCacheFile):
    """The files of a kernel's cache: those with code end with the checksum of what goes before."""

    def _load_index(self) -> dict[Any, str]:
        try:
            return dict(super()._load_index())
        except Exception:  # unpickling damaged bytes raises anything
            _warn(_DAMAGED)
            return {}

    def _save_data(self, name: str, data: Any) -> None:
        code = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(code)
            file.write(_checksum(code))

    def _load_data(self, name: str) -> Any:
        code = Path(self._data_path(name)).read_bytes()
        if code[-4:] != _checksum(code[:-4]):
            _warn(_DAMAGED)
            return None
        return super()._load_data(name)


def _checksum(code: bytes) -> bytes:
    return zlib.crc32(code).to_bytes(4, "little")


class _KernelCache(FunctionCache):
    """The cache of one kernel."""

    _impl_class = _KernelFormat

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        found = self._impl.locator
        self._cache_file = _CheckedFiles(
            found.get_cache_path(), self._impl.filename_base, found.get_source_stamp()
        )

    def save_overload(self, signature: Any, compiled: Any) -> None:
        try:
            super().save_overload(signature, compiled)
        except OSError as error:
            _warn(f"Compiled kernels cannot be kept ({error.strerror}); each run compiles them.")

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        rtsys.initialize(target_context)  # the functions that count references
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, target_context)

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        # Not what Numba wrote itself, with every environment.
        return (*super()._index_key(signature, codegen), "vslam, with checksums")


def _use_temporary_cache() -> None:
    """Keep the kernels of this process, and of those that it starts, in a temporary folder."""
    try:
        folder = tempfile.mkdtemp(prefix="vslam-kernels-")
    except OSError as error:
        raise InputError(
            "No folder can be written to, and compiled kernels must be kept somewhere; set "
            "NUMBA_CACHE_DIR to a writable folder."
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    config: Any = numba.config
    config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = folder
    _warn(
        "There is no writable folder to keep compiled kernels in; each run compiles them, which "
        "takes a minute. Set NUMBA_CACHE_DIR to a writable folder."
    )


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """Numba's compiled function with a cache."""
    made = numba.njit(**options)(function)
    if not isinstance(made, Dispatcher):  # NUMBA_DISABLE_JIT
        return made
    dispatcher: Any = made
    try:
        _enable_cache(dispatcher, function)
    except RuntimeError:  # no folder of Numba's can be written to
        _use_temporary_cache()
        _enable_cache(dispatcher, function)
    return dispatcher


def _enable_cache(dispatcher: Any, function: Callable[..., Any]) -> None:
    if numba.__version__.startswith(TESTED_NUMBA):
        dispatcher._cache = _KernelCache(function)
    else:
        dispatcher.enable_caching()


def kernel(function: Function) -> Function:
    """Compile ``function`` as described above, on its first call."""
    return cast(Function, _cached(function, _OPTIONS))


def inner_kernel(function: Function) -> Function:
    """A kernel that only kernels call: it compiles faster, since Python cannot call it."""
    return cast(Function, _cached(function, _OPTIONS | {"no_cpython_wrapper": True}))


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
