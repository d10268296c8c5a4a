"""Converts frozen dataclasses of arrays to JSON and arrays, and back, by their type annotations.

Stored data name no types, so reading untrusted data creates only objects of the annotated types.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from enum import Enum
from functools import cache
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T")
_PLAIN = (int, float, bool, str)
_MOST_COUNT = 2**31


@dataclass(frozen=True)
class Codec:
    """Converts dataclasses and named tuples.

    Their fields may be arrays, numbers, strings, enumerations, literals, other such objects, or
    lists, tuples and frozen sets of these. A field with the annotation ``X | None`` may be None.
    Integers must be in [-1, 2^31).

    Attributes:
        shapes: shape of each array, such as ``{"Features.xy": ("N", 2)}``. Lengths with the same
            letter must be equal within an object. A field with the shape None is not stored, and is
            read as None; its annotation is ``X | None``.
        most: upper bound of the absolute values of floating-point numbers. If it is None, numbers
            may also be infinite or NaN.
        unbounded: fields to which ``most`` does not apply, such as "Features.u_right".
    """

    shapes: Mapping[str, tuple[str | int, ...] | None]
    most: float | None = None
    unbounded: frozenset[str] = frozenset()

    def encode(self, value: object, name: str) -> tuple[Any, dict[str, NDArray]]:
        """Convert an object to JSON and arrays by name.

        The name of an array is the path of its field, such as "checkpoint.last.T_cw" for
        ``name="checkpoint"``. It replaces the array in the JSON.
        """
        arrays: dict[str, NDArray] = {}
        return self._entry(value, name, "", arrays), arrays

    def _entry(self, value: Any, path: str, field: str, arrays: dict[str, NDArray]) -> Any:
        if value is None or type(value) in _PLAIN:  # most values
            return value
        if field in self.shapes and self.shapes[field] is None:
            return None
        if isinstance(value, np.ndarray):
            arrays[path] = np.ascontiguousarray(value)
            return path
        if is_dataclass(value) or hasattr(value, "_fields"):
            return {
                name: self._entry(getattr(value, name), f"{path}.{name}", inner, arrays)
                for name, (inner, _) in _fields(value.__class__).items()
            }
        if isinstance(value, list | tuple | frozenset):
            items = sorted(value) if isinstance(value, frozenset) else value
            return [self._entry(one, f"{path}.{k}", field, arrays) for k, one in enumerate(items)]
        return value.item() if isinstance(value, np.generic) else value.value

    def decode(self, kind: type[T], entry: Any, arrays: Mapping[str, NDArray]) -> T:
        """Create an object of the type ``kind`` from untrusted JSON and arrays.

        Raises:
            KeyError, TypeError, ValueError, AttributeError: the data are damaged. The message
                describes the damage in a few words.
        """
        found: T = self._value(kind, entry, kind.__name__, arrays)
        return found

    def _value(self, kind: Any, entry: Any, field: str, arrays: Mapping[str, NDArray]) -> Any:
        origin, args = get_origin(kind), get_args(kind)
        if origin is UnionType:
            if entry is None or self.shapes.get(field, ()) is None:
                return None
            return self._value(args[0], entry, field, arrays)
        if origin is np.ndarray:
            return self._checked(arrays[entry], get_args(args[1])[0], field)
        if origin in (list, tuple, frozenset):
            many = origin is not tuple or args[-1] is ...
            kinds = args[:1] * len(entry) if many else args
            pairs = zip(kinds, entry, strict=True)
            return origin(self._value(one, item, field, arrays) for one, item in pairs)
        if is_dataclass(kind) or hasattr(kind, "_fields"):
            fields = _fields(kind)
            if entry.keys() != fields.keys():
                raise ValueError(f"{field} has other fields")
            values = {
                name: self._value(hint, entry[name], inner, arrays)
                for name, (inner, hint) in fields.items()
            }
            self._check_shapes(kind, values)
            return kind(**values)
        if origin is Literal:
            valid, kind = entry in args, str
        elif kind is float:
            valid = type(entry) in (int, float) and self._bounded(entry, field)
        else:
            valid = type(entry) is (str if issubclass(kind, Enum) else kind)
            valid = valid and (kind is not int or -1 <= entry < _MOST_COUNT)
        if not valid:
            raise ValueError(f"{field} is {entry!r:.40}")
        return kind(entry)

    def _checked(self, array: NDArray, dtype: type, field: str) -> NDArray:
        if array.dtype != dtype or not array.flags.c_contiguous:
            raise ValueError(f"{field} has type {array.dtype}")
        if array.dtype.kind == "f" and not self._bounded(array, field):
            raise ValueError(f"{field} is out of range")
        return array

    def _check_shapes(self, kind: type, values: dict[str, Any]) -> None:
        sizes: dict[str, int] = {}
        for name, (field, _) in _fields(kind).items():
            array = values[name]
            if not isinstance(array, np.ndarray):
                continue
            shape = self.shapes[field]
            assert shape is not None  # such an array is read as None
            pairs = zip(shape, array.shape, strict=False)
            wanted = (n if isinstance(n, int) else sizes.setdefault(n, found) for n, found in pairs)
            if len(shape) != array.ndim or array.shape != tuple(wanted):
                raise ValueError(f"{field} has shape {array.shape}")

    def _bounded(self, numbers: NDArray | float, field: str) -> bool:
        if self.most is None or field in self.unbounded:
            return True
        return bool((np.abs(numbers) < self.most).all())


@cache
def _fields(kind: type) -> dict[str, tuple[str, Any]]:
    """Return the names of the fields, each with the name of its class, and their types."""
    hints = get_type_hints(kind)  # slow
    return {name: (f"{kind.__name__}.{name}", hint) for name, hint in hints.items()}
