"""Training data: loads the images of all sources, splits them, and draws pairs of images."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.siamese.images import Fit, Size
from vslam.support.errors import InputError, write_file
from vslam_lab.sources.image_source import DIFFERENT, SAME, UNKNOWN, ImageSource

# First and last frame of each sequence that training may use. All other frames are test data.
TRAINING_FRAMES = {"kitti00": (250, 1499)}
# Groups of collections. Training may use only one collection of a group, because tests need the
# other.
_EITHER = ({"citycentre", "newcollege"},)


@dataclass(frozen=True)
class Collection:
    """The images of all sources of training data.

    Attributes:
        names: names of the N images, as ``source/folder/file``.
        images: ``(N, H, W)`` uint8 grey images.
        relation: ``(N, N)`` int8 relation of each pair of images. The value is 1 if both images
            show the same place, -1 if they show different places, and 0 if this is unknown.
        unit: ``(N,)`` int64 label of the group that an image belongs to. Images with the same label
            are never split between training and validation.
        sources: name of each source, and its number of images.
    """

    names: tuple[str, ...]
    images: NDArray[np.uint8]
    relation: NDArray[np.int8]
    unit: NDArray[np.int64]
    sources: tuple[tuple[str, int], ...]

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class Pairs:
    """Pairs of images, and whether they show the same place.

    Attributes:
        a, b: ``(M,)`` int64 indices of the images in the collection.
        same: ``(M,)`` bool, True for pairs that show the same place.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    same: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.a)


def refuse_test_data(sources: list[ImageSource]) -> None:
    """Check that the sources of training data do not contain the test data.

    Raises:
        InputError: the sources include test frames of KITTI, or both FAB-MAP collections.
    """
    for source in sources:
        first, last = TRAINING_FRAMES.get(source.name, (0, 1_000_000_000))
        frames = [int(Path(name).stem) for name in source.names if source.name in TRAINING_FRAMES]
        if frames and not (first <= min(frames) and max(frames) <= last):
            raise InputError(
                f"{source.name}: frames {min(frames)} to {max(frames)} include test data; "
                f"train on [first={first},last={last}]."
            )
    names = {source.name.lower().replace("_", "") for source in sources}
    for either in _EITHER:
        if len(found := either & names) > 1:
            raise InputError(
                f"--data: {' and '.join(sorted(found))} together leave no test data; train on one "
                "of them."
            )


def load(sources: list[ImageSource], size: Size, fit: Fit, threads: int = 2) -> Collection:
    """Decode all images of all sources into memory. An image of 227x227 pixels takes 51 kB."""
    names = [source.name for source in sources]
    if not sources:
        raise InputError("--data: give at least one source of images.")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"--data: two sources have the name {twice}; rename a folder.")
    work = [(source, i) for source in sources for i in range(len(source))]
    with ThreadPoolExecutor(threads) as pool:
        images = np.stack(list(pool.map(lambda job: job[0].read(job[1], size, fit), work)))
    relation = np.full((len(work), len(work)), DIFFERENT, np.int8)
    starts = np.cumsum([0, *map(len, sources)])
    spans = [slice(a, b) for a, b in pairwise(starts.tolist())]
    for source, span in zip(sources, spans, strict=True):
        for other, other_span in zip(sources, spans, strict=True):
            if other.family == source.family:
                relation[span, other_span] = UNKNOWN
        relation[span, span] = source.relation
    unit = np.concatenate([s.unit + k * 10_000_000 for k, s in enumerate(sources)])
    return Collection(
        tuple(f"{source.name}/{source.names[i]}" for source, i in work),
        images,
        relation,
        unit.astype(np.int64),
        tuple((source.name, len(source)) for source in sources),
    )


