"""Sub-pixel alignment of matches: an image patch of each landmark is registered to the new image.

FAST places a corner at a whole pixel of a pyramid level, so a corner is typically off by half a
pixel. When the camera approaches the scene, this error is biased towards the focus of expansion
(docs/research/motorway.md).

To remove the error, the patch is taken from a keyframe that observed the landmark. The patch is
warped into the view of the frame and shifted until it agrees with the image. This is the "feature
alignment" of SVO (Forster et al., ICRA 2014, section III-B). The method is inverse compositional
Lucas-Kanade (Baker and Matthews, IJCV 2004, section 3.2). Changes in brightness and contrast are
estimated together with the shift.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import AlignmentConfig
from vslam.frontend.patches import patches_around
from vslam.support.kernels import inner_kernel, kernel
from vslam.types.features import PATCH_RADIUS, PATCH_SIDE, LandmarkPatches, Pyramid
from vslam.types.track import Track

# Upper bound of the number of Gauss-Newton iterations. [own]
_ITERATIONS = 7
# Upper bound of the shift between a keypoint and its aligned position, in x and in y, in pixels
# of its octave. [own]
_MAX_SHIFT = 2.0

HALF = 4  # half width of the compared window, pixels
SIDE = 2 * HALF + 1
WIDE = SIDE + 2  # one more pixel on each side, to compute the gradients
MIN_VARIANCE = 1.0  # grey levels squared; a patch with a smaller variance has no texture
MIN_CORNERNESS = 0.05  # least determinant of the 2x2 normal matrix over its diagonal product
STILL = 0.03  # pixels; the iteration ends when a step is smaller


def align_matches(
    track: Track,
    known: LandmarkPatches,
    scales: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    config: AlignmentConfig,
) -> NDArray[np.float32] | None:
    """Find each matched landmark of a frame in the image with sub-pixel accuracy, using an image
    patch from a keyframe.

    Args:
        known: image patches of landmarks. Only the matches of these landmarks are aligned.
        scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.

    Returns:
        ``(N, 2)`` float32, the new value of ``Track.shift``: the offset from each feature to its
        aligned position, in full-resolution pixels. It is NaN where a match was not aligned. The
        result is None if the frame has no image pyramid or if no landmark has a patch.
    """
    features, pyramid = track.features, track.extracted.pyramid
    if pyramid is None or not len(known.ids):
        return None
    matched = np.flatnonzero(track.landmark >= 0)
    landmark = track.landmark[matched]
    at = np.minimum(np.searchsorted(known.ids, landmark), len(known.ids) - 1)
    same = known.ids[at] == landmark
    at, matched = at[same], matched[same]
    octave = features.octave[matched]
    found = find_patches(
        pyramid,
        features.xy[matched],
        octave,
        track.T_cw,
        track.xyz[matched],
        known,
        at,
        scales,
        intrinsics,
        config,
    )
    shift = np.full((len(features), 2), np.nan, np.float32)
    shift[matched] = found * scales[octave][:, None]
    return shift


def find_patches(
    pyramid: Pyramid,
    xy: NDArray[np.float32],
    octave: NDArray[np.uint8],
    T_cw: NDArray[np.float64],
    xyz: NDArray[np.float64],
    known: LandmarkPatches,
    at: NDArray[np.int64],
    scales: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    config: AlignmentConfig,
) -> NDArray[np.float32]:
    """Find the image patches of N landmarks near their expected positions in an image.

    Args:
        xy: ``(N, 2)`` expected positions, full-resolution pixels.
        octave: ``(N,)`` pyramid levels in which the patches are searched for.
        T_cw: ``(4, 4)`` pose of the camera that took the image (world to camera).
        xyz: ``(N, 3)`` positions of the landmarks, in the world frame.
        at: ``(N,)`` index of each landmark's patch in ``known``.
        scales: ``(levels,)`` full-resolution pixels per pixel of each octave.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.

    Returns:
        ``(N, 2)`` float32 shift of each patch from its expected position, in pixels of its octave;
        NaN if the patch was not found. The expected position is first rounded to a whole pixel of
        the octave.
    """
    seen = patches_around(pyramid, xy, octave)
    return register(seen, T_cw, xyz, scales[octave], known, at, intrinsics, config)


def register(
    seen: NDArray[np.uint8],
    T_cw: NDArray[np.float64],
    xyz: NDArray[np.float64],
    size: NDArray[np.float64],
    known: LandmarkPatches,
    at: NDArray[np.int64],
    intrinsics: NDArray[np.float64],
    config: AlignmentConfig,
) -> NDArray[np.float32]:
    """Register the known patches of N landmarks to patches of an image.

    Args:
        seen: ``(N, PATCH_PIXELS)`` uint8 patches of the image.
        T_cw: ``(4, 4)`` pose of the camera that took the image (world to camera).
        xyz: ``(N, 3)`` positions of the landmarks, in the world frame.
        size: ``(N,)`` full-resolution pixels per pixel of ``seen``.
        at: ``(N,)`` index of each landmark's patch in ``known``.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.

    Returns:
        ``(N, 2)`` float32 position of each landmark in pixels of ``seen``, relative to its middle;
        NaN if the patch does not match.
    """
    warp = warps(T_cw, xyz, known.T_cw, known.view[at], known.size[at], size, intrinsics)
    return align(
        seen,
        known.pixels,
        known.shift,
        known.where[at],
        warp,
        _ITERATIONS,
        _MAX_SHIFT,
        config.min_correlation,
    )


@kernel
def warps(T_cw, xyz, T_seen, view, size_seen, size, intrinsics):
    """Compute affine warps from image patches of a frame to image patches of keyframes.

    The surface around a landmark is approximated by a plane perpendicular to the viewing direction
    of the keyframe (section III-B of the SVO paper).

    Args:
        T_cw: ``(4, 4)`` pose of the frame's camera (world to camera).
        xyz: ``(N, 3)`` landmarks in the world frame.
        T_seen: ``(K, 4, 4)`` poses of the keyframes (world to camera).
        view: ``(N,)`` index into ``T_seen`` of the keyframe that observed each landmark.
        size_seen, size: ``(N,)`` scale of the keyframe's patch and of the frame's patch, in
            full-resolution pixels per pixel of the patch.
        intrinsics: ``(6,)``, see ``Camera.intrinsics``.

    Returns:
        ``(N, 2, 2)`` float32 matrices. Each maps an offset in the frame's patch to the offset in
        the keyframe's patch, both in pixels of the patch. A matrix is NaN where the landmark is
        behind one of the cameras, or where the frame views the plane from behind.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    steps = np.full((len(xyz), 2, 2), np.nan, np.float32)
    p, column = np.empty(3), np.empty(3)
    A = np.empty((2, 2))
    for i in range(len(xyz)):
        T, X = T_seen[view[i]], xyz[i]
        depth = T[2, 0] * X[0] + T[2, 1] * X[1] + T[2, 2] * X[2] + T[2, 3]
        for r in range(3):
            p[r] = T_cw[r, 0] * X[0] + T_cw[r, 1] * X[1] + T_cw[r, 2] * X[2] + T_cw[r, 3]
        if not (depth > 0.0 and p[2] > 0.0):
            continue
        for k in range(2):
            # A step of one pixel along u or v in the keyframe, projected onto the plane and from
            # there into the frame.
            for r in range(3):
                column[r] = 0.0
                for m in range(3):
                    column[r] += T_cw[r, m] * T[k, m]
                column[r] *= depth * size_seen[i] / (fx if k == 0 else fy)
            A[0, k] = fx * (column[0] - column[2] * p[0] / p[2]) / (p[2] * size[i])
            A[1, k] = fy * (column[1] - column[2] * p[1] / p[2]) / (p[2] * size[i])
        determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        if determinant > 1e-6:
            steps[i, 0, 0], steps[i, 0, 1] = A[1, 1] / determinant, -A[0, 1] / determinant
            steps[i, 1, 0], steps[i, 1, 1] = -A[1, 0] / determinant, A[0, 0] / determinant
    return steps


