"""Opens ROS 1 bags, ROS 2 bags and MCAP files.

The library rosbags reads bags of ROS. MCAP files that it rejects, because they contain channels
without ROS messages, are read by Foxglove's library mcap. Channels that vslam cannot use are
ignored, whatever their encoding is.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, BinaryIO

from vslam.datasets.bag_messages import READ_TYPES, Message, from_foxglove
from vslam.support.errors import BrokenSourceError, InputError

_MOST_METADATA = 1_000_000  # bytes; a hundred topics need 100,000
_MAGIC = {".bag": b"#ROSBAG V", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\0"}
_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover", ".db3": "ros2 bag reindex"}
_ENCODINGS = {"cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema", "protobuf": "protobuf"}


@dataclass(frozen=True)
class Recording:
    """An open bag.

    Attributes:
        types: the type of each topic that vslam can read, by topic, such as
            ``sensor_msgs/msg/Image``.
        counts: the number of messages of each topic. Topics whose number is unknown are missing.
        others: the types of all other topics.
        span: the times in nanoseconds at which the recording began and ended. Both are 0 if they
            are unknown.
        play: function that yields the topics and messages of the given topics in the order of their
            recording. Its second argument is the time at which they begin; None starts at the
            first message.
    """

    types: Mapping[str, str]
    counts: Mapping[str, int]
    others: frozenset[str]
    span: tuple[int, int]
    play: Callable[[tuple[str, ...], int | None], Iterator[tuple[str, Message]]]


@contextmanager
def opened(path: Path) -> Iterator[Recording]:
    """Open a bag.

    Raises:
        InputError: a library is not installed, or the file is not a bag, cut off or damaged.
    """
    try:
        import mcap.reader  # noqa: F401
        import rosbags.highlevel  # noqa: F401

        from vslam.datasets.bag_limits import limit_bags
    except ImportError as error:
        raise InputError(
            f"{path}: bags are read by rosbags and mcap, which are not installed; pip install "
            "'vslam[bag]'."
        ) from error
    limit_bags()
    files = _files(path)
    with ExitStack() as stack:
        try:
            _check_metadata(path / "metadata.yaml")
            try:
                recording = _ros_recording(path, stack)
            except Exception:  # rosbags and its parsers raise many kinds
                if files and all(file.suffix.lower() == ".mcap" for file in files):
                    recording = _mcap_recording(files, stack)
                elif path.is_dir() and len(files) == 1:  # metadata.yaml names another encoding
                    recording = _ros_recording(files[0], stack)
                else:
                    raise
        except Exception as error:
            raise InputError(_unreadable(path, files, error)) from error
        yield recording


def messages(
    recording: Recording, path: Path, topics: tuple[str, ...], start: int | None = None
) -> Iterator[tuple[str, Message]]:
    """Yield the topics and messages of the given topics, from the time ``start`` (ns) at which they
    were recorded.

    Raises:
        BrokenSourceError: a message cannot be read. All messages before it are yielded first.
    """
    try:
        yield from recording.play(topics, start)
    except Exception as error:  # as in opened
        raise BrokenSourceError(
            f"{path}: the bag is damaged or cut off ({_reason(error)}); copy it again."
        ) from error


def first_message(recording: Recording, path: Path, topic: str) -> Message | None:
    """Return the first message of a topic; None if the topic has no readable message."""
    try:
        return next(messages(recording, path, (topic,)), (topic, None))[1]
    except BrokenSourceError:
        return None


class _WantedTopics:
    """A reader of rosbags that shows only the topics that vslam can read. AnyReader parses the
    definitions of all types, and would fail because of any other topic."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def __enter__(self) -> _WantedTopics:
        self._reader.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._reader, name)

    @property
    def connections(self) -> list[Any]:
        return [c for c in self._reader.connections if c.msgtype in READ_TYPES]


