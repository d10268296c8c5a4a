"""Kernels that read and write the observations of a map.

``a`` is the ``Arrays`` of the map (vslam/types/map.py). A row is one keypoint of one keyframe. The
rows that observe a landmark form a linked list, which begins at ``head`` and continues through
``next_row``.
"""

from __future__ import annotations

import numpy as np

from vslam.support.kernels import hamming, inner_kernel, kernel


@kernel
def count_shared(a, keyframe, n_keyframes):
    """Count the landmarks that each keyframe shares with ``keyframe``.

    Returns:
        ``(n_keyframes,)`` int64. The number is 0 for ``keyframe`` itself.
    """
    counts = np.zeros(n_keyframes, np.int64)
    for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
        landmark = a.landmark[row]
        if landmark < 0:
            continue
        other = a.head[landmark]
        while other >= 0:
            counts[a.keyframe[other]] += 1
            other = a.next_row[other]
    counts[keyframe] = 0
    return counts


@kernel
def link(a, row, landmark):
    """Record that a keypoint observes a landmark. It must not observe a landmark yet.

    ``row`` is the index of the keypoint in ``Arrays``.
    """
    a.landmark[row] = landmark
    a.next_row[row] = a.head[landmark]
    a.head[landmark] = row
    a.n_observations[landmark] += 1 if np.isnan(a.u_right[row]) else 2


@kernel
def link_many(a, rows, landmarks):
    """Record which landmark each of N keypoints observes. None may observe a landmark yet.

    ``rows`` are the ``(N,)`` indices of the keypoints in ``Arrays``.
    """
    for i in range(len(rows)):
        link(a, rows[i], landmarks[i])


@kernel
def unlink(a, row):
    """Remove the observation of a landmark by a keypoint.

    ``row`` is the index of the keypoint in ``Arrays``. If the landmark has no observations left, it
    is culled.
    """
    landmark = a.landmark[row]
    if a.head[landmark] == row:
        a.head[landmark] = a.next_row[row]
    else:
        other = a.head[landmark]
        while a.next_row[other] != row:
            other = a.next_row[other]
        a.next_row[other] = a.next_row[row]
    a.landmark[row] = -1
    a.next_row[row] = -1
    a.n_observations[landmark] -= 1 if np.isnan(a.u_right[row]) else 2
    if a.head[landmark] < 0:
        a.landmark_alive[landmark] = False


@kernel
def erase_landmark(a, landmark):
    """Cull a landmark and remove its observations."""
    row = a.head[landmark]
    while row >= 0:
        following = a.next_row[row]
        a.landmark[row] = -1
        a.next_row[row] = -1
        row = following
    a.head[landmark] = -1
    a.n_observations[landmark] = 0
    a.landmark_alive[landmark] = False


@kernel
def detach_keyframe(a, keyframe):
    """Remove all observations of a keyframe."""
    for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
        if a.landmark[row] >= 0:
            unlink(a, row)


@kernel
def cut_path(a, keyframe, n_keyframes):
    """Remove what joins a keyframe and all later keyframes to the earlier ones: their observations
    of landmarks that an earlier keyframe observed first."""
    for row in range(a.first_row[keyframe], a.first_row[n_keyframes]):
        landmark = a.landmark[row]
        if landmark >= 0 and a.first_keyframe[landmark] < keyframe:
            unlink(a, row)


@kernel
def first_of_submaps(restart, parents):
    """Return the first keyframe of the sub-map of each keyframe, ``(K,)`` int64.

    Args:
        restart: ``(K,)``, not 0 where a keyframe begins a sub-map.
        parents: ``(K,)`` parents in the spanning tree.
    """
    first = np.zeros(len(parents), np.int64)
    for keyframe in range(1, len(parents)):
        first[keyframe] = keyframe if restart[keyframe] else first[parents[keyframe]]
    return first


@kernel
def observed_by(a, landmark, keyframe):
    """Return the index in ``Arrays`` of a keyframe's keypoint that observes a landmark, or -1."""
    row = a.head[landmark]
    while row >= 0:
        if a.keyframe[row] == keyframe:
            return row
        row = a.next_row[row]
    return -1


