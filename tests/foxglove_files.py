"""Writes the messages of Foxglove to MCAP files."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from mcap.writer import Writer as McapWriter

from vslam.types.camera import Camera

TYPES = {"string": 9, "fixed32": 7, "bytes": 12, "double": 1}
FIELDS = {
    "CompressedImage": {"frame_id": "string", "data": "bytes", "format": "string"},
    "RawImage": {"frame_id": "string", "width": "fixed32", "height": "fixed32",
                 "encoding": "string", "step": "fixed32", "data": "bytes"},
    "CameraCalibration": {"frame_id": "string", "width": "fixed32", "height": "fixed32",
                          "distortion_model": "string", **dict.fromkeys("DKRP", "double")},
}  # fmt: skip


def protobuf_of(kind: str) -> tuple[bytes, type]:
    """Return the schema of a message of Foxglove, and its class."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"foxglove/{kind}.proto", package="foxglove", syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )  # fmt: skip
    message = file.message_type.add(name=kind)
    message.field.add(name="timestamp", number=1, type=11, label=1,
                      type_name=".google.protobuf.Timestamp")  # fmt: skip
    for number, (name, of) in enumerate(FIELDS[kind].items(), 2):
        message.field.add(
            name=name, number=number, type=TYPES[of], label=3 if name in "DKRP" else 1
        )
    time = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(time)
    schema = descriptor_pb2.FileDescriptorSet(file=[time, file])
    pool = descriptor_pool.DescriptorPool()
    pool.Add(time)
    pool.Add(file)
    found = pool.FindMessageTypeByName(f"foxglove.{kind}")
    return schema.SerializeToString(), message_factory.GetMessageClass(found)


class Recorder:
    """Writes the messages of Foxglove as JSON or Protobuf, and other messages as bytes."""

    def __init__(self, path: Path, encoding: str = "json", profile: str = "", **options) -> None:
        self.file = path.open("wb")
        self.writer = McapWriter(self.file, **options)
        self.writer.start(profile)
        self.encoding = encoding
        self.channels: dict[str, tuple[int, type | None]] = {}

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.finish()
        self.file.close()

    def raw(self, topic, stamp, data, encoding="", schema="", schema_encoding="", text=b""):
        if topic not in self.channels:
            number = self.writer.register_schema(schema, schema_encoding, text) if schema else 0
            channel = self.writer.register_channel(topic, encoding, number)
            self.channels[topic] = channel, None
        channel, _ = self.channels[topic]
        self.writer.add_message(channel, log_time=stamp, publish_time=stamp, data=data)

    def send(self, topic: str, kind: str, stamp: int, **fields) -> None:
        seconds, nanoseconds = divmod(stamp, 10**9)
        if self.encoding == "json":
            if "data" in fields:
                fields["data"] = base64.b64encode(fields["data"]).decode()
            time = {"sec": seconds, "nsec": nanoseconds}
            data, text = json.dumps({"timestamp": time, **fields}).encode(), b'{"type":"object"}'
        else:
            text, made = protobuf_of(kind)
            time = timestamp_pb2.Timestamp(seconds=seconds, nanos=nanoseconds)
            message = made(**fields)
            message.timestamp.ParseFromString(time.SerializeToString())
            data = message.SerializeToString()
        schema_encoding = {"json": "jsonschema"}.get(self.encoding, self.encoding)
        self.raw(topic, stamp, data, self.encoding, f"foxglove.{kind}", schema_encoding, text)


def compressed(pixels: np.ndarray) -> dict:
    return {"format": "png", "data": cv2.imencode(".png", pixels)[1].tobytes()}


def raw(pixels: np.ndarray) -> dict:
    encoding = {2: "mono8", 3: "rgb8"}[pixels.ndim]
    if pixels.dtype == np.float32:
        encoding = "32FC1"
    step = pixels.strides[0]
    height, width = pixels.shape[:2]
    return {"width": width, "height": height, "encoding": encoding, "step": step,
            "data": pixels.tobytes()}  # fmt: skip


def calibration(camera: Camera, side: int) -> dict:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    P = [*K[:3], -side * camera.bf, *K[3:6], 0.0, *K[6:], 0.0]
    return {"width": camera.width, "height": camera.height, "distortion_model": "plumb_bob",
            "D": [0.0] * 5, "K": K, "R": np.eye(3).ravel().tolist(), "P": P}  # fmt: skip