def divide(
    collection: Collection, seed: int, share: float = 0.15
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split the images into training and validation images. Images of the same unit, for example of
    the same stretch of road, are not split.

    An image of a training unit may show the same place as a validation image, for example at the
    end of a stretch of road. Such an image is left out.
    """
    rng = np.random.default_rng([seed, 1])
    units = np.unique(collection.unit)
    chosen = rng.permutation(len(units))[: max(1, round(share * len(units)))]
    validating = np.isin(collection.unit, units[chosen])
    seen = (collection.relation[validating] == SAME).any(0) & ~validating
    train, validation = np.flatnonzero(~validating & ~seen), np.flatnonzero(validating)
    for part in (train, validation):
        relation = collection.relation[np.ix_(part, part)]
        if not len(part) or not (relation == DIFFERENT).any():
            raise InputError("--data: too few places to split; add a source of images.")
    return train, validation


def validation_images(validation: NDArray[np.int64], most: int, seed: int) -> NDArray[np.int64]:
    """Choose at most ``most`` of the ``(M,)`` validation images at random. The same seed gives the
    same images."""
    if len(validation) <= most:
        return validation
    picked = np.random.default_rng([seed, 2]).choice(len(validation), most, replace=False)
    return validation[np.sort(picked)]


def check_emphasis(collection: Collection, emphasis: Mapping[str, float]) -> None:
    """Check that the collection contains all sources that are named in ``emphasis``.

    Raises:
        InputError: a source does not exist.
    """
    known = [name for name, _ in collection.sources]
    if unknown := [name for name in emphasis if name not in known]:
        raise InputError(
            f"emphasis: there is no source {unknown[0]}; choose from {', '.join(known)}."
        )


def draw_pairs(
    collection: Collection,
    chosen: NDArray[np.int64],
    count: int,
    rng: np.random.Generator,
    hard: NDArray[np.int64] | None = None,
    hard_share: float = 0.5,
    *,
    same_share: float = 0.5,
    together: int = 1,
    emphasis: Mapping[str, float] | None = None,
) -> Pairs:
    """Draw pairs of images for training.

    Args:
        chosen: ``(M,)`` indices of the images from which pairs are drawn.
        count: number of pairs.
        hard: ``(M, K)`` for each chosen image, the indices of at most K similar images that show
            other places. Rows are padded with -1. :func:`mine` computes this array.
        hard_share: fraction of the pairs of different places for which the second image is drawn
            from ``hard``.
        same_share: fraction of the pairs that show the same place. These pairs are spread evenly
            over the list of pairs.
        together: number of consecutive pairs whose first images come from the same source.
        emphasis: relative frequency of each source among the first images of the pairs. The
            frequency is 1 for sources that are not named.
    """
    relation = collection.relation[np.ix_(chosen, chosen)]
    sizes = [size for _, size in collection.sources]
    source = np.repeat(np.arange(len(sizes)), sizes)[chosen]
    if emphasis:
        frequency = np.array([emphasis.get(name, 1.0) for name, _ in collection.sources])[source]
        a = rng.choice(len(chosen), count, p=frequency / frequency.sum())
    else:
        a = rng.integers(len(chosen), size=count)
    if together > 1:
        for k in range(0, count, together):
            members = np.flatnonzero(source == source[a[k]])
            a[k : k + together] = rng.choice(members, len(a[k : k + together]))
    b = np.empty(count, np.int64)
    same = np.diff(np.ceil(same_share * np.arange(count + 1) - 1e-9)) > 0  # evenly spread
    for k in range(count):
        partners = np.flatnonzero(relation[a[k]] == (SAME if same[k] else DIFFERENT))
        use_hard = rng.random() < hard_share
        if not same[k] and hard is not None and use_hard:
            hard_partners = hard[a[k]][hard[a[k]] >= 0]
            if hard_partners.size:
                b[k] = np.searchsorted(chosen, rng.choice(hard_partners))
                continue
        if not partners.size:  # no image is known to show another place
            partners, same[k] = np.array([a[k]]), True
        b[k] = rng.choice(partners)
    return Pairs(chosen[a], chosen[b], same)


def mine(
    collection: Collection, chosen: NDArray[np.int64], alike: NDArray[np.float32], k: int = 10
) -> NDArray[np.int64]:
    """For each image, find the ``k`` most similar images that show other places (hard negatives).

    Args:
        chosen: ``(M,)`` indices of the images.
        alike: ``(M, M)`` similarities of these images.

    Returns:
        ``(M, k)`` int64 indices of images, most similar first, padded with -1.
    """
    out = np.full((len(chosen), k), -1, np.int64)
    for row, image in enumerate(chosen):
        others = np.flatnonzero(collection.relation[image, chosen] == DIFFERENT)
        best = others[np.argsort(-alike[row, others], kind="stable")[:k]]
        out[row, : len(best)] = chosen[best]
    return out


def write_pairs(path: Path, collection: Collection, pairs: Pairs, seed: int) -> None:
    """Write image pairs as a CSV file with the columns a, b, same. The first line states the
    seed."""
    table = io.StringIO()
    table.write(f"# seed {seed}\n")
    rows = csv.writer(table, lineterminator="\n")
    rows.writerow(["a", "b", "same"])
    for a, b, same in zip(pairs.a, pairs.b, pairs.same, strict=True):
        rows.writerow([collection.names[a], collection.names[b], int(same)])
    write_file(path, table.getvalue())