def _ros_recording(path: Path, stack: ExitStack) -> Recording:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    bag: Any = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
    (reader,) = bag.readers
    bag.readers = [_WantedTopics(reader)]
    stack.enter_context(bag)

    def play(topics: tuple[str, ...], start: int | None) -> Iterator[tuple[str, Message]]:
        wanted = [c for c in bag.connections if c.topic in topics]
        for connection, _, data in bag.messages(connections=wanted, start=start):
            message = bag.deserialize(data, connection.msgtype)
            yield connection.topic, from_foxglove(connection.msgtype, message)

    counts: dict[str, int] = {}
    for connection in bag.connections:
        if isinstance(n := connection.msgcount, int):
            counts[connection.topic] = counts.get(connection.topic, 0) + n
    return Recording(
        {c.topic: c.msgtype for c in bag.connections},
        counts,
        frozenset(c.msgtype for c in reader.connections if c.msgtype not in READ_TYPES),
        (bag.start_time, bag.end_time),
        play,
    )


def _mcap_recording(files: list[Path], stack: ExitStack) -> Recording:
    """Open the MCAP files of one recording, in the order of the recording."""
    from mcap.reader import SeekingReader

    decoders = _Decoders()
    readers, types, others = [], {}, set()
    counts: dict[str, int] = {}
    for file in files:
        stream = stack.enter_context(file.open("rb"))
        reader = SeekingReader(stream, validate_crcs=True)
        channels, schemas, n_of = _contents(reader)
        readers.append(reader)
        for channel in channels:
            schema = schemas.get(channel.schema_id)
            name = "" if schema is None else _ros2_name(schema.name)
            if decoders.decoder_for(channel.message_encoding, schema) is not None:
                types[channel.topic] = name
                if n_of is not None:
                    counts[channel.topic] = counts.get(channel.topic, 0) + n_of(channel.id)
            else:
                others.add(f"{name or 'no schema'} ({channel.message_encoding})")

    def play(topics: tuple[str, ...], start: int | None) -> Iterator[tuple[str, Message]]:
        for reader in readers:
            # Without an index, mcap would have to read the whole file to sort it.
            summary = reader.get_summary()
            indexed = summary is not None and bool(summary.chunk_indexes)
            found = reader.iter_messages(topics, starting_at=start, log_time_order=indexed)
            for schema, channel, message in found:
                decode = decoders.decoder_for(channel.message_encoding, schema)
                if schema is not None and decode is not None:
                    decoded = decode(message.data)
                    yield channel.topic, from_foxglove(_ros2_name(schema.name), decoded)

    statistics = [s.statistics for s in (reader.get_summary() for reader in readers) if s]
    spans = [(s.message_start_time, s.message_end_time) for s in statistics if s is not None]
    span = (min(begin for begin, _ in spans), max(end for _, end in spans)) if spans else (0, 0)
    return Recording(types, counts, frozenset(others), span, play)


def _contents(reader: Any) -> tuple[list[Any], dict[int, Any], Callable[[int], int] | None]:
    """Return the channels and schemas of an MCAP file, and a function that returns the number of
    messages of a channel, which is None if the file has no statistics."""
    summary = reader.get_summary()
    if summary is not None and summary.channels:
        n = summary.statistics.channel_message_counts if summary.statistics else None
        count = None if n is None else partial(_count, n)
        return list(summary.channels.values()), summary.schemas, count
    found = {}
    schemas = {}
    for schema, channel, _ in reader.iter_messages(log_time_order=False):
        found[channel.id] = channel
        if schema is not None:
            schemas[schema.id] = schema
    return list(found.values()), schemas, None


def _count(counts: Mapping[int, int], channel: int) -> int:
    return counts.get(channel, 0)


class _Decoders:
    """Decoders of the messages of ROS, and of messages in JSON and Protobuf."""

    def __init__(self) -> None:
        from mcap_protobuf.decoder import DecoderFactory

        self._protobuf = DecoderFactory()
        self._made: dict[tuple[str, str, str], Callable[[bytes], Any] | None] = {}

    def decoder_for(self, encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
        """Return None if vslam does not read the messages of a channel."""
        if schema is None or _ENCODINGS.get(encoding) != schema.encoding:
            return None
        key = encoding, schema.name, schema.data
        if key not in self._made:
            self._made[key] = self._make(encoding, schema)
        return self._made[key]

    def _make(self, encoding: str, schema: Any) -> Callable[[bytes], Any] | None:
        if _ros2_name(schema.name) not in READ_TYPES:
            return None
        if encoding == "json":
            return partial(json.loads, object_hook=_namespace)
        if encoding == "protobuf":
            return self._protobuf.decoder_for(encoding, schema)
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        name = _ros2_name(schema.name)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(schema.data.decode(), name))
        decode = store.deserialize_cdr if encoding == "cdr" else store.deserialize_ros1
        return partial(decode, typename=name)


