"""Test every reader with damaged files (fuzzing).

A reader must quickly return a result or raise an `InputError`. Each input is a small valid file
that is changed by a seeded mutation. A failure is any other exception, a crash, more than SECONDS
of CPU time, or more than MEGABYTES of memory. Readers run in a separate process, so that a crash is
recorded like any other failure.

usage: python tools/fuzz.py [--inputs 1000] [--seed 0] [--readers kitti,video] [--keep FOLDER]
"""

from __future__ import annotations

import argparse
import faulthandler
import gc
import io
import json
import logging
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/product"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

import valid_files

SECONDS, MEGABYTES = 20, 600
WALL_SECONDS = 300  # limit for readers that hang without using CPU time, even on a busy machine
ADDRESS_SPACE = 8 * 2**30  # bytes; a reader that allocates more gets a MemoryError
_NUMBERS = ["nan", "inf", "-inf", "1e999", "-1", "0", "1e-320", "9" * 30, "2147483648", "0x10", ""]
_SPECIAL = [0, 1, 0x7F, 0xFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000, 0x7FFFFFFFFFFFFFFF]


@dataclass(frozen=True)
class Reader:
    """A reader that is tested with damaged files.

    Attributes:
        write: function that writes valid files into a folder.
        read: function that reads the files in a folder.
        changed: pattern of the names of the files to damage. One file is damaged at a time.
        mutation: function of the content, a random generator and the file name, which returns the
            changed content; None for `mutate`.
    """

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    changed: str
    mutation: Callable[[bytes, np.random.Generator, str], bytes] | None = None


# -- readers --------------------------------------------------------------------------------------


def _use(source) -> None:
    """Read every frame of a source. Frames that cannot be read are skipped, as in a run."""
    from vslam.support.errors import InputError, UnreadableImageError

    try:
        for frame in source.frames():
            try:
                frame.read(map)
            except UnreadableImageError:
                continue
    except InputError:
        return


def _each(read: Callable[[str], object], names: Iterable[str]) -> None:
    """Read all files. If some files were rejected, raise one of the errors at the end."""
    from vslam.support.errors import InputError

    refused = None
    for name in names:
        try:
            read(name)
        except InputError as error:
            refused = error
    if refused is not None:
        raise refused


def _read_source(dataset: str, data: str, folder: Path, **options) -> None:
    from vslam.datasets.sources import open_source
    from vslam.types.source_options import SourceOptions

    if "calib" in options:
        options["calib"] = (folder / options["calib"],)
    _use(open_source(SourceOptions(dataset=dataset, data=str(folder / data), **options)))


def _read_video(folder: Path) -> None:
    def read(file: str) -> None:
        calib = "../mono.yaml" if file == "a.mkv" else "../wide.yaml"
        _read_source("video", file, folder, sensor="mono", calib=calib)

    _each(read, ("a.mkv", "b.avi"))


def _read_calibrations(folder: Path) -> None:
    from vslam.calibration.files import read_calibration
    from vslam.calibration.rectification import rectify

    def read(name: str) -> None:
        found = rectify(read_calibration([folder / name], (64, 48)))
        if (found.camera.width, found.camera.height) == (64, 48):
            found.left(valid_files.noise()[0])

    _each(read, valid_files.CALIBRATIONS)


def _read_map(folder: Path) -> None:
    from vslam.maps.storage import load_checkpoint
    from vslam.types.map_kernels import resolve

    stored = load_checkpoint(folder / "map.npz")
    for map_ in (stored.map, stored.compact().map):
        for k in range(map_.n_keyframes):
            map_.covisible(k)
            map_.keyframe_pose(k)
    if stored.checkpoint is not None:
        resolve(stored.map.arrays, stored.checkpoint.last.landmark)


def _use_map(folder: Path) -> None:
    """Use a saved map in every way that vslam offers.

    The map is exported, resumed, continued with a new drive, used for localisation, and merged with
    another map.
    """
    with tempfile.TemporaryDirectory(dir=folder) as out:
        _use_map_in(folder / "map.npz", folder / "other.npz", Path(out))


