"""PCANet: filters by principal components of patches, binary hashing, histograms of blocks.

Chan et al., PCANet, IEEE Transactions on Image Processing 24(12), 2015. It learns without
gradients. Xia et al. (IJCNN 2016) used its features to detect loops. The two stages of 8 filters of
7x7 and the whitened components that reduce the histograms are those of the paper's experiments on
faces (section III); the 4x4 blocks and 512 components are our choice.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from vslam.loopclosure.siamese.images import Size
from vslam.loopclosure.training.branches import Layout
from vslam.loopclosure.training.preprocessing import standardised, to_tensor

FILTERS, KERNEL = 8, 7  # of each of two stages
_BLOCKS = 4  # along a side of the image
_BINS = 2**FILTERS
COMPONENTS = 512
_BATCH = 16


class PcaNetBranch(nn.Module):
    """Two stages of filters, hashing, histograms and whitened components.

    Filters and components are zero until :meth:`learn` is called. They are parameters without
    gradients.
    """

    block: Tensor

    def __init__(self, size: Size) -> None:
        super().__init__()
        self.layout = Layout(size)
        self.size, self.views = size, self.layout.views
        self.dimensions = COMPONENTS
        features = _BLOCKS * _BLOCKS * FILTERS * _BINS
        self.first = _constant(FILTERS, 1, KERNEL, KERNEL)
        self.second = _constant(FILTERS, 1, KERNEL, KERNEL)
        self.mean = _constant(features)
        self.components = _constant(COMPONENTS, features)
        row, column = (torch.arange(side) * _BLOCKS // side for side in size)
        block = (row[:, None] * _BLOCKS + column).flatten() * _BINS
        self.register_buffer("block", block, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """``(N, 3, H, W)`` float32 in [0, 1] to ``(N, 512)``, not yet of length 1."""
        return (self.histograms(images) - self.mean) @ self.components.T

    def histograms(self, images: Tensor) -> Tensor:
        """Histograms ``(N, F)`` float32 of the codes in each block, from ``(N, 3, H, W)``."""
        n = len(images)
        maps = _filtered(standardised(images.mean(1, keepdim=True)), self.first)
        hashed = _filtered(maps.flatten(0, 1)[:, None], self.second) > 0
        weights = 2 ** torch.arange(FILTERS, device=images.device)
        codes = (hashed.long() * weights[:, None, None]).sum(1).flatten(1)
        counts = torch.zeros(n * FILTERS, _BLOCKS * _BLOCKS * _BINS, device=images.device)
        counts = counts.scatter_add(1, codes + self.block, torch.ones_like(codes).float())
        return counts.view(n, -1)

    @torch.no_grad()
    def learn(self, images: NDArray[np.uint8]) -> None:
        """Learn filters and components from images ``(N, H, W)``, in place."""
        self.first.copy_(principal_filters(_grey(images)))
        self.second.copy_(
            principal_filters(
                _filtered(grey, self.first).flatten(0, 1)[:, None] for grey in _grey(images)
            )
        )
        batches = (images[k : k + _BATCH] for k in range(0, len(images), _BATCH))
        histograms = torch.cat([self.histograms(to_tensor(batch)) for batch in batches])
        mean = histograms.mean(0)
        centred = histograms - mean
        # Eigenvectors of the (N, N) Gram matrix, since there are fewer images than dimensions.
        variance, vectors = torch.linalg.eigh((centred @ centred.T).double())
        kept = min(COMPONENTS, len(images) - 1)
        variance, vectors = variance[-kept:].flip(0), vectors[:, -kept:].flip(1)
        scaled = vectors * (len(images) ** 0.5 / variance.clamp_min(1e-9))
        self.mean.copy_(mean)
        self.components.zero_()
        self.components[:kept] = scaled.float().T @ centred


def principal_filters(batches: Iterator[Tensor]) -> Tensor:
    """The leading eigenvectors ``(8, 1, 7, 7)`` of all patches, each minus its mean.

    Signs are chosen so that the largest element of a filter is positive.

    Args:
        batches: batches of images, ``(N, 1, H, W)`` each.
    """
    moments = torch.zeros(KERNEL**2, KERNEL**2, dtype=torch.float64)
    for images in batches:
        patches = functional.unfold(images, KERNEL).transpose(0, 1).flatten(1)
        patches = patches - patches.mean(0)
        moments += (patches @ patches.T).double()
    _, vectors = torch.linalg.eigh(moments)
    filters = vectors.flip(1)[:, :FILTERS].T
    largest = filters.gather(1, filters.abs().argmax(1, keepdim=True))
    return (filters * largest.sign()).float().view(FILTERS, 1, KERNEL, KERNEL)


def _constant(*shape: int) -> nn.Parameter:
    return nn.Parameter(torch.zeros(shape), requires_grad=False)


def _filtered(images: Tensor, filters: Tensor) -> Tensor:
    """``(N, 1, H, W)`` to ``(N, 8, H, W)``, with zeros beyond the border."""
    return functional.conv2d(images, filters, padding=KERNEL // 2)


def _grey(images: NDArray[np.uint8]) -> Iterator[Tensor]:
    """Standardised ``(N, 1, H, W)``, in batches."""
    for k in range(0, len(images), _BATCH):
        yield standardised(to_tensor(images[k : k + _BATCH])[:, :1])
