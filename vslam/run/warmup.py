"""Compiles all kernels before the first frame, so that compilation does not slow down the run.

In the first run on a machine, compilation takes most of the time. A process compiles one kernel at
a time, because Numba holds a lock. Therefore, two processes share the work through Numba's cache.
These processes run ``python -m vslam.run.warmup first`` and ``python -m vslam.run.warmup second``.
The process of the run then calls ``EVERYTHING``, which loads the compiled kernels. This process
compiles only missing kernels, so it does not need the memory of the compiler. Later runs load a
kernel when they first call it.

When you add kernels, add a function that calls them to the entry of ``COMPILE_SHARES`` that takes
less time. If ``run_everything`` does not call the kernels, add this function to ``EVERYTHING`` as
well. If the kernels form a new module, add the last kernel of the module to ``COLD_PROBES``. These
commands show how long each share takes:

    for share in first second; do
        time NUMBA_CACHE_DIR=$(mktemp -d) python -m vslam.run.warmup $share
    done

Monocular runs need no further kernels. Their initialisation, and the similarity transformations of
their loops, are computed with NumPy.

A kernel that both processes need is compiled by the process that calls it first. Both processes
must call the kernel with the same types. If two processes save different signatures of a kernel at
the same time, one signature is lost and must be compiled again.
"""

from __future__ import annotations

import gc
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np

from vslam.backend import (
    block_cholesky,
    bundle_adjustment,
    global_bundle_adjustment,
    global_mapping,
)
from vslam.backend.bundle_adjustment import BundleProblem, adjust
from vslam.backend.fusion import fuse_loop
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import apply_solution, take_snapshot
from vslam.backend.loop_correction import move_keyframes
from vslam.backend.pose_graph import check_pose_graph, essential_graph, load_optimiser
from vslam.config import Config, DepthConfig, KeyframeConfig, MappingConfig, TrackingConfig
from vslam.datasets.png import unfilter
from vslam.frontend import pnp
from vslam.frontend.depth import columns_of_depth
from vslam.frontend.pose import MIN_TRUSTED, optimise_pose
from vslam.frontend.relocaliser import relocalised
from vslam.loopclosure import bow, local_matching, sim3_ransac
from vslam.loopclosure.bow import BowDetector
from vslam.loopclosure.detector import NoDetector
from vslam.loopclosure.local_matching import DescriptorMaps, locate, locate_near, match_coarse
from vslam.loopclosure.verification import verify
from vslam.loopclosure.verifier import Verifier
from vslam.loopclosure.vocabulary import Vocabulary, from_children
from vslam.method.closing import LoopClosing
from vslam.method.mapping import Mapper
from vslam.slam import Slam
from vslam.support.machine import available_cores
from vslam.support.workers import Workers
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Extracted, Features, TrackingState
from vslam.types.loops import LoopCandidate, LoopEdge
from vslam.types.map import Map
from vslam.types.map_view import local_map
from vslam.types.track import Track

WIDTH, HEIGHT, DISPARITY, STEP, FRAMES = 480, 240, 12, 6, 6
CAMERA = Camera(240.0, 240.0, WIDTH / 2, HEIGHT / 2, 0.5, WIDTH, HEIGHT)
# A process that takes longer hangs. Even on a slow machine, each share takes less than a minute.
PATIENCE_S = 300.0


def compile_kernels(*, processes: int = 2, load: bool = False) -> None:
    """Call every kernel once, so that Numba compiles it and keeps it in its cache.

    Nothing is done if all kernels have been compiled.

    Args:
        processes: number of processes that compile. If it is 1, or if there is a single core, no
            other process is started.
        load: if True, compiled kernels and GTSAM are loaded now, which takes 0.3 s. Real-time runs
            need this, because no frame may wait. If False, each kernel is loaded at its first call,
            which takes 2 ms.
    """
    if load:
        load_optimiser()
    if not is_cold():
        for share in EVERYTHING if load else ():
            share()
        return
    if processes > 1 and available_cores() > 1:
        compile_shares()
    for share in EVERYTHING:
        share()
    mark_warm()


def is_cold() -> bool:
    """Return whether one of ``COLD_PROBES`` is missing in the cache or older than its source."""
    return any(
        all(index.stat().st_mtime < source.stat().st_mtime for index in indexes)
        for source, indexes in map(cached, COLD_PROBES)
    )


def mark_warm() -> None:
    """Update the dates of the cached kernels, so that ``is_cold`` accepts them as compiled.

    If only the date of a source file has changed, for example by switching branches, Numba keeps
    the cached kernel and its date.
    """
    for _, indexes in map(cached, COLD_PROBES):
        for index in indexes:
            with suppress(OSError):
                index.touch()


def cached(kernel: tuple[ModuleType, str]) -> tuple[Path, list[Path]]:
    """Return the source file of a kernel, and the index files of this kernel in Numba's cache."""
    module, name = kernel
    source = Path(str(module.__file__))
    folder = Path(getattr(module, name).stats.cache_path)
    return source, list(folder.glob(f"{source.stem}.{name}-*.nbi"))