def _use_map_in(file: Path, other: Path, out: Path) -> None:
    from vslam.cli.export import g2o
    from vslam.cli.map import info
    from vslam.config import Config
    from vslam.loopclosure.registry import detector_with_images
    from vslam.maps.colmap import save_colmap
    from vslam.maps.formats import save_ply
    from vslam.maps.reconstruction import reconstruction_of
    from vslam.maps.storage import load_map
    from vslam.maps.stored_map import in_box
    from vslam.method.joining import join_maps
    from vslam.slam import Slam
    from vslam.support.errors import InputError

    stored = load_map(file)
    map_ = stored.map
    save_ply(out / "a.ply", map_.arrays.xyz[: map_.n_landmarks])
    g2o(file, out / "a.g2o", quiet=True)
    info(file)
    model = reconstruction_of(map_, stored.camera)
    colours = np.zeros((len(model.xyz), 3), np.uint8)
    save_colmap(out, model, [f"{k}.png" for k in range(len(model.frames))], colours)
    stored.select(in_box(map_, (-5.0, 5.0, -5.0, 5.0)))
    for options, start in (({"resume": True}, 2.4), ({}, 0.0), ({"localize": True}, 0.0)):
        slam = Slam.load(file, detector="bow", threads=1, **options)
        valid_files.drive_on(slam, range(24, 28), 0, start)
        slam.finish()
        slam.trajectory()
        if "localize" not in options:
            slam.save(out / "again.npz", resumable=True)
            load_map(out / "again.npz")
    config = Config()
    try:
        join_maps([load_map(other), stored], config, lambda: detector_with_images("bow", config))
    except ValueError as error:  # as ``vslam map merge`` does
        raise InputError(str(error)) from error


def _read_config(folder: Path) -> None:
    from vslam.config import load_config

    load_config(folder / "config.json")


def _read_report(folder: Path) -> None:
    from vslam.report.render import html, markdown
    from vslam.report.run_page import run_page
    from vslam.report.schema import ReportJson
    from vslam_lab.overview.render import write_overview

    report = ReportJson.read(folder / "report.json")
    page = run_page(report)
    html(page)
    markdown(page)
    write_overview([folder], [], folder / "overview")


def _read_vocabulary(folder: Path) -> None:
    from vslam.loopclosure.vocabulary_text import read_vocabulary

    def read(name: str) -> None:
        read_vocabulary(folder / name).words(np.zeros((3, 32), np.uint8))

    _each(read, ("words.npz", "words.txt"))


def _read_trajectories(folder: Path) -> None:
    from vslam.types.trajectory import read_trajectory

    _each(lambda name: read_trajectory(folder / name), ("a.kitti", "a.tum", "a.csv"))


def _read_onnx(folder: Path) -> None:
    from vslam.loopclosure.siamese.inference import OnnxNetwork

    network = OnnxNetwork(folder / "net.onnx")
    network.embed(np.zeros(network.size, np.uint8))


def _read_weights(folder: Path) -> None:
    from vslam_lab.training.siamese import load_network

    load_network(folder / "net.safetensors")


def _foxglove(encoding: str) -> Reader:
    write = partial(valid_files.foxglove, encoding)
    return Reader(write, partial(_read_source, "bag", "a.mcap"), "a.mcap")


def _bag(kind: str, encoding: str, data: str, changed: str, compression: str = "") -> Reader:
    write = partial(valid_files.bag, kind, encoding, compression=compression)
    return Reader(write, partial(_read_source, "bag", data), changed)


# -- mutations of the content of maps ------------------------------------------------------------

_INTEGERS = [-(2**62), -(2**31), -2, -1, 0, 1, 2, 7, 255, 2**31 - 1, 2**40, 2**62]
_FLOATS = [np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 0.5, 5e-324, 1e-30, 1e6, 1e30, 1e200, -1e200]
_HEADER_VALUES = [
    np.nan, np.inf, -np.inf, -1, 0, 0.5, 1, 2, 2**31, 2**63, 10**30, 1e-300, 1e300, True, None,
    "x", [], {}, [[]],
]  # fmt: skip


