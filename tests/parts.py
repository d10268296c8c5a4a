"""A small world and test doubles, with which one part of SLAM is tested in isolation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vslam.support.workers import Job, Urgency, Workers
from vslam.types.camera import Camera
from vslam.types.features import Extracted, Features, TrackingState
from vslam.types.geometry import se3_exp, transform
from vslam.types.map_view import LocalMap, MapView
from vslam.types.track import By, Track

CAMERA = Camera(400.0, 400.0, 320.0, 120.0, 0.5, 640, 240)
ALL, NOTHING = slice(None), slice(0, 0)  # all points of a ``Points``, and none of them


class InstantWorkers(Workers):
    """Workers whose jobs are done before ``submit`` returns."""

    def __init__(self, threads: int = 2) -> None:
        super().__init__(1)

    def submit(self, work: Callable, urgency: Urgency) -> Job:
        job = super().submit(work, urgency)
        job.wait()
        return job


def frame_of(
    features: Features | Extracted,
    index: int = 0,
    timestamp: float = 0.0,
    T_cw: np.ndarray | None = None,
) -> Track:
    """Return a frame with features that are not matched yet."""
    extracted = features if isinstance(features, Extracted) else Extracted(features)
    lost = Track(index, timestamp, np.eye(4) if T_cw is None else T_cw)
    return lost.with_features(extracted)


def ahead(metres: float, turn: float = 0.0) -> np.ndarray:
    """Return ``T_cw`` of a camera that moved forward and turned right by ``turn`` radians."""
    return se3_exp(np.array([0.0, 0.0, -metres, 0.0, -turn, 0.0]))


class OneKeyframe:
    """The keyframe poses of a map with one keyframe at the origin."""

    n_keyframes = 1
    reference = 0

    def keyframe(self, keyframe: int) -> tuple[np.ndarray, float]:
        return np.eye(4), 1.0


@dataclass(frozen=True)
class Points:
    """Points in front of the origin, each with its own descriptor.

    There is no noise, so that a search at the true position of a point finds it. Point ``i`` is
    landmark ``i`` of the views that ``view`` makes.
    """

    xyz: np.ndarray
    descriptors: np.ndarray

    @classmethod
    def create(cls, n: int = 240, seed: int = 0) -> Points:
        rng = np.random.default_rng(seed)
        z = rng.uniform(16.0, 30.0, n)
        x, y = rng.uniform(-0.6, 0.6, n) * z, rng.uniform(-0.22, 0.22, n) * z
        descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
        return cls(np.stack([x, y, z], axis=1), descriptors)

    def see(self, T_cw: np.ndarray, among: slice = ALL) -> Features:
        """Return the features of some points, in their order. The camera must see all of them."""
        uvr = CAMERA.project(transform(T_cw, self.xyz[among])).astype(np.float32)
        n = len(uvr)
        return Features(
            xy=uvr[:, :2],
            octave=np.zeros(n, np.uint8),
            angle=np.zeros(n, np.float32),
            descriptors=self.descriptors[among].copy(),
            u_right=uvr[:, 2],
        )

    def frame(self, index: int, timestamp: float, T_cw: np.ndarray, among: slice = ALL) -> Track:
        return frame_of(self.see(T_cw, among), index, timestamp)

    def tracked_frame(
        self, index: int, timestamp: float, T_cw: np.ndarray, among: slice = ALL
    ) -> Track:
        ids = np.arange(len(self.xyz), dtype=np.int32)[among]
        return replace(
            self.frame(index, timestamp, T_cw, among),
            T_cw=T_cw,
            landmark=ids,
            xyz=self.xyz[among],
            state=TrackingState.OK,
            by=By.FEATURES,
            n_inliers=len(ids),
        )

    def landmarks(self, among: slice = ALL) -> LocalMap:
        xyz = self.xyz[among]
        distance = np.linalg.norm(xyz, axis=1)
        return LocalMap(
            ids=np.arange(len(self.xyz), dtype=np.int32)[among],
            xyz=xyz,
            normal=xyz / distance[:, None],
            distance_range=np.stack([0.1 * distance, distance], axis=1),
            descriptor=self.descriptors[among].view(np.uint64),
            confirmed=np.ones(len(xyz), np.bool_),
        )

    def view(
        self,
        around: slice = ALL,
        nearest: slice = ALL,
        *,
        n_reference: int = 0,
        n_keyframes: int = 20,
    ) -> MapView:
        """Make a view of a map.

        The points ``around`` are in its local map, and the points ``nearest`` are in its reference
        keyframe.
        """
        return MapView(
            n_keyframes=n_keyframes,
            local_landmarks=self.landmarks(around),
            reference_landmarks=self.landmarks(nearest),
            n_reference=n_reference,
        )
