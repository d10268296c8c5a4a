"""Count the right and wrong best images that pass each threshold of the learned image test.

    python tools/experiments/online/image_test_shares.py block+change:1+seed:18:4:6 05:8:20 ...

Arguments are DRIVE:STEP:SECONDS. As in ``vslam loops bench --protocol online``, every STEP-th frame
of a drive is a query among the images that are at least SECONDS older. Two images are chosen by
`capsule`: the best one at the same place (within 5 m and 30 degrees) and the best one elsewhere (25
m or 60 degrees away). For each threshold on the share of coarse cells that one homography explains,
the numbers of both that pass are printed. Drives must be rendered (`vslam synth`).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from vslam.config import LearnedMatchingConfig
from vslam.datasets.synthetic import parse_drive
from vslam.datasets.synthetic.store import cache_folder, folder_name
from vslam.loopclosure.local_matching import DescriptorMaps, homography_share, match_coarse
from vslam.loopclosure.siamese.images import read_grey, to_size
from vslam.loopclosure.siamese.inference import open_network
from vslam.loopclosure.siamese.local_descriptors import LocalDescriptors

RATE = 10.0  # frames a second
LEAST = 5  # images to choose from
THRESHOLDS = np.arange(0.10, 0.41, 0.02)


def shares(tree: Path, route: str, step: int, seconds: float) -> tuple[list[float], list[float]]:
    """Shares of the best right image of each frame that has one, and of its best wrong image."""
    capsule, local = open_network("capsule"), LocalDescriptors()
    least = LearnedMatchingConfig().coarse_alike
    files = sorted((tree / "sequences" / route / "image_0").iterdir())[::step]
    poses = np.loadtxt(tree / "poses" / f"{route}.txt").reshape(-1, 3, 4)[::step]
    maps: list[DescriptorMaps] = []
    descriptors = np.empty((len(files), capsule.dimensions), np.float32)
    right: list[float] = []
    wrong: list[float] = []
    window = round(seconds * RATE / step)
    for k, file in enumerate(files):
        image = read_grey(file)
        descriptors[k] = capsule.embed(to_size(image, capsule.size))
        maps.append(local.describe(image).coarse_alone())
        n = k - window
        if n < LEAST:
            continue
        p = capsule.compare(descriptors[k], descriptors[:n])
        away = np.linalg.norm(poses[:n, :, 3] - poses[k, :, 3], axis=1)
        trace = np.einsum("nij,ij->n", poses[:n, :, :3], poses[k, :, :3])
        turned = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
        for found, among in (
            (right, (away < 5) & (turned < 30)), (wrong, (away > 25) | (turned > 60)),
        ):  # fmt: skip
            if among.any():
                best = maps[int(np.argmax(np.where(among, p, -1)))]
                coarse = match_coarse(maps[k], best, least)
                found.append(homography_share(coarse, maps[k], best))
    return right, wrong


def main() -> None:
    for given in sys.argv[1:]:
        drive, step, seconds = given.rsplit(":", 2)
        route, variation = parse_drive(drive)
        right, wrong = shares(
            cache_folder() / folder_name(variation), route, int(step), float(seconds)
        )
        print(f"{drive}: {len(right)} right, {len(wrong)} wrong")
        for least in THRESHOLDS:
            passed = [sum(one >= least for one in found) for found in (right, wrong)]
            print(f"  {least:.2f}: right {passed[0]}, wrong {passed[1]}")


if __name__ == "__main__":
    main()
