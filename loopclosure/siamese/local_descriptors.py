"""Local descriptors of images, by ONNX Runtime, and the images of keyframes for it."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.loopclosure.local_matching import DescriptorMaps
from vslam.loopclosure.siamese.inference import FORMAT, NAME, VERSION, open_session
from vslam.loopclosure.siamese.weights import SHIPPED

WIDTH = 640  # pixels of the image that the network reads; docs/loops.md has other widths
_QUALITY = 90  # of the JPEG files of keyframes in memory
_KEPT = 12  # descriptor maps, the latest used


class LocalDescriptors:
    """The network of local descriptors."""

    def __init__(self, path: Path = SHIPPED / "local.onnx") -> None:
        """
        Raises:
            InputError: missing, damaged or foreign file, or no ONNX Runtime.
        """
        self._session = open_session(path, path, "image")
        metadata = self._session.get_modelmeta().custom_metadata_map
        if metadata.get(FORMAT) != VERSION or metadata.get(NAME) != "local":
            raise InputError(f"{path}: not the local descriptors of this version of vslam.")

    def describe(self, image: NDArray[np.uint8]) -> DescriptorMaps:
        """Descriptors of a grey image ``(H, W)`` of any size."""
        small, scale = reduced(image)
        return self.describe_reduced(small, scale)

    def describe_reduced(self, image: NDArray[np.uint8], scale: float) -> DescriptorMaps:
        """Of an image that :func:`reduced` made."""
        coarse, fine = self._session.run(None, {"image": image})
        return DescriptorMaps(coarse, fine, scale)


def reduced(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """An image of the width that the network reads, and its pixels for one of the camera's."""
    scale = WIDTH / image.shape[1]
    size = WIDTH, max(64, round(image.shape[0] * scale))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=way), np.uint8), scale


class KeyframeImages:
    """Images of keyframes as JPEG files in memory, about 40 kB each: their descriptors take forty
    times as much, and few are ever asked for."""

    def __init__(self, network: LocalDescriptors) -> None:
        self.network = network
        self._files: dict[int, tuple[bytes, float]] = {}
        self._maps: OrderedDict[int, DescriptorMaps] = OrderedDict()

    def add(self, keyframe: int, image: NDArray[np.uint8]) -> None:
        """Keep an image ``(H, W)``."""
        small, scale = reduced(image)
        file = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        self._files[keyframe] = file.tobytes(), scale

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._files

    def maps(self, keyframe: int) -> DescriptorMaps:
        """Descriptors of a keyframe that was added."""
        if keyframe not in self._maps:
            file, scale = self._files[keyframe]
            image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
            self._maps[keyframe] = self.network.describe_reduced(np.asarray(image), scale)
            while len(self._maps) > _KEPT:
                self._maps.popitem(last=False)
        self._maps.move_to_end(keyframe)
        return self._maps[keyframe]
