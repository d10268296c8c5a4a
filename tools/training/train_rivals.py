"""Train every architecture of docs/research/rivals.md under equal conditions, in two ways.

python tools/training/train_rivals.py --data SOURCE [--data SOURCE ...] --out DIR
        [--networks NAMES] [--pixels N] [--images N] [--core-minutes M] [--epochs N]
        [--device cuda] [--dry-run]

SOURCE is a source of ``vslam train``. All networks use the preset ``rivals``: random weights, the
same augmentation, loss, head and learning rate. For DIR/images, each network gets the same number
of images, as the same pairs in the same order. For DIR/minutes, each network trains for the same
time on one core, without validation and export; ``--core-minutes 0`` leaves DIR/minutes out.
DIR/rivals.csv has a row for each network, DIR/progress.csv one for each of its epochs.
``capsule-pruned`` starts from the weights of ``capsule`` in the same folder and trains for one more
epoch; its row counts only that epoch. PCANet learns once, without gradients.

The time of a step is measured first and stored in DIR/plan.json. ``--dry-run`` only does this and
prints the plan. Finished trainings are skipped and a killed one resumes from its checkpoint, so the
same command continues everything; ``--networks`` may be extended. DIR/conditions.json stores the
other options, and DIR is refused if they differ.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from vslam.errors import InputError
from vslam.lab.loopbench.kept import keep_conditions
from vslam.loopclosure.siamese.images import parse_size
from vslam.loopclosure.siamese.source_registry import open_source
from vslam.loopclosure.training.component_training import learn_components
from vslam.loopclosure.training.data import Collection, load, refuse_test_data
from vslam.loopclosure.training.export import export_onnx
from vslam.loopclosure.training.initial_network import starting_network
from vslam.loopclosure.training.runtime import set_threads
from vslam.loopclosure.training.settings import PRESETS, TrainSettings
from vslam.loopclosure.training.siamese import build_network, load_network
from vslam.loopclosure.training.training import TrainingOutcome, train

TRAINED = (
    "capsule", "capsule-pruned", "squeezenet", "mobilenet", "alexnet", "googlenet", "darknet19",
    "vgg16",
)  # fmt: skip
_TIMED_STEPS = 3


@dataclass(frozen=True)
class Job:
    """One training.

    Attributes:
        way: ``images`` or ``minutes``, the quantity that is equal for all networks.
        network: name of the network.
        pairs: pairs per epoch; 0 for PCANet.
        core_seconds: planned time of its steps.
    """

    way: str
    network: str
    pairs: int
    core_seconds: float


@dataclass(frozen=True)
class Result:
    """A row of rivals.csv; ``weights`` is a path relative to it.

    ``core_seconds`` is the time of the steps, or of the whole training for PCANet. Losses are means
    over the first and the last epoch. Validation APs are those of the last two epochs and of the
    best epoch, from which the weights are.
    """

    way: str
    network: str
    parameters: int
    images_shown: int
    epochs: int
    core_seconds: float
    first_loss: float
    last_loss: float
    ap_before_last: float
    ap_last: float
    ap_best: float
    weights: str


class StepClock:
    """Core seconds of a step, as the median, because other processes can only add to the time."""

    def __init__(self) -> None:
        self._last, self._epoch = time.process_time(), -1
        self._taken: list[float] = []

    def __call__(self, epoch: int, step: int, steps: int, loss: float) -> None:
        """Called after each step; mining and validation precede the first step of an epoch."""
        present = time.process_time()
        if epoch == self._epoch:
            self._taken.append(present - self._last)
        self._last, self._epoch = present, epoch

    def median(self) -> float:
        return statistics.median(self._taken) if self._taken else float("nan")


def main(words: list[str] | None = None) -> None:
    """Parse the command line and run what is left to do."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--data", action="append", required=True, help="source of images")
    parser.add_argument("--out", type=Path, default=Path("training/rivals"))
    parser.add_argument(
        "--networks", default=",".join((*TRAINED, "pcanet")), help="in the order of training"
    )
    parser.add_argument("--pixels", help="image size; default: the preset's")
    parser.add_argument("--images", type=int, default=65536, help="images for each network")
    parser.add_argument("--core-minutes", type=float, default=60.0, help="of each; 0 for none")
    parser.add_argument("--epochs", type=int, help="number of epochs")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--dry-run", action="store_true", help="print the plan only")
    args = parser.parse_args(words)

    set_threads(1)
    settings = PRESETS["rivals"]
    if args.pixels:
        shape = settings.shape.for_images_of(parse_size(args.pixels))
        settings = settings.model_copy(update={"shape": shape})
    if args.epochs:
        settings = settings.model_copy(update={"epochs": args.epochs})
    try:
        networks = known_networks(args.networks)
        keep_conditions(args.out / "conditions.json", conditions(args))
    except InputError as error:
        sys.exit(str(error))
    jobs = plan(
        args.out / "plan.json", settings, networks, args.images, args.core_minutes, args.device
    )
    for job in jobs:
        epochs = 1 if job.network == "capsule-pruned" else settings.epochs
        print(
            f"{job.way:8}{job.network:16}{job.pairs * 2 * epochs:8} images"
            f"{job.core_seconds / 60:8.1f} core minutes"
        )
    if args.dry_run:
        return
    sources = [source for spec in args.data for source in open_source(spec)]
    refuse_test_data(sources)
    collection = load(sources, settings.shape.input, settings.fit, 1)
    table = args.out / "rivals.csv"
    results = read_results(table)
    for job in jobs:
        if (job.way, job.network) in {(r.way, r.network) for r in results}:
            continue
        results.append(run(job, collection, settings, args.out, args.device))
        print(results[-1], flush=True)
        write_results(table, results)
        write_progress(args.out, results)


