"""Dataclasses come back from JSON and arrays, and damaged data are refused."""

from __future__ import annotations

import json
from dataclasses import dataclass, is_dataclass
from enum import StrEnum
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from numpy.typing import NDArray

from vslam.maps.checkpoint import CHECKPOINTS
from vslam.maps.codec import Codec
from vslam.run.progress import PROGRESS, Progress
from vslam.types.states import Checkpoint


class Colour(StrEnum):
    RED = "red"


class Point(NamedTuple):
    at: NDArray[np.float64]
    weight: float


@dataclass(frozen=True)
class Shape:
    points: tuple[Point, ...]
    ends: tuple[int, str]
    numbers: NDArray[np.float32]
    labels: NDArray[np.uint8]
    colour: Colour = Colour.RED
    kind: Literal["open", "closed"] = "open"
    closed: bool = False
    known: frozenset[int] = frozenset()
    names: list[str] | None = None
    scratch: NDArray[np.float64] | None = None


CODEC = Codec(
    {"Point.at": (2,), "Shape.numbers": ("N", 2), "Shape.labels": ("N",), "Shape.scratch": None},
    most=100.0,
    unbounded=frozenset(("Point.weight",)),
)
SHAPE = Shape(
    points=(Point(np.array([0.1, 1 / 3]), np.inf), Point(np.ones(2), 2.0)),
    ends=(3, "x"),
    numbers=np.ones((3, 2), np.float32),
    labels=np.arange(3, dtype=np.uint8),
    known=frozenset((7, 2)),
    names=["a"],
    scratch=np.zeros(9),
)


def stored() -> tuple[Any, dict[str, np.ndarray]]:
    entry, arrays = CODEC.encode(SHAPE, "shape")
    return json.loads(json.dumps(entry)), arrays


def test_an_object_comes_back():
    entry, arrays = stored()
    assert sorted(arrays) == ["shape.labels", "shape.numbers", "shape.points.0.at",
                              "shape.points.1.at"]  # fmt: skip
    found = CODEC.decode(Shape, entry, arrays)
    assert found.scratch is None  # it is not stored
    for field, value in vars(SHAPE).items():
        if field not in ("points", "numbers", "labels", "scratch"):
            assert getattr(found, field) == value
            assert type(getattr(found, field)) is type(value)
    assert [(one.at.tolist(), one.weight) for one in found.points] == [
        ([0.1, 1 / 3], np.inf),
        ([1.0, 1.0], 2.0),
    ]
    assert found.labels is arrays["shape.labels"]


def test_numpy_numbers_become_python_numbers():
    entry, _ = CODEC.encode(Point(np.zeros(2), np.float32(0.5)), "point")
    assert type(entry["weight"]) is float


@pytest.mark.parametrize(
    "change",
    [
        {"ends": [3]},
        {"ends": [3.0, "x"]},
        {"ends": [-2, "x"]},
        {"ends": [2**31, "x"]},
        {"ends": 3},
        {"colour": "blue"},
        {"colour": 1},
        {"kind": "half"},
        {"kind": 1},
        {"closed": 1},
        {"known": [0.5]},
        {"known": None},
        {"names": [1]},
        {"points": {}, "other": 1},
        {"points": [{"at": "shape.points.0.at"}]},
        {"points": [{"at": "shape.points.0.at", "weight": True}]},
        {"points": [{"at": "shape.numbers", "weight": 1.0}]},
        {"points": [{"at": "missing", "weight": 1.0}]},
        {"points": [{"at": ["shape.points.0.at"], "weight": 1.0}]},
        {"points": [[1.0, 2.0]]},
    ],
)
def test_damaged_entries_are_refused(change):
    entry, arrays = stored()
    with pytest.raises((KeyError, TypeError, ValueError, AttributeError)):
        CODEC.decode(Shape, entry | change, arrays)


@pytest.mark.parametrize(
    ("name", "array"),
    [
        ("numbers", np.ones((3, 2))),
        ("numbers", np.ones((4, 2), np.float32)),
        ("numbers", np.ones((3, 3), np.float32)),
        ("numbers", np.ones(3, np.float32)),
        ("numbers", np.ones((3, 2, 1), np.float32)),
        ("numbers", np.asfortranarray(np.ones((3, 2), np.float32))),
        ("numbers", np.full((3, 2), np.nan, np.float32)),
        ("numbers", np.full((3, 2), 101, np.float32)),
        ("labels", np.zeros(4, np.uint8)),
        ("labels", np.zeros(3, object)),
        ("points.0.at", np.array([np.inf, 0.0])),
    ],
)
def test_damaged_arrays_are_refused(name, array):
    entry, arrays = stored()
    with pytest.raises(ValueError, match=r"(Shape|Point)\.\w+ (has|is)"):
        CODEC.decode(Shape, entry, arrays | {f"shape.{name}": array})


def array_fields(kind: Any, left_out: set[str]) -> set[str]:
    """Return the fields that hold arrays, of a type and of the types of its fields.

    Args:
        left_out: fields whose contents are not stored.
    """
    is_object = is_dataclass(kind) or hasattr(kind, "_fields")
    hints = get_type_hints(kind) if is_object else {}
    stored = {
        name: hint for name, hint in hints.items() if f"{kind.__name__}.{name}" not in left_out
    }
    found = {
        f"{kind.__name__}.{name}"
        for name, hint in stored.items()
        if np.ndarray in map(get_origin, (hint, *get_args(hint)))
    }
    inner = (*stored.values(), *get_args(kind))
    return found.union(*(array_fields(one, left_out) for one in inner))


@pytest.mark.parametrize(("codec", "kind"), [(CHECKPOINTS, Checkpoint), (PROGRESS, Progress)])
def test_every_array_has_a_shape(codec, kind):
    left_out = {name for name, shape in codec.shapes.items() if shape is None}
    assert array_fields(kind, left_out) == codec.shapes.keys() - left_out
