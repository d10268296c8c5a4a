"""Features of images that show little: noise is taken out, faint contrast is raised.

FAST's thresholds are grey levels, made for images of a usual contrast. At night, in fog or under a
wrong exposure a corner is a level or two high, and under heavy noise every pixel is a corner.
Averaging pixels tells fractions of a grey level that rounding has spread over them, so that even
five levels hold a scene. Neither is done to an image of usual light: it stays as it is.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.camera import ImageMap
from vslam.config import Config, WeakImageConfig
from vslam.frontend.orb import Extraction, extract
from vslam.kernels import kernel

Grey = NDArray[np.uint8]

ROW_STRIDE = 32  # of the rows that noise is measured in: 15 thousand pixels of a KITTI image
# Of a normal number, the median of the size; of I[x-1] - 2 I[x] + I[x+1], the deviation.
_SECOND_DIFFERENCE = 0.6745 * 6.0**0.5
_SPIKE_DEVIATIONS, LEAST_SPIKE = 4.0, 32.0  # of the noise, grey levels
_MEDIAN = 5  # side of the filter against spikes, pixels
_GAUSSIAN = 2.0 * np.pi**0.5  # noise after a blur of s pixels is a (2 sqrt(pi) s)-th
_BLOCK = 16  # side of the blocks that contrast is measured in, pixels
_SHOWS_NOTHING = 2  # grey levels between the darkest pixel and the brightest


def extract_in_any_light(
    images: Sequence[Grey], config: Config, image_map: ImageMap = map
) -> list[Extraction]:
    """ORB features of ``(H, W)`` images of one moment: as ``extract`` has them, or where the
    images are noisy or faint, of what can be made of them. All are treated alike, for patches of
    one are compared with those of the other. A pure function.
    """
    weak = config.weak_images
    images = without_noise(images, weak)
    found = list(image_map(lambda image: extract(image, config.orb), images))
    if is_faint(images, [len(one.xy) for one in found], config):
        raised = image_map(lambda image: extract(with_contrast(image, weak), config.orb), images)
        found = list(raised)
    return found


def without_noise(images: Sequence[Grey], config: WeakImageConfig) -> Sequence[Grey]:
    """The images, those of usual noise themselves: pixels that stand out alone are replaced by
    the median around, and normal noise is blurred to ``noise_left``."""
    measured = [grain(image, ROW_STRIDE, LEAST_SPIKE) for image in images]
    if max(spikes for _, spikes in measured) > config.spikes_from:
        images = [np.asarray(cv2.medianBlur(image, _MEDIAN), np.uint8) for image in images]
        measured = [grain(image, ROW_STRIDE, LEAST_SPIKE) for image in images]
    noise = max(sigma for sigma, _ in measured)
    if noise < config.noise_from:
        return images
    blur = min(noise / (_GAUSSIAN * config.noise_left), config.max_blur)
    return [np.asarray(cv2.GaussianBlur(image, (0, 0), blur), np.uint8) for image in images]


@kernel
def grain(image, stride, least):
    """Noise of an ``(H, W)`` uint8 image, and its spikes, from every ``stride``-th row.

    The median of second differences along a row looks past edges, which the mean does not
    (Immerkaer, CVIU 1996, has the mean).

    Returns:
        Deviation of the noise in grey levels; share of the pixels that stand out from both
        neighbours, to the same side, by ``least`` grey levels and by four deviations.
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
    """Whether an image has few corners because of low contrast. One out of focus has few, too, but
    raising it would raise its rounding; one that shows nothing at all is not asked."""
    few = config.weak_images.few_features * config.orb.n_features
    return any(
        count < few and int(np.ptp(image)) > _SHOWS_NOTHING and _is_faint(image, config.weak_images)
        for image, count in zip(images, counts, strict=True)
    )


def _is_faint(image: Grey, config: WeakImageConfig) -> bool:
    deviation = contrast(image)
    return deviation < config.low_contrast and detail(image) >= config.least_detail * deviation


def detail(image: Grey) -> float:
    """Mean size of second differences along the rows, grey levels."""
    return float(np.abs(np.diff(image[::2].astype(np.int16), 2, axis=1)).mean())


def contrast(image: Grey) -> float:
    """Median over blocks of the deviation of their grey values."""
    rows, columns = (side // _BLOCK * _BLOCK for side in image.shape)
    if not rows or not columns:
        return 0.0
    blocks = image[:rows, :columns].astype(np.float32)
    return float(np.median(blocks.reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).std(axis=(1, 3))))


def with_contrast(image: Grey, config: WeakImageConfig) -> Grey:
    """Brought to the same deviation around every pixel (``contrast_window``), blurred by a pixel
    first; flat parts, which show noise alone, are raised less."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    window = (config.contrast_window, config.contrast_window)
    mean = cv2.boxFilter(smooth, -1, window)
    variance = cv2.boxFilter(smooth * smooth, -1, window) - mean * mean
    deviation = cv2.boxFilter(np.sqrt(np.maximum(variance, 0.0)), -1, window)
    least = max(config.least_contrast, config.flat_share * float(np.median(deviation)))
    raised = 128.0 + (smooth - mean) * (config.raised_contrast / np.maximum(deviation, least))
    return np.clip(np.rint(raised), 0, 255).astype(np.uint8)