@kernel
def fuse_landmarks(a, loser, winner):
    """Move the observations of landmark ``loser`` to landmark ``winner``.

    A keyframe that observes both landmarks keeps only its observation of ``winner``.
    """
    # The other callers of link() and observed_by() pass int64. With the same type, both kernels are
    # compiled only once.
    row = np.int64(a.head[loser])
    while row >= 0:
        following = np.int64(a.next_row[row])
        a.landmark[row] = -1
        a.next_row[row] = -1
        if observed_by(a, winner, np.int64(a.keyframe[row])) < 0:
            link(a, row, winner)
        row = following
    a.head[loser] = -1
    a.n_observations[loser] = 0
    a.landmark_alive[loser] = False
    a.fused_into[loser] = winner
    a.visible[winner] += a.visible[loser]
    a.found[winner] += a.found[loser]


@kernel
def resolve(a, landmarks):
    """Return the current ids of landmarks that may have been fused or culled.

    Returns:
        ``(N,)`` int32. For a fused landmark, this is the id of the landmark that it was fused
        with. For a culled landmark, it is -1. Other landmarks keep their ids.
    """
    out = np.empty(len(landmarks), np.int32)
    for i in range(len(landmarks)):
        landmark = landmarks[i]
        while landmark >= 0 and not a.landmark_alive[landmark]:
            landmark = a.fused_into[landmark]
        out[i] = landmark
    return out


