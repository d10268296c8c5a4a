"""Compare two tests that decide whether two photographs show the same place.

    python tools/experiments/local_descriptors/image_test.py PHOTOS multiview webcams

PHOTOS is a folder of sets of photographs, with the images in SET/PLACE/. Every image is a query.
Each query is paired with a right image and with two wrong images. Similarities are computed using
the capsule network.

- The right image is the most similar image of the same place. The viewpoint of a webcam never
  changes. Therefore, for a webcam, the right image is one that was taken at a different hour, and
  the query is warped.
- The wrong images are the two most similar images of other places.

The script prints the share of right pairs and the share of wrong pairs that pass each test. Both
tests match the cells of a coarse grid and use the matches that fit one homography. The test by
share requires that these matches cover 18 % of the image. The test by number requires 90 matches.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import LearnedMatchingConfig
from vslam.lab.loopbench.detectors import NetworkScorer
from vslam.lab.loopbench.measure import LEAST_COSINE, MIN_CELLS
from vslam.loopclosure.local_matching import homography_inliers, homography_share, match_coarse
from vslam.loopclosure.siamese.local_descriptors import LocalDescriptors

MIN_SHARE = 0.18
WEBCAMS = "webcams"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photos", type=Path)
    parser.add_argument("sets", nargs="+")
    parser.add_argument("--of-place", type=int, default=10, help="images of a place, at most")
    options = parser.parse_args()
    print("| set | right pairs | by share, by number | wrong pairs | by share, by number |")
    print("|---|---|---|---|---|")
    for name in options.sets:
        right, wrong = measure(options.photos / name, options.of_place)
        cells = [
            f"{len(passed)} | {' %, '.join(f'{100 * x:.1f}' for x in passed.mean(axis=0))} %"
            for passed in (right, wrong)
        ]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def measure(folder: Path, of_place: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Apply both tests to all pairs of a set of photographs.

    Returns:
        Two ``(N, 2)`` bool arrays, for the right and for the wrong pairs: whether a pair passes the
        test by share, and whether it passes the test by number.
    """
    gallery, places = [], []
    for place in sorted(path for path in folder.iterdir() if path.is_dir()):
        files = sorted(place.iterdir())
        for file in files[:: -(-len(files) // of_place)]:
            gallery.append(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
            places.append(place.name)
    rng, place = np.random.default_rng(0), np.array(places)
    queries = [warped(image, rng) for image in gallery] if folder.name == WEBCAMS else gallery
    scorer, network = NetworkScorer("capsule"), LocalDescriptors()
    of_gallery = [network.describe(image).coarse_alone() for image in gallery]
    of_queries = of_gallery
    if queries is not gallery:
        of_queries = [network.describe(image).coarse_alone() for image in queries]
    stored = scorer.embed(gallery)
    pairs: tuple[list[tuple[bool, bool]], ...] = ([], [])
    for q, embedded in enumerate(scorer.embed(queries)):
        order = np.argsort(-scorer.compare(embedded, stored))
        same, other = order[place[order] == place[q]], order[place[order] != place[q]]
        same = same[same != q]
        same = rng.permutation(same) if folder.name == WEBCAMS else same
        for found, images in zip(pairs, (same[:1], other[:2]), strict=True):
            for g in images:
                a, b = of_queries[q], of_gallery[g]
                loose = match_coarse(a, b, LearnedMatchingConfig().min_coarse_similarity)
                cells = homography_inliers(match_coarse(a, b, LEAST_COSINE), a, b)
                found.append((homography_share(loose, a, b) >= MIN_SHARE, cells >= MIN_CELLS))
    return np.array(pairs[0]), np.array(pairs[1])


def warped(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Warp an image by a random homography. Its corners move by up to 12 % of the image size."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corners + rng.uniform(-0.12, 0.12, (4, 2)) * [width, height]
    H = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
    return cv2.warpPerspective(image, H, (width, height), borderMode=cv2.BORDER_REFLECT)


if __name__ == "__main__":
    main()
