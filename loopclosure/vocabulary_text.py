"""Reads and writes vocabularies in DBoW2's text format, for example ORB-SLAM's ``ORBvoc.txt``.

The first line is ``k L scoring weighting``. Each further line describes a node by 35 numbers: the
number of its parent, a flag that is 1 for a leaf and 0 otherwise, the 32 bytes of its descriptor,
and its weight. The weight of a leaf is the inverse document frequency. Nodes are numbered from 1,
in the order of their lines. Node 0 is the root and has no line.

The reader accepts any order in which parents precede their children. The writer uses breadth-first
order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.vocabulary import (
    MAX_BRANCHING,
    MAX_LEVELS,
    Vocabulary,
    from_children,
    load,
    save,
)
from vslam.support.errors import InputError, write_file

NUMBERS = 35  # numbers per line of a node: parent, leaf, 32 bytes, weight
L1_NORM, TF_IDF = 0, 0  # DBoW2's codes for the scoring and the weighting of vslam


def read_vocabulary(path: Path) -> Vocabulary:
    """Read a vocabulary. The name of the file must end in .txt (DBoW2's text format) or .npz (the
    format of vslam).

    Raises:
        InputError: the name has any other extension, or the file cannot be read.
    """
    return read_text(path) if is_text(path) else load(path)


def write_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write a vocabulary. The name of the file must end in .txt (DBoW2's text format) or .npz (the
    format of vslam).

    Raises:
        InputError: the name has any other extension.
        ResultsError: the file cannot be written.
    """
    (write_text if is_text(path) else save)(vocabulary, path)


def is_text(path: Path) -> bool:
    """Return True for a file name that ends in .txt (DBoW2's text format), and False for .npz (the
    format of vslam).

    Raises:
        InputError: the name has any other extension.
    """
    if path.suffix not in (".txt", ".npz"):
        raise InputError(
            f"{path}: the name of a vocabulary must end in .npz or in .txt (DBoW2's format)."
        )
    return path.suffix == ".txt"


def read_text(path: Path) -> Vocabulary:
    """Read a vocabulary in DBoW2's text format.

    Raises:
        InputError: the file is missing or damaged. The message states the line and the error.
    """
    try:
        text = path.read_bytes().rstrip()
    except OSError as error:
        raise InputError(f"{path}: cannot read the vocabulary ({error.strerror}).") from error
    if not text:
        raise InputError(f"{path}: the file is empty; fetch or export the vocabulary again.")
    header, _, body = text.partition(b"\n")
    branching, levels = _read_header(path, header)
    numbers = _read_nodes(path, body.split(b"\n"))
    n = len(numbers)
    parent = np.concatenate([[-1], numbers[:, 0].astype(np.int64)])
    leaf = np.concatenate([[False], numbers[:, 1] == 1])
    descriptors, weight = np.zeros((n + 1, 32), np.uint8), np.zeros(n + 1)
    descriptors[1:], weight[1:] = numbers[:, 2:-1], numbers[:, -1]
    _check_children(path, parent, leaf, branching)
    order, level = _breadth_first(parent)
    if level[-1] > levels:
        node = int(order[np.argmax(level > levels)])
        raise InputError(
            f"{path}: line {node + 1} is at level {level.max()}, but line 1 says {levels} levels; "
            "fetch or export it again."
        )
    n_children = np.bincount(parent[1:], minlength=n + 1)[order]
    return from_children(
        branching,
        levels,
        np.ascontiguousarray(descriptors[order]).view(np.uint64),
        n_children.astype(np.uint8),
        weight[order][leaf[order]].astype(np.float32),
    )


def write_text(vocabulary: Vocabulary, path: Path) -> None:
    """Write a vocabulary in DBoW2's text format, which DBoW2 and ORB-SLAM can read.

    Raises:
        ResultsError: the file cannot be written.
    """
    v = vocabulary
    weight = np.zeros(len(v.word), np.float32)
    weight[v.word >= 0] = v.weight
    byte_text = [f" {value}" for value in range(256)]
    # There is no newline at the end, because ORB-SLAM's reader expects a node after each newline.
    lines = [f"{v.branching} {v.levels} {L1_NORM} {TF_IDF}"]
    rows = zip(
        v.parent[1:].tolist(),
        (v.word[1:] >= 0).tolist(),
        v.descriptors[1:].view(np.uint8).tolist(),
        weight[1:].tolist(),
        strict=True,
    )
    for parent, leaf, values, idf in rows:
        descriptor = "".join([byte_text[value] for value in values])
        lines.append(f"{parent} {leaf:d}{descriptor} {idf:.9g}")
    write_file(path, "\n".join(lines))


