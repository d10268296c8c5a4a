"""Drive a route that closes on itself for ever: what the map, the time and the error do, by lap.

The frames of a rendered route are linked into laps: where the route passes its own beginning again,
its last frame is followed by the next one of the first pass, so that nothing leaps. Times and
ground truth go on. ``--perturb`` runs on over the laps: a walk of brightness shows each of them in
another light.

    python tools/laps.py --seq demo --laps 20 --out laps.csv
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.camera import Camera, DepthImage, Image, ImageMap
from vslam.config import Config, load_config
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import TimedFrame, timed_frames
from vslam.errors import InputError
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.features import TrackingState, TrackResult
from vslam.loopclosure.registry import create_detector, create_images
from vslam.machine import available_cores, peak_memory_mb
from vslam.run.pipeline import PreparedFrame, prepared_frames
from vslam.run.warmup import compile_kernels
from vslam.slam import Slam
from vslam.trajectory import Trajectory

DEGREE = 0.05  # m that a degree counts for, where the seam is looked for
MAX_SEAM_M, MAX_SEAM_DEG = 0.5, 2.0
COLUMNS = (
    "lap", "frames", "new_keyframes", "keyframes", "landmarks", "loops", "lost", "ate_m",
    "cpu_ms", "wait_p99_ms", "memory_mb",
)  # fmt: skip


def find_seam(T_wc: NDArray[np.float64]) -> tuple[int, int]:
    """The two frames of a route that are most alike in pose, half a route apart at least.

    Args:
        T_wc: ``(N, 4, 4)`` true poses.

    Returns:
        The later frame and the earlier one that it lies on.

    Raises:
        InputError: the route does not pass its beginning again.
    """
    half = len(T_wc) // 2
    position, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    apart = np.linalg.norm(position[half:, None] - position[None, :half], axis=-1)
    turned = np.degrees(np.arccos(np.clip(forward[half:] @ forward[:half].T, -1.0, 1.0)))
    late, early = np.unravel_index(np.argmin(apart + DEGREE * turned), apart.shape)
    if apart[late, early] > MAX_SEAM_M or turned[late, early] > MAX_SEAM_DEG:
        raise InputError(
            "the route does not close on itself: its ends are "
            f"{apart[late, early]:.1f} m and {turned[late, early]:.0f} degrees apart at best."
        )
    return half + int(late), int(early)


@dataclass(frozen=True)
class Laps:
    """A route driven several times (``vslam.datasets.sequence.Sequence``).

    Attributes:
        route: the frames to be had.
        frames: ``(N,)`` int64, frame of the route that each frame of the laps is.
        lap: ``(N,)`` int64, from 1.
        timestamps: ``(N,)`` seconds.
    """

    route: Sequence
    frames: NDArray[np.int64]
    lap: NDArray[np.int64]
    timestamps: NDArray[np.float64]

    @classmethod
    def of(cls, route: Sequence, laps: int) -> Laps:
        """Link a route into laps, the first from its first frame to its last.

        Raises:
            InputError: no ground truth, or a route that does not close on itself.
        """
        if route.ground_truth is None:
            raise InputError(f"{route.name}: laps need the ground truth; it has none.")
        late, early = find_seam(route.ground_truth)
        first, later = np.arange(late + 1), np.arange(early + 1, late + 1)
        frames = np.concatenate([first, *[later] * (laps - 1)])
        lap = np.concatenate(
            [np.full(len(first), 1)] + [np.full(len(later), k) for k in range(2, laps + 1)]
        )
        step = np.median(np.diff(route.timestamps))
        return cls(route, frames, lap, route.timestamps[0] + step * np.arange(len(frames)))

    @property
    def dataset(self) -> str:
        return self.route.dataset

    @property
    def name(self) -> str:
        return f"{self.route.name}-laps"

    @property
    def camera(self) -> Camera:
        return self.route.camera

    @property
    def ground_truth(self) -> NDArray[np.float64]:
        assert self.route.ground_truth is not None
        return self.route.ground_truth[self.frames]

    def __len__(self) -> int:
        return len(self.frames)

    def read(
        self, index: int, image_map: ImageMap = map
    ) -> tuple[Image, Image | DepthImage | None]:
        return self.route.read(int(self.frames[index]), image_map)


def lap_row(
    slam: Slam, laps: Laps, tracks: list[TrackResult], first: int, cpu_s: float
) -> list[float | int | str]:
    """What one lap, the frames from ``first`` on, did to the map (``COLUMNS``); ``ate_m`` is that
    of all frames so far."""
    results = tracks[first:]
    waits = [result.stage_ms.get("wait_for_mapping", 0.0) for result in results]
    truth = Trajectory(laps.timestamps[: len(tracks)], laps.ground_truth[: len(tracks)])
    error = evaluate_trajectory(slam.trajectory(), truth)
    return [
        int(laps.lap[first]),
        len(results),
        sum(result.is_keyframe for result in results),
        len(slam.map.living_keyframes()),
        len(slam.map.living_landmarks()),
        len(slam.corrections),
        sum(result.state == TrackingState.LOST for result in results),
        f"{error.ate_rmse_m:.4f}",
        f"{1e3 * cpu_s / len(results):.1f}",
        f"{np.percentile(waits, 99):.0f}",
        f"{peak_memory_mb():.0f}",
    ]


def drive(laps: Laps, config: Config, perturb: str, seed: int, threads: int, detector: str):
    """Run SLAM over the laps; yields a row when each is done."""
    images = create_images(detector, config)
    slam = Slam(
        laps.camera, config, create_detector(detector, config, None, images),
        threads=threads, images=images,
    )  # fmt: skip
    perturbation = parse_perturbation(perturb, seed)
    known: dict[int, PreparedFrame] = {}  # unperturbed, a lap looks like the one before

    def frames():
        unread = perturbed(timed_frames(laps), perturbation)
        if perturbation.laws:
            yield from prepared_frames(unread, slam.context, threads)
            return
        first = np.unique(laps.frames, return_index=True)[1]
        n_new = int(first.max()) + 1
        for index, prepared in enumerate(
            prepared_frames((f for f, _ in zip(unread, range(n_new))), slam.context, threads)
        ):
            known[int(laps.frames[index])] = replace(prepared[1], left=None)
            yield prepared
        for index in range(n_new, len(laps)):
            yield float(laps.timestamps[index]), known[int(laps.frames[index])]

    tracks: list[TrackResult] = []
    first, cpu = 0, 0.0
    for timestamp, frame in frames():
        assert frame.features is not None
        start = time.process_time()
        tracks.append(slam.step_features(frame.features, timestamp, frame.left))
        cpu += time.process_time() - start
        done = len(tracks)
        if done == len(laps):
            slam.finish()
        if done == len(laps) or laps.lap[done] != laps.lap[first]:
            while slam.is_mapping:
                slam._merge()
            yield lap_row(slam, laps, tracks, first, cpu)
            first, cpu = done, 0.0
    drive.tracks, drive.slam = tracks, slam


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seq", default="demo", help="rendered route")
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--perturb", default="none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--detector", default="bow")
    parser.add_argument("--threads", type=int, default=min(available_cores(), 4))
    parser.add_argument("--config", type=Path)
    parser.add_argument("--out", type=Path, help="CSV")
    options = parser.parse_args()
    config = Config() if options.config is None else load_config(options.config)
    try:
        route = open_sequence("synthetic", Path(), options.seq)
        laps = Laps.of(route, options.laps)
    except InputError as error:
        sys.exit(str(error))
    compile_kernels(processes=1)
    rows = []
    print(*COLUMNS, sep="\t", flush=True)
    for row in drive(
        laps, config, options.perturb, options.seed, options.threads, options.detector
    ):
        rows.append(row)
        print(*row, sep="\t", flush=True)
    waits = [result.stage_ms.get("wait_for_mapping", 0.0) for result in drive.tracks]
    ks = [result.stage_ms.get("keyframe", 0.0) for result in drive.tracks]
    print(
        f"wait for mapping: p99 {np.percentile(waits, 99):.0f} ms, max {max(waits):.0f}; keyframe p99 {np.percentile(ks, 99):.0f}"
    )
    if options.out:
        with options.out.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *rows])
    e = [x for x in drive.slam.loops if x.accepted]
    print([(x.query, x.match) for x in e], len(drive.slam.loops))


if __name__ == "__main__":
    main()
