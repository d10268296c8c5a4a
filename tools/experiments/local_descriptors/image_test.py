"""Compare tests that decide whether two photographs show the same place.

    python tools/experiments/local_descriptors/image_test.py PHOTOS multiview webcams

PHOTOS is a folder of sets of photographs, with the images in SET/PLACE/. Half of the places are the
tuning half, on which the threshold of the test was chosen. The others are the test half. Images of
two halves are not paired. Every image is a query. Each query is paired with a right image and with
two wrong images. Similarities are computed using the capsule network.

- The right image is the most similar image of the same place. The viewpoint of a webcam never
  changes. Therefore, for a webcam, the right image is one that was taken at a different hour, and
  the query is warped.
- The wrong images are the two most similar images of other places. Places whose names agree up to
  ``__`` may overlap, so they are not paired.

For each half of a set, the script prints how many right and how many wrong pairs pass each test:

- ORB: 20 matches fit one epipolar geometry.
- cells: 90 matches of the cells of a coarse grid of learned descriptors fit one homography.
- confirmed: the number of these cells, multiplied by the share of the fine matches that fit one
  homography, is at least 28 (``confirmed_cells``).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.local_matching import homography_inliers, match_coarse
from vslam.loopclosure.vocabulary import load
from vslam_lab.loopbench.detectors import LocalDescriptorCache, NetworkScorer, describe
from vslam_lab.loopbench.measure import (
    LEAST_COSINE,
    MIN_CONFIRMED,
    MIN_MATCHES,
    confirmed_cells,
    epipolar_inliers,
)

MIN_CELLS = 90
WEBCAMS = "webcams"
HALVES = "tuning", "test"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--of-place", type=int, default=10, help="images of a place, at most")
    options = parser.parse_args()
    print("| set | half | right pairs | ORB, cells, confirmed | wrong pairs | "
          "ORB, cells, confirmed |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    for name in options.sets:
        for half, title in enumerate(HALVES):
            cells = [
                f"{len(passed)} | {', '.join(str(n) for n in passed.sum(axis=0))}"
                for passed in measure(options.photos / name, options.of_place, half)
            ]
            print(f"| {name} | {title} | {' | '.join(cells)} |", flush=True)


def measure(folder: Path, of_place: int, half: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Apply the tests to all pairs of one half of a set of photographs.

    Returns:
        Two ``(N, 3)`` bool arrays, for the right and for the wrong pairs: whether a pair passes
        each test.
    """
    names = sorted({path.name.split("__")[0] for path in folder.iterdir() if path.is_dir()})
    drawn = np.random.default_rng(7).permutation(len(names)) % 2
    chosen = {name for name, of in zip(names, drawn, strict=True) if of == half}
    gallery, places = [], []
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        if place.name.split("__")[0] not in chosen:
            continue
        files = sorted(place.iterdir())
        for file in files[:: -(-len(files) // of_place)]:
            gallery.append(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
            places.append(place.name)
    rng, place = np.random.default_rng(0), np.array(places)
    group = np.array([name.split("__")[0] for name in places])
    queries = [warped(image, rng) for image in gallery] if folder.name == WEBCAMS else gallery
    scorer, local, vocabulary = NetworkScorer("capsule"), LocalDescriptorCache(), load()
    of_queries, of_gallery = (describe(images, vocabulary, 1) for images in (queries, gallery))
    stored = scorer.embed(gallery)
    pairs: tuple[list[tuple[bool, bool, bool]], ...] = ([], [])
    for q, embedded in enumerate(scorer.embed(queries)):
        order = np.argsort(-scorer.compare(embedded, stored))
        same, other = order[place[order] == place[q]], order[group[order] != group[q]]
        same = same[same != q]
        same = rng.permutation(same) if folder.name == WEBCAMS else same
        for found, images in zip(pairs, (same[:1], other[:2]), strict=True):
            for g in images:
                one, two = of_queries[q], of_gallery[g]
                a, b = local.of(one), local.of(two)
                cells = homography_inliers(match_coarse(a, b, LEAST_COSINE), a, b)
                found.append((
                    epipolar_inliers(one, two) >= MIN_MATCHES,
                    cells >= MIN_CELLS,
                    confirmed_cells(one, two, local) >= MIN_CONFIRMED,
                ))  # fmt: skip
    shape = -1, 3
    return np.array(pairs[0], np.bool_).reshape(shape), np.array(pairs[1], np.bool_).reshape(shape)


def warped(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Warp an image by a random homography. Its corners move by up to 12 % of the image size."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + rng.uniform(-0.12, 0.12, (4, 2)) * [width, height]
    H = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    return cv2.warpPerspective(image, H, (width, height), borderMode=cv2.BORDER_REFLECT)


if __name__ == "__main__":
    main()
