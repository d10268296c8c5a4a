"""Matches landmarks and descriptors with the features of a frame.

The search by projection follows ORB-SLAM (Mur-Artal et al., T-RO 2015, sections V-C and V-D). A
landmark is searched for only near its projection and near the pyramid level at which it should
appear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vslam.support.kernels import hamming, kernel
from vslam.types.features import CELL, FeatureGrid, Features
from vslam.types.map_kernels import predict_octave

ORIENTATION_BINS = 30


@kernel
def predict_view(T, xyz, normal, distance_range, intrinsics, width, height, scales, window):
    """Predict where landmarks appear in an image (section V-D of the ORB-SLAM paper).

    A landmark is visible if it meets three conditions. It projects into the image. Its distance
    from the camera is in ``distance_range``, with a tolerance of 20 %. The angle between the
    viewing ray and its mean viewing direction is at most 60 degrees.

    Args:
        T: ``(4, 4)`` pose of the camera (world to camera).
        xyz, normal: ``(N, 3)`` positions and ``(N, 3)`` mean viewing directions (unit vectors) of
            the landmarks, in the world frame.
        distance_range: ``(N, 2)`` least and greatest distance at which each landmark can be
            detected.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.
        scales: ``(levels,)`` pyramid scale factors.
        window: search radius at octave 0, pixels.

    Returns:
        ``(N, 3)`` predicted u, v, u_right, in pixels; ``(N,)`` search radius in pixels, 0 for
        landmarks that are not visible; ``(N,)`` int64 predicted octave.
    """
    n = len(xyz)
    fx, fy, cx, cy, bf, _ = intrinsics
    uvr = np.zeros((n, 3))
    radius = np.zeros(n)
    octave = np.zeros(n, np.int64)
    log_scale = np.log(scales[1] / scales[0])
    centre = np.empty(3)
    for i in range(3):
        centre[i] = -(T[0, i] * T[0, 3] + T[1, i] * T[1, 3] + T[2, i] * T[2, 3])
    for i in range(n):
        p = xyz[i]
        z = T[2, 0] * p[0] + T[2, 1] * p[1] + T[2, 2] * p[2] + T[2, 3]
        if z <= 0.1:
            continue
        x = T[0, 0] * p[0] + T[0, 1] * p[1] + T[0, 2] * p[2] + T[0, 3]
        u = fx * x / z + cx
        if u < 0.0 or u >= width:
            continue
        y = T[1, 0] * p[0] + T[1, 1] * p[1] + T[1, 2] * p[2] + T[1, 3]
        v = fy * y / z + cy
        if v < 0.0 or v >= height:
            continue
        dx, dy, dz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        if distance < 0.8 * distance_range[i, 0] or distance > 1.2 * distance_range[i, 1]:
            continue
        cos = (dx * normal[i, 0] + dy * normal[i, 1] + dz * normal[i, 2]) / distance
        if cos < 0.5:
            continue
        octave[i] = predict_octave(distance, distance_range[i, 1], log_scale, len(scales))
        uvr[i, 0], uvr[i, 1], uvr[i, 2] = u, v, u - bf / z
        # The prediction is more accurate for a landmark that is seen from near its mean direction.
        radius[i] = (window if cos > 0.998 else 1.6 * window) * scales[octave[i]]
    return uvr, radius, octave


class Projections(NamedTuple):
    """The predicted image positions and the descriptors of M landmarks.

    Attributes:
        uvr: ``(M, 3)`` predicted u, v, u_right, pixels.
        radius: ``(M,)`` half width of the search window, pixels. Landmarks with radius 0 are
            skipped.
        octave_low, octave_high: ``(M,)`` lowest and highest accepted octave.
        descriptor: ``(M, 4)``, the 32 bytes of each descriptor as four integers.
    """

    uvr: NDArray[np.float64]
    radius: NDArray[np.float64]
    octave_low: NDArray[np.int64]
    octave_high: NDArray[np.int64]
    descriptor: NDArray[np.uint64]


class Searchable(NamedTuple):
    """N features of an image, and a grid to search them by position.

    Attributes:
        xy: ``(N, 2)`` pixels.
        octave: ``(N,)`` pyramid level.
        u_right: ``(N,)`` columns in the right image, NaN without a stereo match.
        descriptor: ``(N, 4)``, the 32 bytes of each descriptor as four integers.
        grid: the features sorted by image cell.
    """

    xy: NDArray[np.float32]
    octave: NDArray[np.uint8]
    u_right: NDArray[np.float32]
    descriptor: NDArray[np.uint64]
    grid: FeatureGrid

    @classmethod
    def of_features(cls, features: Features, width: int, height: int) -> Searchable:
        """Sort the features of an image of ``width`` by ``height`` pixels into a grid."""
        grid = FeatureGrid.of_positions(features.xy, width, height)
        descriptor = features.descriptors.view(np.uint64)
        return cls(features.xy, features.octave, features.u_right, descriptor, grid)


@kernel
def search_windows(projections, features, free, max_distance, ratio):
    """Find the best feature for each of M projected landmarks. A feature is matched at most once,
    with the landmark that has the closest descriptor.

    Args:
        projections: the ``Projections`` of the M landmarks.
        features: the ``Searchable`` of the image, with N features.
        free: ``(N,)`` bool, True for features that may be matched.
        max_distance: largest Hamming distance of a match, bits.
        ratio: largest ratio of the best to the second best distance. The ratio is tested only if
            both features have the same octave; 1 disables the test.

    Returns:
        ``(M,)`` int32 index of the matched feature of each landmark, or -1; ``(M,)`` int32
        distances between the descriptors.
    """
    uvr, radius, octave_low, octave_high, descriptors = projections
    xy, octave, u_right, frame_descriptors, grid = features
    start, items, columns = grid
    m, n = len(uvr), len(xy)
    rows = (len(start) - 1) // columns
    matches = np.full(m, -1, np.int32)
    distances = np.full(m, 257, np.int32)
    owner = np.full(n, -1, np.int32)
    for i in range(m):
        r = radius[i]
        if r <= 0:
            continue
        u, v = uvr[i, 0], uvr[i, 1]
        column_first = max(0, int(np.floor((u - r) / CELL)))
        column_last = min(columns - 1, int(np.floor((u + r) / CELL)))
        row_first = max(0, int(np.floor((v - r) / CELL)))
        row_last = min(rows - 1, int(np.floor((v + r) / CELL)))
        if column_first > column_last or row_first > row_last:
            continue  # the window lies outside the image
        best, best_distance, second, second_distance = -1, 257, -1, 257
        for row in range(row_first, row_last + 1):
            for k in range(
                start[row * columns + column_first], start[row * columns + column_last + 1]
            ):
                j = items[k]
                if not free[j] or octave[j] < octave_low[i] or octave[j] > octave_high[i]:
                    continue
                if abs(xy[j, 0] - u) > r or abs(xy[j, 1] - v) > r:
                    continue
                if u_right[j] == u_right[j] and abs(u_right[j] - uvr[i, 2]) > r:
                    continue
                distance = hamming(descriptors[i], frame_descriptors[j])
                if distance < best_distance:
                    second, second_distance = best, best_distance
                    best, best_distance = j, distance
                elif distance < second_distance:
                    second, second_distance = j, distance
        if best < 0 or best_distance > max_distance:
            continue
        comparable = second >= 0 and octave[second] == octave[best]
        if comparable and best_distance > ratio * second_distance:
            continue
        previous = owner[best]
        if previous >= 0:
            if distances[previous] <= best_distance:
                continue
            matches[previous] = -1
        owner[best] = i
        matches[i], distances[i] = best, best_distance
    return matches, distances


@kernel
def search_all(a, b, max_distance, ratio):
    """Match two sets of descriptors exhaustively. A match is a pair of mutual nearest neighbours
    that passes a ratio test.

    Args:
        a, b: ``(M, 4)`` and ``(N, 4)`` uint64 descriptors.
        max_distance: largest Hamming distance of a match, bits.
        ratio: largest ratio of the best to the second best distance, for each descriptor of a.

    Returns:
        ``(M,)`` int32 index in b of the match of each descriptor of a, or -1.
    """
    m, n = len(a), len(b)
    best_of_a = np.full(m, -1, np.int32)
    best_of_b = np.full(n, -1, np.int32)
    distance_of_b = np.full(n, 257, np.int32)
    for i in range(m):
        best, best_distance, second_distance = -1, 257, 257
        for j in range(n):
            distance = hamming(a[i], b[j])
            if distance < distance_of_b[j]:
                distance_of_b[j], best_of_b[j] = distance, i
            if distance < best_distance:
                second_distance = best_distance
                best, best_distance = j, distance
            elif distance < second_distance:
                second_distance = distance
        if best_distance <= max_distance and best_distance <= ratio * second_distance:
            best_of_a[i] = best
    for i in range(m):
        if best_of_a[i] >= 0 and best_of_b[best_of_a[i]] != i:
            best_of_a[i] = -1
    return best_of_a


@kernel
def consistent_orientation(angle_a, angle_b):
    """Test whether the rotation of each match agrees with the rotations of most other matches
    (section V-C of the ORB-SLAM paper).

    The rotation of a match is the difference between the orientations of its two features. Matches
    in the three fullest bins of a histogram of the rotations are consistent. The second and the
    third bin count only if each holds at least a tenth as many matches as the first.

    Args:
        angle_a, angle_b: ``(N,)`` float32 orientations of the matched features, radians.

    Returns:
        ``(N,)`` bool, True for matches whose rotation is consistent.
    """
    n = len(angle_a)
    bins = np.empty(n, np.int64)
    count = np.zeros(ORIENTATION_BINS, np.int64)
    turn = 2.0 * np.pi
    for i in range(n):
        difference = (np.float64(angle_a[i]) - np.float64(angle_b[i])) % turn
        bins[i] = int(difference / turn * ORIENTATION_BINS + 0.5) % ORIENTATION_BINS
        count[bins[i]] += 1
    allowed = np.zeros(ORIENTATION_BINS, np.bool_)
    fullest = 0
    for _ in range(3):
        k = int(np.argmax(count))
        fullest = max(fullest, count[k])
        if count[k] * 10 >= fullest:
            allowed[k] = True
        count[k] = -1
    return allowed[bins]


def count_elsewhere(u: NDArray[np.floating], width: int) -> int:
    """Count the inliers outside the vertical strip that contains the most inliers. The strip is a
    third of the image wide.

    Two different places may contain a similar object, for example a facade or a parked car. Such an
    object can provide a hundred inliers, but all of them lie close together. At a true revisit, the
    inliers are spread over the whole image.

    Args:
        u: ``(N,)`` columns of the inliers, pixels.
        width: width of the image, pixels.
    """
    columns = np.sort(u)
    ends = np.searchsorted(columns, columns + width / 3, side="right")
    strip = ends - np.arange(len(columns))
    return len(columns) - int(strip.max(initial=0))