def _read_header(path: Path, header: bytes) -> tuple[int, int]:
    try:
        branching, levels, scoring, weighting = map(int, header.split())
    except ValueError:
        raise InputError(
            f"{path}: line 1 is not 'k L scoring weighting' in whole numbers; "
            "give a vocabulary in DBoW2's text format."
        ) from None
    if not (2 <= branching <= MAX_BRANCHING and 1 <= levels <= MAX_LEVELS):
        raise InputError(
            f"{path}: line 1 says k {branching} and L {levels}, but k must be 2 to "
            f"{MAX_BRANCHING} and L 1 to {MAX_LEVELS}."
        )
    if (scoring, weighting) != (L1_NORM, TF_IDF):
        raise InputError(
            f"{path}: line 1 says scoring {scoring} and weighting {weighting}; "
            "only 0 and 0 (L1 norm, tf-idf) can be read."
        )
    return branching, levels


def _read_nodes(path: Path, lines: list[bytes]) -> NDArray[np.float64]:
    """Parse and check the lines of nodes 1 to n. Returns ``(n, 35)`` numbers."""

    def refused(node: int, fault: str) -> InputError:
        return InputError(f"{path}: line {node + 1} {fault}; fetch or export it again.")

    numbers = np.empty((len(lines), NUMBERS))
    for node, line in enumerate(lines, 1):
        words = line.split()
        if len(words) != NUMBERS:
            amount = "fewer" if len(words) < NUMBERS else "more"
            raise refused(node, f"has {amount} than {NUMBERS} numbers")
        try:
            numbers[node - 1] = list(map(float, words))
        except ValueError:
            raise refused(node, "contains something that is not a number") from None
    parent, leaf, byte, weight = numbers[:, 0], numbers[:, 1], numbers[:, 2:-1], numbers[:, -1]
    nodes = np.arange(1, len(lines) + 1)
    for valid, fault in (
        (~np.isnan(numbers).any(1), "contains something that is not a number"),
        ((parent >= 0) & (parent < nodes) & (parent % 1 == 0),
         "names a parent that does not come before it"),
        ((leaf == 0) | (leaf == 1), "has a leaf flag that is neither 0 nor 1"),
        (((byte >= 0) & (byte <= 255) & (byte % 1 == 0)).all(1),
         "has a descriptor byte that is not a whole number from 0 to 255"),
        ((weight >= 0) & (weight <= 3e38), "has a weight that is negative or too large"),
    ):  # fmt: skip
        if not valid.all():
            raise refused(1 + int(np.argmin(valid)), fault)
    return numbers


def _check_children(
    path: Path, parent: NDArray[np.int64], leaf: NDArray[np.bool_], branching: int
) -> None:
    n_children = np.bincount(parent[1:], minlength=len(parent))
    for wrong, fault in (
        (leaf & (n_children > 0), "is a leaf but has children"),
        (~leaf & (n_children == 0), "is not a leaf but has no children, so the file is truncated"),
        (n_children > branching, f"has more children than the {branching} that line 1 allows"),
    ):
        if wrong.any():
            node = int(np.argmax(wrong))
            name = f"line {node + 1}" if node else "the root"
            raise InputError(f"{path}: {name} {fault}; fetch or export it again.")


def _breadth_first(parent: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the nodes of a tree in breadth-first order, and the level of each of these nodes.
    Siblings keep the order of their lines."""
    by_parent = np.argsort(parent, kind="stable")
    n_children = np.bincount(parent[1:], minlength=len(parent))
    first = 1 + np.cumsum(n_children) - n_children  # position of each first child in by_parent
    generations = [np.zeros(1, np.int64)]
    while True:
        parents = generations[-1][n_children[generations[-1]] > 0]
        if len(parents) == 0:
            break
        counts = n_children[parents]
        within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        generations.append(by_parent[np.repeat(first[parents], counts) + within])
    levels = np.repeat(np.arange(len(generations)), [len(nodes) for nodes in generations])
    return np.concatenate(generations), levels
