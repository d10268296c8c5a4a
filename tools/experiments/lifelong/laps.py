r"""Drive many laps of a closed route, and record map size, time and error for each lap.

The frames of a rendered route are linked into laps: where the route returns to its beginning, the
last frame is followed by the matching frame of the first pass, so that the motion is continuous.
Times and ground truth continue. With ``--lights N``, lap k is driven in light k mod N: light 0 is
as rendered, the others are ``brightness`` with that seed. ``--incidents`` adds dropped frames,
black images, and jumps to another place of the route, most of them with another light.

    python tools/experiments/lifelong/laps.py --laps 20 --out docs/research/lifelong/laps.csv
    python tools/experiments/lifelong/laps.py --laps 60 --lights 4 --incidents \
        --figure docs/research/lifelong/soak.svg

Features are extracted once for each frame and light; the milliseconds are those of tracking and
mapping. Ctrl-C ends the drive after the current lap, and the results so far are written.
"""

from __future__ import annotations

import argparse
import csv
import resource
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.config import Config, load_config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.errors import InputError
from vslam.evaluation.loops import is_right_loop
from vslam.evaluation.trajectories import evaluate_trajectory
from vslam.features import Extracted, TrackingState, TrackResult
from vslam.frontend.tracking import TrackingContext
from vslam.loopclosure.registry import create_detector
from vslam.machine import available_cores
from vslam.run.preparation import prepared_frames
from vslam.run.warmup import compile_kernels
from vslam.slam import Slam
from vslam.trajectory import Trajectory

DEGREE_M = 0.05  # metres that a degree counts for in the search for the seam
MAX_SEAM_M, MAX_SEAM_DEG = 0.5, 2.0
LIGHT = "brightness:1.0"
BLACK = -1
COLUMNS = (
    "lap", "light", "frames", "new_keyframes", "keyframes", "landmarks", "loops", "wrong_loops",
    "lost", "ate_m", "cpu_ms", "wait_p99_ms", "memory_mb",
)  # fmt: skip


def find_seam(T_wc: NDArray[np.float64]) -> tuple[int, int]:
    """The two frames of a route with the most similar poses, at least half a route apart.

    Args:
        T_wc: ``(N, 4, 4)`` true poses.

    Returns:
        The later frame, and the earlier one at the same place.

    Raises:
        InputError: the route does not return to its beginning.
    """
    half = len(T_wc) // 2
    position, forward = T_wc[:, :3, 3], T_wc[:, :3, 2]
    apart = np.linalg.norm(position[half:, None] - position[None, :half], axis=-1)
    turned = np.degrees(np.arccos(np.clip(forward[half:] @ forward[:half].T, -1.0, 1.0)))
    late, early = np.unravel_index(np.argmin(apart + DEGREE_M * turned), apart.shape)
    if apart[late, early] > MAX_SEAM_M or turned[late, early] > MAX_SEAM_DEG:
        raise InputError(
            "the route does not close on itself: its ends are "
            f"{apart[late, early]:.1f} m and {turned[late, early]:.0f} degrees apart at best."
        )
    return half + int(late), int(early)


@dataclass
class Laps:
    """N frames to drive, without dropped ones, whose times still pass.

    Attributes:
        frame: frame of the route, or BLACK.
        place: frame of the route at whose place the camera is.
        lap: number of the lap, from 1.
        light: 0 is as rendered.
        step: number of the clock tick.
    """

    frame: list[int] = field(default_factory=list)
    place: list[int] = field(default_factory=list)
    lap: list[int] = field(default_factory=list)
    light: list[int] = field(default_factory=list)
    step: list[int] = field(default_factory=list)

    def add(self, place: int, lap: int, light: int, step: int, *, black: bool = False) -> None:
        """Append a frame."""
        self.frame.append(BLACK if black else place)
        self.place.append(place)
        self.lap.append(lap)
        self.light.append(light)
        self.step.append(step)


def plan_laps(seam: tuple[int, int], laps: int, lights: int, seed: int | None = None) -> Laps:
    """Drive from frame 0 to the seam, then in laps.

    Args:
        seam: result of ``find_seam``.
        seed: seed of the incidents, which begin in the third lap; None for no incidents. About once
            in 100 frames, up to 10 frames are dropped or up to 15 are black; once in 400, the
            camera jumps to another place and gets the light of another lap.
    """
    late, early = seam
    length, rng = late - early, np.random.default_rng(seed)
    planned, place, step, black, light = Laps(), 0, 0, 0, 0
    total = late + 1 + (laps - 1) * length
    for done in range(total):
        lap = 1 if done <= late else 2 + (done - late - 1) // length
        if done <= late or (done - late - 1) % length == 0:
            light = (lap - 1) % lights
        if seed is not None and lap > 2:
            chance = rng.random()
            if chance < 0.005:
                step += int(rng.integers(1, 11))
                place += step - planned.step[-1] - 1
            elif chance < 0.01:
                black = int(rng.integers(1, 16))
            elif chance < 0.0125:
                place, light = int(rng.integers(early + 1, late + 1)), int(rng.integers(lights))
        if place > late:
            place -= length
        planned.add(place, lap, light, step, black=black > 0)
        place, step, black = place + 1, step + 1, max(0, black - 1)
    return planned


