"""Wraps a loop detector from another package, and checks its results before they are used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config
from vslam.loopclosure.detector import LoopDetector
from vslam.support.errors import InputError
from vslam.support.plugins import PlugIn
from vslam.types.features import Features
from vslam.types.loops import DetectorMemory, LoopCandidate
from vslam.types.map import Map

_METHODS = ("add", "query", "locate")


class PlugInDetector:
    """A ``LoopDetector`` that forwards all calls to the detector of another package. After that
    detector has failed once, it is not called again.

    Attributes:
        problem: one sentence about the failure; None if there was no failure. A run ends after a
            failure and keeps the results obtained so far.
    """

    def __init__(self, plugin: PlugIn, detector: LoopDetector) -> None:
        self.name = plugin.name
        self.problem: str | None = None
        self._plugin = plugin
        self._detector = detector

    def add(self, keyframe: int, image: NDArray[np.uint8] | None, features: Features) -> None:
        self._call(self._detector.add, keyframe, _read_only(image), features)

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        return self._candidates(keyframe, map_, self._detector.query, keyframe, map_)

    def locate(
        self, image: NDArray[np.uint8] | None, features: Features, map_: Map
    ) -> list[LoopCandidate]:
        return self._candidates(-1, map_, self._detector.locate, _read_only(image), features, map_)

    def memory(self) -> DetectorMemory:
        """Return the data of the other package's detector. If that detector has no method
        ``memory``, the result contains only the name of the detector."""
        empty = DetectorMemory(self.name)
        if not callable(getattr(self._detector, "memory", None)):
            return empty
        memory = self._call(self._detector.memory)
        if memory is None and self.problem is not None:
            return empty
        if not isinstance(memory, DetectorMemory):
            self.problem = (
                f"{self._plugin}: memory returned {type(memory).__name__}, not DetectorMemory; "
                "repair the package"
            )
            return empty
        return replace(memory, name=self.name)

    def restore(self, memory: DetectorMemory) -> None:
        """Load the data that the method ``memory`` returned.

        Raises:
            ValueError: the data comes from a different detector, or the other package's detector
                cannot restore it.
        """
        if memory.name != self.name:
            raise ValueError(f"made with the detector {memory.name}, not {self.name}")
        if not callable(getattr(self._detector, "restore", None)):
            raise ValueError(
                f"{self._plugin} has no method restore, so it cannot continue a saved map"
            )
        self._call(self._detector.restore, memory)
        if self.problem is not None:
            raise ValueError(self.problem)

    def _call(self, method: Callable[..., Any], *arguments: object) -> Any:
        """Call a method of the other package's detector. Returns None if that detector fails or has
        failed before."""
        if self.problem is not None:
            return None
        try:
            return self._plugin.guarded(method, *arguments)
        except InputError as error:
            self.problem = str(error).rstrip(".")
            return None

    def _candidates(
        self, query: int, map_: Map, method: Callable[..., Any], *arguments: object
    ) -> list[LoopCandidate]:
        candidates = self._call(method, *arguments)
        if candidates is None and self.problem is not None:
            return []
        if fault := _fault(candidates, query, map_):
            self.problem = f"{self._plugin}: {method.__name__} {fault}; repair the package"
            return []
        return [replace(one, proposed_by=self.name) for one in candidates]


def open_plugin(plugin: PlugIn, config: Config, weights: Path | None) -> PlugInDetector:
    """Create an empty loop detector from a plug-in.

    Raises:
        InputError: the package is broken, or the object that it creates is not a detector.
    """
    detector = plugin.call(config, weights)
    missing = [name for name in _METHODS if not callable(getattr(detector, name, None))]
    if missing:
        raise InputError(
            f"{plugin}: {type(detector).__name__} has no method {' nor '.join(missing)}; repair or "
            "uninstall the package."
        )
    return PlugInDetector(plugin, detector)


def _fault(candidates: object, query: int, map_: Map) -> str:
    """Describe what is wrong with the candidates that a plug-in returned, or return "" if they are
    valid.

    The check is needed because compiled kernels use the ids as indices without bounds checks.
    """
    if not isinstance(candidates, (list, tuple)):
        return f"returned {type(candidates).__name__}, not a list"
    for candidate in candidates:
        if not isinstance(candidate, LoopCandidate):
            return f"returned a list with {type(candidate).__name__}, not LoopCandidate"
        numbers = candidate.query, candidate.match, candidate.score
        kinds = (int, np.integer), (int, np.integer), (int, float, np.integer, np.floating)
        if not all(isinstance(x, kind) for x, kind in zip(numbers, kinds, strict=True)):
            return f"returned a LoopCandidate of {', '.join(type(x).__name__ for x in numbers)}"
        if candidate.query != query or not isfinite(candidate.score):
            return (
                f"returned query {candidate.query} with score {candidate.score} for keyframe "
                f"{query}"
            )
        inside = 0 <= candidate.match < map_.n_keyframes
        if not inside or not map_.arrays.keyframe_alive[candidate.match]:
            return f"returned keyframe {candidate.match}, which is not in the map"
    return ""


def _read_only(image: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
    if image is None:
        return None
    view = image.view()
    view.flags.writeable = False
    return view
