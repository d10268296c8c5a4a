"""Threads of torch, and the time that an image takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from vslam.loopclosure.training.siamese import SiameseNetwork


def set_threads(threads: int) -> None:
    """Set the number of threads with which torch computes."""
    torch.set_num_threads(threads)


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute with one thread, so that sums do not depend on the machine's number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.no_grad()
def milliseconds_per_image(*networks: SiameseNetwork, repeats: int = 50) -> list[float]:
    """Shortest time to embed one image on one core for each network.

    Networks take turns, so that the load of the machine affects all of them equally. The shortest
    time counts, because other processes can only add to it.
    """
    best = [float("inf")] * len(networks)
    with one_thread():
        for _ in range(repeats):
            for k, network in enumerate(networks):
                image = torch.rand(1, 3, *network.size)
                began = time.perf_counter()
                network.embed(image)
                best[k] = min(best[k], time.perf_counter() - began)
    return [1e3 * seconds for seconds in best]
