"""Local mapping beside tracking, with the same result on every machine.

The mapping of a keyframe starts when it is inserted, in a thread of its own, and is merged at a
point that is found by counting frames, never by looking whether it is done; with one thread in all
it runs where it is merged.
Between the two the thread is the only one to touch the map; tracking sees the copies that the
last merge left.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vslam.backend.disparity_offset import map_and_calibrate
from vslam.backend.local_mapping import refresh_keyframe
from vslam.backend.triangulation import map_stereo_points
from vslam.backend.two_views import map_two_views
from vslam.camera import Camera
from vslam.closing import LoopClosing
from vslam.config import Config
from vslam.features import Features, KeyframePatches, LandmarkPatches
from vslam.frontend.frame import Frame
from vslam.frontend.patches import RecentPatches, patches_around
from vslam.frontend.rig import RigCalibration
from vslam.geometry import Matrix
from vslam.map import LocalMap, Map, local_map
from vslam.map_kernels import count_seen_by, gather_observations, link_many, resolve
from vslam.maps.checkpoint import Checkpoint
from vslam.monocular import TwoViewStart


class MappingThread:
    """The map, and what tracking may see of it while a keyframe is being mapped.

    Attributes:
        reference: the keyframe that frames are tracked and placed by, the last one as a rule.
        n_keyframes: keyframes made, culled ones included.
        last_frame, last_timestamp: index and seconds of the frame that became the last keyframe.
        local: landmarks around the reference keyframe, as of the last merge.
        patches: of those of them that the newest keyframes observe.
        recent: the patches of these keyframes.
        reference_view: landmarks of the reference keyframe alone.
        n_reference: of these, those that at least three keyframes see (all in a young map).
    """

    local: LocalMap
    patches: LandmarkPatches
    reference_view: LocalMap
    n_reference: int

    def __init__(
        self,
        scales: NDArray[np.float64],
        camera: Camera,
        config: Config,
        closing: LoopClosing,
        rig: RigCalibration,
        *,
        threads: int,
        map_: Map | None = None,
    ) -> None:
        """``map_``: to go on in; an empty one by default."""
        self.reference = 0
        self.n_keyframes = 0
        self.last_frame = -1
        self.last_timestamp = -np.inf
        self.recent = RecentPatches(config.alignment.keyframes)
        self._map = map_ or Map(scales)
        self._camera = camera
        self._config = config
        self._closing = closing
        self._rig = rig
        self._executor = ThreadPoolExecutor(1, "mapping") if threads > 1 else None
        self._pending: Callable[[], None] | None = None
        self._T_reference = np.eye(4)
        self._reference_unit_scale = 1.0
        self._visible: list[NDArray[np.int32]] = []
        self._found: list[NDArray[np.int32]] = []
        if self._map.n_keyframes:
            self.n_keyframes = self._map.n_keyframes
            self.set_reference(int(self._map.living_keyframes()[-1]))

    def resume(self) -> None:
        """Take the newest keyframe for the last one made, unless an earlier drive made it."""
        map_, newest = self._map, self.reference
        if map_.n_keyframes and map_.sessions[newest] == map_.session:
            self.last_frame, self.last_timestamp = map_.frames[newest], map_.timestamps[newest]

    def return_to(self, checkpoint: Checkpoint) -> None:
        """Go on as from there, in the map as it was then."""
        self.last_frame, self.last_timestamp = checkpoint.last_frame, checkpoint.last_timestamp
        for one in checkpoint.patches:
            self.recent.add(one)
        self.set_reference(checkpoint.reference)

    @property
    def busy(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._pending is not None

    @property
    def map(self) -> Map:
        """The map.

        Raises:
            RuntimeError: a keyframe is being mapped, so that another thread may be writing.
        """
        if self.busy:
            raise RuntimeError("a keyframe is being mapped: merge before reading the map")
        return self._map

    def insert(self, frame: Frame, *, predicted: bool = True) -> None:
        """Make a frame a keyframe, map its stereo points and start its local mapping. Merge first.

        The frame's landmarks become those that its features observe now, new ones included. A
        frame that shares none with the map is the root of a sub-map.

        Args:
            predicted: whether the pose of such a root is at least a prediction.
        """
        self.write_counts()
        map_ = self._map
        keyframe = map_.add_keyframe(
            frame.observed(),
            frame.T_cw,
            frame.timestamp,
            frame.index,
            self._certainty(frame),
        )
        tracked = np.flatnonzero(frame.landmark >= 0)
        link_many(map_.arrays, map_.rows(keyframe).start + tracked, frame.landmark[tracked])
        if keyframe > 0:
            neighbours, _ = map_.covisible(keyframe)
            if len(neighbours):
                map_.parents[keyframe] = int(neighbours[0])
            else:
                map_.begin_submap(keyframe, self.reference, predicted=predicted)
        map_stereo_points(map_, keyframe, self._camera, self._config)
        refresh_keyframe(map_, keyframe)
        self._remember_patches(frame, keyframe)
        self._set_newest(keyframe, frame)
        # The map is the thread's from here on.
        self._observe(frame, keyframe)
        if keyframe > 0:
            self._pending = self._start(
                partial(self._map_keyframe, keyframe, frame.features, frame.image)
            )
        else:
            self._closing.process(map_, keyframe, frame.features, frame.image)

    def map_far_points(self, frame: Frame) -> bool:
        """Map all stereo points of a keyframe with which a map or sub-map begins, where nothing
        follows it yet. Merge first.

        ORB-SLAM2 (III-B) begins with all of them. They bend the first poses by what the pair
        measures wrong; but at speed close points leave the view within a frame.

        Args:
            frame: that became the keyframe; its landmarks become those that its features observe.

        Returns:
            Whether there were any that had not been mapped.
        """
        map_, keyframe = self._map, self.reference
        begins = keyframe == 0 or keyframe in map_.restarts
        if not begins or keyframe != map_.n_keyframes - 1 or map_.frames[keyframe] != frame.index:
            return False
        new = map_stereo_points(map_, keyframe, self._camera, self._config, far=True)
        refresh_keyframe(map_, keyframe)
        self._copy_view()
        self._observe(frame, keyframe)
        return len(new) > 0

    def begin(self, start: TwoViewStart) -> tuple[int, int]:
        """Add the first two keyframes of a monocular map or sub-map. Merge first.

        The second frame's landmarks become those that its features observe.

        Returns:
            The keyframes that the two frames are.
        """
        self.write_counts()
        map_, frames = self._map, (start.first, start.second)
        one, two = map_two_views(
            map_,
            (start.first.features, start.second.features),
            start.features,
            start.first.T_cw,
            start.T_2_1,
            start.points,
            (start.first.timestamp, start.second.timestamp),
            (start.first.index, start.second.index),
        )
        if one > 0:
            map_.begin_submap(one, self.reference, predicted=start.predicted)
        map_.parents[two] = one
        self._remember_patches(start.second, two)
        for keyframe, frame in zip((one, two), frames, strict=True):
            self._closing.process(map_, keyframe, frame.features, frame.image)
        self._set_newest(two, start.second)
        self._observe(start.second, two)
        return one, two

    def merge(self, frames: Collection[Frame] | None = None) -> bool:
        """Wait for the pending mapping and show its result; returns whether there was one.

        Args:
            frames: all that hold ids of landmarks, which may get others; None: nothing must.
        """
        if self._pending is None:
            return False
        pending, self._pending = self._pending, None
        pending()
        self.write_counts()
        # A global bundle adjustment under way knows its landmarks by their ids.
        if frames is not None and not self._closing.is_adjusting and self._map.many_dead_landmarks:
            new_id = self._map.drop_dead_landmarks()
            for frame in frames:
                frame.landmark = np.where(frame.landmark >= 0, new_id[frame.landmark], -1)
        self._copy_view()
        return True

    def finish(self) -> None:
        """Complete all that is pending, global bundle adjustment included."""
        self.merge()
        self._closing.conclude(self._map)
        self._closing.finish(self._map)
        if self.n_keyframes:
            self._copy_view()

    def is_due(self, frame: int) -> bool:
        """Whether pending mapping is to be merged at a frame, by counting frames alone."""
        waited = frame - self.last_frame
        return self.busy and waited >= self._config.keyframes.merge_after_frames

    def count(self, visible: NDArray[np.int32], found: NDArray[np.int32]) -> None:
        """Remember which landmarks a frame should have seen and did, until the map is free."""
        self._visible.append(visible)
        self._found.append(found)

    def keyframe_pose(self, keyframe: int) -> Matrix:
        """``T_cw``; while a keyframe is being mapped, only that of the reference keyframe, as it
        was inserted."""
        if self.busy and keyframe == self.reference:
            return self._T_reference
        return self.map.keyframe_pose(keyframe)

    def unit_scale(self, keyframe: int) -> float:
        """``Map.unit_scale`` of a keyframe; while one is being mapped, of the reference only."""
        if self.busy and keyframe == self.reference:
            return self._reference_unit_scale
        return self.map.unit_scale[keyframe]

    def update(self, frame: Frame) -> None:
        """Bring a frame's landmarks up to what they stand for after a merge, and where that is:
        -1 and NaN for those that are gone.

        Two landmarks may have become one: the first feature keeps it.
        """
        arrays = self.map.arrays
        self._rig.prepare(frame)
        ids = resolve(arrays, frame.landmark)
        _, first = np.unique(ids, return_index=True)
        repeated = np.ones(len(ids), np.bool_)
        repeated[first] = False
        ids[repeated] = -1
        frame.landmark = ids
        frame.xyz = np.where((ids >= 0)[:, None], arrays.xyz[ids], np.nan)

    def old_keyframe(self, frame: Frame) -> tuple[int, int, int]:
        """The keyframe that shares most landmarks with a frame, of those that are old enough for
        their place to be known; merge first.

        Returns:
            Its id, how many landmarks it shares, and how many of its own at least three keyframes
            see; -1, 0, 0 if there is none.
        """
        map_ = self.map
        since = frame.timestamp - self._config.keyframes.known_after_s
        young = np.array(map_.sessions) == map_.session
        young &= np.array(map_.timestamps) > since
        shared = np.where(young, 0, self.count_shared(frame))
        best = int(np.argmax(shared))
        if shared[best] == 0:
            return -1, 0, 0
        return best, int(shared[best]), count_seen_by(map_.arrays, best, 3)

    def count_shared(self, frame: Frame) -> NDArray[np.int64]:
        """``(n_keyframes,)`` how many of the landmarks of a frame each keyframe observes."""
        a, n = self.map.arrays, self.map.n_keyframes
        _, rows = gather_observations(a, frame.landmark[frame.landmark >= 0], np.arange(n))
        return np.bincount(a.keyframe[rows], minlength=n)

    def follow(self, keyframe: int, frame: Frame) -> None:
        """Track by an old keyframe instead of making a new one. Merge first."""
        self.write_counts()
        self.last_timestamp = frame.timestamp
        self.set_reference(keyframe)
        if self._closing.follow(self.n_keyframes - 1):
            self.last_frame = frame.index
            self._pending = self._start(lambda: self._closing.finish(self._map))

    def set_reference(self, keyframe: int) -> None:
        """Make another keyframe the reference, and show tracking what is around it."""
        self.reference = keyframe
        self._copy_view()

    def _observe(self, frame: Frame, keyframe: int) -> None:
        frame.landmark = self._map.arrays.landmark[self._map.rows(keyframe)]
        self.update(frame)

    def _certainty(self, frame: Frame) -> NDArray[np.uint8] | int:
        """Of the features of a frame. What a landmark is first seen as is where it is seen; a
        match that was not aligned is half a pixel off."""
        if frame.pyramid is None:
            return 1
        unaligned = (frame.landmark >= 0) & ~frame.aligned
        return np.where(unaligned, 1, self._config.alignment.certainty).astype(np.uint8)

    def _remember_patches(self, frame: Frame, keyframe: int) -> None:
        features = frame.features
        if frame.pyramid is None:
            return
        shift = np.zeros((len(features), 2), np.float32)
        if frame.shift is not None:
            aligned = frame.aligned
            scale = self._map.scales[features.octave[aligned]]
            shift[aligned] = frame.shift[aligned] / scale[:, None]
        pixels = patches_around(frame.pyramid, features.xy, features.octave)
        self.recent.add(KeyframePatches(keyframe, pixels, shift))

    def _set_newest(self, keyframe: int, frame: Frame) -> None:
        self.n_keyframes = keyframe + 1
        self.last_frame, self.last_timestamp = frame.index, frame.timestamp
        self.set_reference(keyframe)

    def write_counts(self) -> None:
        """Write down what ``count`` remembered. Merge first."""
        for seen, counter in (
            (self._visible, self._map.arrays.visible),
            (self._found, self._map.arrays.found),
        ):
            for ids in seen:
                counter[ids] += 1
            seen.clear()

    def _map_keyframe(
        self, keyframe: int, features: Features, image: NDArray[np.uint8] | None
    ) -> None:
        map_and_calibrate(self._map, keyframe, self._camera, self._config)
        self._closing.process(self._map, keyframe, features, image)

    def _start(self, work: Callable[[], None]) -> Callable[[], None]:
        if self._executor is None:
            return work
        future: Future[None] = self._executor.submit(work)
        return future.result

    def _copy_view(self) -> None:
        map_, reference = self._map, self.reference
        self._rig.disparity_offset = map_.disparity_offset
        self.local = local_map(map_, reference, self._config.tracking.local_keyframes)
        self.patches = self.recent.of(map_, self.local.ids)
        self.reference_view = local_map(map_, reference, 1)
        living = map_.living_keyframes()
        if self._camera.monocular and map_.restarts:
            # A sub-map is young once more: without stereo nothing but this tells when to go on.
            living = living[living >= map_.restarts[-1]]
        needed = min(3, len(living))
        self.n_reference = count_seen_by(map_.arrays, reference, needed)
        self._T_reference = map_.keyframe_pose(reference)
        self._reference_unit_scale = map_.unit_scale[reference]
