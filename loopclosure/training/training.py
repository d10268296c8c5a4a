"""Training: an epoch of pairs after the other, checkpoints that a killed run goes on from.

Everything random is drawn from the seed, the epoch and the number of the step or pair: a
checkpoint needs no state of a generator beside them, and a resumed training has the bits of one
that was never interrupted (same machine, same number of threads).
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

from vslam.errors import InputError, ResultsError
from vslam.loopclosure.training.augmentation import augment
from vslam.loopclosure.training.checkpoint import (
    CHECKPOINT,
    TrainingProgress,
    load_checkpoint,
    save_checkpoint,
)
from vslam.loopclosure.training.data import (
    Collection,
    Pairs,
    check_emphasis,
    divide,
    draw_pairs,
    mine,
    validation_images,
    write_pairs,
)
from vslam.loopclosure.training.lite import LiteExtractor
from vslam.loopclosure.training.objective import (
    blend,
    calibrate,
    contrast,
    cross_entropy,
    embed_all,
    validate,
)
from vslam.loopclosure.training.preprocessing import to_tensor
from vslam.loopclosure.training.settings import TrainSettings
from vslam.loopclosure.training.siamese import (
    SiameseNetwork,
    build_network,
    load_network,
    save_network,
)

OnStep = Callable[[int, int, int, float], None]
"""``(epoch, step, steps of the epoch, loss)``"""

_CHECKPOINT_EVERY_S = 300.0
_HEAD_RATE = 30.0  # a and b are logarithms of single numbers: Adam's steps are small for them


@dataclass(frozen=True)
class TrainingOutcome:
    """What a training came to.

    Attributes:
        finished: False if it was asked to stop before its end; a call with ``resume`` goes on.
        figures: validation figures of the best epoch, calibrated.
        progress: with the figures of every epoch.
        weights: file of the best network.
        train, validation: images of the division.
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
    """Train a network and write it, its log, its lists of pairs and checkpoints to a folder.

    Args:
        collection: images and their relations.
        settings: see there.
        folder: to write to; ``settings.network`` names the file of the weights.
        device: ``cpu`` or ``cuda``.
        threads: that augment images.
        resume: go on from the folder's checkpoint, if there is one.
        start: network to start from instead of random weights (fine-tuning).
        on_step: called after each step.
        should_stop: asked after each step; a checkpoint is written before stopping.

    Raises:
        InputError: too little data, an unknown device or source, a device without bfloat16 where
            the settings ask for it, a checkpoint of other settings, or a learned share without a
            network to start from.
        ResultsError: the loss is not finite (the last good checkpoint stays), or a full disk.
    """
    if settings.learned_share < 1 and start is None:
        raise InputError("learned_share: there is no network to go back towards; give --weights.")
    where = open_device(device)
    half = _mixed_precision(settings, where)
    check_emphasis(collection, settings.emphasis)
    train_images, validation = divide(collection, settings.seed, settings.validation_share)
    validation = validation_images(validation, settings.validation_images, settings.seed)
    torch.manual_seed(settings.seed)
    network = start or build_network(settings.network, settings.shape, settings.head)
    network = network.to(where)
    before = copy.deepcopy(network.state_dict()) if settings.learned_share < 1 else None
    optimiser = _optimiser(network, settings)
    progress, pairs = TrainingProgress(), None
    steps = max(1, settings.pairs // settings.batch)
    weights = folder / f"{settings.network}.safetensors"
    if resume and (folder / CHECKPOINT).exists():
        progress, pairs = load_checkpoint(folder / CHECKPOINT, settings, network, optimiser)
    else:  # so that there is one to keep, whatever the first steps do
        save_checkpoint(folder / CHECKPOINT, settings, network, optimiser, progress, None)
    saved = time.monotonic()
    with ThreadPoolExecutor(threads) as pool:
        while progress.epoch < settings.epochs and progress.stale < settings.patience:
            began = time.monotonic()
            if pairs is None:
                pairs = _pairs_of_epoch(
                    collection, train_images, settings, network, progress, where
                )
                write_pairs(
                    folder / "pairs" / f"epoch_{progress.epoch:03d}.csv",
                    collection, pairs, settings.seed,
                )  # fmt: skip
            while progress.step < steps:
                batch = slice(progress.step * settings.batch, (progress.step + 1) * settings.batch)
                loss = _step(
                    network, optimiser, collection, pairs, batch, settings, progress, steps, pool,
                    where, half,
                )  # fmt: skip
                if not math.isfinite(loss):
                    raise ResultsError(
                        f"{folder}: the loss is {loss} in epoch {progress.epoch}, step "
                        f"{progress.step}; the last good checkpoint is kept, resume it with a "
                        "lower learning rate."
                    )
                progress.step += 1
                progress.loss_sum += loss
                progress.images += 2 * (min(batch.stop, len(pairs)) - batch.start)
                if on_step:
                    on_step(progress.epoch, progress.step, steps, loss)
                stop = should_stop is not None and should_stop()
                if stop or time.monotonic() - saved > _CHECKPOINT_EVERY_S:
                    progress.seconds += time.monotonic() - began
                    began = saved = time.monotonic()
                    save_checkpoint(
                        folder / CHECKPOINT, settings, network, optimiser, progress, pairs
                    )
                if stop:
                    return TrainingOutcome(False, {}, progress, weights, train_images, validation)
            _end_epoch(network, collection, validation, settings, progress, weights, steps, where)
            progress.seconds += time.monotonic() - began
            progress.history[-1]["seconds"] = progress.seconds
            pairs = None
            save_checkpoint(folder / CHECKPOINT, settings, network, optimiser, progress, None)
            saved = time.monotonic()
            write_log(folder / "log.csv", progress.history)
    best, about = load_network(weights)
    best.to(where)
    if before is not None and "learned_share" not in about:  # resumed after its end
        blend(best, before, settings.learned_share)
        about["learned_share"] = settings.learned_share
    figures = calibrated(best, about, collection, validation, settings, weights, where)
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
    """Calibrate a network and write it.

    Returns:
        Its validation figures.

    Raises:
        ResultsError: the file cannot be written.
    """
    _, score, same = validate(network, collection, validation, settings.augmentation, device)
    calibrate(network, score, same)
    figures = validate(network, collection, validation, settings.augmentation, device)[0]
    save_network(network, weights, {**about, "validation": figures})
    return figures


def _step(
    network: SiameseNetwork,
    optimiser: torch.optim.Optimizer,
    collection: Collection,
    pairs: Pairs,
    batch: slice,
    settings: TrainSettings,
    progress: TrainingProgress,
    steps: int,
    pool: ThreadPoolExecutor,
    device: torch.device,
    half: bool,
) -> float:
    """One step of Adam; the weights are untouched where the loss is not finite."""
    a, b = pairs.a[batch], pairs.b[batch]
    same = torch.from_numpy(pairs.same[batch]).to(device)
    images = _augmented(collection, a, b, batch.start, settings, progress.epoch, pool).to(device)
    rate = _learning_rate(settings, progress.epoch * steps + progress.step, settings.epochs * steps)
    for group in optimiser.param_groups:
        group["lr"] = rate * group["factor"]
    network.train()
    with torch.autocast(device.type, torch.bfloat16, enabled=half):
        descriptors = network.embed(images)
    first, second = descriptors[: len(a)], descriptors[len(a) :]
    loss = cross_entropy(network.logits(first, second), same)
    if settings.loss == "bce+contrast":
        both = np.concatenate([a, b])
        relation = torch.from_numpy(collection.relation[np.ix_(both, both)]).to(device)
        loss = loss + contrast(
            network.cosines(descriptors, descriptors), same, relation, settings.temperature
        )
    value = loss.item()
    if math.isfinite(value):
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return value


def _augmented(
    collection: Collection,
    a: NDArray[np.int64],
    b: NDArray[np.int64],
    first: int,
    settings: TrainSettings,
    epoch: int,
    pool: ThreadPoolExecutor,
) -> torch.Tensor:
    def one(job: tuple[int, int, int]) -> NDArray[np.uint8]:
        image, pair, side = job
        picture = collection.images[image]
        if settings.augmentation.mirror and (pair + epoch) // 2 % 2:
            picture = np.ascontiguousarray(picture[:, ::-1])
        rng = np.random.default_rng([settings.seed, 3, epoch, pair, side])
        return augment(picture, settings.augmentation, rng)

    jobs = [(int(image), first + k, 0) for k, image in enumerate(a)]
    jobs += [(int(image), first + k, 1) for k, image in enumerate(b)]
    return to_tensor(np.stack(list(pool.map(one, jobs))))


def _pairs_of_epoch(
    collection: Collection,
    images: NDArray[np.int64],
    settings: TrainSettings,
    network: SiameseNetwork,
    progress: TrainingProgress,
    device: torch.device,
) -> Pairs:
    rng = np.random.default_rng([settings.seed, 4, progress.epoch])
    hard = None
    if progress.epoch > 0 and settings.hard_share > 0:  # random weights find nothing hard
        if len(images) > settings.mined_images:
            images = np.sort(rng.choice(images, settings.mined_images, replace=False))
        d = torch.from_numpy(embed_all(network, collection.images[images], device))
        alike = torch.cat([network.cosines(rows, d) for rows in d.split(512)])
        hard = mine(collection, images, alike.numpy())
    return draw_pairs(
        collection, images, settings.pairs, rng, hard, settings.hard_share,
        same_share=settings.same_share, together=settings.together, emphasis=settings.emphasis,
    )  # fmt: skip


def _end_epoch(
    network: SiameseNetwork,
    collection: Collection,
    validation: NDArray[np.int64],
    settings: TrainSettings,
    progress: TrainingProgress,
    weights: Path,
    steps: int,
    device: torch.device,
) -> None:
    figures = validate(network, collection, validation, settings.augmentation, device)[0]
    row = {"epoch": float(progress.epoch), "loss": progress.loss_sum / steps, **figures}
    progress.history.append(row)
    if figures["average_precision"] > progress.best:
        progress.best, progress.stale = figures["average_precision"], 0
        save_network(network, weights, {"epoch": progress.epoch, "validation": figures})
    else:
        progress.stale += 1
    progress.epoch, progress.step, progress.loss_sum = progress.epoch + 1, 0, 0.0


def _learning_rate(settings: TrainSettings, step: int, steps: int) -> float:
    if settings.schedule == "constant":
        return settings.learning_rate
    return settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * step / steps))


