"""Files from untrusted people are not executed, and small files cannot use much memory."""

from __future__ import annotations

import ast
import io
import os
import pickle
import re
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from test_report import make_outcome, report_of

from vslam.calibration.documents import read_document
from vslam.datasets.bag import open_bag
from vslam.datasets.image_files import read_grey
from vslam.datasets.video import open_video
from vslam.loopclosure.vocabulary import load
from vslam.maps.storage import load_map
from vslam.report.render import html
from vslam.report.run_page import run_page
from vslam.run.progress import read_progress
from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.untrusted import MOST_PIXELS, read_npz

ROOT = Path(__file__).parents[2]
SOURCES = [
    path for folder in ("vslam", "frontend", "backend", "loopclosure", "tools")
    for path in sorted((ROOT / folder).rglob("*.py"))
]  # fmt: skip


def png(width: int, height: int, rows: int = 10) -> bytes:
    """Make an image whose header states more rows than the image has."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(rows * (width + 1)))
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + chunks


def npy(shape: tuple[int, ...], data: bytes, descr: str = "<f8") -> bytes:
    out = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(out, header)
    return out.getvalue() + data


def write_zip(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


class Touch:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("read", [lambda p: read_npz(p, "a map"), load, load_map])
def test_pickles_in_npz_are_refused_unread(tmp_path: Path, read):
    trap = tmp_path / "made"
    array = np.array([Touch(trap)], dtype=object)
    np.savez(tmp_path / "a.npz", schema=array, n_children=array)
    with pytest.raises(InputError, match=r"holds Python objects|not a map of vslam"):
        read(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(pickle.dumps(Touch(trap)))
    with pytest.raises(InputError, match="not a"):
        read(tmp_path / "b.npz")
    assert not trap.exists()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (npy((12_500_000_000,), bytes(64)), "a.npy is not as long as its header says"),
        (npy((2**62, 2**62), bytes(8)), "a.npy is not as long as its header says"),
        (npy((-1,), b""), "a.npy is not as long as its header says"),
        (npy((1,), bytes(8))[:40], "."),
        (b"no array", "."),
    ],
)
def test_arrays_that_promise_more_than_there_is(tmp_path: Path, data: bytes, says: str):
    path = write_zip(tmp_path / "a.npz", {"a.npy": data})
    with pytest.raises(InputError, match=re.escape(says)):
        read_npz(path, "a map")


def test_a_zip_that_unpacks_beyond_the_memory(tmp_path: Path, monkeypatch):
    """The file contains 4 MB of zeros in a few kB, and only 1 MB of memory is free."""
    import psutil

    path = write_zip(tmp_path / "a.npz", {"a.npy": npy((2**19,), bytes(2**22))})
    assert path.stat().st_size < 10_000
    assert read_npz(path, "a map")["a"].nbytes == 2**22
    free = type("Memory", (), {"available": 2**20})
    monkeypatch.setattr(psutil, "virtual_memory", free)
    with pytest.raises(InputError, match=r"unpacks to 0.0 GB, .* if this is not a map"):
        read_npz(path, "a map")


def test_arrays_come_back_as_numpy_reads_them(tmp_path: Path):
    arrays = {
        "f": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "empty": np.zeros((0, 3), np.int32),
        "scalar": np.array(7),
        "text": np.array(["a", "bc"]),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz", "a map")
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            assert (found[name] == array).all()
            assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
            assert found[name].flags.writeable


@pytest.mark.parametrize(("width", "height"), [(100_000, 100_000), (12_000, 12_000)])
def test_images_of_absurd_size_are_refused_by_their_header(tmp_path: Path, width, height):
    """The test uses a separate process, because OpenCV reads the limit when it is imported."""
    assert width * height > MOST_PIXELS
    (tmp_path / "a.png").write_bytes(png(width, height))
    script = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from vslam.datasets.image_files import read_grey\n"
        "from vslam.support.errors import UnreadableImageError\n"
        "try: read_grey(Path(sys.argv[1]))\n"
        "except UnreadableImageError as error: print(error)\n"
        # getrusage starts at the peak of the parent.
        "status = Path('/proc/self/status').read_text()\n"
        "print(int(re.search(r'VmHWM:\\s+(\\d+)', status)[1]) // 1024)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "a.png")], capture_output=True, text=True
    )
    said, peak = done.stdout.splitlines()
    assert f"has more than {MOST_PIXELS / 1e6:.0f} million pixels" in said
    assert int(peak) < 400  # MB


def test_a_video_of_absurd_size_is_refused_by_its_header(tmp_path: Path, monkeypatch):
    class Capture:
        """A video with 144 million pixels per frame. No frame of it may be read."""

        def get(self, kind: int) -> float:
            return 12_000.0

    (tmp_path / "a.mp4").write_bytes(b"a video")
    monkeypatch.setattr("vslam.datasets.video.open_capture", lambda name: Capture())
    with pytest.raises(
        InputError, match="exceed the limit of 134 million pixels; scale the video down"
    ):
        open_video(tmp_path / "a.mp4", monocular=True)


def test_a_damaged_image_says_so(tmp_path: Path):
    (tmp_path / "a.png").write_bytes(png(64, 64)[:40])
    with pytest.raises(UnreadableImageError, match="cannot be decoded"):
        read_grey(tmp_path / "a.png")


def test_yaml_makes_no_objects_and_no_bombs(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text(f"left: !!python/object/apply:os.mkdir [{tmp_path / 'made'}]\n")
    assert read_document(path).values["left"] == [str(tmp_path / "made")]
    assert not (tmp_path / "made").exists()
    bomb = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    bomb += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 12)]
    path.write_text("\n".join([*bomb, "focal: *a11"]))
    with pytest.raises(InputError, match="focal must be numbers, all finite"):
        read_document(path).numbers("focal")
    path.write_text("a: &a [1, *a]\n")
    with pytest.raises(InputError, match="not valid YAML"):
        read_document(path)
    path.write_text("b: [&c [2], *c]\n")
    assert read_document(path).numbers("b") == (2.0, 2.0)


@pytest.mark.slow
def test_what_people_write_is_escaped_in_pages(tmp_path: Path):
    evil = "<script>alert(1)</script>\"'&"
    report = report_of(make_outcome(20), tmp_path).model_copy(
        update={
            "sequence": evil,
            "dataset": evil,
            "detector": evil,
            "evo_command": evil,
            "interrupted": evil,
            "skipped_messages": (evil,),
        }
    )
    page = html(run_page(report, config=evil))
    assert "alert(1)" in page
    assert "<script>alert" not in page


# The last parts of the names of calls that execute what they read, or write outside a folder.
FORBIDDEN = {"eval", "exec", "system", "popen", "extractall", "extract", "unpack_archive"}
FORBIDDEN_MODULES = {"pickle", "dill", "shelve", "marshal", "tarfile", "joblib"}


@pytest.mark.slow
def test_no_source_executes_what_it_reads():
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = [a.name for a in node.names] + [getattr(node, "module", None) or ""]
                found += [where for name in names if name.split(".")[0] in FORBIDDEN_MODULES]
            if not isinstance(node, ast.Call):
                continue
            target = node.func
            plain = target.id if isinstance(target, ast.Name) else None
            method = target.attr if isinstance(target, ast.Attribute) else None
            owner = ast.unparse(target.value) if isinstance(target, ast.Attribute) else ""
            if plain in {"eval", "exec"} or (method in FORBIDDEN - {"eval", "exec", "extract"}):
                found.append(where)
            words = {k.arg: ast.unparse(k.value) for k in node.keywords}
            if words.get("shell", "False") != "False" or words.get("allow_pickle") == "True":
                found.append(where)
            if owner == "yaml" and method == "load" and "BaseLoader" not in ast.unparse(node):
                found.append(where)
            if owner == "torch" and method == "load" and words.get("weights_only") != "True":
                found.append(where)
    assert found == []


def test_yaml_is_bounded_by_its_size(tmp_path: Path):
    """Before there was a limit, 6 MB of YAML took 2.3 GB and a minute."""
    pytest.importorskip("rosbags")
    path = tmp_path / "a.yaml"
    path.write_text("a: [" + "1, " * 40_000 + "1]\n")
    with pytest.raises(
        InputError, match=r"a\.yaml: is larger than 100 kB, so it is not a calibration"
    ):
        read_document(path)
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("a: [" + "1, " * 400_000 + "1]\n")
    with pytest.raises(InputError, match=r"metadata\.yaml is larger than 1 MB"):
        open_bag(bag)


@pytest.mark.parametrize("read", [load_map, read_progress])
def test_a_header_that_is_a_number_is_not_that_many_bytes(tmp_path: Path, read):
    """bytes(3_000_000_000) makes 3 GB of zeros. The file that requested them had 192 bytes."""
    path = tmp_path / "a.npz"
    np.savez(path, header=np.array(100_000_000))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"not a map of vslam|the header is not text"):
        read(path)
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("read", [lambda p: read_npz(p, "a map"), load_map, read_progress])
def test_an_archive_may_not_unpack_to_far_more_than_its_size(tmp_path: Path, read):
    """A small file is rejected even if there is enough memory for its contents."""
    path = write_zip(tmp_path / "a.npz", {"header.npy": npy((2**25,), bytes(2**28))})
    assert path.stat().st_size < 300_000
    with pytest.raises(InputError, match=r"unpacks from 0\.2 MB to 256 MB, so it is probably not"):
        read(path)
