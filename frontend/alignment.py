"""Sub-pixel alignment of matches: a landmark's patch is laid over the image around its keypoint.

A corner is found at whole pixels of one of a few scales, half a pixel off as a rule, and where the
camera comes closer, matches lie systematically too near to where it drives (docs/motorway.md). The
patch of the keyframe that saw a landmark last, drawn at the size that the distance foretells, is
moved until it agrees with the image: "feature alignment" of SVO (Forster et al., ICRA 2014, III-B),
by the inverse compositional form of Lucas-Kanade (Baker and Matthews, IJCV 2004, section 3.2). Mean
and contrast of a patch do not matter: both are unknowns beside the shift.

All needed of an image are patches around its keypoints, cut when they are extracted: a frame is
aligned after its images are gone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.config import AlignmentConfig
from vslam.features import PATCH_RADIUS, PATCH_SIDE, LandmarkPatches
from vslam.kernels import inner_kernel, kernel

HALF = 4  # of the window that is compared, pixels
SIDE = 2 * HALF + 1
WIDE = SIDE + 2  # with a pixel around it, for slopes
MIN_VARIANCE = 1.0  # grey levels squared; a patch with less shows nothing
MIN_CORNERNESS = 0.05  # determinant of the normal equations over that of a corner
STILL = 0.03  # pixels; a smaller step ends the iteration


def align_matches(
    patches: NDArray[np.uint8],
    size: NDArray[np.float64],
    landmark: NDArray[np.int32],
    known: LandmarkPatches,
    depth: NDArray[np.float64],
    config: AlignmentConfig,
) -> NDArray[np.float32]:
    """How far from its keypoint each match truly lies.

    Args:
        patches: ``(N, PATCH_PIXELS)`` uint8 around the matched keypoints.
        size: ``(N,)`` full-resolution pixels for a pixel of their octaves.
        landmark: ``(N,)`` ids that they are matched with.
        known: patches of landmarks.
        depth: ``(N,)`` of them in the camera.

    Returns:
        ``(N, 2)`` float32 full-resolution pixels; NaN where that is not known: the landmark has
        no patch, or none that the image agrees with.
    """
    shift = np.full((len(landmark), 2), np.nan, np.float32)
    if not len(known.ids):
        return shift
    at = np.minimum(np.searchsorted(known.ids, landmark), len(known.ids) - 1)
    found = np.flatnonzero(known.ids[at] == landmark)
    at = at[found]
    shift[found] = align(
        patches[found],
        known.pixels,
        known.shift,
        known.where[at],
        known.extent[at] / (depth[found] * size[found]),
        config.iterations,
        config.max_shift,
        config.min_correlation,
    )
    return shift * size[:, None].astype(np.float32)


@kernel
def align(seen, reference, centre, which, zoom, iterations, max_shift, min_correlation):
    """Where in each of N patches lies what is at the ``centre`` of its reference.

    Args:
        seen: ``(N, PATCH_PIXELS)`` uint8.
        reference: ``(P, PATCH_PIXELS)`` uint8; centre: ``(P, 2)`` float32, from the middle of the
            reference, pixels.
        which: ``(N,)`` of these.
        zoom: ``(N,)`` pixels of the seen patch for each one of the reference.
        iterations: at most.
        max_shift: from the middle of the seen patch, in x and in y, pixels.
        min_correlation: least normalised cross-correlation.

    Returns:
        ``(N, 2)`` float32 shift from the middle of the seen patch, NaN where there is none.
    """
    n = len(zoom)
    shift = np.full((n, 2), np.nan, np.float32)
    wide = np.empty((WIDE, WIDE), np.float32)
    template = np.empty((SIDE, SIDE), np.float32)
    slope_x, slope_y = np.empty((SIDE, SIDE), np.float32), np.empty((SIDE, SIDE), np.float32)
    for i in range(n):
        drawn = draw(
            reference[which[i]].reshape(PATCH_SIDE, PATCH_SIDE), centre[which[i]], zoom[i], wide
        )
        if not drawn:
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
def draw(patch, centre, zoom, out):
    """Draw a patch at another size around ``centre``; returns whether it reaches that far."""
    step = np.float32(1.0 / zoom)
    reach = np.float32(HALF + 1) * step + max(abs(centre[0]), abs(centre[1]))
    if not (step > 0.0 and reach <= np.float32(PATCH_RADIUS)):
        return False
    for r in range(WIDE):
        y = np.float32(PATCH_RADIUS) + centre[1] + np.float32(r - HALF - 1) * step
        row = min(int(y), PATCH_SIDE - 2)
        part_y = y - np.float32(row)
        for c in range(WIDE):
            x = np.float32(PATCH_RADIUS) + centre[0] + np.float32(c - HALF - 1) * step
            column = min(int(x), PATCH_SIDE - 2)
            part_x = x - np.float32(column)
            a, b = np.float32(patch[row, column]), np.float32(patch[row, column + 1])
            c_, d = np.float32(patch[row + 1, column]), np.float32(patch[row + 1, column + 1])
            above, below = a + part_x * (b - a), c_ + part_x * (d - c_)
            out[r, c] = above + part_y * (below - above)
    return True


@inner_kernel
def prepare(wide, template, slope_x, slope_y):
    """Template without its mean, and its slopes without what another mean or contrast would
    explain; returns the template's energy and the three sums of products of the slopes."""
    half, nil, count = np.float32(0.5), np.float32(0.0), np.float32(SIDE * SIDE)
    mean, mean_x, mean_y = nil, nil, nil
    for r in range(SIDE):
        for c in range(SIDE):
            template[r, c] = wide[r + 1, c + 1]
            slope_x[r, c] = half * (wide[r + 1, c + 2] - wide[r + 1, c])
            slope_y[r, c] = half * (wide[r + 2, c + 1] - wide[r, c + 1])
            mean += template[r, c]
            mean_x += slope_x[r, c]
            mean_y += slope_y[r, c]
    mean, mean_x, mean_y = mean / count, mean_x / count, mean_y / count
    energy, on_x, on_y = nil, nil, nil
    for r in range(SIDE):
        for c in range(SIDE):
            template[r, c] -= mean
            slope_x[r, c] -= mean_x
            slope_y[r, c] -= mean_y
            energy += template[r, c] * template[r, c]
            on_x += template[r, c] * slope_x[r, c]
            on_y += template[r, c] * slope_y[r, c]
    if energy < np.float32(MIN_VARIANCE) * count:
        return energy, nil, nil, nil
    on_x, on_y = on_x / energy, on_y / energy
    xx, xy, yy = nil, nil, nil
    for r in range(SIDE):
        for c in range(SIDE):
            slope_x[r, c] -= on_x * template[r, c]
            slope_y[r, c] -= on_y * template[r, c]
            xx += slope_x[r, c] * slope_x[r, c]
            xy += slope_x[r, c] * slope_y[r, c]
            yy += slope_y[r, c] * slope_y[r, c]
    return energy, xx, xy, yy


@inner_kernel
def compare(image, x, y, template, slope_x, slope_y):
    """The image around its middle, shifted by ``x, y``: its energy without the mean, and its
    products with the template and the slopes."""
    one, nil = np.float32(1.0), np.float32(0.0)
    left, top = int(np.floor(x)), int(np.floor(y))
    part_x, part_y = x - np.float32(left), y - np.float32(top)
    a, b = (one - part_y) * (one - part_x), (one - part_y) * part_x
    c_, d = part_y * (one - part_x), part_y * part_x
    total, square, product, b_x, b_y = nil, nil, nil, nil, nil
    for r in range(SIDE):
        above = image[PATCH_RADIUS - HALF + r + top]
        below = image[PATCH_RADIUS - HALF + r + top + 1]
        for c in range(SIDE):
            k = PATCH_RADIUS - HALF + c + left
            value = a * above[k] + b * above[k + 1] + c_ * below[k] + d * below[k + 1]
            # Template and slopes have no mean: the value's own counts for nothing.
            total += value
            square += value * value
            product += value * template[r, c]
            b_x += value * slope_x[r, c]
            b_y += value * slope_y[r, c]
    return square - total * total / np.float32(SIDE * SIDE), product, b_x, b_y