def compile_shares() -> None:
    """Compile each of ``COMPILE_SHARES`` in its own process, and wait for both processes.

    If a process fails, its kernels are not compiled, and the caller must compile them. An exception
    such as Ctrl-C ends both processes.
    """
    # The executable of a frozen application is not Python.
    if not sys.executable or getattr(sys, "frozen", False):
        return
    processes = []
    quiet = subprocess.DEVNULL
    try:
        for name in COMPILE_SHARES:
            # -P: do not import a folder "vslam" in the current directory.
            command = [sys.executable, "-P", "-m", "vslam.run.warmup", name]
            process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
            processes.append(process)
        for process in processes:
            process.wait(PATIENCE_S)
    except (OSError, subprocess.TimeoutExpired):
        pass
    finally:
        for process in processes:
            process.kill()
            process.wait()


_FEATURES = TrackingConfig(method="orb")


def run_everything() -> None:
    """Run SLAM on a few small images of a camera that moves sideways along a textured wall.

    Each image becomes a keyframe. Therefore, the run calls all kernels of tracking, triangulation,
    fusion and bundle adjustment.
    """
    every_frame = KeyframeConfig(max_interval_s=0.05, publish_after_frames=1)
    run_slam(Config(keyframes=every_frame, tracking=_FEATURES), FRAMES)
    compile_patches()
    decode_image()


def compile_tracking() -> None:
    """Compile feature extraction, stereo matching and tracking by a SLAM run with one keyframe."""
    decode_image()
    only_first = KeyframeConfig(max_interval_s=1e9, max_tracked_ratio=1e-6, min_tracked_close=0)
    run_slam(Config(keyframes=only_first, tracking=_FEATURES), 3)


def compile_patches() -> None:
    """Compile tracking by patches, by a SLAM run on a few images of a wall."""
    run_slam(Config(tracking=TrackingConfig(method="patches")), FRAMES)


def decode_image() -> None:
    """Compile the decoder of PNG files, by decoding two lines."""
    unfilter(np.zeros((2, 5), np.uint8), np.empty((2, 4), np.uint8))


def run_slam(config: Config, frames: int) -> None:
    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (HEIGHT, WIDTH + DISPARITY + STEP * FRAMES)).astype(np.float32)
    wall = cv2.GaussianBlur(noise, (0, 0), 2.0)
    wall = np.clip(128 + 5.0 * (wall - 128), 0, 255).astype(np.uint8)
    slam = Slam(CAMERA, config, "none", threads=1)
    for k in range(frames):
        x = STEP * k
        left, right = wall[:, x : x + WIDTH], wall[:, x + DISPARITY : x + DISPARITY + WIDTH]
        slam.step(np.ascontiguousarray(left), np.ascontiguousarray(right), 0.1 * k)
    slam.finish()
    slam.trajectory()


def compile_trusted_pose() -> None:
    """Compile the search for a pose by trusted landmarks, beside an object that moves."""
    points = np.random.default_rng(0).uniform([-4.0, -2.0, 9.0], [4.0, 2.0, 12.0], (200, 3))
    trusted = np.arange(len(points)) < 2 * MIN_TRUSTED
    uvr = CAMERA.project(points + np.where(trusted, 0.0, 0.5)[:, None])
    weights = np.ones(len(points))
    optimise_pose(np.eye(4), points, uvr, weights, CAMERA.intrinsics, trusted=trusted)


def compile_depth() -> None:
    """Compile the kernels that take the depths of keypoints from a depth image."""
    depth, scale = np.ones((8, 8), np.float32), np.ones(1)
    columns_of_depth(np.zeros((1, 2), np.float32), scale, depth, CAMERA, DepthConfig())


def compile_insertion() -> None:
    """Compile the insertion of a keyframe, which is part of tracking."""
    map_synthetic(1)


def compile_local_mapping() -> None:
    """Compile local mapping: triangulation, fusion, bundle adjustment and culling."""
    map_synthetic(4)