def known_networks(names: str) -> list[str]:
    """Parse names separated by commas.

    Raises:
        InputError: a name is unknown, or ``capsule-pruned`` is not preceded by ``capsule``.
    """
    found = names.split(",")
    for name in found:
        if name not in (*TRAINED, "pcanet"):
            raise InputError(f"--networks: {name} is none of {', '.join((*TRAINED, 'pcanet'))}.")
    if "capsule-pruned" in found and "capsule" not in found[: found.index("capsule-pruned")]:
        raise InputError("--networks: capsule-pruned continues from capsule; name that before it.")
    return found


def conditions(args: argparse.Namespace) -> dict[str, Any]:
    """The options that determine the result of a training."""
    named = ("data", "pixels", "images", "core_minutes", "epochs", "device")
    return {f"--{name.replace('_', '-')}": getattr(args, name) for name in named}


def plan(
    path: Path,
    settings: TrainSettings,
    networks: list[str],
    images: int,
    minutes: float,
    device: str,
) -> list[Job]:
    """The jobs of these networks, from a file, to which missing ones are added.

    The number of pairs per epoch follows from the number of images or the time of a step.
    """
    known = [Job(**job) for job in json.loads(path.read_text())] if path.exists() else []
    ways = ("images", "minutes") if minutes else ("images",)
    wanted = [(way, name) for way in ways for name in networks if name != "pcanet"]
    wanted += [("images", "pcanet")] if "pcanet" in networks else []
    planned = {(job.way, job.network) for job in known}
    missing = [one for one in wanted if one not in planned]
    timed = dict.fromkeys(name for _, name in missing if name != "pcanet")
    step = {name: seconds_of_a_step(name, settings, device) for name in timed}
    for way, name in missing:
        if name == "pcanet":
            known.append(Job(way, name, 0, 0.0))
            continue
        shown = images if way == "images" else 60 * minutes / step[name] * 2 * settings.batch
        batches = max(1, round(shown / 2 / settings.epochs / settings.batch))
        steps = batches * (1 if name == "capsule-pruned" else settings.epochs)
        known.append(Job(way, name, batches * settings.batch, step[name] * steps))
    path.write_text(json.dumps([asdict(job) for job in known], indent=1) + "\n")
    found = {(job.way, job.network): job for job in known}
    return [found[one] for one in wanted]


