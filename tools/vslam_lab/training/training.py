"""Trains a network on pairs of images, epoch by epoch. An interrupted training run can be resumed
from a checkpoint.

All random numbers depend only on the seed, the epoch and the number of the pair. A checkpoint
therefore needs no states of random generators. A resumed training run gives bit-identical results
to an uninterrupted training run, if both run on the same machine with the same number of threads.
"""

from __future__ import annotations

import copy
import csv
import io
import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from vslam.support.errors import InputError, ResultsError, write_file
from vslam_lab.training.augmentation import augment
from vslam_lab.training.checkpoint import (
    CHECKPOINT,
    TrainingProgress,
    load_checkpoint,
    save_checkpoint,
)
from vslam_lab.training.data import (
    Collection,
    Pairs,
    check_emphasis,
    divide,
    draw_pairs,
    mine,
    validation_images,
    write_pairs,
)
from vslam_lab.training.lite import LiteExtractor
from vslam_lab.training.objective import (
    blend,
    calibrate,
    contrast,
    cross_entropy,
    embed_all,
    validate,
)
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.settings import TrainSettings
from vslam_lab.training.siamese import (
    SiameseNetwork,
    build_network,
    load_network,
    save_network,
)

OnStep = Callable[[int, int, int, float], None]
"""Arguments: epoch, step, number of steps in the epoch, loss."""

_CHECKPOINT_EVERY_S = 300.0
_HEAD_RATE = 30.0  # factor for the learning rate of log a and log b, which need larger steps


@dataclass(frozen=True)
class TrainingOutcome:
    """The result of a training run.

    Attributes:
        finished: False if the training run was stopped early. It can be continued by calling
            ``train`` with ``resume=True``.
        figures: validation metrics of the best network after calibration.
        progress: the progress of the training run, with the loss and the validation metrics of
            every epoch.
        weights: file of the best network.
        train, validation: indices of the training and validation images.
    """

    finished: bool
    figures: dict[str, float]
    progress: TrainingProgress
    weights: Path
    train: NDArray[np.int64]
    validation: NDArray[np.int64]