def map_synthetic(keyframes: int) -> tuple[Map, Features]:
    """Build the map of a camera that moves sideways past a cloud of points. No images are needed.

    Half of the points have a stereo match. The other points must be triangulated. The thresholds
    are such that the fourth insertion culls a keyframe.

    Returns:
        The map and the features of the last keyframe.
    """
    config = Config(mapping=MappingConfig(redundant_ratio=1e-6))
    context = Context.create(CAMERA, config)
    closing = LoopClosing(NoDetector(), Verifier(context), context, threads=1)
    mapper = Mapper(context, closing, Workers(1))
    rng = np.random.default_rng(0)
    n = 400
    points = rng.uniform([-5.0, -4.0, 9.0], [9.0, 4.0, 12.0], (n, 3))
    descriptors = rng.integers(0, 256, (n, 32), dtype=np.uint8)
    landmark = np.full(n, -1, np.int32)
    for k in range(keyframes):
        T_cw = np.eye(4)
        T_cw[0, 3] = -1.0 * k
        uvr = CAMERA.project(points + T_cw[:3, 3])
        uvr[n // 2 :, 2] = np.nan
        features = Features(
            uvr[:, :2].astype(np.float32),
            np.zeros(n, np.uint8),
            np.zeros(n, np.float32),
            descriptors,
            uvr[:, 2].astype(np.float32),
        )
        seen = Track(k, 0.1 * k, T_cw, state=TrackingState.OK).with_features(Extracted(features))
        track = replace(seen, landmark=landmark)
        mapper.published.record(track)
        (track,) = mapper.published.complete(mapper.insert(track, None))
        landmark = track.landmark
    return mapper.published.map, features


def compile_recognition() -> None:
    """Compile loop detection, verification and relocalisation."""
    context = Context.create(CAMERA, Config())
    map_, features = map_synthetic(1)
    verify(map_, LoopCandidate(0, 0, 1.0), context)

    place = local_map(map_, 0, 1)
    lost = Track(0, 0.0, np.eye(4)).with_features(Extracted(features))
    relocalised(lost, place, place, context, seed=0)

    detector = BowDetector(smallest_vocabulary())
    detector.add(0, None, features)
    detector.query(0, map_)


def compile_learned_matching() -> None:
    """Compile the matching of learned descriptors, with random descriptors."""
    rng = np.random.default_rng(0)
    coarse, fine = (rng.standard_normal((rows, 2 * rows, 4), np.float32) for rows in (4, 16))
    maps = DescriptorMaps(coarse, fine, 1.0)
    xy = np.full((2, 2), 20.0, np.float32)
    locate(xy, maps, maps, match_coarse(maps, maps, -1.0), 1, -1.0)
    locate_near(xy, np.full((2, 2), 20.0), maps, maps, 1, -1.0)


def compile_correction() -> None:
    """Compile the kernels of ``LoopClosing``: pose graph, loop fusion, global bundle adjustment.

    GTSAM is not called, because it takes a second to import and has nothing to compile.
    """
    config = Config()
    map_, _ = map_synthetic(3)
    nothing = np.empty(0, np.int32)
    edge = LoopEdge(
        2, 0, 1.0, True, "", T_query_match=np.eye(4), features=nothing, landmarks=nothing
    )
    graph = essential_graph(map_, [edge], config.pose_graph)
    check_pose_graph(graph, graph.T_cw, config.pose_graph)
    move_keyframes(map_, graph.keyframes, graph.T_cw)
    fuse_loop(map_, edge, [2], [0], Context.create(CAMERA, config))
    snapshot = take_snapshot(map_, CAMERA)
    apply_solution(map_, snapshot, adjust_globally(snapshot.problem, iterations=1))


def smallest_vocabulary() -> Vocabulary:
    """Return a vocabulary of two words, which is enough to compile the kernels."""
    centres = np.array([[0] * 4, [0] * 4, [2**64 - 1] * 4], np.uint64)
    return from_children(2, 1, centres, np.array([2, 0, 0], np.uint8), np.ones(2, np.float32))


def compile_bundle_adjustment() -> None:
    """Compile bundle adjustment with a problem of one free camera and two points."""
    points = np.array([[-1.0, 0.5, 8.0], [1.0, -0.5, 9.0]])
    uvr = np.repeat(CAMERA.project(points), 2, axis=0)
    problem = BundleProblem(
        T_cw=np.stack([np.eye(4), np.eye(4)]),
        n_free=1,
        points=points,
        first=np.array([0, 2, 4], np.int64),
        camera=np.array([0, 1, 0, 1], np.int64),
        uvr=uvr,
        inverse_sigma2=np.ones(4),
        intrinsics=CAMERA.intrinsics,
    )
    adjust(problem, iterations=1)


# The second process starts with kernels that the first process does not need. The first process
# starts with the insertion of keyframes, so that the kernels of the insertion are cached before the
# second process calls them.
COMPILE_SHARES: dict[str, tuple[Callable[[], None], ...]] = {
    "first": (
        compile_insertion,
        compile_tracking,
        compile_trusted_pose,
        compile_depth,
        compile_recognition,
    ),
    "second": (
        compile_bundle_adjustment,
        compile_local_mapping,
        compile_correction,
        compile_learned_matching,
        compile_patches,
    ),
}
EVERYTHING: tuple[Callable[[], None], ...] = (
    run_everything,
    compile_trusted_pose,
    compile_depth,
    compile_recognition,
    compile_learned_matching,
    compile_correction,
)
# The last kernel to be compiled in each module that takes long to compile.
COLD_PROBES: tuple[tuple[ModuleType, str], ...] = (
    (bundle_adjustment, "_adjust"),
    (sim3_ransac, "_ransac"),
    (pnp, "ransac_pose"),
    (bow, "choose_candidates"),
    (local_matching, "_locate_near"),
    (global_bundle_adjustment, "reduce_points_sparsely"),
    (block_cholesky, "factor_solve"),
    (global_mapping, "remove_unchanged"),
)


if __name__ == "__main__":
    # Garbage collection would take 14 % of the time, but free little memory.
    gc.disable()
    for share in COMPILE_SHARES[sys.argv[1]]:
        share()
