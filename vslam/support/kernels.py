"""Compilation of vslam's Numba kernels, and the bit arithmetic that several kernels share.

A kernel is compiled once on each machine and kept in Numba's cache. It releases the GIL, so that
threads of the pipeline run kernels in parallel. ``error_model="numpy"`` and fused multiply-add are
the only relaxations of floating-point arithmetic. Sums are not re-associated. Therefore, a result
never depends on how a loop was vectorised.

Before Numba looks into its cache, it prepares for compilation. A run that finds all kernels in the
cache does not need this. ``_KernelCache`` therefore prepares only when a kernel must be compiled,
and loads kernels in a fifth of the time. It relies on internals of Numba. With releases of Numba
for which it was not tested, Numba's own cache is used instead.

A cache problem never ends a run. A power cut can truncate a cache file, and loading such a file
would abort Python. Truncated files are detected by a checksum, and their kernels are compiled
again. If neither the folder of the source nor the home folder is writable, the process uses a
temporary cache.
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

from vslam.support.errors import InputError

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
    def reduce(self, compiled: Any) -> tuple[Any, ...]:
        *parts, environments = super().reduce(compiled)
        # Only the constants of an environment are needed, because kernels use no Python objects.
        return *parts, tuple(one for one in environments if one.consts)

    def rebuild(self, target_context: Any, payload: tuple[Any, ...]) -> Any:
        (name, kind, (machine_code, bitcode)), function, *rest = payload
        # The entry point for calls from Python. An inner kernel has no such entry point.
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
    """Parse the LLVM module of a loaded kernel, which is needed only to inline the kernel."""
    if library._shared_module is None:
        module = llvm.parse_bitcode(bitcode)
        library.codegen._engine._load_defined_symbols(module)
        library._shared_module = module
    return library._shared_module


@cache
def _warn(message: str) -> None:
    """Log a message once in each process."""
    _log.warning(message)


class _CheckedFiles(IndexDataCacheFile):
    """The cache files of a kernel. Each file with code ends with a checksum of the code."""

    def _load_index(self) -> dict[Any, str]:
        try:
            return dict(super()._load_index())
        except Exception:  # unpickling damaged bytes may raise any exception
            _warn(_DAMAGED)
            return {}

    def save(self, key: Any, data: Any) -> None:
        # The number is that of the key, and the code is written first: whatever another process
        # saves or loads at the same time, the index never names the code of another signature.
        index, name = self._load_index(), self._data_name(zlib.crc32(repr(key).encode()))
        self._save_data(name, data)
        self._save_index(index | {key: name})

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
        rtsys.initialize(target_context)  # loaded kernels call Numba's reference counting
        with self._guard_against_spurious_io_errors():
            return self._load_overload(signature, target_context)

    def _index_key(self, signature: Any, codegen: Any) -> tuple[Any, ...]:
        # Entries that Numba itself wrote have no checksum, and must not be loaded.
        return (*super()._index_key(signature, codegen), "vslam, with checksums")


def _use_temporary_cache() -> None:
    """Keep compiled kernels of this process and its child processes in a temporary folder."""
    try:
        folder = tempfile.mkdtemp(prefix="vslam-kernels-")
    except OSError as error:
        raise InputError(
            "There is no writable folder for compiled kernels; set NUMBA_CACHE_DIR to a writable "
            "folder."
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    config: Any = numba.config
    config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = folder
    _warn(
        "There is no writable folder for compiled kernels, so each run compiles them, which takes "
        "a minute. Set NUMBA_CACHE_DIR to a writable folder."
    )


def _cached(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    made = numba.njit(**options)(function)
    if not isinstance(made, Dispatcher):  # NUMBA_DISABLE_JIT is set
        return made
    dispatcher: Any = made
    try:
        _enable_cache(dispatcher, function)
    except RuntimeError:  # none of Numba's cache folders is writable
        _use_temporary_cache()
        _enable_cache(dispatcher, function)
    return dispatcher


def _enable_cache(dispatcher: Any, function: Callable[..., Any]) -> None:
    if numba.__version__.startswith(TESTED_NUMBA):
        dispatcher._cache = _KernelCache(function)
    else:
        dispatcher.enable_caching()


def kernel(function: Function) -> Function:
    """Decorate a function as a kernel, which Numba compiles on its first call and then caches."""
    return cast(Function, _cached(function, _OPTIONS))


def inner_kernel(function: Function) -> Function:
    """Decorate a function that only kernels call. Numba compiles it.

    The function gets no entry point for Python, which makes compilation faster.
    """
    return cast(Function, _cached(function, _OPTIONS | {"no_cpython_wrapper": True}))


def inline(function: Function) -> Function:
    """Decorate a function that is inlined into the kernels that call it."""
    return cast(Function, numba.njit(inline="always", error_model="numpy")(function))


@intrinsic
def popcount(typing_context, value):
    """Count the set bits of a uint64, using a single instruction."""

    def generate(context, builder, signature, arguments):
        return builder.ctpop(arguments[0])

    return types.uint64(types.uint64), generate


@intrinsic
def trailing_zeros(typing_context, value):
    """Return the index of the lowest set bit of a non-zero uint64, using a single instruction."""

    def generate(context, builder, signature, arguments):
        never_zero = context.get_constant(types.boolean, True)
        return builder.cttz(arguments[0], never_zero)

    return types.uint64(types.uint64), generate


@intrinsic
def borrowed(typing_context, array):
    """Return the same array without reference counting.

    The result is valid while a caller holds the original array. Counting a reference takes longer
    than calling a small function.
    """

    def generate(context, builder, signature, arguments):
        view = context.make_array(signature.return_type)(context, builder, arguments[0])
        view.meminfo = view.meminfo.type(None)
        view.parent = view.parent.type(None)
        return view._getvalue()

    return array(array), generate


@inline
def hamming(a, b):
    """Return the Hamming distance of two 256-bit descriptors, each given as ``(4,)`` uint64."""
    return int(
        popcount(a[0] ^ b[0])
        + popcount(a[1] ^ b[1])
        + popcount(a[2] ^ b[2])
        + popcount(a[3] ^ b[3])
    )