def train(
    collection: Collection,
    settings: TrainSettings,
    folder: Path,
    *,
    device: str = "cpu",
    threads: int = 2,
    resume: bool = False,
    start: SiameseNetwork | None = None,
    on_step: OnStep | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TrainingOutcome:
    """Train a Siamese network, and write its weights, the settings, a log, the lists of image pairs
    and checkpoints to a folder.

    Args:
        folder: output folder. The weights are written to ``<settings.network>.safetensors``.
        device: ``cpu`` or ``cuda``.
        threads: number of threads that augment images.
        resume: whether training continues from the checkpoint in the folder, if there is one.
        start: network to start from instead of random weights (fine-tuning).
        on_step: called after each training step.
        should_stop: called after each training step. If it returns True, a checkpoint is written
            and training stops.

    Raises:
        InputError: there are too few images, the device or a source is unknown, the device does not
            support the required bfloat16, or the checkpoint has different settings. The error is
            also raised if ``learned_share`` is below 1 but ``start`` is None.
        ResultsError: the loss is not finite, or the results cannot be written. If the loss is not
            finite, the last good checkpoint is kept.
    """
    if settings.learned_share < 1 and start is None:
        raise InputError("learned_share: needs a network to start from; give it with --weights.")
    torch_device = open_device(device)
    half = _mixed_precision(settings, torch_device)
    check_emphasis(collection, settings.emphasis)
    train_images, validation = divide(collection, settings.seed, settings.validation_share)
    validation = validation_images(validation, settings.validation_images, settings.seed)
    torch.manual_seed(settings.seed)
    network = start or build_network(settings.network, settings.shape)
    network = network.to(torch_device)
    before = copy.deepcopy(network.state_dict()) if settings.learned_share < 1 else None
    optimiser = _optimiser(network, settings)
    progress, pairs = TrainingProgress(), None
    checkpoint = folder / CHECKPOINT
    weights = folder / f"{settings.network}.safetensors"
    if resume and checkpoint.exists():
        progress, pairs = load_checkpoint(checkpoint, settings, network, optimiser)
    else:  # a good checkpoint then exists even if the first steps diverge
        save_checkpoint(checkpoint, settings, network, optimiser, progress, None)
    # Written only now, because a checkpoint with other settings is refused.
    write_file(folder / "settings.json", settings.model_dump_json(indent=1) + "\n")
    last_saved = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        run = _Training(
            collection, settings, network, optimiser, progress, train_images, torch_device, half,
            pool,
        )  # fmt: skip
        while progress.epoch < settings.epochs and progress.stale < settings.patience:
            start_time = time.monotonic()
            if pairs is None:
                pairs = run.pairs_of_epoch()
                file = folder / "pairs" / f"epoch_{progress.epoch:03d}.csv"
                write_pairs(file, collection, pairs, settings.seed)
            while progress.step < run.steps:
                loss = run.step(pairs)
                if not math.isfinite(loss):
                    raise ResultsError(
                        f"{folder}: the loss is {loss} in epoch {progress.epoch}, step "
                        f"{progress.step}; the last good checkpoint is kept; resume it with a "
                        "lower learning rate."
                    )
                if on_step:
                    on_step(progress.epoch, progress.step, run.steps, loss)
                stop = should_stop is not None and should_stop()
                if stop or time.monotonic() - last_saved > _CHECKPOINT_EVERY_S:
                    progress.seconds += time.monotonic() - start_time
                    start_time = last_saved = time.monotonic()
                    save_checkpoint(checkpoint, settings, network, optimiser, progress, pairs)
                if stop:
                    return TrainingOutcome(False, {}, progress, weights, train_images, validation)
            run.end_epoch(validation, weights)
            progress.seconds += time.monotonic() - start_time
            progress.history[-1]["seconds"] = progress.seconds
            pairs = None
            save_checkpoint(checkpoint, settings, network, optimiser, progress, None)
            last_saved = time.monotonic()
            write_log(folder / "log.csv", progress.history)
    best, about = load_network(weights)
    best.to(torch_device)
    if before is not None and "learned_share" not in about:  # otherwise an earlier call has blended
        blend(best, before, settings.learned_share)
        about["learned_share"] = settings.learned_share
    figures = calibrated(best, about, collection, validation, settings, weights, torch_device)
    return TrainingOutcome(True, figures, progress, weights, train_images, validation)


def calibrated(
    network: SiameseNetwork,
    about: dict[str, Any],
    collection: Collection,
    validation: NDArray[np.int64],
    settings: TrainSettings,
    weights: Path,
    device: torch.device,
) -> dict[str, float]:
    """Calibrate a network and write its weights. Returns the validation metrics of the network."""
    _, score, same = validate(network, collection, validation, settings.augmentation, device)
    calibrate(network, score, same)
    figures = validate(network, collection, validation, settings.augmentation, device)[0]
    save_network(network, weights, {**about, "validation": figures})
    return figures


@dataclass(frozen=True)
class _Training:
    collection: Collection
    settings: TrainSettings
    network: SiameseNetwork
    optimiser: torch.optim.Optimizer
    progress: TrainingProgress
    images: NDArray[np.int64]
    device: torch.device
    half: bool
    pool: ThreadPoolExecutor

    @property
    def steps(self) -> int:
        return max(1, self.settings.pairs // self.settings.batch)

    def step(self, pairs: Pairs) -> float:
        """Make one step of Adam and return the loss. If the loss is not finite, the weights and the
        progress are not changed."""
        settings, network, progress = self.settings, self.network, self.progress
        first = progress.step * settings.batch
        a, b, same_place = (x[first : first + settings.batch] for x in vars(pairs).values())
        same = torch.from_numpy(same_place).to(self.device)
        images = self._augmented(a, b, first).to(self.device)
        rate = self._learning_rate()
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["factor"]
        network.train()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.half):
            descriptors = network.embed(images)
        loss = cross_entropy(network.logits(descriptors[: len(a)], descriptors[len(a) :]), same)
        if settings.loss == "bce+contrast":
            both = np.concatenate([a, b])
            relation = torch.from_numpy(self.collection.relation[np.ix_(both, both)])
            alike = network.cosines(descriptors, descriptors)
            loss = loss + contrast(alike, same, relation.to(self.device), settings.temperature)
        value = loss.item()
        if math.isfinite(value):
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self.optimiser.step()
            progress.step += 1
            progress.loss_sum += value
            progress.images += 2 * len(a)
        return value

    def _augmented(self, a: NDArray[np.int64], b: NDArray[np.int64], first: int) -> torch.Tensor:
        """Augment the images of N successive pairs of the epoch. Returns ``(2 N, 3, H, W)`` images.
        ``first`` is the index of the first of these pairs in the epoch."""
        settings, epoch = self.settings, self.progress.epoch

        def augmented(job: tuple[int, int, int]) -> NDArray[np.uint8]:
            index, pair, side = job
            image = self.collection.images[index]
            if settings.augmentation.mirror and (pair + epoch) // 2 % 2:
                image = np.ascontiguousarray(image[:, ::-1])
            rng = np.random.default_rng([settings.seed, 3, epoch, pair, side])
            return augment(image, settings.augmentation, rng)

        jobs = [
            (int(index), first + k, side)
            for side, chosen in enumerate((a, b))
            for k, index in enumerate(chosen)
        ]
        return to_tensor(np.stack(list(self.pool.map(augmented, jobs))))

    def pairs_of_epoch(self) -> Pairs:
        settings, network, images, hard = self.settings, self.network, self.images, None
        rng = np.random.default_rng([settings.seed, 4, self.progress.epoch])
        # There are no hard pairs in the first epoch, because random weights would not find any.
        if self.progress.epoch > 0 and settings.hard_share > 0:
            if len(images) > settings.mined_images:
                images = np.sort(rng.choice(images, settings.mined_images, replace=False))
            embedded = embed_all(network, self.collection.images[images], self.device)
            descriptors = torch.from_numpy(embedded)
            alike = torch.cat(
                [network.cosines(rows, descriptors) for rows in descriptors.split(512)]
            )
            hard = mine(self.collection, images, alike.numpy())
        return draw_pairs(
            self.collection, images, settings.pairs, rng, hard, settings.hard_share,
            same_share=settings.same_share, together=settings.together,
            emphasis=settings.emphasis,
        )  # fmt: skip

    def end_epoch(self, validation: NDArray[np.int64], weights: Path) -> None:
        """Validate the network, and write its weights to a file if they are the best so far."""
        network, progress = self.network, self.progress
        augmentation = self.settings.augmentation
        figures = validate(network, self.collection, validation, augmentation, self.device)[0]
        loss = progress.loss_sum / self.steps
        progress.history.append({"epoch": float(progress.epoch), "loss": loss, **figures})
        if figures["average_precision"] > progress.best:
            progress.best, progress.stale = figures["average_precision"], 0
            save_network(network, weights, {"epoch": progress.epoch, "validation": figures})
        else:
            progress.stale += 1
        progress.epoch, progress.step, progress.loss_sum = progress.epoch + 1, 0, 0.0

    def _learning_rate(self) -> float:
        settings, progress = self.settings, self.progress
        if settings.schedule == "constant":
            return settings.learning_rate
        done, steps = progress.epoch * self.steps + progress.step, settings.epochs * self.steps
        return settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * done / steps))


