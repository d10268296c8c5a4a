"""The light feature extractor of Zhou and Sun (Sci Rep 15, 7644, 2025), and the layer of primary
capsules."""

from __future__ import annotations

from collections.abc import Collection
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from vslam_lab.training.capsules import squash

Block = tuple[int, int, int]
"""Channels, stride and dilation of a separable convolution. The first block is the stem."""

LIGHT_BLOCKS: tuple[Block, ...] = (
    (32, 4, 1),  # 57x57 grid cells for 227 pixels
    (64, 2, 1),  # 29x29
    (128, 1, 2),
    (192, 2, 3),  # 15x15
    (256, 1, 2),
)


class Separable(nn.Module):
    """Depthwise and pointwise convolution, followed by batch normalisation (equation 1 of Zhou and
    Sun) and ReLU."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int = 3,
        stride: int = 1,
        dilation: int = 1,
        *,
        active: bool = True,
    ) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(
            inputs, inputs, kernel, stride, dilation * (kernel // 2), dilation,
            groups=inputs, bias=False,
        )  # fmt: skip
        self.pointwise = nn.Conv2d(inputs, outputs, 1, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)
        self.active = active

    def forward(self, x: Tensor) -> Tensor:
        x = self.norm(self.pointwise(self.depthwise(x)))
        return torch.relu(x) if self.active else x

    def fold(self) -> None:
        """Fold the batch normalisation into the preceding convolution, which makes inference
        faster."""
        if isinstance(self.norm, nn.BatchNorm2d):
            self.pointwise = fuse_conv_bn_eval(self.pointwise, self.norm)
            self.norm = nn.Identity()


class Stem(nn.Module):
    """The first layer of the extractor, an ordinary 7x7 convolution. A separable convolution would
    not be faster, because the image has only one grey channel."""

    def __init__(self, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(1, outputs, 7, stride, 3, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.norm(self.conv(x)))

    def fold(self) -> None:
        if isinstance(self.norm, nn.BatchNorm2d):
            self.conv = fuse_conv_bn_eval(self.conv, self.norm)
            self.norm = nn.Identity()


class PrimaryCapsules(nn.Module):
    """The layer of primary capsules: a separable 7x7 convolution with stride 1. Its output channels
    are grouped into capsules, and each capsule is squashed."""

    def __init__(self, inputs: int, types: int, size: int) -> None:
        super().__init__()
        self.types, self.size = types, size
        self.conv = Separable(inputs, types * size, kernel=7, active=False)

    def forward(self, x: Tensor) -> Tensor:
        """Compute ``(N, types, h w, size)`` capsules from ``(N, C, h, w)`` features."""
        x = self.conv(x)
        n, _, h, w = x.shape
        return squash(x.reshape(n, self.types, self.size, h * w).transpose(2, 3))


class LightExtractor(nn.Sequential):
    """The light feature extractor of Zhou and Sun: strided separable convolutions with dilations 1,
    2 and 3. An image of 227x227 pixels gives a feature grid of 15x15 cells.

    Attributes:
        out_channels: number of channels of the feature grid.
    """

    def __init__(self, blocks: Collection[Block] = LIGHT_BLOCKS) -> None:
        stem, *rest = blocks
        layers: list[nn.Module] = [Stem(stem[0], stem[1])]
        inputs = stem[0]
        for outputs, stride, dilation in rest:
            layers.append(Separable(inputs, outputs, stride=stride, dilation=dilation))
            inputs = outputs
        super().__init__(*layers)
        self.out_channels = inputs


def grid_side(pixels: int, blocks: Collection[Block] = LIGHT_BLOCKS) -> int:
    """Compute the number of cells of the feature grid along a side of ``pixels``."""
    for _, stride, _ in blocks:
        pixels = (pixels - 1) // stride + 1
    return pixels


def fold_batch_norms(network: nn.Module) -> None:
    """Fold all batch normalisations of a network into its convolutions, in place. The network must
    be in eval mode."""
    for module in network.modules():
        if isinstance(module, Separable | Stem):
            cast(Separable, module).fold()