class PreparedRoute:
    """Features of the frames of a route in each light, extracted on first use."""

    def __init__(self, route: Source, context: TrackingContext, threads: int, seed: int) -> None:
        self._route, self._context, self._threads, self._seed = route, context, threads, seed
        self._lights: dict[int, list[Extracted]] = {}

    def extracted(self, frame: int, light: int) -> Extracted:
        """Features of a frame of the route, or of a black image."""
        if frame == BLACK:
            return Extracted.nothing()
        if light not in self._lights:
            self._lights[light] = list(self._prepare(light))
        return self._lights[light][frame]

    def _prepare(self, light: int) -> Iterator[Extracted]:
        spec = LIGHT if light else "none"
        changed = perturbed(self._route.frames(), parse_perturbation(spec, self._seed + light))
        for _, prepared in prepared_frames(changed, self._context, self._threads):
            assert prepared.images is not None, prepared.problem
            yield prepared.images.extracted


def resident_mb() -> float:
    """Memory of the process (Linux), images and figures included."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


@dataclass
class Drive:
    """The state of a drive: SLAM, its result for each frame, and the ground truth."""

    slam: Slam
    laps: Laps
    seconds: float
    T_wc: NDArray[np.float64]  # of the route
    tracks: list[TrackResult] = field(default_factory=list)

    def row(self, first: int, cpu_s: float) -> list[int | str]:
        """``COLUMNS`` for the frames from ``first`` on; ``ate_m`` and ``wrong_loops`` are for all
        frames so far."""
        slam, done, memory = self.slam, len(self.tracks), resident_mb()
        results = self.tracks[first:]
        waits = [result.stage_ms.get("wait_for_mapping", 0.0) for result in results]
        times = self.seconds * np.array(self.laps.step[:done], np.float64)
        truth = Trajectory(times, self.T_wc[self.laps.place[:done]])
        tracked = np.array([r.state in (TrackingState.OK, TrackingState.WEAK) for r in self.tracks])
        known = np.flatnonzero(tracked)
        error = evaluate_trajectory(slam.trajectory().select(known), truth.select(known))
        loops = [edge for edge in slam.loops if edge.accepted]
        frames = slam.map.frames
        return [
            self.laps.lap[first],
            self.laps.light[first],
            len(results),
            sum(result.is_keyframe for result in results),
            len(slam.map.living_keyframes()),
            len(slam.map.living_landmarks()),
            len(loops),
            sum(not is_right_loop(edge, frames, truth.T_wc) for edge in loops),
            int(np.count_nonzero(~tracked[first:])),
            f"{error.ate_rmse_m:.4f}",
            f"{1e3 * cpu_s / len(results):.1f}",
            f"{np.percentile(waits, 99):.0f}",
            f"{memory:.0f}",
        ]


def drive(run: Drive, prepared: PreparedRoute) -> Iterator[list[int | str]]:
    """Run SLAM over the laps; yields a row at the end of each lap."""
    laps, slam, first, cpu = run.laps, run.slam, 0, 0.0
    for done in range(len(laps.frame)):
        extracted = prepared.extracted(laps.frame[done], laps.light[done])
        start = time.process_time()
        run.tracks.append(slam.step_features(extracted, run.seconds * laps.step[done]))
        cpu += time.process_time() - start
        last = done + 1 == len(laps.frame)
        if last:
            slam.finish()
        # The map can only be read when no keyframe is being mapped, a frame or two later.
        if last or (laps.lap[done] != laps.lap[first] and not slam.is_mapping):
            yield run.row(first, cpu)
            first, cpu = done + 1, 0.0


def draw(rows: list[list[int | str]], path: Path) -> None:
    """Plot map size, cost and memory over the frames."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    column = {name: np.array([float(r[i]) for r in rows]) for i, name in enumerate(COLUMNS)}
    frames = np.cumsum(column["frames"])
    figure, axes = plt.subplots(3, 1, figsize=(7, 6), sharex=True, layout="constrained")
    for axis, name, label in zip(
        axes,
        ("keyframes", "cpu_ms", "memory_mb"),
        ("keyframes in the map", "CPU time per frame (ms)", "memory (MB)"),
        strict=True,
    ):
        axis.plot(frames, column[name], color="#2563eb", linewidth=1.2)
        axis.set_ylim(0, 1.15 * column[name].max())
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[-1].set_xlabel("frames")
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seq", default="demo", help="rendered route")
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--lights", type=int, default=1)
    parser.add_argument("--incidents", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=min(available_cores(), 4))
    parser.add_argument("--config", type=Path)
    parser.add_argument("--out", type=Path, help="CSV table")
    parser.add_argument("--figure", type=Path, help="SVG or PNG")
    options = parser.parse_args()
    try:
        config = Config() if options.config is None else load_config(options.config)
        route = open_sequence("synthetic", Path(), options.seq)
        assert route.ground_truth is not None
        seam = find_seam(route.ground_truth)
    except InputError as error:
        sys.exit(f"error: {error}")
    compile_kernels(processes=1)
    detector = create_detector("bow", config, None, None)
    slam = Slam(route.camera, config, detector, threads=options.threads)
    laps = plan_laps(
        seam, options.laps, options.lights, options.seed if options.incidents else None
    )
    seconds = float(np.median(np.diff(route.timestamps)))
    run = Drive(slam, laps, seconds, route.ground_truth)
    rows: list[list[int | str]] = []
    print(*COLUMNS, sep="\t", flush=True)
    try:
        for row in drive(run, PreparedRoute(route, slam.context, options.threads, options.seed)):
            rows.append(row)
            print(*row, sep="\t", flush=True)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
    waits = [result.stage_ms.get("wait_for_mapping", 0.0) for result in run.tracks]
    print(f"{len(run.tracks)} frames, wait for mapping p99 {np.percentile(waits, 99):.0f} ms")
    if options.out:
        with options.out.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    if options.figure and rows:
        draw(rows, options.figure)


if __name__ == "__main__":
    main()
