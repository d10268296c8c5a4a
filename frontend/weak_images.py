"""Extracts features from all images, including images that are noisy or have low contrast.

The thresholds of FAST are grey levels that suit images of normal contrast. At night, in fog or with
a wrong exposure, a corner differs from its surroundings by only one or two grey levels. In heavy
noise, every pixel is a corner.

Therefore, noise is filtered and contrast is raised before extraction. Averaging neighbouring pixels
recovers differences of less than a grey level. In this way, a scene can be recognised in an image
of only five grey levels. Images with normal contrast and noise are left unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.config import Config, WeakImageConfig
from vslam.frontend.orb import Extraction, extract
from vslam.support.kernels import kernel
from vslam.types.camera import ImageMap
from vslam.types.features import Pyramid

# Standard deviation of the noise that should remain after the blur, in grey levels. A smaller
# value blurs the image more. [own]
_NOISE_LEFT = 4.0
# Upper bound of the standard deviation of the Gaussian blur, in pixels. [own]
_MAX_BLUR = 3.5
# An image counts as out of focus if the mean absolute second difference of its grey values is
# below this fraction of its contrast. The contrast of such an image is not raised. In sharp
# images, this ratio is 0.4 or more. [own]
_LEAST_DETAIL = 0.25
# Contrast is raised until the grey values in each window have this standard deviation, in grey
# levels. The default is the contrast of KITTI's images on a bright day. [own]
_RAISED_CONTRAST = 12.0
# Side of the window in which contrast is raised, in pixels. [own]
_CONTRAST_WINDOW = 33
# The contrast of a window counts as at least this fraction of the median contrast of all windows.
# This limits how much the noise in flat parts of the image is amplified. A larger fraction
# amplifies flat parts less. [own]
_FLAT_SHARE = 0.25
# The contrast of a window also counts as at least this value, in grey levels. Rounding alone
# causes a standard deviation of this size. [own]
_LEAST_CONTRAST = 0.15

Grey = NDArray[np.uint8]

ROW_STRIDE = 32  # noise is measured in every 32nd row: 15,000 pixels of a KITTI image
# For Gaussian noise, median abs(I[x-1] - 2 I[x] + I[x+1]) = 0.6745 sqrt(6) sigma.
_SECOND_DIFFERENCE = 0.6745 * 6.0**0.5
_SPIKE_DEVIATIONS, LEAST_SPIKE = 4.0, 32.0  # least height of a spike: in sigmas, in grey levels
_MEDIAN = 5  # side of the median filter that removes spikes, pixels
_GAUSSIAN = 2.0 * np.pi**0.5  # a Gaussian blur of s pixels divides the noise by 2 sqrt(pi) s
_BLOCK = 16  # side of the blocks in which contrast is measured, pixels
_EMPTY_RANGE = 2  # largest range of the grey values of an image that shows nothing


def extract_in_any_light(
    images: Sequence[Grey],
    config: Config,
    image_map: ImageMap = map,
    allowed: Pyramid | None = None,
    pyramid: Pyramid | None = None,
) -> list[Extraction]:
    """Extract the ORB features of ``(H, W)`` uint8 images that were taken at the same time.

    Noisy images are filtered first. Then the contrast is raised in images that have low contrast
    and few corners. If one image needs this, all images are processed in the same way, because
    stereo matching compares their patches.

    Args:
        image_map: applies a function to all images, sequentially or in parallel.
        allowed: mask pyramid, 1 where the first image may have corners, see ``extract``; None
            allows all pixels.
        pyramid: the pyramid of the first image, if it has already been built.
    """
    weak, first = config.weak_images, images[0]

    def found_in(image: Grey) -> Extraction:
        built = pyramid if image is first else None
        return extract(image, config.orb, allowed if image is images[0] else None, built)

    images = without_noise(images, weak)
    found = list(image_map(found_in, images))
    if is_faint(images, [len(one.xy) for one in found], config):
        images = list(image_map(lambda image: with_contrast(image), images))
        found = list(image_map(found_in, images))
    return found


def without_noise(images: Sequence[Grey], config: WeakImageConfig) -> Sequence[Grey]:
    """Filter the noise of ``(H, W)`` uint8 images. Images with normal noise are returned unchanged.

    A median filter removes spikes (single bright or dark pixels). A Gaussian blur reduces the other
    noise to 4 grey levels.
    """
    measured = [grain(image, ROW_STRIDE, LEAST_SPIKE) for image in images]
    if max(spikes for _, spikes in measured) > config.spikes_from:
        images = [np.asarray(cv2.medianBlur(image, _MEDIAN), np.uint8) for image in images]
        measured = [grain(image, ROW_STRIDE, LEAST_SPIKE) for image in images]
    noise = max(sigma for sigma, _ in measured)
    if noise < config.noise_from:
        return images
    blur = min(noise / (_GAUSSIAN * _NOISE_LEFT), _MAX_BLUR)
    return [np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.uint8) for image in images]


@kernel
def grain(image, stride, least):
    """Estimate the noise and the spikes of an ``(H, W)`` uint8 image from every ``stride``-th row.

    Noise is estimated from the median of absolute second differences along a row. The mean, which
    Immerkaer (CVIU 1996) uses, is not robust to edges.

    Returns:
        Standard deviation of the noise, in grey levels; share of the pixels that are spikes. A
        spike is brighter than both of its neighbours, or darker than both of them. The difference
        must exceed ``least`` grey levels and four standard deviations.
    """
    height, width = image.shape
    counts = np.zeros(1021, np.int64)
    n = 0
    for y in range(stride // 2, height, stride):
        row = image[y]
        for x in range(1, width - 1):
            before, after = np.int64(row[x - 1]), np.int64(row[x + 1])
            counts[abs(before - 2 * np.int64(row[x]) + after)] += 1
            n += 1
    if n == 0:
        return 0.0, 0.0
    median, below = 0, counts[0]
    while 2 * below < n:
        median += 1
        below += counts[median]
    sigma = median / _SECOND_DIFFERENCE
    limit = max(least, _SPIKE_DEVIATIONS * sigma)
    spikes = 0
    for y in range(stride // 2, height, stride):
        row = image[y]
        for x in range(1, width - 1):
            here = np.int64(row[x])
            before, after = here - np.int64(row[x - 1]), here - np.int64(row[x + 1])
            spikes += min(before, after) > limit or max(before, after) < -limit
    return sigma, spikes / n


def is_faint(images: Sequence[Grey], counts: Sequence[int], config: Config) -> bool:
    """Return whether at least one of the images has few corners because of low contrast.

    An image that is out of focus also has few corners. It does not count, because raising its
    contrast would only amplify rounding errors. An image that shows nothing at all is ignored.

    Args:
        counts: number of features of each image.
    """
    few = config.weak_images.few_features * config.orb.n_features
    return any(
        count < few and int(np.ptp(image)) > _EMPTY_RANGE and _is_faint(image, config.weak_images)
        for image, count in zip(images, counts, strict=True)
    )


def _is_faint(image: Grey, config: WeakImageConfig) -> bool:
    deviation = contrast(image)
    return deviation < config.low_contrast and detail(image) >= _LEAST_DETAIL * deviation


def detail(image: Grey) -> float:
    """Compute the mean absolute second difference of the grey values along the rows, in grey
    levels. It measures how much fine detail an image has."""
    return float(np.abs(np.diff(image[::2].astype(np.int16), 2, axis=1)).mean())


def contrast(image: Grey) -> float:
    """Compute the median standard deviation of the grey values in the blocks of an image, in grey
    levels."""
    rows, columns = (side // _BLOCK * _BLOCK for side in image.shape)
    if not rows or not columns:
        return 0.0
    blocks = image[:rows, :columns].astype(np.float32)
    return float(np.median(blocks.reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).std(axis=(1, 3))))


def with_contrast(image: Grey) -> Grey:
    """Normalise the local contrast of an ``(H, W)`` uint8 image.

    The image is blurred by one pixel. Then the grey values are scaled so that the window around
    every pixel has the same standard deviation. Flat regions, which contain only noise, are
    amplified less.
    """
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    window = (_CONTRAST_WINDOW, _CONTRAST_WINDOW)
    mean = cv2.boxFilter(smooth, -1, window)
    variance = cv2.boxFilter(smooth * smooth, -1, window) - mean * mean
    deviation = cv2.boxFilter(np.sqrt(np.maximum(variance, 0.0)), -1, window)
    least = max(_LEAST_CONTRAST, _FLAT_SHARE * float(np.median(deviation)))
    raised = 128.0 + (smooth - mean) * (_RAISED_CONTRAST / np.maximum(deviation, least))
    return np.clip(np.rint(raised), 0, 255).astype(np.uint8)
