"""A stub for ``vslam run``, which quickly writes the folder of a run with invented results.

Files in ``$STUB_FOLDER`` change the behaviour of a run. NAME consists of the sequence, the
perturbation, the detector and the seed, joined by ``-``:

- ``fail-NAME``: the run fails.
- ``interrupt-NAME``: the run is interrupted.
- ``lost-NAME``: all frames are lost.
- ``unwritten-NAME``: the run exits with 1 after it has written the report.
- ``hold-NAME``: the run waits as long as this file exists.

Each run adds a line with its NAME and the process id of its parent to the file ``started``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

COMMAND = (sys.executable, str(Path(__file__).resolve()))


def started(stub: Path) -> list[tuple[str, int]]:
    """Return NAME and the process id of the parent of each run so far, in order."""
    file = stub / "started"
    lines = [line.split() for line in file.read_text().splitlines()] if file.exists() else []
    return [(name, int(parent)) for name, parent in lines]


def wait_for(condition: Callable[[], object], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def main() -> None:
    assert sys.argv[1] == "run"
    words = [word for word in sys.argv[2:] if word not in ("--no-record", "--no-report", "--quiet")]
    options = dict(zip(words[::2], words[1::2], strict=True))
    keys = ("--seq", "--perturb", "--detector", "--seed")
    name = "-".join(options[key] for key in keys)
    folder = Path(os.environ["STUB_FOLDER"])
    with (folder / "started").open("a") as started:
        started.write(f"{name} {os.getppid()}\n")
    while (folder / f"hold-{name}").exists():
        time.sleep(0.02)
    if (folder / f"fail-{name}").exists():
        sys.exit("some talk\nerror: images of the moon; point the camera down.")
    report = json.loads((folder / "report.json").read_text())
    index = sum(map(ord, name)) % 7
    report |= {
        "dataset": options["--dataset"],
        "sequence": options["--seq"],
        "perturb": options["--perturb"],
        "detector": options["--detector"],
        "seed": int(options["--seed"]),
        "max_frames": int(options["--max-frames"]) if "--max-frames" in options else None,
        "threads": int(options["--threads"]),
        "ate_rmse_m": 1.0 + 0.1 * index,
        "interrupted": "Ctrl-C" if (folder / f"interrupt-{name}").exists() else None,
    }
    lost = (folder / f"lost-{name}").exists()
    if lost:
        report["lost_frames"] = report["frames"]
    out = Path(options["--out"]) / "20261121-120000"
    out.mkdir(parents=True)
    report["evo_command"] = f"evo_ape kitti {out}/ground_truth_kitti.txt --align"
    (out / "report.json").write_text(json.dumps(report))
    (out / "config.json").write_text(Path(options["--config"]).read_text())
    (out / "run.json").write_text("{}")
    (out / "map.npz").write_bytes(b"large")
    for file in ("trajectory.tum", "ground_truth_kitti.txt"):
        (out / file).write_bytes((folder / file).read_bytes())
    if lost or (folder / f"unwritten-{name}").exists():
        sys.exit(1)


if __name__ == "__main__":
    main()
