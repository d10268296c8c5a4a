"""Computes local descriptors of images with ONNX Runtime, and stores the images of keyframes."""

from __future__ import annotations

from collections import OrderedDict
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.local_matching import DescriptorMaps
from vslam.loopclosure.siamese.inference import FORMAT, NAME, VERSION, open_session
from vslam.loopclosure.siamese.weights import SHIPPED
from vslam.support.errors import InputError
from vslam.types.loops import PerKeyframe

SHIPPED_LOCAL = SHIPPED / "local.onnx"
WIDTH = 640  # width of the network's input, pixels
GLANCE_WIDTH = 320  # input width for a quick comparison ("glance"), pixels
_QUALITY = 90  # JPEG quality of the keyframe images in memory
_JPEG = b"\xff\xd8"  # the first bytes of a JPEG file
_CACHED = 4  # number of descriptor maps in the least-recently-used cache


class LocalDescriptors:
    """Computes local descriptors of images using a network, which is loaded by ``load`` or when the
    first image arrives."""

    def __init__(self, path: Path = SHIPPED_LOCAL) -> None:
        """Check that the file of the network exists.

        Args:
            path: ONNX file of a network that maps an image to coarse and fine descriptors.
        """
        if not path.exists():
            fix = "install vslam again" if path == SHIPPED_LOCAL else "give another file"
            raise InputError(f"{path}: the weights of the local descriptors are missing; {fix}.")
        self._path = path

    def load(self) -> None:
        """Load the network.

        Raises:
            InputError: see ``describe``.
        """
        self.describe(np.zeros((96, GLANCE_WIDTH), np.uint8), GLANCE_WIDTH)  # the first use is slow

    @cached_property
    def _session(self) -> Any:
        session = open_session(self._path, self._path, "image")
        metadata = session.get_modelmeta().custom_metadata_map
        if metadata.get(FORMAT) != VERSION or metadata.get(NAME) != "local":
            raise InputError(
                f"{self._path}: not the local descriptors of this version of vslam; give another "
                "file."
            )
        return session

    def describe(self, image: NDArray[np.uint8], width: int = WIDTH) -> DescriptorMaps:
        """Resize an ``(H, W)`` uint8 image to ``width`` pixels and compute its local descriptors.

        Raises:
            InputError: the file is damaged or not a network that computes local descriptors, or
                ONNX Runtime is not installed.
        """
        scale = width / image.shape[1]
        coarse, fine = self._session.run(None, {"image": resized(image, width)})
        return DescriptorMaps(coarse, fine, scale)


def resized(image: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Resize an image to a width in pixels. The aspect ratio is kept, but the result has at least
    64 rows."""
    scale = width / image.shape[1]
    size = width, max(64, round(image.shape[0] * scale))
    if size == image.shape[::-1]:
        return image
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), np.uint8)


class KeyframeImages:
    """Stores the images of keyframes as JPEG files in memory. An image takes about 40 kB.

    The local descriptors of an image would take thirty times as much memory, so they are computed
    on demand.
    """

    def __init__(self, network: LocalDescriptors) -> None:
        self.network = network
        self._files: dict[int, tuple[bytes, float]] = {}
        self._maps: OrderedDict[int, DescriptorMaps] = OrderedDict()
        self._glances: dict[int, DescriptorMaps] = {}

    def add(self, keyframe: int, image: NDArray[np.uint8]) -> None:
        """Store the ``(H, W)`` uint8 image of a keyframe."""
        small = resized(image, WIDTH)
        file = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
        self._files[keyframe] = file.tobytes(), WIDTH / image.shape[1]

    def files(self, n_keyframes: int) -> PerKeyframe:
        """Return the JPEG files of the first ``n_keyframes`` keyframes, as uint8, to be saved in a
        map file."""
        files = [self._files[k][0] if k in self._files else b"" for k in range(n_keyframes)]
        first = np.cumsum([0, *map(len, files)]).astype(np.int64)
        return PerKeyframe(first, np.frombuffer(b"".join(files), np.uint8))

    def restore(self, files: PerKeyframe, width: int) -> None:
        """Store the JPEG files that the method ``files`` returned.

        Args:
            width: width of the camera images, pixels.

        Raises:
            ValueError: a file is not a JPEG file.
        """
        for keyframe in range(len(files)):
            file = files.of(keyframe).tobytes()
            if file and not file.startswith(_JPEG):
                raise ValueError(f"the image of keyframe {keyframe} is not a JPEG file")
            if file:
                self._files[keyframe] = file, WIDTH / width

    def keep(self, alive: NDArray[np.bool_]) -> None:
        """Remove the images of keyframes that were culled from the map.

        Args:
            alive: ``(K,)`` bool, False for culled keyframes.
        """
        for keyframe in [one for one in self._files if not alive[one]]:
            for kept in (self._files, self._maps, self._glances):
                kept.pop(keyframe, None)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._files

    def maps(self, keyframe: int) -> DescriptorMaps:
        """Compute the local descriptors of the stored image of a keyframe."""
        if keyframe not in self._maps:
            self._maps[keyframe] = self._described(keyframe, WIDTH)
            while len(self._maps) > _CACHED:
                self._maps.popitem(last=False)
        self._maps.move_to_end(keyframe)
        return self._maps[keyframe]

    def glance(self, keyframe: int) -> DescriptorMaps:
        """Compute the coarse descriptors of the stored image of a keyframe, at half the width.

        This takes a quarter of the time that ``maps`` takes. The descriptors stay in memory.
        """
        if keyframe not in self._glances:
            maps = self._described(keyframe, GLANCE_WIDTH)
            self._glances[keyframe] = maps.coarse_alone()
        return self._glances[keyframe]

    def glance_at(self, image: NDArray[np.uint8]) -> DescriptorMaps:
        """Compute the local descriptors of an image that is not stored, at the width that
        ``glance`` uses."""
        return self.network.describe(image, GLANCE_WIDTH)

    def image(self, keyframe: int) -> NDArray[np.uint8]:
        """Decode the stored image of a keyframe, as uint8, with a width of ``WIDTH`` pixels.

        Raises:
            InputError: the file comes from a loaded map and is damaged.
        """
        file, _ = self._files[keyframe]
        image = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise InputError(
                f"the image of keyframe {keyframe} in the map is damaged; build the map again."
            )
        return np.asarray(image, np.uint8)

    def _described(self, keyframe: int, width: int) -> DescriptorMaps:
        maps = self.network.describe(self.image(keyframe), width)
        return maps._replace(scale=maps.scale * self._files[keyframe][1])
