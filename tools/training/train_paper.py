"""Train the weights of ``--detector capsule-paper``: the network as the paper describes it.

python tools/training/train_paper.py --kitti $KITTI_ROOT --photos DIR --out DIR [--dry-run]

KITTI_ROOT holds sequences/00 and poses/00.txt, DIR the sets of photographs (datasets.md).

The script renders eight towns, trains from random weights with the settings paper.json beside this
file (the preset ``paper`` in float32, with less patience and fewer images mined and validated),
removes 20 % of the primary capsules, trains the rest for two epochs and exports it. Finished parts
are skipped and an interrupted training resumes from its checkpoint, so the same command continues
everything.

bfloat16 fails on a CPU: in thirteen steps replayed with torch 2.13, one gradient had a norm of 5e32
instead of 0.16 in float32, and the loss became NaN in the second epoch.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import sys
from pathlib import Path

_SETTINGS = Path(__file__).parent / "paper.json"
# Arguments of vslam synth, in which the second views of towns 31 and 34 are from the other lane.
_OWN_LANE = ("--pairs", "120", "--lateral=-3.2:1.4", "--heading", "0:30")
_OTHER_LANE = ("--pairs", "120", "--lateral=-3.4:-1.6", "--heading", "15:32")
_TOWNS = {
    "town11": ("00", "--seed", "11", "--change", "0.5", *_OWN_LANE),
    "town12": ("05", "--seed", "12", "--change", "0.9", *_OWN_LANE),
    "town13": ("05", "--seed", "13", "--change", "0.6", "--aliased", *_OWN_LANE),
    "town14": ("02", "--seed", "14", "--change", "0.5", *_OWN_LANE),
    "town15": ("demo", "--seed", "15", "--change", "1.0", *_OWN_LANE),
    "town16": ("00", "--seed", "16", "--change", "0.9", "--aliased", *_OWN_LANE),
    "town31": ("05", "--seed", "31", "--change", "0.3", *_OTHER_LANE),
    "town34": ("02", "--seed", "34", "--change", "0.3", *_OTHER_LANE),
}
# Frame 1500 is the first of the range that docs/research/loops.md tests on.
_FRAMES = "seq=00,first=250,last=1499,near=20"


def main() -> None:
    """Parse the command line and run the unfinished parts."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kitti", type=Path, required=True, help="folder with sequences/")
    parser.add_argument("--photos", type=Path, required=True, help="sets of photographs")
    parser.add_argument("--out", type=Path, default=Path("training"), help="folder to write to")
    parser.add_argument("--dry-run", action="store_true", help="print the commands only")
    args = parser.parse_args()
    for command in _commands(args.out, args.kitti, args.photos):
        print(shlex.join(["vslam", *command]), flush=True)
        if not args.dry_run:
            done = subprocess.run([sys.executable, "-m", "vslam", *command])
            if done.returncode:
                sys.exit(done.returncode)


def _commands(out: Path, kitti: Path, photos: Path) -> list[list[str]]:
    """Commands whose results are missing. The last file of a town is pairs.csv, that of a training
    is the model card."""
    towns = {name: out / "pairs" / name for name in _TOWNS}
    commands = [
        ["synth", *_TOWNS[name], "--out", str(folder)]
        for name, folder in towns.items()
        if not (folder / "pairs.csv").exists()
    ]
    data = [f"kitti:{kitti}[{_FRAMES}]", f"photos:{photos}"]
    data += [f"pairs:{folder}" for folder in towns.values()]
    whole, pruned = out / "paper" / "capsule", out / "paper-pruned" / "capsule-paper"
    for weights, more in (
        (whole, []),
        (pruned, ["--weights", f"{whole}.safetensors", "--epochs", "2"]),
    ):
        if not weights.with_suffix(".md").exists():
            command = ["train", weights.name, "--settings", str(_SETTINGS), "--threads", "1", *more]
            command += [word for source in data for word in ("--data", source)]
            resume = ["--resume"] if (weights.parent / "checkpoint.pt").exists() else []
            commands.append([*command, "--out", str(weights.parent), *resume])
    shipped = out / "capsule-paper.safetensors"
    export = ["export", "weights", "--weights", f"{pruned}.safetensors", "--out", str(shipped)]
    return [*commands, export]


if __name__ == "__main__":
    main()
