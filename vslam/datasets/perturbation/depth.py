"""Computes the dense depth of an image, for perturbations that depend on distance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.types.camera import Camera, DepthImage, Image

_SHRINK = 2  # matching at half size takes a fifth of the time and is accurate enough for fog
_BLOCK = 5
_NEAREST_M = 3.0  # nearest depth in the search range


def dense_depths(
    camera: Camera, left: Image, second: Image | DepthImage | None
) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """Estimate the depth of all pixels of a frame.

    A left and a right image are matched using semi-global matching (SGBM; Hirschmueller, PAMI
    2008).

    Args:
        left: ``(H, W)`` uint8.
        second: right image, ``(H, W)`` uint8. For RGB-D, it is the depth of the left image's
            pixels, ``(H, W)`` float32 metres, 0 where unknown.

    Returns:
        Two ``(H, W)`` arrays of depth along z in metres, for the pixels of the left and of the
        right image. The second array is None if there is no right image. The depth is infinite
        where it is very large or unknown, for example in the sky.
    """
    if second is not None and second.dtype != np.uint8:
        depth = np.asarray(second, np.float32)
        return np.where(depth > 0, depth, np.float32(np.inf)), None
    right = np.asarray(second, np.uint8)
    disparities = disparity(camera, left, right), disparity(camera, right, left, mirrored=True)
    with np.errstate(divide="ignore"):
        of_left, of_right = (np.float32(camera.bf) / found for found in disparities)
    return of_left, of_right


def disparity(
    camera: Camera, image: Image, other: Image, *, mirrored: bool = False
) -> NDArray[np.float32]:
    """Compute the disparities of the pixels of ``image``.

    Args:
        image: ``(H, W)`` uint8, the left image of a pair, or the right image if ``mirrored``.
        other: ``(H, W)`` uint8, the other image of the pair.

    Returns:
        ``(H, W)`` float32 disparities in pixels. A row without any match has the disparity 0.
    """
    import cv2

    height, width = image.shape
    size = width // _SHRINK, height // _SHRINK
    pair = [cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (image, other)]
    if mirrored:
        pair = [np.ascontiguousarray(i[:, ::-1]) for i in pair]
    most = camera.bf / _NEAREST_M / _SHRINK
    levels = int(np.clip(16 * np.ceil(most / 16.0), 16, max(16, 16 * (size[0] // 32))))
    if size[0] <= levels:  # OpenCV fails, because no pixel has the whole search range
        return np.zeros(image.shape, np.float32)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=levels,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = _filled(matcher.compute(*pair).astype(np.float32) / 16.0)
    if mirrored:
        found = found[:, ::-1]
    full = cv2.resize(np.ascontiguousarray(found), (width, height))
    return np.asarray(full * np.float32(width / size[0]), np.float32)


def _filled(found: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill each unknown pixel with the smaller of the two nearest disparities in its row.

    The smaller disparity belongs to the background, which is what an occluded pixel shows (Geiger
    et al., CVPR 2012).
    """
    known = found > 0
    columns = np.broadcast_to(np.arange(found.shape[1]), found.shape)
    before = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    backwards = np.where(known, columns, found.shape[1])[:, ::-1]
    after = np.minimum.accumulate(backwards, axis=1)[:, ::-1]
    padded = np.pad(found, ((0, 0), (0, 1)))
    rows = np.arange(len(found))[:, None]
    left = np.where(before >= 0, padded[rows, before], np.inf)
    right = np.where(after < found.shape[1], padded[rows, after], np.inf)
    filled = np.minimum(left, right)
    return np.where(known, found, np.where(np.isfinite(filled), filled, 0.0)).astype(np.float32)
