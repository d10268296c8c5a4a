"""SLAM on a stereo, RGB-D or monocular stream. ``Slam.step`` processes one frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vslam.config import Config, as_config
from vslam.frontend.extraction import FrameImages, checked_images
from vslam.frontend.images import GivenFeatures
from vslam.loopclosure.detector import LoopDetector
from vslam.loopclosure.names import DEFAULT_DETECTOR
from vslam.loopclosure.registry import detector_with_images
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.method.gaps import Gap, find_gaps
from vslam.method.hypotheses import map_gravity
from vslam.method.inertia import IMU_REFUSED, SCALE_LOST, SCALE_UNKNOWN, is_refused
from vslam.method.map_frames import in_first_part, keyframe_trajectory
from vslam.method.session import Session
from vslam.support.errors import InputError
from vslam.support.workers import Workers
from vslam.types.camera import Camera, DepthImage, Image
from vslam.types.context import Context
from vslam.types.features import Extracted, TrackResult
from vslam.types.imu import ImuCalibration
from vslam.types.loops import LoopCorrection, LoopEdge
from vslam.types.map import Map
from vslam.types.track import Track
from vslam.types.trajectory import Trajectory


def _ignore(result: TrackResult) -> None:
    """The default of ``on_pose``."""


def _as_mounted(trajectory: Trajectory, camera: Camera) -> Trajectory:
    return replace(trajectory, T_wc=camera.as_mounted(trajectory.T_wc))


class Slam:
    """Stereo, RGB-D or monocular SLAM. A monocular map has an arbitrary unit instead of metres,
    until an IMU tells its scale.

    >>> slam = Slam(camera)
    >>> for left, right, timestamp in frames:
    ...     result = slam.step(left, right, timestamp)
    >>> slam.finish()
    >>> slam.trajectory().T_wc
    >>> slam.save(path)

    ``Slam.load(path)`` continues in the saved map. The camera is relocalised in this map, and new
    places are added. If relocalisation fails, a new sub-map begins, which a loop may join to the
    map later. With ``localize=True``, the map is not changed.

    Attributes:
        context: camera, thresholds and pyramid scales, for ``FrameImages``.
        detector: proposes loop candidates, and places for relocalisation.
        rig: measurements of the stereo pair, such as the exposures of its images.
        workers: threads that run the mapping jobs. They can also prepare frames in advance.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | Mapping[str, Any] | str | None = None,
        detector: LoopDetector | str = DEFAULT_DETECTOR,
        *,
        threads: int = 2,
        images: KeyframeImages | None = None,
        start: StoredMap | None = None,
        localize: bool = False,
        resume: bool = False,
        imu: ImuCalibration | None = None,
        realtime: bool = False,
    ) -> None:
        """Begin SLAM with a new map, or continue in a stored map.

        Args:
            camera: the rectified camera that the images come from. Use ``camera.left_camera()`` for
                monocular SLAM.
            config: thresholds, as a ``Config``, as a dictionary such as ``{"orb": {"n_features":
                1000}}``, or as the name of a preset, such as ``"fast"``. Thresholds that are left
                out keep their defaults.
            detector: proposes loop candidates, and places for relocalisation. It is an object or a
                name (``vslam.loopclosure.registry``). ``both`` combines the capsule network with
                the bag of words. ``none`` closes no loops.
            threads: number of threads. The results do not depend on this number.
            images: store of the keyframe images, from which learned descriptors are computed. These
                descriptors verify loops where ORB fails. None verifies loops with ORB only. This
                argument is used only if ``detector`` is an object.
            start: a map to continue in, which is changed in place. It must have been made with the
                same camera, detector and pyramid. ``Slam.load`` reads such a map from a file.
            localize: only track in the map ``start``, without changing it.
            resume: continue the last drive of the map ``start`` instead of beginning a new drive.
                The poses equal those of an uninterrupted drive only if the map was saved with
                ``resumable=True``.
            imu: where the IMU is on the rectified left camera, and its noise. Its samples are
                passed to ``step`` or ``add_imu``. None if there is no IMU.
            realtime: load networks now and apply them to every keyframe, so that a lost frame need
                not wait for this. Otherwise, they are applied only when needed, which takes less
                time in total. This argument is used only if ``detector`` is a name.

        Raises:
            ValueError: the map cannot be continued. The message gives the reason in a few words.
            InputError: a preset or threshold is unknown, or a value is out of range.
        """
        config = as_config({} if config is None else config)
        if isinstance(detector, str):
            detector, images = detector_with_images(detector, config, on_demand=not realtime)
        self.context = context = Context.create(camera, config, has_imu=imu is not None)
        self.detector = detector
        self.workers = Workers(threads)
        self._session = Session(
            context, detector, images, self.workers, start,
            localize=localize, resume=resume, imu=imu,
        )  # fmt: skip
        self.rig = self._session.rig

    @classmethod
    def load(
        cls,
        path: Path | str,
        config: Config | Mapping[str, Any] | str | None = None,
        detector: LoopDetector | str | None = None,
        *,
        resume: bool = False,
        **options: Any,
    ) -> Slam:
        """Continue in a map that ``save`` or a run wrote.

        Args:
            path: the map file, or the folder of a run.
            config: thresholds, as for a new map. None uses the thresholds with which the map was
                made.
            detector: the detector with which the map was made, as a name or an object. None uses
                the detector that is named in the file.
            resume: continue the last drive of the map instead of beginning a new drive.
            options: ``threads``, ``images``, ``localize``, ``imu`` and ``realtime``, as for a new
                map.

        Raises:
            InputError: the file is not a map or is damaged, the map was made with another detector
                or pyramid, or it has no drive to resume.
        """
        stored = load_checkpoint(path) if resume else load_map(path)
        if resume and stored.frames is None:
            raise InputError(f"{path}: the map has no drive to continue; load it without resume.")
        detector = stored.detector.name if detector is None else detector
        config = as_config(stored.thresholds, str(path)) if config is None else config
        try:
            return cls(stored.camera, config, detector, start=stored, resume=resume, **options)
        except (ValueError, KeyError) as error:
            raise InputError(f"{path}: {error}; use the options of that run.") from error

    def save(self, path: Path | str, drive: str = "", *, resumable: bool = False) -> None:
        """Write the map, and everything else that ``load`` needs, to a file.

        An existing file is replaced.

        Args:
            path: the file.
            drive: source of the images of this drive, such as "kitti 06".
            resumable: also write the state of tracking and the culled parts of the map. A run that
                loads the file with ``resume=True`` then gives poses that are byte-identical to the
                poses of an uninterrupted run.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
            OSError: the file cannot be written. In this case, an existing file is unchanged.
        """
        save_map(path, self.stored_map(drive), resumable=resumable)

    def stored_map(self, drive: str = "") -> StoredMap:
        """Return the map in the form that ``save`` writes to a file.

        The result shares its arrays with the map that is being built. Before the next step, call
        ``compact()`` on it to get a copy.

        Raises:
            RuntimeError: mapping failed, so that the map is incomplete.
        """
        return self._session.stored_map(drive)

    def step(
        self,
        left: Image,
        second: Image | DepthImage | None,
        timestamp: float,
        *,
        mask: NDArray[np.uint8] | NDArray[np.bool_] | None = None,
        imu: ArrayLike | None = None,
        on_pose: Callable[[TrackResult], None] = _ignore,
    ) -> TrackResult:
        """Track one rectified stereo pair, RGB-D image or monocular image.

        A frame that shows something new is inserted as a keyframe.

        Images that are kept are copied. Therefore, a camera may write its next images into the same
        arrays.

        Args:
            left: ``(H, W)`` uint8 left image.
            second: for a stereo camera, the ``(H, W)`` uint8 right image. For an RGB-D camera, the
                ``(H, W)`` float32 depth of the pixels of the left image in metres, and 0 where the
                depth is unknown. None for a monocular camera.
            timestamp: seconds. It must be later than the timestamp of the last call.
            mask: ``(H, W)`` uint8 or bool. It is 0 where the left image must not be used, for
                example where it shows the hood of the car. None uses the whole image.
            imu: ``(N, 7)`` samples of the IMU since the last call, see ``add_imu``. None if there
                is no IMU, or if ``add_imu`` is used.
            on_pose: function that is called with the result as soon as the pose is known, before a
                keyframe is inserted. ``is_keyframe`` may not be decided yet. Exceptions of this
                function are passed on.

        Raises:
            ValueError: the images or samples have the wrong size or type, or the timestamp is not
                finite or not later than the last timestamp.
            RuntimeError: mapping an earlier keyframe failed, so that the map is incomplete.
        """
        images = checked_images(left, second, mask, self.context)
        if imu is not None:
            self.add_imu(imu)
        return self.step_images(images, timestamp, on_pose=on_pose)

    def step_images(
        self,
        images: FrameImages,
        timestamp: float,
        stage_ms: dict[str, float] | None = None,
        on_pose: Callable[[TrackResult], None] = _ignore,
    ) -> TrackResult:
        """Do the same as ``step`` with images that were prepared in advance.

        Args:
            images: the images, which are not copied. Do not write to them afterwards.
            timestamp: seconds. It must be later than the timestamp of the last call.
            stage_ms: wall time of the stages before this call, in milliseconds. It is included in
                the result.
            on_pose: as in ``step``.
        """
        return self._session.step(images, timestamp, stage_ms, on_pose)

    def add_imu(self, samples: ArrayLike) -> None:
        """Add samples of the IMU, for example as soon as they arrive from a live sensor.

        Samples that are not in order are sorted. Repeated times, and rows with numbers that are not
        finite, are left out. A frame uses the samples that were added before its step. If the last
        of them is a little earlier than the frame, it is continued. If samples are missing for more
        than 0.1 s, the motion is predicted without the IMU.

        Args:
            samples: ``(N, 7)`` seconds in the clock of the camera, angular rate x, y and z in
                rad/s, specific force x, y and z in m/s^2, in the frame of the IMU.

        Raises:
            ValueError: the shape is wrong.
        """
        self._session.add_imu(samples)

    def step_features(
        self,
        extracted: Extracted,
        timestamp: float,
        image: Image | None = None,
        stage_ms: dict[str, float] | None = None,
    ) -> TrackResult:
        """Do the same as ``step`` with features that were extracted in advance.

        Args:
            extracted: the features (``FrameImages.extracted``).
            timestamp: seconds. It must be later than the timestamp of the last call.
            image: ``(H, W)`` uint8, the image of the features, for loop detectors that need it. It
                is not copied. Do not write to it afterwards.
            stage_ms: wall time of the stages before this call, in milliseconds. It is included in
                the result.
        """
        return self._session.step(GivenFeatures(extracted, image), timestamp, stage_ms, _ignore)

    def skip(self, timestamp: float, *, dropped: bool = False) -> TrackResult:
        """Add a frame without images at the predicted pose. Its state is LOST or DROPPED."""
        return self._session.skip(timestamp, dropped=dropped)

    def resume_odometry(self, last: TrackResult) -> None:
        """Continue ``T_odom_camera`` and its uncertainty after a drive was resumed.

        This is needed only if the map was saved without the state of tracking. Without this call,
        the odometry then starts at the identity, with no uncertainty.

        Args:
            last: the last result of the drive before it was resumed.
        """
        self._session.resume_odometry(last)

    def finish(self) -> None:
        """Complete all mapping. The map and trajectory then do not change until the next step."""
        self._session.finish()

    @property
    def map(self) -> Map:
        """The map with its keyframes, landmarks and observations.

        Raises:
            RuntimeError: a keyframe is being mapped. Check ``is_mapping``, or call ``finish()``.
        """
        return self._session.published.map

    @property
    def gravity(self) -> NDArray[np.float64] | None:
        """``(3,)`` acceleration of free fall in the world frame of the map, in m/s^2.

        It is the mean over the keyframes. ``TrackResult.gravity`` is what is known at a frame. None
        without an IMU, and until a keyframe was added after gravity became known.

        Raises:
            RuntimeError: a keyframe is being mapped. Check ``is_mapping``, or call ``finish()``.
        """
        return map_gravity(self.map, self._session.closing.closed)

    @property
    def frame(self) -> Track | None:
        """The last tracked frame, for visualisation. None before the first tracked frame."""
        return self._session.last

    @property
    def truth_alignment(self) -> TruthAlignment | None:
        """The transformation from the loaded map to the frame of a ground truth, if known."""
        return self._session.opened.truth_alignment

    @property
    def is_mapping(self) -> bool:
        """Whether a keyframe is being mapped."""
        return self._session.published.is_mapping

    @property
    def is_adjusting(self) -> bool:
        """Whether a global bundle adjustment is running, or its result has not been applied yet."""
        return self._session.closing.is_adjusting

    @property
    def loops(self) -> list[LoopEdge]:
        """The outcomes of all loop candidates so far."""
        return self._session.closing.edges

    @property
    def problems(self) -> list[str]:
        """One sentence for each failure that did not harm the map.

        Such failures are a failed search for loops, a failed global bundle adjustment, and a right
        image that could not be read.
        """
        of_imu = [IMU_REFUSED] if is_refused(self._session.inertia) else []
        if self._session.lacks_scale:
            of_imu.append(SCALE_UNKNOWN if self.metric_since is None else SCALE_LOST)
        return [*self._session.closing.problems, *self.rig.problems, *of_imu]

    @property
    def metric_since(self) -> float | None:
        """Time in seconds since when an IMU has made a monocular map metric. The whole map is then
        scaled. None for other maps."""
        since = self._session.inertia.metric_since
        return since if since >= 0.0 else None

    @property
    def corrections(self) -> list[LoopCorrection]:
        """The correction of the keyframes by each closed loop."""
        return self._session.closing.corrections

    def trajectory(self) -> Trajectory:
        """Return the pose of every frame. The poses of lost frames are interpolated."""
        return _as_mounted(self._session.published.trajectory(), self.context.camera)

    def keyframe_trajectory(self) -> Trajectory:
        """Return the poses of the keyframes of this drive, without culled keyframes."""
        return _as_mounted(keyframe_trajectory(self.map), self.context.camera)

    def tracked(self) -> NDArray[np.bool_]:
        """Return an ``(N,)`` bool array, True for frames whose pose was found by their images, at
        the time of tracking or later."""
        return self._session.published.frames.table().tracked

    def in_map(self) -> NDArray[np.bool_]:
        """Return an ``(N,)`` bool array, True for frames that were tracked in the first sub-map.

        Sub-maps that closed loops have joined to the first sub-map count as part of it.
        """
        return in_first_part(self.map, self._session.closing.closed, self._session.published.frames)

    def gaps(self) -> list[Gap]:
        """Return the stretches of this drive whose poses relative to the world were not measured.

        The camera was lost before each stretch, and no closed loop has joined the stretch to the
        map since. The list also contains lost frames at the start and at the end of the drive.

        Raises:
            RuntimeError: a keyframe is being mapped. Check ``is_mapping``, or call ``finish()``.
        """
        closing, published = self._session.closing, self._session.published
        return find_gaps(self.map, closing.closed, published.frames, self.context)
