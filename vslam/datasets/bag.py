"""Bags of ROS 1 and ROS 2 and MCAP files, read by the library rosbags.

Images are those of ``sensor_msgs/Image`` and ``CompressedImage``, their times the stamps in their
headers. Images of two topics belong together when their stamps lie within 5 ms; others are left
out. Where the bag holds the ``camera_info`` of its image topics, that is their calibration.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from vslam.calibration.formats import read_ros
from vslam.calibration.models import Calibration
from vslam.camera import ImageMap
from vslam.datasets.bag_messages import (
    CAMERA_INFO_TYPE,
    IMAGE_TYPES,
    Message,
    camera_info,
    grey_of,
    stamp_of,
)
from vslam.datasets.image_files import size_text
from vslam.datasets.sequence import Image
from vslam.datasets.stream import TimedFrame
from vslam.errors import BrokenSourceError, InputError, UnreadableImageError

Bag = Any  # rosbags.highlevel.AnyReader

_TOLERANCE_NS = 5_000_000
_MOST_WAITING = 32  # images of one side that wait for a partner


@dataclass(frozen=True)
class BagStream:
    """See `vslam.datasets.stream.RawStream`.

    Attributes:
        topics: of the left images, and of the right ones.
    """

    path: Path
    topics: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    n_expected: int | None

    @property
    def dataset(self) -> str:
        return "bag"

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def live(self) -> bool:
        return False

    def frames(self) -> Iterator[TimedFrame]:
        """See `vslam.datasets.stream.RawStream.frames`."""
        with _opened(self.path) as bag:
            for messages in _together(_messages(bag, self.path, self.topics), self.topics):
                timestamp = stamp_of(messages[0]) / 10**9
                yield TimedFrame(timestamp, partial(self._read, messages))

    def _read(
        self, messages: tuple[Message, ...], image_map: ImageMap
    ) -> tuple[Image, Image | None]:
        sides = zip(messages, self.topics, self.sizes, strict=False)
        left, *right = image_map(self._grey, list(sides))
        return left, right[0] if right else None

    def _grey(self, side: tuple[Message, str, tuple[int, int]]) -> Image:
        message, topic, size = side
        image = _decoded(self.path, topic, message)
        if image.shape[::-1] != size:
            raise UnreadableImageError(
                self.path,
                f"{topic}: {size_text(image.shape)} pixels where the first image has "
                f"{size_text(size[::-1])}.",
            )
        return image


def open_bag(path: Path, *, topics: tuple[str, ...] = (), monocular: bool = False) -> BagStream:
    """Open a bag and read its first frame.

    Args:
        path: ``.bag``, ``.mcap`` or ``.db3``, or the folder of a ROS 2 bag.
        topics: of the left and the right images; without any, the only image topics there are, in
            the order of their names.
        monocular: one topic is enough, and of two given the first one is taken.

    Raises:
        InputError: rosbags is not installed, no bag, cut off, topics missing, or images that have
            no stamps, cannot be decoded or do not belong together.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file; name a bag with --data.")
    with _opened(path) as bag:
        chosen = _choose_topics(path, bag, topics, 1 if monocular else 2)
        pairs = _together(_messages(bag, path, chosen), chosen)
        begin = list(islice(pairs, 2))
        if not begin:
            raise InputError(
                f"{path}: {' and '.join(chosen)} have no images of one time (within "
                f"{_TOLERANCE_NS / 1e6:g} ms); name topics of one camera with --topics."
            )
        if all(stamp_of(messages[0]) == 0 for messages in begin):
            raise InputError(
                f"{path}: the images of {chosen[0]} have no time stamps (header.stamp is 0); "
                "record them again with a driver that sets it."
            )
        images = [_decoded(path, *side) for side in zip(chosen, begin[0], strict=True)]
        return BagStream(
            path=path,
            topics=chosen,
            sizes=tuple((image.shape[1], image.shape[0]) for image in images),
            n_expected=min(bag.topics[topic].msgcount for topic in chosen) or None,
        )