def _namespace(values: dict[str, Any]) -> SimpleNamespace:
    return SimpleNamespace(**values)


def _ros2_name(name: str) -> str:
    """Return the name of a type as ROS 2 writes it. ROS 1 writes ``sensor_msgs/Image``."""
    package, slash, kind = name.partition("/")
    return f"{package}/msg/{kind}" if slash and "/" not in kind else name


def _check_metadata(file: Path) -> None:
    """Reject a large file, because rosbags needs 30 us and 300 bytes of memory for each byte."""
    if file.is_file() and file.stat().st_size > _MOST_METADATA:
        raise ValueError(f"{file.name} is larger than {_MOST_METADATA / 1e6:.0f} MB")


def _files(path: Path) -> list[Path]:
    """Return the files of a bag in the order of their numbers."""
    if not path.is_dir():
        return [path]
    found = [file for file in path.iterdir() if file.suffix.lower() in _MAGIC]
    return sorted(found, key=lambda file: ([int(n) for n in re.findall(r"\d+", file.stem)], file))


def _unreadable(path: Path, files: list[Path], error: Exception) -> str:
    """Say why a bag cannot be opened, and what to do about it."""
    for file in files:
        if (why := _why_cut_off(file)) is not None:
            repair = _REPAIR.get(file.suffix.lower(), "mcap recover")
            return (
                f"{file}: the recording was cut off ({why}); repair it with '{repair}', or copy "
                "the whole file again."
            )
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        if not files:
            return f"{path}: the folder contains no bag; give a bag with --data."
        return (
            f"{path}: there is no metadata.yaml, which 'ros2 bag record' writes at its end; write "
            "it with 'ros2 bag reindex', or give a file of the folder with --data."
        )
    for file in files:
        kind = file.suffix.lower()
        with file.open("rb") as stream:
            begins = stream.read(16)
        if kind in _MAGIC and not begins.startswith(_MAGIC[kind]):
            return (
                f"{file}: not a bag, because it does not begin like a file of the kind {kind}; "
                "give another file."
            )
    return (
        f"{path}: cannot be read as a bag ({_reason(error)}); convert it to a bag that rosbags or "
        "mcap can read, or copy it again if it was damaged."
    )


def _why_cut_off(file: Path) -> str | None:
    """Return what a file lacks that every completed file of its kind has; None if it is complete
    or of another kind."""
    kind, size = file.suffix.lower(), file.stat().st_size
    if not size:
        return "the file is empty"
    with file.open("rb") as stream:
        begins = stream.read(4200)  # the header of a ROS 1 bag ends after 4,109 bytes
        if not begins.startswith(_MAGIC.get(kind, b"?")[:size]):
            return None
        if kind == ".mcap":
            stream.seek(-min(size, 8), os.SEEK_END)
            return None if size > 16 and stream.read() == _MAGIC[kind] else "it has no footer"
        if kind == ".db3":
            page, pages = int.from_bytes(begins[16:18], "big"), int.from_bytes(begins[28:32], "big")
            whole = (65536 if page == 1 else page) * pages
            return None if whole <= size else f"{whole - size:,} bytes are missing"
        return _why_unindexed(stream, begins, size)


def _why_unindexed(stream: BinaryIO, begins: bytes, size: int) -> str | None:
    """The same for a ROS 1 bag, at whose end is an index of its connections and chunks."""
    if begins.startswith(b"#ROSBAG V1"):
        return None
    index, n_connections, n_chunks = (
        int.from_bytes(begins.partition(name + b"=")[2][:length], "little")
        for name, length in ((b"index_pos", 8), (b"conn_count", 4), (b"chunk_count", 4))
    )
    if not 0 < index <= size:
        return "it has no index"
    end = index
    for _ in range(2 * (n_connections + n_chunks)):  # each record has a header and data
        stream.seek(end)
        end += 4 + int.from_bytes(stream.read(4), "little")
        if end > size:
            return "its index is incomplete"
    return None


def _reason(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0].rstrip(".")
