"""Every command on the pages runs, in a shortened form, on the corridor of the tests.

Commands that do not run here are listed with the reason. Commands are the lines of shell blocks,
and those with arguments in tables. The tutorials run in ``test_site.py``, and the pages of plug-ins
in ``test_plugins.py``.
"""

from __future__ import annotations

import glob
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from conftest import corridor_depth
from source_files import write_bag, write_calibration, write_images, write_video
from stub_runner import wait_for

from vslam.types.trajectory import write_kitti

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [p for p in sorted(DOCS.rglob("*.md")) if DOCS / "reference" not in p.parents]
PAGES += [ROOT / name for name in ("README.md", "datasets.md", "CONTRIBUTING.md")]
ELSEWHERE = {"docs/tutorial": "test_site.py", "docs/howto/plugins.md": "test_plugins.py"}
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
IN_TABLE = re.compile(r"`(vslam [^` ]+ [^` ]+ [^`]+)`")
TOOL = re.compile(r"(vslam|python3?|pip|pipx|uvx|make|dask|for) ")
N = 6  # frames of each sequence

HOURS = "it takes hours"
AGAIN = "each town takes seconds, and this form runs on another page or above"
DEPTH_CAMERA = "there is none here; test_depth_cameras.py has fakes of both"
ORBSLAM = "it needs pyorbslam3, which vslam does not depend on"
BOARDS = "test_calibrate.py renders boards for it"
INSTALL = "`make test` builds and installs the wheel"


@dataclass(frozen=True)
class Rules:
    """The rules by which the commands of a page are run.

    ``shorter`` contains patterns in the text of the page and their replacements. ``not_run``
    contains the beginnings of commands that are not run, with the reason.
    """

    shorter: tuple[tuple[str, str], ...] = ()
    not_run: tuple[tuple[str, str], ...] = ()