def seconds_of_a_step(name: str, settings: TrainSettings, device: str) -> float:
    """Core seconds of a training step, without reading and augmenting images."""
    torch.manual_seed(0)
    network = build_network(name, settings.shape, settings.head).to(device).train()
    optimiser = torch.optim.Adam(network.parameters(), fused=True)
    images = torch.rand(2 * settings.batch, 3, *settings.shape.input, device=device)
    taken = []
    for _ in range(_TIMED_STEPS):
        began = time.process_time()
        with torch.autocast(device, torch.bfloat16, enabled=bool(settings.mixed_precision)):
            descriptors = network.embed(images)
        loss = network.cosines(descriptors, descriptors).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        taken.append(time.process_time() - began)
    return min(taken)


def run(
    job: Job, collection: Collection, settings: TrainSettings, out: Path, device: str
) -> Result:
    """Train, export and judge one network."""
    folder = out / job.way / job.network
    settings = settings.model_copy(update={"network": job.network})
    clock, began = StepClock(), time.process_time()
    if job.network == "pcanet":
        outcome = learn_components(collection, settings, folder, device=device)
    else:
        settings = settings.model_copy(update={"pairs": job.pairs})
        start = None
        if job.network == "capsule-pruned":
            settings = settings.model_copy(update={"epochs": 1})
            whole = out / job.way / "capsule" / "capsule.safetensors"
            start, settings, _ = starting_network(settings, collection, whole, device)
        outcome = train(
            collection, settings, folder, device=device, threads=1, resume=True, start=start,
            on_step=clock,
        )  # fmt: skip
    all_seconds = time.process_time() - began
    network, about = load_network(outcome.weights)
    onnx = outcome.weights.with_suffix(".onnx")
    export_onnx(network, onnx, about)
    steps = job.pairs // settings.batch * settings.epochs
    seconds = all_seconds if job.network == "pcanet" else clock.median() * steps
    return result(job, outcome, network.n_parameters(), seconds, onnx.relative_to(out))


def result(
    job: Job, outcome: TrainingOutcome, parameters: int, seconds: float, weights: Path
) -> Result:
    """The row of a finished training."""
    history = outcome.progress.history
    ap = [row["average_precision"] for row in history]
    return Result(
        way=job.way, network=job.network, parameters=parameters,
        images_shown=outcome.progress.images, epochs=outcome.progress.epoch,
        core_seconds=round(seconds, 1), first_loss=round(history[0]["loss"], 4),
        last_loss=round(history[-1]["loss"], 4), ap_before_last=round(ap[-2:][0], 4),
        ap_last=round(ap[-1], 4), ap_best=round(max(ap), 4), weights=str(weights),
    )  # fmt: skip


def read_results(path: Path) -> list[Result]:
    """Rows of rivals.csv; empty if it does not exist."""
    if not path.exists():
        return []
    types = {"parameters": int, "images_shown": int, "epochs": int,
             "way": str, "network": str, "weights": str}  # fmt: skip
    with path.open() as file:
        return [
            Result(**{key: types.get(key, float)(value) for key, value in row.items()})
            for row in csv.DictReader(file)
        ]


def write_results(path: Path, results: list[Result]) -> None:
    """Write rivals.csv."""
    with path.open("w", newline="") as file:
        rows = csv.DictWriter(file, list(asdict(results[0])), lineterminator="\n")
        rows.writeheader()
        rows.writerows(asdict(one) for one in results)


def write_progress(out: Path, results: list[Result]) -> None:
    """Write progress.csv from the logs of all finished trainings."""
    rows: list[tuple[str | int, ...]] = [
        ("way", "network", "images_shown", "loss", "validation_ap")
    ]
    for one in results:
        if one.network == "pcanet":  # learns once
            continue
        with (out / Path(one.weights).parent / "log.csv").open() as file:
            for number, row in enumerate(csv.DictReader(file), 1):
                figures = (f"{float(row[key]):.4f}" for key in ("loss", "average_precision"))
                shown = one.images_shown * number // one.epochs
                rows.append((one.way, one.network, shown, *figures))
    with (out / "progress.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


if __name__ == "__main__":
    main()
