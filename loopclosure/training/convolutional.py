"""Convolutional branches: classification networks that compute descriptors of images.

Like the capsule network, all take standardised grey images. A linear layer to the descriptor
replaces the classification layer, so that only the architectures differ.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn

from vslam.errors import InputError
from vslam.loopclosure.siamese.images import Size
from vslam.loopclosure.training.branches import Layout
from vslam.loopclosure.training.preprocessing import standardised
from vslam.loopclosure.training.torch_files import read_pth

DIMENSIONS = 1024  # of the descriptor, as in the capsule network
_LEAST_SIDE = 64  # of an image: AlexNet's last pooling needs 63


class ConvolutionalBranch(nn.Module):
    """Features, pooling, fully connected layers (none after a global average), a linear layer.

    There is no dropout. With it the network does not learn, because at the start of training
    dropout changes a descriptor more (cosine 0.5) than another image does (cosine 0.97). Weights
    are initialised as in He et al., ICCV 2015; with torch's default, descriptors of images differ
    by only 0.003.

    Attributes:
        width: input dimension of the last layer, as in the original classifier.
    """

    def __init__(
        self,
        name: str,
        features: nn.Sequential,
        size: Size,
        width: int,
        *,
        pooled: int = 1,
        classifier: nn.Sequential | None = None,
    ) -> None:
        """Draw random weights.

        Args:
            pooled: side of the grid after pooling.
            classifier: fully connected layers before the last one.

        Raises:
            InputError: the images are too small.
        """
        super().__init__()
        if min(size) < _LEAST_SIDE:
            raise InputError(
                f"{name}: needs images of at least {_LEAST_SIDE} pixels per side, not "
                f"{size[0]}x{size[1]}."
            )
        self.name, self.width = name, width
        self.layout = Layout(size)
        self.size, self.views = size, self.layout.views
        self.dimensions = DIMENSIONS
        self.features = features
        self.pool = nn.AdaptiveAvgPool2d(pooled)
        self.classifier = classifier or nn.Sequential()
        self.descriptor = nn.Linear(width, self.dimensions)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                if module.bias is not None:
                    nn.init.zeros_(module.bias)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Tensor) -> Tensor:
        """``(N, 3, H, W)`` float32 in [0, 1] to ``(N, 1024)``, not yet normalised."""
        grey = standardised(images.mean(1, keepdim=True))
        x: Tensor = self.features(grey.expand(-1, 3, -1, -1))
        x = self.classifier(self.pool(x).flatten(1))
        return cast(Tensor, self.descriptor(x))

    def load_torchvision(self, path: Path) -> None:
        """Load the weights of a torchvision file (``alexnet-*.pth``, ``vgg16-*.pth``).

        The classification layer is left out. The weights only initialise training, because the
        branch standardises each image instead of normalising it as for ImageNet.

        Raises:
            InputError: the file is missing, not a weight file, or of another network.
        """
        fix = f"name torchvision's weight file of {self.name}"
        state = read_pth(path, fix)
        own = {key: value for key, value in self.state_dict().items() if "descriptor" not in key}
        if not isinstance(state, dict) or any(
            key not in state or state[key].shape != value.shape for key, value in own.items()
        ):
            raise InputError(f"{path}: has the layers of another network; {fix}.")
        self.load_state_dict({key: state[key] for key in own}, strict=False)


def alexnet(size: Size) -> ConvolutionalBranch:
    """Krizhevsky et al., NIPS 2012, in one tower (Krizhevsky 2014), with torchvision's layout."""
    features = nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
    )  # fmt: skip
    classifier = nn.Sequential(  # without dropout
        nn.Identity(), nn.Linear(256 * 36, 4096), nn.ReLU(inplace=True),
        nn.Identity(), nn.Linear(4096, 4096), nn.ReLU(inplace=True),
    )  # fmt: skip
    return ConvolutionalBranch("alexnet", features, size, 4096, pooled=6, classifier=classifier)


def vgg16(size: Size) -> ConvolutionalBranch:
    """Simonyan and Zisserman, ICLR 2015, configuration D, with torchvision's layout."""
    layers: list[nn.Module] = []
    inputs = 3
    for outputs, repeats in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(repeats):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
            inputs = outputs
        layers.append(nn.MaxPool2d(2, 2))
    classifier = nn.Sequential(
        nn.Linear(512 * 49, 4096), nn.ReLU(inplace=True), nn.Identity(),
        nn.Linear(4096, 4096), nn.ReLU(inplace=True), nn.Identity(),
    )  # fmt: skip
    features = nn.Sequential(*layers)
    return ConvolutionalBranch("vgg16", features, size, 4096, pooled=7, classifier=classifier)


def darknet19(size: Size) -> ConvolutionalBranch:
    """Redmon and Farhadi, YOLO9000, CVPR 2017, Table 6, up to its last convolution.

    The 3x3 convolutions increase the number of channels, the 1x1 convolutions between them reduce
    it; batch normalisation and leaky ReLU follow each convolution.
    """
    layers: list[nn.Module] = []
    inputs = 3
    for stage in ((32,), (64,), (128, 64, 128), (256, 128, 256), (512, 256, 512, 256, 512),
                  (1024, 512, 1024, 512, 1024)):  # fmt: skip
        if layers:
            layers.append(nn.MaxPool2d(2, 2))
        for number, outputs in enumerate(stage):
            kernel = 1 if number % 2 else 3
            layers += [
                nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2, bias=False),
                nn.BatchNorm2d(outputs),
                nn.LeakyReLU(0.1, inplace=True),
            ]
            inputs = outputs
    return ConvolutionalBranch("darknet19", nn.Sequential(*layers), size, inputs)