ALWAYS = (
    (r"--max-frames \d+", f"--max-frames {N}"),
    (r"/tmp/", "tmp/"),
    (r"--seqs 00-05", "--seqs 00"),
    (r"--perturb none,brightness\b", "--perturb none"),
    (r"--detectors none,bow,capsule", "--detectors none"),
    (r"--seeds 3", f"--seeds 1 --max-frames {N}"),
)
RULES = {
    "README.md": Rules(
        not_run=(
            ("git clone", "it needs the address of the repository"),
            ("make ", "CI runs it, and this test in it"),
            ("vslam calibrate", BOARDS),
            ("source .venv", "there is no other environment here"),
        ),
    ),
    "CONTRIBUTING.md": Rules(
        not_run=(
            ("make ", "CI runs it"),
            (".ci/run", "CI runs it"),
            (".venv", "it is this test, or it takes hours"),
            ("git worktree", "it makes a second checkout and its environment"),
            ("(cd ../main", "it is in the second checkout"),
        )
    ),
    "datasets.md": Rules(
        (
            ("synth 05 --change", "synth block --max-frames 2 --change"),
            (r"(vslam synth mine .*?)#", r"\1 --max-frames 2 #"),
            ("--pairs 1000", "--pairs 1"),
            ("--fisheye --out", "--max-frames 2 --fisheye --out"),
        ),
    ),
    "docs/howto/bench.md": Rules(
        (
            # All frames are needed, because errors are not defined for a straight path.
            ("vslam bench --out bench/kitti", "vslam bench --seqs 00 --seeds 1 --out bench/kitti"),
            ("synthetic --out", f"synthetic --seqs block --max-frames {N} --perturb none --out"),
            (
                "--seqs 00,05-07 --perturb brightness:1.5",
                f"--seqs 00 --max-frames {N} --perturb none",
            ),
            ("--seeds 3", "--seeds 1"),
            (
                "stereo.yaml --perturb none,brightness",
                f"stereo.yaml --max-frames {N} --perturb none",
            ),
            (r"\\\n +--trajectory ORB-SLAM3@00@brightness:1=\S+", ""),
            (" --threads 4 ...", f" --seqs 00 --perturb none --max-frames {N}"),
        ),
    ),
    "docs/howto/calibrate.md": Rules(not_run=(("vslam calibrate", BOARDS),)),
    "docs/howto/cameras.md": Rules(
        not_run=(
            ("vslam synth block --fisheye", AGAIN),
            ("pip install", INSTALL),
            ("vslam run --dataset realsense", DEPTH_CAMERA),
            ("vslam run --dataset oakd", DEPTH_CAMERA),
        )
    ),
    "docs/howto/exports.md": Rules(
        (
            ("colmap RUN", "colmap RUN --out again"),
            ("RUN", "runs/latest"),
            (r"nerfstudio runs/latest\n", r"nerfstudio runs/latest --out twice\n"),
        ),
        not_run=(("vslam run phone.mp4", "test_exports.py runs it"),),
    ),
    "docs/howto/ros.md": Rules(),
    "docs/index.md": Rules(not_run=(("pip", INSTALL), ("vslam run", "test_site.py runs them"))),
    "docs/howto/euroc.md": Rules(),
    "docs/howto/install.md": Rules(
        not_run=(
            ("pip", INSTALL),
            ("uvx", INSTALL),
            ("python tools/wheel_test.py", INSTALL),
        )
    ),
    "docs/howto/kitti.md": Rules(),
    "docs/howto/masks.md": Rules(),
    "docs/howto/gps.md": Rules(),
    "docs/howto/tum.md": Rules(),
    "docs/howto/untrusted.md": Rules((("--inputs 1000", "--inputs 2 --readers trajectory"),)),
    "docs/howto/lifelong.md": Rules(
        not_run=(("vslam run --resume", "test_autosave.py resumes runs"),)
    ),
    "docs/research/lifelong.md": Rules(
        not_run=(
            (
                "python tools/experiments/lifelong/inject_faults.py",
                "test_faults.py runs a part",
            ),
            ("python tools/kill_test.py", "it runs for minutes; test_autosave.py kills runs"),
        )
    ),
    "docs/research/local_descriptors.md": Rules(
        not_run=(
            ("vslam bench", HOURS),
            ("python tools/experiments/local_descriptors", "test_loopbench.py runs it"),
        )
    ),
    "docs/research/gps.md": Rules(
        not_run=(
            ("vslam run", "test_gps.py runs a short drive"),
            ("python tools/experiments/gps", "test_gps.py runs it"),
        )
    ),
    "docs/research/scale.md": Rules(
        not_run=(("python tools/experiments/scale/growth.py", "test_scale.py runs it"),)
    ),
    "docs/research/recordings.md": Rules(not_run=(("python tools/experiments/recordings", HOURS),)),
    "docs/research/uncertainty.md": Rules(
        not_run=(
            ("vslam synth", "test_synthetic.py renders drives"),
            ("python tools/experiments/uncertainty", "test_odometry.py runs it"),
        )
    ),
    "docs/research/loops.md": Rules(
        not_run=(
            ("vslam loops bench", "it takes hours; test_loopbench.py runs it on a small town"),
        )
    ),
    "docs/howto/maps.md": Rules(
        (
            ("for town in 401 402 403", "for town in 401"),
            ("for change in 1 0.9", "for change in 1"),
            ("--start 220", "--start 3 --max-frames 3"),
            ("--seq 00` writes", "--seq 00 --save-map town.npz` writes"),
            ("--point 20,140", "--point 0,2"),
        ),
        (("vslam map merge", "its drives must meet; test_joining.py has some"),),
    ),
    "docs/research/online.md": Rules(
        not_run=(("vslam loops bench", "it takes hours; test_online.py runs it"),)
    ),
    "docs/research/performance.md": Rules(not_run=(("python tools/bench_speed.py", ORBSLAM),)),
    "docs/research/results.md": Rules(not_run=(("vslam bench", HOURS),)),
    "docs/howto/rgbd.md": Rules(
        (("demo --rgbd", f"demo --rgbd --max-frames {N}"),),
        (
            ("vslam synth block", AGAIN),
            ("vslam run --data block", AGAIN),
            ("vslam bench --data rgbd_dataset_freiburg1_desk", ORBSLAM),
        ),
    ),
    "docs/howto/sources.md": Rules(
        not_run=(
            ("vslam run --dataset synthetic --seq demo", "test_site.py runs it"),
            ("vslam run --data 0", "there is no camera here; test_sources.py makes one"),
            ("vslam run --dataset realsense", DEPTH_CAMERA),
        )
    ),
    "docs/howto/stress.md": Rules(
        (
            ("--laws fog,night,stereo_gain", "--laws night --seeds 1 --steps 1"),
            (
                "--systems mine --system",
                f"--max-frames {N} --laws night --seeds 1 --steps 1 --systems mine --system",
            ),
        ),
        (
            ("python3 -m venv orbslam", ORBSLAM),
            ("vslam stress --seqs 00 --systems vslam,orbslam3", ORBSLAM),
        ),
    ),
    "docs/research/light.md": Rules(
        (
            ("vslam,orbslam3 .* --perturb ", "vslam --perturb "),
            (r"none,dark:2\S+", "none"),
            ("--every 4", "--every 2 --laws none dark:4 --detectors bow --candidates 3"),
        ),
        (("python tools/experiments/light/day_night.py synthetic", AGAIN),),
    ),
    "docs/research/stress.md": Rules(
        (("--laws all --detectors bow --steps 4", "--laws night --seeds 1 --steps 1"),),
    ),
    "docs/research/training.md": Rules(),
    "docs/howto/training.md": Rules(
        (
            (r'--data "kitti:[^"]*" ', ""),
            ("--pairs 320 --epochs 8", "--pairs 4 --epochs 1 --pixels 65"),
        ),
        (("vslam synth ROUTE --pairs", AGAIN),),
    ),
}


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def is_elsewhere(path: Path) -> bool:
    return any(name(path).startswith(page) for page in ELSEWHERE)