@inner_kernel
def lower_median(values, n):
    """Return the lower median of the first ``n`` values.

    These values are sorted in place by insertion sort.
    """
    for i in range(1, n):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return values[(n - 1) // 2]


@kernel
def refresh_landmarks(a, landmarks, scales):
    """Recompute the descriptor, normal and distance range of landmarks from their observations.

    The descriptor is taken from the observation whose median distance to the descriptors of the
    other observations is least (ORB-SLAM, III-C). To limit the computing time, only the newest 32
    observations are considered. The distance range is computed from the octave in the first
    keyframe that observes the landmark.
    """
    limit = 32
    rows = np.empty(limit, np.int64)
    distances = np.empty((limit, limit), np.int64)
    for i in range(len(landmarks)):
        landmark = landmarks[i]
        if not a.landmark_alive[landmark]:
            continue
        n = 0
        first, first_row = 2**31 - 1, -1
        nx, ny, nz = 0.0, 0.0, 0.0
        row = a.head[landmark]
        while row >= 0:
            k = a.keyframe[row]
            T = a.T_cw[k]
            # Centre of the camera: -R' t.
            dx = a.xyz[landmark, 0] + T[0, 0] * T[0, 3] + T[1, 0] * T[1, 3] + T[2, 0] * T[2, 3]
            dy = a.xyz[landmark, 1] + T[0, 1] * T[0, 3] + T[1, 1] * T[1, 3] + T[2, 1] * T[2, 3]
            dz = a.xyz[landmark, 2] + T[0, 2] * T[0, 3] + T[1, 2] * T[1, 3] + T[2, 2] * T[2, 3]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            nx += dx / distance
            ny += dy / distance
            nz += dz / distance
            if k < first:
                first, first_row = k, row
                farthest = distance * scales[a.octave[row]]
                a.distance_range[landmark, 0] = farthest / scales[-1]
                a.distance_range[landmark, 1] = farthest
            if n < limit:
                rows[n] = row
                n += 1
            row = a.next_row[row]
        norm = np.sqrt(nx * nx + ny * ny + nz * nz)
        if norm > 0:
            a.normal[landmark, 0] = nx / norm
            a.normal[landmark, 1] = ny / norm
            a.normal[landmark, 2] = nz / norm
        for p in range(n):
            distances[p, p] = 0
            for q in range(p):
                d = hamming(a.descriptor[rows[p]], a.descriptor[rows[q]])
                distances[p, q] = d
                distances[q, p] = d
        best, best_median = first_row, 1000
        for p in range(n):
            median = lower_median(distances[p], n)
            if median < best_median:
                best, best_median = rows[p], median
        for word in range(4):
            a.landmark_descriptor[landmark, word] = a.descriptor[best, word]


@kernel
def predict_octave(distance, farthest, log_scale, levels):
    """Predict the pyramid level at which a landmark is detected (ORB-SLAM, V-D)."""
    level = int(np.ceil(np.log(farthest / distance) / log_scale))
    return min(max(level, 0), levels - 1)


@kernel
def collect_landmarks(a, keyframes, n_landmarks):
    """Return the ``(N,)`` int32 ids of all landmarks that the keyframes observe, sorted."""
    seen = np.zeros(n_landmarks, np.bool_)
    for keyframe in keyframes:
        for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
            if a.landmark[row] >= 0:
                seen[a.landmark[row]] = True
    return np.flatnonzero(seen).astype(np.int32)


@kernel
def count_seen_by(a, keyframe, needed):
    """Count the landmarks of a keyframe that at least ``needed`` keyframes observe.

    The keyframe itself counts as one of the ``needed`` keyframes.
    """
    count = 0
    for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
        if a.landmark[row] < 0:
            continue
        seen = 0
        other = a.head[a.landmark[row]]
        while other >= 0 and seen < needed:
            seen += 1
            other = a.next_row[other]
        if seen >= needed:
            count += 1
    return count


@kernel
def covisible_pairs(a, keyframes, n_keyframes, minimum):
    """Find all pairs of keyframes that share at least ``minimum`` landmarks.

    Only the ``(N,)`` given keyframes are considered.

    Returns:
        ``(M, 2)`` int64 pairs in ascending order, and the ``(M,)`` numbers of landmarks that the
        pairs share. The lower id comes first in each pair.
    """
    counts = np.zeros(n_keyframes, np.int64)
    listed = np.zeros(n_keyframes, np.bool_)
    for keyframe in keyframes:
        listed[keyframe] = True
    met = np.empty(n_keyframes, np.int64)
    pairs, shared = np.empty((64, 2), np.int64), np.empty(64, np.int64)
    n = 0
    for keyframe in range(n_keyframes):
        if not listed[keyframe]:
            continue
        n_met = 0
        for row in range(a.first_row[keyframe], a.first_row[keyframe + 1]):
            if a.landmark[row] < 0:
                continue
            other = a.head[a.landmark[row]]
            while other >= 0:
                k = a.keyframe[other]
                if k > keyframe and listed[k]:
                    if counts[k] == 0:
                        met[n_met] = k
                        n_met += 1
                    counts[k] += 1
                other = a.next_row[other]
        met[:n_met].sort()
        for k in met[:n_met]:
            if counts[k] >= max(1, minimum):
                if n == len(pairs):
                    pairs = np.concatenate((pairs, np.empty_like(pairs)))
                    shared = np.concatenate((shared, np.empty_like(shared)))
                pairs[n, 0], pairs[n, 1], shared[n] = keyframe, k, counts[k]
                n += 1
            counts[k] = 0
    return pairs[:n], shared[:n]


@kernel
def gather_observations(a, landmarks, index):
    """Find the keypoints that observe each of P landmarks.

    Only keyframes with ``index[keyframe] >= 0`` are considered.

    Returns:
        ``(P + 1,)`` int64 offsets, and the int64 indices of the keypoints in ``Arrays``, sorted by
        landmark. The indices of landmark i begin at ``offsets[i]`` and end before ``offsets[i +
        1]``.
    """
    first = np.zeros(len(landmarks) + 1, np.int64)
    for i in range(len(landmarks)):
        first[i + 1] = first[i]
        row = a.head[landmarks[i]]
        while row >= 0:
            if index[a.keyframe[row]] >= 0:
                first[i + 1] += 1
            row = a.next_row[row]
    rows = np.empty(first[-1], np.int64)
    n = 0
    for i in range(len(landmarks)):
        row = a.head[landmarks[i]]
        while row >= 0:
            if index[a.keyframe[row]] >= 0:
                rows[n] = row
                n += 1
            row = a.next_row[row]
    return first, rows
