"""Localise single images in a map that was made by day, under changes in lighting.

    python tools/experiments/light/day_night.py DATASET SEQ[=MAP_FRAMES] ... --out TABLE.csv

The map is made from the first MAP_FRAMES frames. Each later left image is then localised in the
map, without using other images. If MAP_FRAMES is not given, the map is made from the whole drive,
and all images except its keyframes are localised. The script counts how many poses are right.

A pose counts as right if it is within 2 m and 15 degrees of the ground truth. These limits were
also used in AirSLAM's experiment on map reuse (Xu et al., T-RO 2025, section VII-D). Poses are
compared relative to the nearest frame of the map, so that the drift of the map has no influence.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from vslam.config import as_config
from vslam.datasets import open_sequence
from vslam.datasets.frames import Source
from vslam.datasets.perturbation import parse_perturbation
from vslam.frontend.extraction import FrameImages
from vslam.frontend.relocaliser import Relocaliser
from vslam.loopclosure.learned_verification import LearnedRelocalisation
from vslam.loopclosure.registry import detector_with_images
from vslam.slam import Slam
from vslam.types.camera import Image
from vslam.types.geometry import Matrix, inverse
from vslam.types.track import Track

WITHIN_M, WITHIN_DEG = 2.0, 15.0
LAWS = ("none", "dark:4", "dark:8", "dark:10", "dark:12", "brightness:1.5")


@dataclass(frozen=True)
class Day:
    """A saved map, which was made from a drive by day.

    Attributes:
        path: file of the map.
        T_wc: ``(N, 4, 4)`` poses of the N frames from which the map was made.
        keyframes: indices of the frames that are keyframes.
    """

    path: Path
    T_wc: Matrix
    keyframes: frozenset[int]


def map_of(source: Source, n_frames: int, detector: str, path: Path) -> Day:
    slam = Slam(source.camera, detector=detector)
    for frame in islice(source.frames(), n_frames):
        slam.step(*frame.read(map), frame.timestamp)
    slam.finish()
    slam.save(path)
    n, alive = slam.map.n_keyframes, slam.map.arrays.keyframe_alive
    kept = slam.map.keyframes.frame[:n][alive[:n]]
    return Day(path, slam.trajectory().T_wc, frozenset(kept.tolist()))


class Localiser:
    """Finds the poses of single images in a saved map."""

    def __init__(self, day: Day, detector: str, candidates: int) -> None:
        """Load the map in which images are localised.

        ``candidates`` is the number of keyframes with which an image is compared.
        """
        config = as_config(
            {
                "relocalization": {"max_candidates": candidates},
                "learned": {"max_candidates": candidates, "max_compared": candidates},
                "siamese": {"max_candidates": candidates},
            }
        )
        places, images = detector_with_images(detector, config)
        slam = Slam.load(day.path, config, places, images=images, localize=True)
        self._context, self._map = slam.context, slam.map
        recognise = LearnedRelocalisation(images, slam.context)
        self._relocaliser = Relocaliser(slam.context, places.locate, recognise)

    def pose(self, image: Image) -> Matrix | None:
        """Return the ``(4, 4)`` pose ``T_wc`` of an image; None if localisation fails."""
        images = FrameImages(image, lambda: None, self._context)
        lost = Track(0, 0.0, np.eye(4)).with_features(images.extracted)
        found = self._relocaliser.check(lost, images, self._map, None)
        return None if found.is_lost else inverse(found.T_cw)


def is_right(T_wc: Matrix, k: int, day: Day, truth: Matrix) -> bool:
    """Return whether a pose is within 2 m and 15 degrees of the ground truth.

    Args:
        T_wc: ``(4, 4)`` pose of the image in the world frame of the map.
        k: index of the frame to which the image belongs.
        truth: ``(N, 4, 4)`` true poses of all frames.
    """
    away = np.linalg.norm(truth[: len(day.T_wc), :3, 3] - truth[k, :3, 3], axis=1)
    near = int(np.argmin(away))
    T = inverse(inverse(truth[near]) @ truth[k]) @ inverse(day.T_wc[near]) @ T_wc
    turned = np.degrees(np.arccos(np.clip(0.5 * (np.trace(T[:3, :3]) - 1.0), -1.0, 1.0)))
    return bool(np.linalg.norm(T[:3, 3]) <= WITHIN_M and turned <= WITHIN_DEG)


def rows_of(source: Source, n_map: int | None, options: argparse.Namespace) -> Iterator[list]:
    """Yield a row of the table for each detector, number of candidates and perturbation."""
    n = len(source.timestamps)
    for detector in options.detectors:
        with tempfile.TemporaryDirectory() as folder:
            day = map_of(source, n_map or n, detector, Path(folder) / "map.npz")
            queries = [k for k in range(n_map or 0, n, options.every) if k not in day.keyframes]
            if not queries:
                raise SystemExit(
                    f"{source.name}: no image is left to localise; give a smaller MAP_FRAMES or "
                    "--every."
                )
            for candidates in options.candidates:
                localiser = Localiser(day, detector, candidates)
                for law in options.laws:
                    perturbation = parse_perturbation(law, options.seed).bound_to(source)
                    right = wrong = 0
                    for k in queries:
                        t = float(source.timestamps[k] - source.timestamps[0])
                        image, _ = perturbation.apply(k, t, *source.read(k))
                        T_wc = localiser.pose(image)
                        if T_wc is not None:
                            good = is_right(T_wc, k, day, source.ground_truth)
                            right, wrong = right + good, wrong + (not good)
                    count, recall = len(queries), round(right / len(queries), 3)
                    yield [source.name, law, detector, candidates, count, right, wrong, recall]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("dataset", choices=("kitti", "synthetic"))
    parser.add_argument("drives", nargs="+", metavar="SEQ[=MAP_FRAMES]")
    parser.add_argument("--data", default="", help="folder of KITTI")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--laws", nargs="+", default=LAWS)
    parser.add_argument("--detectors", nargs="+", default=("bow", "capsule", "both"))
    parser.add_argument("--candidates", nargs="+", type=int, default=(3, 5, 10))
    parser.add_argument("--every", type=int, default=8, help="localise every n-th image")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="table to write")
    options = parser.parse_args()
    options.out.write_text("sequence,law,detector,candidates,images,right,wrong,recall\n")
    for drive in options.drives:
        name, _, n_map = drive.partition("=")
        source = open_sequence(options.dataset, options.data, name, max_frames=options.max_frames)
        for row in rows_of(source, int(n_map) if n_map else None, options):
            with options.out.open("a", newline="") as file:
                csv.writer(file, lineterminator="\n").writerow(row)
            print(*row, sep="\t", flush=True)


if __name__ == "__main__":
    main()