def commands_of(text: str) -> Iterator[str]:
    """Split shell blocks into commands.

    A loop is one command. Text that a command reads up to ``END`` belongs to the command.
    """
    rest = []
    at = 0
    for block in FENCE.finditer(text):
        rest.append(text[at : block.start()])
        at = block.end()
        if block[1] == "sh":
            yield from _logical_lines(block[2])
        elif not block[1]:
            yield from filter(TOOL.match, _logical_lines(block[2]))
    rest.append(text[at:])
    rows = [line for line in "".join(rest).splitlines() if line.startswith("|")]
    for row in rows:
        yield from IN_TABLE.findall(row)


def _logical_lines(block: str) -> Iterator[str]:
    waiting, until = "", ""
    for line in block.replace("\\\n", " ").splitlines():
        if not waiting and line.startswith("for ") and "done" not in line:
            until = "done"
        elif "<<'END'" in line:
            until = "END"
        waiting += line + "\n"
        if not until or line.startswith(until):
            if waiting.strip() and not waiting.startswith("#"):
                yield waiting.strip()
            waiting, until = "", ""


def is_shell(command: str) -> bool:
    """Return whether a command is more than a single call of ``vslam``."""
    return not command.startswith("vslam ") or any(x in command for x in ("; ", "&&", " > "))


@pytest.mark.parametrize("path", PAGES, ids=name)
def test_every_page_with_commands_has_rules(path: Path):
    """Every page is tested here or in another test. Commands that are not run exist on the page."""
    commands = list(commands_of(path.read_text()))
    if is_elsewhere(path):
        return
    assert bool(commands) == (name(path) in RULES)
    for start, reason in RULES.get(name(path), Rules()).not_run:
        assert reason
        assert any(command.startswith(start) for command in commands), start


def test_the_reader_of_commands_sees_all_kinds():
    text = (
        "a\n```sh\nfor n in 1; do\n  vslam run\ndone\nvslam info \\\n  x  # y\n"
        "python - <<'END'\nz\nEND\n# no\n```\n| `vslam map info FILE`, `vslam run` |\n"
        "```python\nvslam\n```\n`vslam run x`\n"
    )
    assert list(commands_of(text)) == [
        "for n in 1; do\n  vslam run\ndone", "vslam info    x  # y", "python - <<'END'\nz\nEND",
        "vslam map info FILE",
    ]  # fmt: skip