class Inception(nn.Module):
    """Four paths side by side: 1x1; 1x1, 3x3; 1x1, 5x5; pooling, 1x1 (Szegedy 2015, Figure 2b)."""

    def __init__(
        self, inputs: int, one: int, before_three: int, three: int, before_five: int, five: int,
        after_pool: int,
    ) -> None:  # fmt: skip
        super().__init__()
        self.paths = nn.ModuleList([
            _convolution(inputs, one, 1),
            nn.Sequential(_convolution(inputs, before_three, 1),
                          _convolution(before_three, three, 3)),
            nn.Sequential(_convolution(inputs, before_five, 1),
                          _convolution(before_five, five, 5)),
            nn.Sequential(nn.MaxPool2d(3, 1, 1), _convolution(inputs, after_pool, 1)),
        ])  # fmt: skip
        self.outputs = one + three + five + after_pool

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([path(x) for path in self.paths], 1)


# Columns of Table 1: #1x1, #3x3 reduce, #3x3, #5x5 reduce, #5x5, pool proj; None pools.
INCEPTIONS: tuple[tuple[int, int, int, int, int, int] | None, ...] = (
    (64, 96, 128, 16, 32, 32),
    (128, 128, 192, 32, 96, 64),
    None,
    (192, 96, 208, 16, 48, 64),
    (160, 112, 224, 24, 64, 64),
    (128, 128, 256, 24, 64, 64),
    (112, 144, 288, 32, 64, 64),
    (256, 160, 320, 32, 128, 128),
    None,
    (256, 160, 320, 32, 128, 128),
    (384, 192, 384, 48, 128, 128),
)


def googlenet(size: Size) -> ConvolutionalBranch:
    """Szegedy et al., CVPR 2015, Table 1 and Figure 3, without the auxiliary classifiers.

    As in the paper, it has local response normalisation and no batch normalisation.
    """
    layers: list[nn.Module] = [
        _convolution(3, 64, 7, 2), _halving(), nn.LocalResponseNorm(5),
        _convolution(64, 64, 1), _convolution(64, 192, 3), nn.LocalResponseNorm(5), _halving(),
    ]  # fmt: skip
    inputs = 192
    for widths in INCEPTIONS:
        if widths is None:
            layers.append(_halving())
            continue
        layers.append(module := Inception(inputs, *widths))
        inputs = module.outputs
    return ConvolutionalBranch("googlenet", nn.Sequential(*layers), size, inputs)


def mobilenet(size: Size) -> ConvolutionalBranch:
    """Howard et al., MobileNets, arXiv:1704.04861, Table 1: width and resolution multiplier 1.

    The last depthwise convolution has stride 1: the table says 2, but its sizes imply 1.
    """
    layers: list[nn.Module] = _normalised(3, 32, 3, stride=2)
    inputs = 32
    for outputs, stride in ((64, 1), (128, 2), (128, 1), (256, 2), (256, 1), (512, 2),
                            *[(512, 1)] * 5, (1024, 2), (1024, 1)):  # fmt: skip
        layers += _normalised(inputs, inputs, 3, stride=stride, groups=inputs)
        layers += _normalised(inputs, outputs, 1)
        inputs = outputs
    return ConvolutionalBranch("mobilenet", nn.Sequential(*layers), size, inputs)


class Fire(nn.Module):
    """Squeeze by 1x1, expand by equally many 1x1 and 3x3 filters (Iandola et al. 2016, 3.2)."""

    def __init__(self, inputs: int, squeezed: int, expanded: int) -> None:
        super().__init__()
        self.squeeze = _convolution(inputs, squeezed, 1)
        self.ones = _convolution(squeezed, expanded, 1)
        self.threes = _convolution(squeezed, expanded, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = self.squeeze(x)
        return torch.cat([self.ones(x), self.threes(x)], 1)


def squeezenet(size: Size) -> ConvolutionalBranch:
    """Iandola et al., arXiv:1602.07360, in the authors' version 1.1, up to fire9.

    Version 1.1 begins with 64 filters of 3x3 and has pooling after layers 1, 3 and 5.
    """
    layers: list[nn.Module] = [nn.Conv2d(3, 64, 3, 2), nn.ReLU(inplace=True)]
    inputs = 64
    for number, (squeezed, expanded) in enumerate(
        ((16, 64), (16, 64), (32, 128), (32, 128), (48, 192), (48, 192), (64, 256), (64, 256))
    ):
        if number in (0, 2, 4):
            layers.append(nn.MaxPool2d(3, 2, ceil_mode=True))
        layers.append(Fire(inputs, squeezed, expanded))
        inputs = 2 * expanded
    return ConvolutionalBranch("squeezenet", nn.Sequential(*layers), size, inputs)


CONVOLUTIONAL: dict[str, Callable[[Size], ConvolutionalBranch]] = {
    one.__name__: one for one in (alexnet, vgg16, darknet19, googlenet, mobilenet, squeezenet)
}


def _convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2), nn.ReLU(inplace=True)
    )


def _halving() -> nn.MaxPool2d:
    return nn.MaxPool2d(3, 2, ceil_mode=True)


def _normalised(
    inputs: int, outputs: int, kernel: int, *, stride: int = 1, groups: int = 1
) -> list[nn.Module]:
    return [
        nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    ]
