"""Drive a route in parts, each in another light, and measure how well their maps are merged.

    vslam synth 05                                    # once
    python tools/experiments/maps/merge_drives.py 05 --parts 4

The parts overlap by ``--overlap`` frames, and meet where the route returns. The brightness of each
part changes with another seed; one long drive with the seed of the first part is the reference.
Prints which pairs of drives truly meet, which pairs are joined by their own loops, the wrong loops,
and the ATE (m) of the keyframes of each drive alone, of the merged map, and of the long drive.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.evaluation.loops import LoopLimits, is_right_loop
from vslam.evaluation.trajectories import evaluate_trajectory, path_length
from vslam.geometry import inverses
from vslam.loopclosure.registry import detector_with_images
from vslam.loops import LoopEdge
from vslam.map import Map
from vslam.maps.stored_map import StoredMap
from vslam.merging import MergedMaps, merge_maps
from vslam.run.preparation import prepared_frames
from vslam.slam import Slam
from vslam.trajectory import Trajectory

LIMITS = LoopLimits()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("routes", nargs="+", help="if several, they must not be joined")
    parser.add_argument("--parts", type=int, default=4)
    parser.add_argument("--overlap", type=int, default=100, help="frames")
    parser.add_argument("--detector", default="bow")
    parser.add_argument("--perturb", default="brightness:1")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--without-whole", action="store_true", help="no long drive to compare")
    options = parser.parse_args()
    drives, maps, whole = [], [], None
    for route in options.routes:
        sequence = open_sequence("synthetic", None, route, max_frames=options.max_frames)
        if whole is None and not options.without_whole:
            whole = drive(sequence, range(len(sequence)), options.detector, options.perturb, 0)
        for number, frames in enumerate(parts(len(sequence), options.parts, options.overlap)):
            drives.append((sequence, frames, route))
            maps.append(drive(sequence, frames, options.detector, options.perturb, number))
            truth = sequence.ground_truth[maps[-1].map.frames]
            name = f"{route}, frames {frames.start} to {frames[-1]}"
            print(f"{name}: ATE {ate(maps[-1].map, truth):.4f} m", flush=True)
    merged = merge_maps(maps, Config(), lambda: memory(options.detector))
    tell(merged, drives, whole)


def parts(n: int, number: int, overlap: int) -> list[range]:
    ends = np.linspace(0, n, number + 1).round().astype(int).tolist()
    return [range(max(0, first - overlap), last) for first, last in pairwise(ends)]


def memory(detector: str):
    return detector_with_images(detector, Config())


def lit_frames(sequence: Source, frames: range, perturb: str, seed: int) -> Iterator[TimedFrame]:
    """Some frames of a sequence, in a light drawn from the seed."""
    some = (frame for k, frame in enumerate(sequence.frames()) if k in frames)
    return perturbed(some, parse_perturbation(perturb, seed))


def drive(sequence: Source, frames: range, detector: str, perturb: str, seed: int) -> StoredMap:
    made, images = memory(detector)
    slam = Slam(sequence.camera, Config(), made, images=images)
    lit = lit_frames(sequence, frames, perturb, seed)
    for timestamp, prepared in prepared_frames(lit, slam.context, 2):
        slam.step_images(prepared.images, timestamp)
    slam.finish()
    stored = slam.stored_map(f"{sequence.name} {frames.start}-{frames[-1]}").compact()
    stored.map.frames[:] = [frames[k] for k in stored.map.frames]
    return stored


def tell(merged: MergedMaps, drives, whole: StoredMap | None) -> None:
    order = [0, *merged.joined]
    truth = [sequence.ground_truth for sequence, _, _ in drives]
    met = true_meetings(drives)
    map_ = merged.stored.map
    print(f"joined {merged.joined}, left out {merged.left_out}")
    pairs: dict[tuple[int, int], list[bool]] = {}
    for loop in merged.stored.loops:
        ends = [order[map_.sessions[k]] for k in (loop.query, loop.match)]
        if ends[0] != ends[1]:
            pair = (min(ends), max(ends))
            pairs.setdefault(pair, []).append(is_right(loop, map_, order, truth))
    print(f"pairs of drives that truly meet: {sorted(met)}")
    print(f"joined by loops of their own:    {sorted(pairs)}")
    loops = [right for found in pairs.values() for right in found]
    print(f"{len(loops)} loops between drives, {loops.count(False)} wrong")
    if len({route for _, _, route in drives}) == 1:
        kept = [truth[order[s]][f] for s, f in zip(map_.sessions, map_.frames, strict=True)]
        print(f"keyframes of the merged map: ATE {ate(map_, np.array(kept)):.4f} m")
    if whole is not None:
        frames = whole.map.frames
        print(f"keyframes of one long drive: ATE {ate(whole.map, truth[0][frames]):.4f} m")


def true_meetings(drives) -> set[tuple[int, int]]:
    """Pairs of drives that, over at least 20 m, are within 5 m and 30 degrees of each other."""
    from scipy.spatial import cKDTree

    met = set()
    for i, j in combinations(range(len(drives)), 2):
        (one, frames, route), (other, others, other_route) = drives[i], drives[j]
        if route != other_route:
            continue
        T, U = one.ground_truth[list(frames)], other.ground_truth[list(others)]
        distance, nearest = cKDTree(U[:, :3, 3]).query(T[:, :3, 3])
        cosine = np.einsum("ni,ni->n", T[:, :3, 2], U[nearest, :3, 2])
        near = distance <= LIMITS.max_lateral_m
        near &= cosine >= np.cos(np.radians(LIMITS.max_heading_deg))
        if np.diff(path_length(T), prepend=0.0)[near].sum() >= LIMITS.min_length_m:
            met.add((i, j))
    return met


def is_right(loop: LoopEdge, map_: Map, order: list[int], truth) -> bool:
    ends = [truth[order[map_.sessions[k]]][map_.frames[k]] for k in (loop.query, loop.match)]
    return is_right_loop(replace(loop, query=0, match=1), np.arange(2), np.stack(ends)) is True


def ate(map_: Map, T_true: np.ndarray) -> float:
    T_wc = inverses(map_.arrays.T_cw[: map_.n_keyframes])
    times = np.arange(float(len(T_wc)))  # because each drive has its own clock
    return evaluate_trajectory(Trajectory(times, T_wc), Trajectory(times, T_true), "se3").ate_rmse_m


if __name__ == "__main__":
    main()