def find_calibration(stream: BagStream) -> Calibration | None:
    """By the ``camera_info`` beside the image topics, as ROS's drivers name it.

    None where one is missing or has no focal length, as drivers of uncalibrated cameras fill it.

    Raises:
        InputError: a ``camera_info`` cannot be read, or is no calibration.
    """
    path = stream.path
    documents = []
    with _opened(path) as bag:
        for topic in stream.topics:
            namespace, _, image = topic.removesuffix("/compressed").rpartition("/")
            info = f"{namespace}/camera_info"
            if not any(c.topic == info and c.msgtype == CAMERA_INFO_TYPE for c in bag.connections):
                return None
            _, message = next(_messages(bag, path, (info,)), (info, None))
            if message is None:
                return None
            rectified = image.startswith("image_rect")
            found = camera_info(message, f"{path}: {info}", rectified)
            if found is None:
                return None
            documents.append(found)
    return read_ros(documents, None)


@contextmanager
def _opened(path: Path) -> Iterator[Bag]:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            f"{path}: bags are read by rosbags, which is not installed; pip install 'vslam[bag]'."
        ) from error
    try:
        bag = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        bag.open()
    except Exception as error:  # of a damaged file rosbags and its parsers raise all sorts
        raise InputError(
            f"{path}: cannot be read as a bag ({_reason(error)}); if its recording was cut off, "
            "repair it with 'rosbag reindex', 'ros2 bag reindex' or 'mcap recover'."
        ) from error
    try:
        yield bag
    finally:
        bag.close()


def _messages(bag: Bag, path: Path, topics: tuple[str, ...]) -> Iterator[tuple[str, Message]]:
    """Messages of these topics with the name of theirs, in the order of their recording.

    Raises:
        BrokenSourceError: behind the last good one of a damaged bag.
    """
    connections = [c for c in bag.connections if c.topic in topics]
    try:
        for connection, _, data in bag.messages(connections=connections):
            yield connection.topic, bag.deserialize(data, connection.msgtype)
    except Exception as error:  # see _opened
        raise BrokenSourceError(
            f"{path}: the bag is damaged or cut off ({_reason(error)}); copy it again."
        ) from error


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")


def _together(
    messages: Iterator[tuple[str, Message]], topics: tuple[str, ...]
) -> Iterator[tuple[Message, ...]]:
    """Messages of one time, one of each topic."""
    if len(topics) == 1:
        yield from ((message,) for _, message in messages)
        return
    waiting = {topic: deque[Message](maxlen=_MOST_WAITING) for topic in topics}
    first, second = waiting.values()
    for topic, message in messages:
        waiting[topic].append(message)
        while first and second:
            apart = stamp_of(first[0]) - stamp_of(second[0])
            if abs(apart) <= _TOLERANCE_NS:
                yield first.popleft(), second.popleft()
            else:
                (first if apart < 0 else second).popleft()


def _choose_topics(path: Path, bag: Bag, topics: tuple[str, ...], n: int) -> tuple[str, ...]:
    there = sorted({c.topic for c in bag.connections if c.msgtype in IMAGE_TYPES})
    listed = f"image topics are {', '.join(there)}" if there else "there are no image topics"
    if len(there) < n:
        instead = "; run with --sensor mono" if there else ""
        raise InputError(f"{path}: stereo needs two image topics; {listed}{instead}.")
    for topic in topics:
        if topic not in there:
            raise InputError(f"--topics {topic}: not in {path}; {listed}.")
    if not topics and len(there) > n:
        wanted = "LEFT,RIGHT" if n == 2 else "TOPIC"
        raise InputError(f"{path}: choose with --topics {wanted}; {listed}.")
    chosen = topics or tuple(there)
    if not n <= len(chosen) <= 2:
        raise InputError(
            f"--topics {','.join(topics)}: name the topic of the left images and that of the "
            "right ones, or run with --sensor mono."
        )
    return chosen[:n]


def _decoded(path: Path, topic: str, message: Message) -> Image:
    try:
        return grey_of(message)
    except ValueError as error:
        raise UnreadableImageError(path, f"{topic}: {error}.") from error
