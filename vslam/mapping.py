"""Local mapping beside tracking, with the same result on every machine.

The mapping of a keyframe starts when it is inserted, in a thread of its own, and is merged at a
fixed point that the caller chooses by counting frames, never by looking whether it is done.
Between the two the thread is the only one to touch the map; tracking sees the copies that the
last merge left.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from vslam.backend.local_mapping import map_keyframe, refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.backend.two_views import map_two_views
from vslam.camera import StereoCamera
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.features import Features
from vslam.map import LocalMap, Map, local_map
from vslam.monocular import FirstView, Start
from vslam.observations import count_seen_by, link_many, resolve

Matrix = NDArray[np.float64]


class DeferredMapping:
    """The map, and what tracking may see of it.

    Attributes:
        map: read it only while ``busy`` is False.
        busy: a keyframe is being mapped.
        reference: the last keyframe.
        local: landmarks around the reference keyframe, as of the last merge.
        reference_view: landmarks of the reference keyframe alone.
        n_reference: of these, those that at least three keyframes see (all in a young map).
    """

    map: Map
    reference: int
    local: LocalMap
    reference_view: LocalMap
    n_reference: int

    def __init__(
        self,
        scales: NDArray[np.float64],
        camera: StereoCamera,
        config: Config,
        closing: LoopClosing,
        *,
        threads: int,
    ) -> None:
        self.map = Map(scales)
        self.reference = 0
        self._camera = camera
        self._config = config
        self._closing = closing
        self._executor = ThreadPoolExecutor(1, "mapping") if threads > 1 else None
        self._pending: Callable[[], None] | None = None
        self._T_reference = np.eye(4)
        self._rescaled_reference = 1.0
        self._visible: list[NDArray[np.int32]] = []
        self._found: list[NDArray[np.int32]] = []

    @property
    def busy(self) -> bool:
        return self._pending is not None

    def insert(
        self,
        features: Features,
        landmark: NDArray[np.int32],
        T_cw: Matrix,
        timestamp: float,
        frame: int,
        image: NDArray[np.uint8] | None = None,
    ) -> tuple[NDArray[np.int32], Matrix]:
        """Add a keyframe, map its stereo points and start its local mapping. Merge first.

        Args:
            landmark: ``(N,)`` landmark that each feature tracks, or -1.
            image: the left image, for loop detectors that look at it.

        Returns:
            The landmarks that its features observe now, new ones included, and where they are, as
            ``current`` gives them.
        """
        self._write_counts()
        map_ = self.map
        keyframe = map_.add_keyframe(features, T_cw, timestamp, frame)
        tracked = np.flatnonzero(landmark >= 0)
        link_many(map_.arrays, map_.rows(keyframe).start + tracked, landmark[tracked])
        if keyframe > 0:
            neighbours, _ = map_.covisible(keyframe)
            map_.parents[keyframe] = int(neighbours[0]) if len(neighbours) else self.reference
            if len(neighbours) == 0:
                map_.restarts.append(keyframe)
        map_stereo_points(map_, keyframe, self._camera, self._config)
        refresh_keyframe(map_, keyframe)
        self.reference = keyframe
        self._copy_view()
        # The map is the thread's from here on.
        observed = self.current(map_.arrays.landmark[map_.rows(keyframe)])
        if keyframe > 0:
            self._pending = self._start(keyframe, features, image)
        else:
            self._closing.process(map_, keyframe, features, image)
        return observed

    def begin(self, start: Start, second: FirstView) -> tuple[NDArray[np.int32], Matrix]:
        """Add the first two keyframes of a monocular map or sub-map. Merge first.

        Returns:
            The landmarks that the second view's features observe, and where they are.
        """
        self._write_counts()
        map_, views = self.map, (start.first, second)
        one, two = map_two_views(
            map_,
            (views[0].frame.features, views[1].frame.features),
            start.features,
            start.first.frame.T_cw,
            start.T_2_1,
            start.points,
            (views[0].timestamp, views[1].timestamp),
            (views[0].index, views[1].index),
        )
        if one > 0:
            map_.parents[one] = self.reference
            map_.restarts.append(one)
        map_.parents[two] = one
        for keyframe, view in zip((one, two), views, strict=True):
            self._closing.process(map_, keyframe, view.frame.features, view.image)
        self.reference = two
        self._copy_view()
        return self.current(map_.arrays.landmark[map_.rows(two)])

    def merge(self) -> bool:
        """Wait for the pending mapping and show its result; returns whether there was one."""
        if self._pending is None:
            return False
        pending, self._pending = self._pending, None
        pending()
        self._write_counts()
        self._copy_view()
        return True

    def finish(self) -> None:
        """Complete all that is pending, global bundle adjustment included."""
        self.merge()
        self._closing.finish(self.map)
        if self.map.n_keyframes:
            self._copy_view()

    def count(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Remember which landmarks a frame should have seen and did, until the map is free."""
        self._visible.append(visible)
        self._found.append(found)

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """``T_cw``; while a keyframe is being mapped, only that of the reference keyframe, as it
        was inserted."""
        if self.busy:
            if keyframe != self.reference:
                raise RuntimeError("a keyframe is being mapped: merge before reading other poses")
            return self._T_reference
        return self.map.keyframe_pose(keyframe)

    def rescaled(self, keyframe: int) -> float:
        """``Map.rescaled`` of a keyframe; while one is being mapped, of the reference only."""
        if self.busy:
            if keyframe != self.reference:
                raise RuntimeError("a keyframe is being mapped: merge before reading its scale")
            return self._rescaled_reference
        return self.map.rescaled[keyframe]

    def current(self, landmark: NDArray[np.int32]) -> tuple[NDArray[np.int32], Matrix]:
        """What ``(N,)`` landmark ids stand for after a merge, and where that is: ``(N,)`` ids and
        ``(N, 3)`` points, -1 and NaN for landmarks that are gone.

        Two landmarks may have become one: the first feature keeps it.
        """
        ids = resolve(self.map.arrays, landmark)
        _, first = np.unique(ids, return_index=True)
        repeated = np.ones(len(ids), np.bool_)
        repeated[first] = False
        ids[repeated] = -1
        xyz = np.where((ids >= 0)[:, None], self.map.arrays.xyz[ids], np.nan)
        return ids, xyz

    def _write_counts(self) -> None:
        for seen, counter in (
            (self._visible, self.map.arrays.visible),
            (self._found, self.map.arrays.found),
        ):
            for ids in seen:
                counter[ids] += 1
            seen.clear()

    def look_at(self, keyframe: int) -> None:
        """Make another keyframe the reference, and show tracking what is around it."""
        self.reference = keyframe
        self._copy_view()

    def _start(
        self, keyframe: int, features: Features, image: NDArray[np.uint8] | None
    ) -> Callable[[], None]:
        def work() -> None:
            map_keyframe(self.map, keyframe, self._camera, self._config)
            self._closing.process(self.map, keyframe, features, image)

        if self._executor is None:
            return work
        future: Future[None] = self._executor.submit(work)
        return future.result

    def _copy_view(self) -> None:
        self.local = local_map(self.map, self.reference, self._config.tracking.local_keyframes)
        self.reference_view = local_map(self.map, self.reference, 1)
        living = self.map.living_keyframes()
        if self._camera.monocular and self.map.restarts:
            # A sub-map is young once more: without stereo nothing but this tells when to go on.
            living = living[living >= self.map.restarts[-1]]
        needed = min(3, len(living))
        self.n_reference = count_seen_by(self.map.arrays, self.reference, needed)
        self._T_reference = self.map.keyframe_pose(self.reference)
        self._rescaled_reference = self.map.rescaled[self.reference]