def _optimiser(network: SiameseNetwork, settings: TrainSettings) -> torch.optim.Optimizer:
    extractor = network.branch.extractor
    if isinstance(extractor, LiteExtractor):
        extractor.freeze(settings.frozen)
    of_extractor = [p for p in extractor.parameters() if p.requires_grad]
    of_head = list(network.head.parameters())
    separate = {id(p) for p in (*of_extractor, *of_head)}
    others = [p for p in network.parameters() if p.requires_grad and id(p) not in separate]
    sets = [(others, 1.0), (of_extractor, settings.extractor_rate), (of_head, _HEAD_RATE)]
    groups: list[dict[str, Any]] = [{"params": p, "factor": f} for p, f in sets if p]
    return torch.optim.Adam(groups, lr=settings.learning_rate, fused=True)


def set_threads(threads: int) -> None:
    torch.set_num_threads(threads)


def open_device(name: str) -> torch.device:
    """Return the torch device with the given name.

    Raises:
        InputError: the device is unknown or not available.
    """
    if name not in ("cpu", "cuda"):
        raise InputError(f"--device {name}: must be cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no CUDA device; train with --device cpu.")
    return torch.device(name)


def _mixed_precision(settings: TrainSettings, device: torch.device) -> bool:
    supported = device.type == "cpu" or torch.cuda.is_bf16_supported()
    if settings.mixed_precision and not supported:
        raise InputError("mixed_precision: this GPU does not support bfloat16; leave it out.")
    if settings.mixed_precision is None:
        return supported and device.type == "cuda"
    return settings.mixed_precision


def write_log(path: Path, history: list[dict[str, float]]) -> None:
    """Write the loss and the validation metrics of each epoch as a CSV file."""
    table = io.StringIO()
    rows = csv.DictWriter(table, list(history[0]), lineterminator="\n")
    rows.writeheader()
    rows.writerows(history)
    write_file(path, table.getvalue())
