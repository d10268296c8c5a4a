"""Measure the 256 point pairs that OpenCV's ORB compares, and write them for vslam.frontend.

vslam has its own extraction, but its descriptors should be compatible with others, so that
vocabularies trained elsewhere can be used. The sampling pattern (learned by Rublee et al., ICCV
2011, section 4.3) is therefore measured: one bright (dark) dot is moved over the patch of a
keypoint at angle 0, and each bit shows at which positions its second (first) point is brighter.
OpenCV smooths the image before sampling, so that a dot has an effect within 3 px.

usage: python tools/experiments/design/orb_pattern.py frontend/orb_pattern.npy
"""

import sys

import cv2
import numpy as np

REACH = 16  # pixels around the keypoint at which a dot can act
CENTRE = 40


def describe(image: np.ndarray) -> np.ndarray:
    orb = cv2.ORB_create(nlevels=1)
    keypoint = cv2.KeyPoint(CENTRE, CENTRE, 31.0, 0.0, 1.0, 0)
    _, descriptor = orb.compute(image, [keypoint])
    return np.unpackbits(descriptor[0], bitorder="little").astype(bool)


def responses(background: int, dot: int) -> np.ndarray:
    """Bit i for a dot at every offset: ``(2 REACH + 1, 2 REACH + 1, 256)`` bool, [dy, dx]."""
    side = 2 * REACH + 1
    bits = np.zeros((side, side, 256), bool)
    for dy in range(-REACH, REACH + 1):
        for dx in range(-REACH, REACH + 1):
            image = np.full((2 * CENTRE, 2 * CENTRE), background, np.uint8)
            image[CENTRE + dy, CENTRE + dx] = dot
            bits[dy + REACH, dx + REACH] = describe(image)
    return bits


def expected(a: tuple[int, int], b: tuple[int, int]) -> np.ndarray:
    """``(2, side, side)`` bright and dark response of a test I(a) < I(b), with exact smoothing."""
    offsets = np.arange(-REACH, REACH + 1)
    x, y = np.meshgrid(offsets, offsets)

    def seen(point: tuple[int, int]) -> np.ndarray:
        dx, dy = x - point[0], y - point[1]
        inside = (np.abs(dx) <= 3) & (np.abs(dy) <= 3)
        return np.where(inside, np.exp(-(dx**2 + dy**2) / 8.0), 0.0)

    return np.stack([seen(b) > seen(a) + 1e-12, seen(a) > seen(b) + 1e-12])


def solve(bright: np.ndarray, dark: np.ndarray) -> tuple[int, int, int, int]:
    """``x_a, y_a, x_b, y_b`` that explain the responses of one bit best.

    The fit need not be exact, because OpenCV's integer smoothing breaks ties between two points
    whose windows overlap.
    """

    def near(mask: np.ndarray) -> list[tuple[int, int]]:
        ys, xs = np.nonzero(mask)
        x, y = (round((v.min() + v.max()) / 2) - REACH for v in (xs, ys))
        return [(x + i, y + j) for i in range(-2, 3) for j in range(-2, 3)]

    observed = np.stack([bright, dark])
    errors = {
        (*a, *b): np.sum(expected(a, b) != observed) for a in near(dark) for b in near(bright)
    }
    best, second = sorted(errors, key=lambda pair: errors[pair])[:2]
    if errors[best] >= errors[second]:
        raise RuntimeError(f"{best} and {second} explain a bit equally well")
    return best


def main(path: str) -> None:
    bright, dark = responses(0, 255), responses(255, 0)
    rows = [solve(bright[:, :, i], dark[:, :, i]) for i in range(256)]
    pattern = np.array(rows, np.int8)
    np.save(path, pattern)
    print(f"{path}: {pattern.shape} {pattern.dtype}, reach {np.abs(pattern).max()} px")


if __name__ == "__main__":
    main(sys.argv[1])