@kernel
def align(seen, reference, centre, which, warp, iterations, max_shift, min_correlation):
    """Locate landmarks with sub-pixel accuracy: register a reference patch to each of N image
    patches.

    Args:
        seen: ``(N, PATCH_PIXELS)`` uint8 patches of the frame.
        reference: ``(P, PATCH_PIXELS)`` uint8 patches of keyframes.
        centre: ``(P, 2)`` float32 position of the landmark in each reference patch, in pixels
            relative to the middle of the patch.
        which: ``(N,)`` index of the reference patch for each patch of the frame.
        warp: ``(N, 2, 2)`` float32 matrices, see ``warps``.
        max_shift: largest accepted shift in x and in y, in pixels of the frame's patch.
        min_correlation: least normalised cross-correlation of an accepted alignment.

    Returns:
        ``(N, 2)`` float32 position of each landmark, in pixels relative to the middle of the
        frame's patch; NaN if the alignment failed.
    """
    n = len(seen)
    shift = np.full((n, 2), np.nan, np.float32)
    wide = np.empty(WIDE * WIDE, np.float32)
    template = np.empty((SIDE, SIDE), np.float32)
    slope_x, slope_y = np.empty((SIDE, SIDE), np.float32), np.empty((SIDE, SIDE), np.float32)
    for i in range(n):
        if not draw(reference[which[i]], centre[which[i]], warp[i], wide):
            continue
        energy, xx, xy, yy = prepare(wide, template, slope_x, slope_y)
        determinant = xx * yy - xy * xy
        if not determinant > np.float32(MIN_CORNERNESS) * xx * yy:
            continue
        image = seen[i].reshape(PATCH_SIDE, PATCH_SIDE)
        x, y = np.float32(0.0), np.float32(0.0)
        for _ in range(iterations):
            square, product, b_x, b_y = compare(image, x, y, template, slope_x, slope_y)
            if not product > 0.0:
                break
            gain = product / energy
            step_x = (yy * b_x - xy * b_y) / (determinant * gain)
            step_y = (xx * b_y - xy * b_x) / (determinant * gain)
            x, y = x - step_x, y - step_y
            if not max(abs(x), abs(y)) <= max_shift:
                break
            if step_x * step_x + step_y * step_y < np.float32(STILL * STILL):
                if product >= min_correlation * np.sqrt(square * energy):
                    shift[i, 0], shift[i, 1] = x, y
                break
    return shift


