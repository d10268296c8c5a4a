"""A ring road of points, which are observed as features. Loops need no rendered images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vslam.types.camera import Camera
from vslam.types.features import Features
from vslam.types.geometry import inverse
from vslam.types.loops import DetectorMemory, LoopCandidate
from vslam.types.map import Map

CAMERA = Camera(500.0, 500.0, 400.0, 150.0, 0.5, 800, 300)
RADIUS, STEP = 50.0, 1.5  # radius of the road, and distance between frames, in metres
LAP = round(2 * np.pi * RADIUS / STEP)  # number of frames


@dataclass(frozen=True)
class Ring:
    """Points on both sides of a ring road, each with its own descriptor.

    The calibrated focal length is too long by ``focal_error``. Therefore, turns are estimated with
    an error, and a lap does not end at its start. With ``zoom``, the octave of a feature depends on
    the distance of the point. Otherwise, it is 0. The right image is taken ``right_delay`` seconds
    late. The frame rate is 10 Hz.
    """

    points: np.ndarray
    descriptors: np.ndarray
    focal_error: float = 0.0
    zoom: bool = False
    right_delay: float = 0.0

    @classmethod
    def create(
        cls, seed: int = 0, n: int = 12000, focal_error: float = 0.0, zoom: bool = False
    ) -> Ring:
        rng = np.random.default_rng(seed)
        angle = rng.uniform(0, 2 * np.pi, n)
        inner = rng.random(n) < 0.5
        radius = np.where(inner, RADIUS - 6, RADIUS + 6) + rng.uniform(-1, 1, n)
        height = rng.uniform(-5.0, 1.4, n)
        points = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1)
        return cls(points, rng.integers(0, 256, (n, 32), dtype=np.uint8), focal_error, zoom)

    def pose(self, k: float) -> np.ndarray:
        """Return ``T_wc`` at frame k. Seen from below, the camera moves counter-clockwise."""
        angle = k * STEP / RADIUS
        forward = np.array([-np.sin(angle), 0.0, np.cos(angle)])
        T = np.eye(4)
        T[:3, 2] = forward
        T[:3, 1] = [0.0, 1.0, 0.0]
        T[:3, 0] = np.cross(T[:3, 1], forward)
        T[:3, 3] = RADIUS * np.array([np.cos(angle), 0.0, np.sin(angle)])
        return T

    def see(self, k: float, seed: int) -> Features:
        """Return the noisy features at frame k. Six bits of each descriptor are wrong."""
        rng = np.random.default_rng((seed, round(10 * k)))
        T_cw = inverse(self.pose(k))
        p = self.points @ T_cw[:3, :3].T + T_cw[:3, 3]
        focal = CAMERA.fx * (1.0 + self.focal_error)
        ahead = (p[:, 2] > 3.0) & (np.linalg.norm(p, axis=1) < 30.0)
        z = np.where(ahead, p[:, 2], 1.0)
        u, v = focal * p[:, 0] / z + CAMERA.cx, focal * p[:, 1] / z + CAMERA.cy
        inside = (u > 0) & (u < CAMERA.width - 1) & (v > 0) & (v < CAMERA.height - 1)
        seen = np.flatnonzero(ahead & inside)[:1200]
        n = len(seen)
        xy = np.stack([u[seen], v[seen]], axis=1) + rng.normal(0, 0.5, (n, 2))
        T_late = inverse(self.pose(k + 10.0 * self.right_delay))
        late = self.points[seen] @ T_late[:3, :3].T + T_late[:3, 3]
        moved = focal * late[:, 0] / late[:, 2] + CAMERA.cx - u[seen]
        u_right = xy[:, 0] + moved - CAMERA.bf * (1.0 + self.focal_error) / late[:, 2]
        u_right += rng.normal(0, 0.17, n)
        octave = np.log(30.0 / np.linalg.norm(p[seen], axis=1)) / np.log(1.2) * self.zoom
        bits = np.unpackbits(self.descriptors[seen], axis=1)
        for _ in range(6):
            bits[np.arange(n), rng.integers(0, 256, n)] ^= 1
        return Features(
            xy.astype(np.float32),
            np.clip(np.round(octave), 0, 7).astype(np.uint8),
            np.zeros(n, np.float32),
            np.packbits(bits, axis=1),
            u_right.astype(np.float32),
        )


class Oracle:
    """A detector that knows where each frame was taken, from the index in its image.

    ``frames`` are the places of the frames of the run.
    """

    name = "oracle"

    def __init__(self, ring: Ring, frames: list[float]) -> None:
        self.ring, self.frames = ring, frames

    def add(self, keyframe, image, features):
        pass

    def query(self, keyframe: int, map_: Map) -> list[LoopCandidate]:
        return self._near(map_.frames[keyframe], keyframe, map_, keyframe - 20)

    def locate(self, image, features, map_: Map) -> list[LoopCandidate]:
        return self._near(int(image[0, 0]) | int(image[0, 1]) << 8, -1, map_, map_.n_keyframes)

    def _near(self, frame: int, query: int, map_: Map, last: int) -> list[LoopCandidate]:
        here = self.ring.pose(self.frames[frame])[:3, 3]
        close = set() if query < 0 else set(map_.covisible(query, 15)[0].tolist())
        found = []
        for k in map_.living_keyframes():
            there = self.ring.pose(self.frames[map_.frames[k]])[:3, 3]
            distance = float(np.linalg.norm(here - there))
            if k < last and distance < 3.0 and int(k) not in close:
                found.append(LoopCandidate(query, int(k), -distance))
        return sorted(found, key=lambda candidate: -candidate.score)

    def memory(self) -> DetectorMemory:
        return DetectorMemory(self.name)

    def restore(self, memory: DetectorMemory) -> None:
        pass