def _mutate_meaning(data: bytes, rng: np.random.Generator, name: str) -> bytes:
    """Change one or two values in arrays or in the header of a map, but no types or shapes."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name].copy() for name in file.files}
    for _ in range(int(rng.integers(1, 3))):
        if rng.random() < 0.3:
            header = json.loads(arrays["header"].tobytes())
            text = json.dumps(_other_number(header, rng))
            arrays["header"] = np.frombuffer(text.encode(), np.uint8)
            continue
        array = arrays[str(rng.choice([n for n in arrays if n != "header" and arrays[n].size]))]
        _change(array.reshape(-1), rng, len(array))
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _change(flat: np.ndarray, rng: np.random.Generator, length: int) -> None:
    """Change one, some or all numbers of an array in place."""
    share = rng.choice([0.0, 0.1, 1.0], p=[0.6, 0.2, 0.2])
    at = np.flatnonzero(rng.random(len(flat)) < share)
    if not len(at):
        at = rng.integers(len(flat), size=1)
    way = int(rng.integers(5))
    if way == 0:  # other numbers of the array
        flat[at] = flat[rng.integers(len(flat), size=len(at))]
    elif way == 1:  # another order
        flat[at] = flat[at][::-1] if len(at) > 1 else flat[len(flat) - 1 - at]
    elif flat.dtype == bool:
        flat[at] ^= True
    elif flat.dtype.kind in "iu":
        bounds = np.iinfo(flat.dtype)
        value = int(rng.choice([*_INTEGERS, length, length - 1]))
        if way == 2:
            value = int(flat[at[0]]) + int(rng.choice([-1, 1]))
        flat[at] = min(max(value, bounds.min), bounds.max)
    else:
        value = float(rng.choice(_FLOATS))
        with np.errstate(all="ignore"):
            flat[at] = flat[at] * value if way == 2 else value


def _other_number(value: object, rng: np.random.Generator) -> object:
    """Replace one value in JSON data with a different value."""
    if isinstance(value, dict | list) and value and rng.random() < 0.95:
        keys = list(value) if isinstance(value, dict) else list(range(len(value)))
        key = keys[int(rng.integers(len(keys)))]
        value[key] = _other_number(value[key], rng)
        return value
    return _HEADER_VALUES[int(rng.integers(len(_HEADER_VALUES)))]


READERS: dict[str, Reader] = {
    "images": Reader(
        valid_files.images, partial(_read_source, "images", "", calib="stereo.yaml"), "**/*.*"
    ),
    "image-kinds": Reader(
        valid_files.other_images,
        partial(_read_source, "images", "", calib="../mono.yaml", sensor="mono"),
        "*.*",
    ),
    "kitti": Reader(valid_files.kitti, partial(_read_source, "kitti", ""), "**/*.*"),
    "tum": Reader(valid_files.tum, partial(_read_source, "tum", ""), "**/*.*"),
    "euroc": Reader(valid_files.euroc, partial(_read_source, "euroc", ""), "**/*.*"),
    "calibration": Reader(valid_files.calibrations, _read_calibrations, "*.*"),
    "bag-ros1": _bag("ros1", "mono8", "a.bag", "a.bag"),
    "bag-ros2": _bag("ros2", "png", "a", "a/*"),
    "bag-mcap": _bag("folder", "mono16", "a", "a/*"),
    "foxglove-json": _foxglove("json"),
    "foxglove-protobuf": _foxglove("protobuf"),
    "bag-lz4": _bag("ros1", "mono8", "a.bag", "a.bag", "lz4"),
    "bag-zstd": _bag("folder", "mono8", "a", "a/*", "storage"),
    "video": Reader(valid_files.video, _read_video, "*.*"),
    "map": Reader(valid_files.map_file, _read_map, "map.npz"),
    "map-meaning": Reader(valid_files.drives, _use_map, "map.npz", mutation=_mutate_meaning),
    "config": Reader(partial(valid_files.config_or_report, "config"), _read_config, "config.json"),
    "report": Reader(partial(valid_files.config_or_report, "report"), _read_report, "*.json"),
    "vocabulary": Reader(valid_files.vocabulary, _read_vocabulary, "words.*"),
    "trajectory": Reader(valid_files.trajectories, _read_trajectories, "a.*"),
    "onnx": Reader(valid_files.onnx, _read_onnx, "net.onnx"),
    "weights": Reader(valid_files.weights, _read_weights, "net.safetensors"),
}


# -- mutations ------------------------------------------------------------------------------------


def mutate(data: bytes, rng: np.random.Generator, name: str) -> bytes:
    """Damage the content of a file: apply one to four changes.

    Sometimes, a single change that is specific to the format of the file is applied instead.
    """
    if name.endswith(".npz") and rng.random() < 0.6:
        return _mutate_npz(data, rng)
    if data[:8] == b"\x89PNG\r\n\x1a\n" and rng.random() < 0.3:
        return _mutate_png(data, rng)
    text = not data[:512].translate(None, bytes(range(32, 127)) + b"\n\r\t")
    changes = [_bytes, _number, _lines, _nest] if text else [_bytes]
    for _ in range(int(rng.integers(1, 5))):
        if data:
            data = changes[int(rng.integers(len(changes)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """Return a random position in the content of a file.

    With a probability of one half, it is in the first 256 bytes, which contain the header.
    """
    return int(rng.integers(min(len(data), 256) if rng.random() < 0.5 else len(data)))


def _bytes(data: bytes, rng: np.random.Generator) -> bytes:
    way, at, size = rng.integers(8), _place(data, rng), int(rng.integers(1, 64))
    if way < 2:
        return data[:at] + bytes([data[at] ^ 1 << int(rng.integers(8))]) + data[at + 1 :]
    if way < 4:
        size = int(rng.choice([1, 2, 4, 8]))
        value = int(rng.choice(np.array(_SPECIAL, np.uint64))) & (1 << 8 * size) - 1
        new = value.to_bytes(size, "little" if rng.random() < 0.5 else "big")
        return data[:at] + new + data[at + size :]
    if way == 4:
        return data[:at]
    if way == 5:
        return data[:at] + data[at + size :]
    if way == 6:
        return data[:at] + data[at : at + size] * int(rng.integers(2, 50)) + data[at + size :]
    return data[:at] + rng.bytes(size) + data[at:]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    found = list(re.finditer(rb"-?\d+(\.\d+)?(e[-+]?\d+)?", data))
    if not found:
        return data
    one = found[int(rng.integers(len(found)))]
    return data[: one.start()] + str(rng.choice(_NUMBERS)).encode() + data[one.end() :]


def _lines(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    at, to = (int(rng.integers(len(lines))) for _ in range(2))
    line = lines[at] if rng.random() < 0.3 else lines.pop(at)
    if rng.random() < 0.7:
        lines.insert(to, line)
    return b"\n".join(lines)


def _nest(data: bytes, rng: np.random.Generator) -> bytes:
    """Insert deeply nested brackets, or YAML aliases that grow exponentially."""
    way = int(rng.integers(6))
    if way == 5:  # replace a list with one that grows exponentially
        return _GROWING + b"\n" + re.sub(rb"\[[^]]*\]", b"*a8", data, count=1)
    bombs = (
        b"[" * 20_000,
        b'{"a":' * 20_000,
        b"- " * 20_000,
        _GROWING,
        "\u202e\ufeff\x00é".encode(),
    )
    at = 0 if rng.random() < 0.5 else _place(data, rng)
    return data[:at] + bombs[way] + b"\n" + data[at:]


_GROWING = b"\n".join(
    [b"a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    + [b"a%d: &a%d [%s]" % (k, k, b", ".join([b"*a%d" % (k - 1)] * 9)) for k in range(1, 9)]
)


def _mutate_npz(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the values, shape or type of an array in an .npz file, or state a size of 100 GB."""
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    name = str(rng.choice(sorted(arrays)))
    array = arrays.pop(name)
    way, out, claim = int(rng.integers(7)), io.BytesIO(), io.BytesIO()
    if way == 0:
        arrays[name] = array.reshape(-1)[: int(rng.integers(0, array.size + 1))]
    elif way == 1:
        arrays[name] = np.concatenate([array.reshape(-1)] * 3)
    elif way == 2:
        arrays[name] = array.astype(str(rng.choice(["f8", "i1", "u8", "c16", "S3", "f2"])))
    elif way == 3:
        arrays[name] = array.reshape((1, *array.shape, 1))
    elif way == 4 and array.size and array.dtype.kind in "biuf":
        arrays[name] = array.copy()
        _change(arrays[name].reshape(-1), rng, len(array.reshape(-1)))
    np.savez(out, **arrays)  # in the other cases, the array is missing
    if way == 5:
        header = {"descr": "<f8", "fortran_order": False, "shape": (12_500_000_000,)}
        np.lib.format.write_array_header_1_0(claim, header)
        with zipfile.ZipFile(out, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(f"{name}.npy", claim.getvalue() + bytes(64))
    return out.getvalue()


def _mutate_png(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the size, depth or colour type in the header of a PNG file. Correct the checksum."""
    sizes = [0, 1, 47, 64, 65, 11_000, 100_000, 2**31 - 1]
    width, height = (int(rng.choice(sizes)) for _ in range(2))
    depth, kind = int(rng.choice([1, 8, 16])), int(rng.choice([0, 2, 3, 6]))
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return data[:12] + body + struct.pack(">I", zlib.crc32(body)) + data[33:]


# -- in the child process that runs the readers ---------------------------------------------------


def _peak_mb() -> float:
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+)", status.read_text()) if status.exists() else None
    return int(found[1]) / 1024 if found else 0.0


def _reset_peak() -> None:
    clear = Path("/proc/self/clear_refs")
    if clear.exists():
        clear.write_text("5")


def _work(name: str, first: int, inputs: int, seed: int, scratch: Path) -> None:
    """Read damaged inputs in this process.

    For each input, a JSON line with its number is printed before it is read, and a JSON line with
    the outcome afterwards.
    """
    from vslam.support.errors import InputError

    logging.disable(logging.CRITICAL)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    faulthandler.register(signal.SIGPROF, chain=True)  # prints a traceback, then ends the process
    reader = READERS[name]
    valid = scratch / "valid"
    valid.mkdir(parents=True, exist_ok=True)
    if not any(valid.iterdir()):
        reader.write(valid)
    reader.read(valid)  # this must succeed; it also imports and compiles everything that is needed
    files = sorted(p for p in valid.glob(reader.changed) if p.is_file())
    for number in range(first, inputs):
        print(json.dumps({"begin": number}), flush=True)
        rng = np.random.default_rng([seed, zlib.crc32(name.encode()), number])
        file = files[int(rng.integers(len(files)))]
        data = (reader.mutation or mutate)(file.read_bytes(), rng, file.name)
        folder = scratch / "now"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(valid, folder)
        (folder / file.relative_to(valid)).write_bytes(data)
        gc.collect()
        _reset_peak()
        before, start = _peak_mb(), time.process_time()
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        faulthandler.dump_traceback_later(WALL_SECONDS, exit=True)
        message = None
        try:
            reader.read(folder)
            outcome = "read"
        except InputError as error:
            message = str(error)
            outcome = "more than a line" if "\n" in message else "refused"
        except BaseException as error:
            outcome, message = type(error).__name__, traceback.format_exc()
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
        seconds, grown = time.process_time() - start, _peak_mb() - before
        if outcome in ("read", "refused") and grown > MEGABYTES:
            outcome, message = "memory", f"{grown:.0f} MB"
        line = {"reader": name, "number": number, "file": file.name, "outcome": outcome}
        line |= {"message": message, "seconds": seconds, "mb": grown}
        print(json.dumps(line), flush=True)


# -- in the parent process ------------------------------------------------------------------------


def fuzz(name: str, inputs: int, seed: int, keep: Path | None = None) -> dict[str, object]:
    """Test a reader. Return how many inputs were read, how many were rejected, and the failures."""
    tried, read, refused, slowest, most = 0, 0, 0, 0.0, 0.0
    failures: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="vslam-fuzz-") as scratch:
        first = 0
        while first < inputs:
            command = [sys.executable, __file__, "--work", name, str(first), str(inputs)]
            command += [str(seed), scratch]
            done = subprocess.run(command, capture_output=True, text=True, errors="replace")
            lines = [json.loads(x) for x in done.stdout.splitlines() if x.startswith("{")]
            begun = [line["begin"] for line in lines if "begin" in line]
            ended = [line for line in lines if "number" in line]
            tried += len(begun)
            for line in ended:
                slowest, most = max(slowest, line["seconds"]), max(most, line["mb"])
                read += line["outcome"] == "read"
                refused += line["outcome"] == "refused"
                if line["outcome"] not in ("read", "refused"):
                    failures.append(line)
            if not begun or len(begun) > len(ended):
                number = begun[-1] if begun else first
                slow = "Timeout" in done.stderr or done.returncode == -signal.SIGPROF
                why = "hang" if slow else f"exit code {done.returncode}"
                failures.append({"number": number, "outcome": why, "message": done.stderr[-3000:]})
                if not begun:
                    break
                if keep is not None:
                    shutil.copytree(
                        f"{scratch}/{name}/now", keep / f"{name}-{number}", dirs_exist_ok=True
                    )
            first = begun[-1] + 1
    return {
        "reader": name,
        "tried": tried,
        "read": read,
        "refused": refused,
        "failures": failures,
        "slowest_s": round(slowest, 2),
        "most_mb": round(most),
    }


def main() -> None:
    if sys.argv[1:2] == ["--work"]:
        names, first, inputs, seed, scratch = sys.argv[2:]
        for name in names.split(","):
            _work(name, int(first), int(inputs), int(seed), Path(scratch) / name)
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=1000, help="number per reader")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--readers", default=",".join(READERS))
    parser.add_argument("--keep", type=Path, help="folder for inputs that crash or hang")
    options = parser.parse_args()
    total, failed = 0, 0
    print("| reader | inputs | read | refused | failures | slowest | most memory |")
    print("|---|---|---|---|---|---|---|")
    problems = []
    for name in options.readers.split(","):
        found = fuzz(name, options.inputs, options.seed, options.keep)
        failures = found["failures"]
        assert isinstance(failures, list)
        total, failed = total + int(str(found["tried"])), failed + len(failures)
        problems += [(name, one) for one in failures]
        print(
            f"| {name} | {found['tried']} | {found['read']} | {found['refused']} | "
            f"{len(failures)} | {found['slowest_s']} s | {found['most_mb']} MB |",
            flush=True,
        )
    print(f"\n{total} inputs, {failed} failures")
    for name, one in problems:
        print(f"\n{name} {one['number']}: {one['outcome']}\n{one['message']}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