@inner_kernel
def draw(patch, centre, warp, out):
    """Warp a patch around ``centre`` with bilinear interpolation. Returns False, and leaves ``out``
    unchanged, if the warped window is not inside the patch.

    Args:
        patch: ``(PATCH_PIXELS,)`` uint8.
        centre: ``(2,)`` float32, in pixels relative to the middle of the patch.
        warp: ``(2, 2)`` float32, see ``warps``.
        out: ``(WIDE * WIDE,)`` float32, receives the window.
    """
    xx, xy, yx, yy = warp[0, 0], warp[0, 1], warp[1, 0], warp[1, 1]
    far = np.float32(HALF + 1)
    reach_x = far * (abs(xx) + abs(xy)) + abs(centre[0])
    reach_y = far * (abs(yx) + abs(yy)) + abs(centre[1])
    if not max(reach_x, reach_y) <= np.float32(PATCH_RADIUS - 0.01):
        return False
    # Coordinates are in fixed point (1 / 65536 pixel). A bit shift separates the whole and the
    # fractional part much faster than floating-point arithmetic does.
    one, part = np.float32(65536.0), np.float32(1.0 / 65536.0)
    x_first = np.int32((np.float32(PATCH_RADIUS) + centre[0] - far * (xx + xy)) * one)
    y_first = np.int32((np.float32(PATCH_RADIUS) + centre[1] - far * (yx + yy)) * one)
    x_by_c, x_by_r = np.int32(xx * one), np.int32(xy * one)
    y_by_c, y_by_r = np.int32(yx * one), np.int32(yy * one)
    right, down = np.uintp(1), np.uintp(PATCH_SIDE)
    for r in range(WIDE):
        x, y = np.int32(x_first + r * x_by_r), np.int32(y_first + r * y_by_r)
        for c in range(WIDE):
            k = np.uintp((y >> 16) * PATCH_SIDE + (x >> 16))
            part_x, part_y = part * np.float32(x & 65535), part * np.float32(y & 65535)
            above, below = np.float32(patch[k]), np.float32(patch[k + down])
            above += part_x * (np.float32(patch[k + right]) - above)
            below += part_x * (np.float32(patch[k + down + right]) - below)
            out[r * WIDE + c] = above + part_y * (below - above)
            x, y = np.int32(x + x_by_c), np.int32(y + y_by_c)
    return True