def _optimiser(network: SiameseNetwork, settings: TrainSettings) -> torch.optim.Optimizer:
    extractor = getattr(network.branch, "extractor", None)
    if isinstance(extractor, LiteExtractor):
        extractor.freeze(settings.frozen)
    given = [] if extractor is None else [p for p in extractor.parameters() if p.requires_grad]
    single = [p for p in network.head.parameters() if p.ndim == 0]
    apart = {id(p) for p in (*given, *single)}
    others = [p for p in network.parameters() if p.requires_grad and id(p) not in apart]
    sets = [(others, 1.0), (given, settings.extractor_rate), (single, _HEAD_RATE)]
    groups: list[dict[str, Any]] = [{"params": p, "factor": f} for p, f in sets if p]
    # One pass over the weights: a step of VGG16 takes half the time.
    return torch.optim.Adam(groups, lr=settings.learning_rate, fused=True)


def open_device(name: str) -> torch.device:
    """The device of that name.

    Raises:
        InputError: it is unknown, or not there.
    """
    if name not in ("cpu", "cuda"):
        raise InputError(f"--device {name}: must be cpu or cuda.")
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch finds no CUDA device; train with --device cpu.")
    return torch.device(name)


def _mixed_precision(settings: TrainSettings, device: torch.device) -> bool:
    """Whether to compute in bfloat16."""
    can = device.type == "cpu" or torch.cuda.is_bf16_supported()
    if settings.mixed_precision and not can:
        raise InputError("mixed_precision: this GPU has no bfloat16; leave it out.")
    if settings.mixed_precision is None:
        return can and device.type == "cuda"
    return settings.mixed_precision


def write_log(path: Path, history: list[dict[str, float]]) -> None:
    """Write the figures of each epoch as CSV.

    Raises:
        ResultsError: the file cannot be written.
    """
    table = io.StringIO()
    rows = csv.DictWriter(table, list(history[0]), lineterminator="\n")
    rows.writeheader()
    rows.writerows(history)
    try:
        path.write_text(table.getvalue())
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written ({error.strerror}).") from error