@pytest.fixture(scope="module")
def home(corridor, kitti_tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the data sets that the pages name. Each sequence shows the corridor."""
    root, c = tmp_path_factory.mktemp("home"), corridor.camera
    for sequence in ("00", "05", "06"):
        for kind, file in (("sequences", "00"), ("poses", "00.txt")):
            link = root / "kitti" / kind / file.replace("00", sequence)
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(kitti_tree / kind / file)
    for sequence in ("V1_01_easy", "V1_01_start", "MH_03_medium", "V2_02_medium"):
        _write_euroc(root / "euroc" / sequence, corridor)
    depth = [
        (5000 * corridor_depth(c, T_wc)).clip(0, 65535).astype(np.uint16)
        for T_wc in corridor.T_wc[:N]
    ]
    for sequence in ("freiburg1_desk", "freiburg3_long_office_household", "freiburg1_xyz"):
        _write_tum(root / "tum" / f"rgbd_dataset_{sequence}", corridor, depth)
    return root


def _write_euroc(folder: Path, corridor) -> None:
    c = corridor.camera
    for side, images in enumerate((corridor.left, corridor.right)):
        camera = folder / "mav0" / f"cam{side}"
        stamps = [10**18 + 10**8 * k for k in range(N)]
        write_images(camera, {"data": images[:N]}, [f"{stamp}.png" for stamp in stamps])
        lines = "".join(f"{stamp},{stamp}.png\n" for stamp in stamps)
        (camera / "data.csv").write_text(f"#timestamp [ns],filename\n{lines}")
        T = f"[1, 0, 0, {c.baseline * side}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
        (camera / "sensor.yaml").write_text(
            f"T_BS:\n  rows: 4\n  cols: 4\n  data: {T}\ncamera_model: pinhole\n"
            f"resolution: [{c.width}, {c.height}]\nintrinsics: [{c.fx}, {c.fy}, {c.cx}, {c.cy}]"
            "\ndistortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
        )


def _write_tum(folder: Path, corridor, depth: list[np.ndarray]) -> None:
    names = [f"{100 + 0.1 * k:.1f}.png" for k in range(N)]
    write_images(folder, {"rgb": corridor.left[:N], "depth": depth}, names)
    for side in ("rgb", "depth"):
        lines = "".join(f"{Path(name).stem} {side}/{name}\n" for name in names)
        (folder / f"{side}.txt").write_text(lines)
    write_calibration(folder / "calibration.yaml", corridor.camera, mono=True)


@pytest.fixture(scope="module")
def towns(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of rendered towns, which the tests of all pages share."""
    return tmp_path_factory.mktemp("towns")


@pytest.fixture
def desk(
    home: Path, towns: Path, corridor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """The folder in which commands are run, with the files that they name."""
    c = corridor.camera
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("KITTI_ROOT", str(home / "kitti"))
    monkeypatch.setenv("VSLAM_CACHE", str(towns))
    path = f"{tmp_path / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}"
    monkeypatch.setenv("PATH", path)
    for folder in ("tmp", "orbslam3", "poses", "bin"):
        (tmp_path / folder).mkdir()
    for link, target in {
        "KITTI": "kitti", "KITTI_AS_PNG": "kitti", "V1_01_easy": "euroc/V1_01_easy",
        "rgbd_dataset_freiburg1_desk": "tum/rgbd_dataset_freiburg1_desk",
        "tum/mine": "tum/rgbd_dataset_freiburg1_xyz",
    }.items():  # fmt: skip
        (tmp_path / link).parent.mkdir(exist_ok=True)
        (tmp_path / link).symlink_to(home / target)
    for link in ("tools", "frontend"):
        (tmp_path / link).symlink_to(ROOT / link)
    poses = home / "kitti" / "poses" / "00.txt"
    for copy in ("orbslam3.txt", "orbslam3/00.txt", "poses/07.txt"):
        shutil.copy(poses, tmp_path / copy)
    write_calibration(tmp_path / "stereo.yaml", c)
    write_calibration(tmp_path / "mine.yaml", c)
    for mono in ("camera.yaml", "left.yaml"):
        write_calibration(tmp_path / mono, c, mono=True)
    return tmp_path


def _videos(desk: Path, corridor) -> None:
    pairs = [np.hstack(x) for x in zip(corridor.left[:N], corridor.right[:N], strict=True)]
    write_video(desk / "drive.mp4", pairs)


def _video_and_mask(desk: Path, corridor) -> None:
    _videos(desk, corridor)
    cv2.imwrite("hood.png", np.pad(np.full((110, 480), 255, np.uint8), ((0, 50), (0, 0))))


def _fixes(desk: Path, corridor) -> None:
    """Write GPS fixes. A metre to the north is 9 millionths of a degree."""
    north = enumerate(corridor.T_wc[:N, 2, 3].tolist())
    rows = [f"{0.1 * k},{48 + 9e-6 * metres:.9f},11,500,0.01" for k, metres in north]
    (desk / "fixes.csv").write_text("\n".join(["time,latitude,longitude,altitude,sigma", *rows]))


def _depth_sources(desk: Path, corridor) -> None:
    """Write images into ``FOLDER``, and a bag with depth."""
    c = corridor.camera
    names = [f"{10**18 + 10**8 * k}.png" for k in range(N)]
    depth = [
        (1000 * corridor_depth(c, T)).clip(0, 65535).astype(np.uint16) for T in corridor.T_wc[:N]
    ]
    write_images(desk / "FOLDER", {"rgb": corridor.left[:N], "depth": depth}, names)
    topics = ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")
    sides = dict(zip(topics, (corridor.left[:N], depth), strict=True))
    write_bag(desk / "drive.bag", "ros1", sides, [10**8 * (k + 1) for k in range(N)], camera=c)


def _pair_sources(desk: Path, corridor) -> None:
    """Write images into ``FOLDER``, into two folders, and with depth; a video; a bag; and a drive
    of KITTI raw."""
    _videos(desk, corridor)
    names = [f"{10**18 + 10**8 * k}.png" for k in range(N)]
    sides = {"LEFT": corridor.left[:N], "RIGHT": corridor.right[:N], "RGB": corridor.left[:N]}
    sides["DEPTH"] = [
        (1000 * corridor_depth(corridor.camera, T)).clip(0, 65535).astype(np.uint16)
        for T in corridor.T_wc[:N]
    ]
    write_images(desk, sides, names)
    write_images(desk / "FOLDER", {"left": sides["LEFT"], "right": sides["RIGHT"]}, names)
    of_bag = {"/cam0/image_raw": sides["LEFT"], "/cam1/image_raw": sides["RIGHT"]}
    stamps = [10**8 * (k + 1) for k in range(N)]
    write_bag(desk / "drive.bag", "ros1", of_bag, stamps, camera=corridor.camera)
    drive = desk / "2011_09_26" / "2011_09_26_drive_0005_sync"
    rows, c = "", corridor.camera
    for k, side in enumerate(("LEFT", "RIGHT")):
        names = [f"{n:010d}.png" for n in range(N)]
        write_images(drive, {f"image_0{k}/data": sides[side]}, names)
        times = "".join(f"2011-09-26 13:02:25.{n}00000000\n" for n in range(N))
        (drive / f"image_0{k}" / "timestamps.txt").write_text(times)
        rows += f"S_0{k}: {c.width} {c.height}\nS_rect_0{k}: {c.width} {c.height}\n"
        rows += f"P_rect_0{k}: {c.fx} 0 {c.cx} {-c.bf * k} 0 {c.fy} {c.cy} 0 0 0 1 0\n"
    (drive.parent / "calib_cam_to_cam.txt").write_text(rows)


def _earlier_run(desk: Path, corridor) -> None:
    _videos(desk, corridor)
    run_words(["run", "--seq", "00"])
    (desk / "runs" / "latest").resolve().rename(desk / "runs" / "20261121-100000-kitti-00-none")


def _another_system(desk: Path, corridor) -> None:
    """Write ``run_mine``, a SLAM system that knows the true poses of its frames."""
    script = desk / "bin" / "run_mine"
    truth = desk / "poses" / "07.txt"
    script.write_text(
        f'#!/bin/sh\nhead -n "$(wc -l < "$1/times.txt")" {truth} > "$2/trajectory.txt"\n'
    )
    script.chmod(0o755)


def _photographs(desk: Path, corridor) -> None:
    rng = np.random.default_rng(0)
    for family in ("multiview", "stitch_pairs", "pano360", "bsds500"):
        folder = desk / "PLACES" / family
        for place in ("a", "b", "c", "d"):
            image = cv2.resize(rng.integers(0, 256, (9, 12), dtype=np.uint8), (96, 72))
            write_images(folder, {place: [image, image[::-1]]}, ["0.png", "1.png"])
        (folder / "NOTES.txt").write_text("kind (a)\n")
    (desk / "FILE").touch()
    (desk / "training").mkdir()
    (desk / "training" / "7-seventh").symlink_to(desk / "tmp" / "smoke")


def _straight_route(desk: Path, corridor) -> None:
    T_wc = np.tile(np.eye(4), (30, 1, 1))
    T_wc[:, 2, 3] = np.arange(30)
    write_kitti(desk / "poses" / "07.txt", T_wc)


PREPARE: dict[str, Callable[[Path, object], None]] = {
    "README.md": _videos,
    "datasets.md": _straight_route,
    "docs/howto/bench.md": _earlier_run,
    "docs/howto/calibrate.md": _videos,
    "docs/howto/gps.md": _fixes,
    "docs/howto/masks.md": _video_and_mask,
    "docs/howto/rgbd.md": _depth_sources,
    "docs/howto/sources.md": _pair_sources,
    "docs/howto/stress.md": _another_system,
    "docs/howto/training.md": _photographs,
}


def run_words(words: list[str]) -> None:
    """Run ``vslam`` in this process. Runs are short and write no pages."""
    from vslam.cli import main as cli

    if words[0] == "run":
        words += [x for x in ("--no-record", "--no-report", "--quiet") if x not in words]
        words += [] if "--max-frames" in words else ["--max-frames", str(N)]
    before = sys.argv
    sys.argv = ["vslam", *words]
    try:
        cli.main()
        code = 0
    except SystemExit as stop:
        code = int(stop.code or 0)
    finally:
        sys.argv = before
    assert code == 0, words


def run_command(command: str) -> None:
    if is_shell(command):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", command], capture_output=True, text=True
        )
        assert done.returncode == 0, command + done.stdout + done.stderr
        return
    words = [os.path.expandvars(os.path.expanduser(w)) for w in shlex.split(command, comments=True)]
    words = [w for word in words for w in (sorted(glob.glob(word)) if "*" in word else [word])]
    run_words(words[1:])


@pytest.fixture
def dask(desk: Path) -> Iterator[Callable[[str], str]]:
    """Return a function that runs the commands on the page about clusters.

    It starts the programs on the loopback interface, and returns the address of the scheduler.
    """
    pytest.importorskip("distributed", reason="no dask here: pip install 'vslam[cluster]'")
    log, processes, address = desk / "dask.txt", [], ""

    def start(command: str) -> str:
        nonlocal address
        here = " --host 127.0.0.1 --no-dashboard"
        here += " --port 0" if "scheduler" in command else f" --local-directory {desk}"
        words = shlex.split(command.replace("tcp://HOST:8786", address) + here, comments=False)
        with log.open("ab") as output:
            processes.append(psutil.Popen(words, stdout=output, stderr=subprocess.STDOUT))
        said = r"Scheduler at:\s+(tcp://\S+)"
        if not address:
            wait_for(lambda: re.search(said, log.read_text()))
            address = re.search(said, log.read_text())[1]  # type: ignore[index]
        else:
            wait_for(lambda: log.read_text().count("Registered to") == 2)
        return address

    yield start
    for process in reversed(processes):
        for child in process.children(recursive=True):
            child.kill()
        process.kill()
        process.wait()


@pytest.mark.slow
@pytest.mark.parametrize("page", RULES)
def test_commands_of_the_page_run(page: str, desk: Path, corridor, request):
    rules, text = RULES[page], (ROOT / page).read_text()
    if page in PREPARE:
        PREPARE[page](desk, corridor)
    shorter = text
    for pattern, instead in rules.shorter:
        shorter, found = re.subn(pattern, instead, shorter)
        assert found, pattern
    for pattern, instead in ALWAYS:
        shorter = re.sub(pattern, instead, shorter)
    address = "tcp://HOST:8786"
    for command, written in zip(commands_of(shorter), commands_of(text), strict=True):
        if written.startswith(("export ", *(start for start, _ in rules.not_run))):
            continue
        if command.startswith("dask "):
            address = request.getfixturevalue("dask")(command.partition("#")[0])
            continue
        run_command(command.replace("tcp://HOST:8786", address))