@inner_kernel
def prepare(wide, template, slope_x, slope_y):
    """Compute the template and its gradients from a warped window.

    The mean of the template is subtracted. The gradients are made orthogonal to changes in
    brightness and contrast, so that such changes do not affect the shift.

    Returns:
        The sum of squares of the template, and the entries xx, xy and yy of the 2x2 normal matrix.
    """
    half, zero, count = np.float32(0.5), np.float32(0.0), np.float32(SIDE * SIDE)
    # Sums of products of 1, the template t and its gradients x, y. Grey values are relative to the
    # middle pixel, because smaller numbers lose less precision in float32 sums.
    middle = wide[WIDE * WIDE // 2]
    t, x, y, tt, tx, ty, xx, xy, yy = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for r in range(SIDE):
        for c in range(SIDE):
            k = np.uintp((r + 1) * WIDE + c + 1)
            value = wide[k] - middle
            step_x = half * (wide[k + np.uintp(1)] - wide[k - np.uintp(1)])
            step_y = half * (wide[k + np.uintp(WIDE)] - wide[k - np.uintp(WIDE)])
            template[r, c], slope_x[r, c], slope_y[r, c] = value, step_x, step_y
            t, x, y = t + value, x + step_x, y + step_y
            tt, tx, ty = tt + value * value, tx + value * step_x, ty + value * step_y
            xx, xy, yy = xx + step_x * step_x, xy + step_x * step_y, yy + step_y * step_y
    t, x, y = t / count, x / count, y / count
    energy = tt - count * t * t
    if energy < np.float32(MIN_VARIANCE) * count:
        return energy, zero, zero, zero
    on_x, on_y = (tx - count * t * x) / energy, (ty - count * t * y) / energy
    for r in range(SIDE):
        for c in range(np.uintp(SIDE)):
            value = template[r, c] - t
            template[r, c] = value
            slope_x[r, c] -= x + on_x * value
            slope_y[r, c] -= y + on_y * value
    xx -= count * x * x + on_x * on_x * energy
    xy -= count * x * y + on_x * on_y * energy
    yy -= count * y * y + on_y * on_y * energy
    return energy, xx, xy, yy


@inner_kernel
def compare(image, x, y, template, slope_x, slope_y):
    """Compare a template with the window of an image whose middle is ``x, y`` pixels from the
    middle of the image.

    Returns:
        The sum of squares of the window after its mean is subtracted; the inner product of the
        window and the template; the inner products of the window and both gradients.
    """
    one, zero = np.float32(1.0), np.float32(0.0)
    left, top = int(np.floor(x)), int(np.floor(y))
    part_x, part_y = x - np.float32(left), y - np.float32(top)
    w00, w01 = (one - part_y) * (one - part_x), (one - part_y) * part_x
    w10, w11 = part_y * (one - part_x), part_y * part_x
    total, square, product, b_x, b_y = zero, zero, zero, zero, zero
    for r in range(SIDE):
        above = image[PATCH_RADIUS - HALF + r + top]
        below = image[PATCH_RADIUS - HALF + r + top + 1]
        for c in range(SIDE):
            k = PATCH_RADIUS - HALF + c + left
            value = w00 * above[k] + w01 * above[k + 1] + w10 * below[k] + w11 * below[k + 1]
            # The template and its gradients have zero mean, so the mean of the window cancels.
            total += value
            square += value * value
            product += value * template[r, c]
            b_x += value * slope_x[r, c]
            b_y += value * slope_y[r, c]
    return square - total * total / np.float32(SIDE * SIDE), product, b_x, b_y
