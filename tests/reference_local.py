"""The network of the shipped local descriptors in torch, with which its ONNX file is compared.

One extractor computes a global descriptor and local descriptors (HF-Net, Sarlin et al., CVPR 2019).
Matches are found on a coarse grid and refined to subpixels on a fine grid (LoFTR, Sun et al., CVPR
2021). The extractor is that of the shipped network. Only a small head is trained.

Cell ``(row, column)`` of a grid of stride s lies at the pixel ``(s column, s row)``.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from vslam_lab.training.lite import LiteExtractor
from vslam_lab.training.preprocessing import standardised, textured

COARSE_SIZE, FINE_SIZE = 64, 32  # dimensions of the descriptors
_QUARTER = 3  # blocks of the extractor up to stride 4, with 24 channels
_HIDDEN, _FINE_HIDDEN = 128, 64


class Separable(nn.Module):
    """ReLU, depthwise and pointwise convolution, added to the input."""

    def __init__(self, channels: int, kernel: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(channels, channels, kernel, 1, kernel // 2, groups=channels)
        self.pointwise = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.pointwise(torch.relu(self.depthwise(torch.relu(x))))


class LocalHead(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.read16 = nn.Conv2d(112, _HIDDEN, 1)
        self.context = nn.Sequential(Separable(_HIDDEN, 5), Separable(_HIDDEN, 5))
        self.coarse = nn.Conv2d(_HIDDEN, COARSE_SIZE, 1)
        self.down = nn.Conv2d(_HIDDEN, _FINE_HIDDEN, 1)
        self.read8 = nn.Conv2d(40, _FINE_HIDDEN, 1)
        self.mix8 = Separable(_FINE_HIDDEN, 3)
        self.read4 = nn.Conv2d(24, _FINE_HIDDEN, 1)
        self.mix4 = nn.Sequential(Separable(_FINE_HIDDEN, 3), Separable(_FINE_HIDDEN, 3))
        self.fine = nn.Conv2d(_FINE_HIDDEN, FINE_SIZE, 1)

    def forward(self, x4: Tensor, x8: Tensor, x16: Tensor) -> tuple[Tensor, Tensor]:
        """Compute descriptors of length 1 from the features of each stride.

        Args:
            x4, x8, x16: ``(N, C, h, w)`` features at strides 4, 8 and 16.

        Returns:
            ``(N, 64, h, w)`` coarse descriptors, and ``(N, 32, 4 h, 4 w)`` fine descriptors.
        """
        hidden = self.context(self.read16(x16))
        y = self.mix8(self.read8(x8) + doubled(self.down(hidden), x8))
        y = self.mix4(self.read4(x4) + doubled(y, x4))
        return (
            functional.normalize(self.coarse(hidden), dim=1),
            functional.normalize(self.fine(y), dim=1),
        )


class LocalNetwork(nn.Module):
    def __init__(self, extractor: LiteExtractor, head: LocalHead) -> None:
        super().__init__()
        self.extractor, self.head = extractor, head

    def features(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Compute features at strides 4, 8 and 16 of ``(N, 1, H, W)`` float32 images in [0, 1]."""
        x = standardised(image, textured(image))
        x = functional.relu6(self.extractor.stem(x))
        kept = []
        for number, block in enumerate(self.extractor.residuals, 1):
            x = block(x)
            if number in (_QUARTER, _QUARTER + 2):
                kept.append(x)
        return kept[0], kept[1], x

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the descriptors of an ``(H, W)`` uint8 grey image.

        Returns:
            ``(h, w, 64)`` coarse descriptors, and ``(4 h, 4 w, 32)`` fine descriptors.
        """
        grey = image.float() / 255.0
        coarse, fine = self.head(*self.features(grey[None, None]))
        return coarse[0].permute(1, 2, 0), fine[0].permute(1, 2, 0)


def doubled(x: Tensor, like: Tensor) -> Tensor:
    """Interpolate ``(N, C, h, w)`` to twice the resolution, and crop it to the size of ``like``.

    The value at (i, j) moves to (2 i, 2 j).
    """
    for axis in (2, 3):
        last = x.narrow(axis, x.shape[axis] - 1, 1)
        following = torch.cat([x.narrow(axis, 1, x.shape[axis] - 1), last], axis)
        x = torch.stack([x, 0.5 * (x + following)], axis + 1).flatten(axis, axis + 1)
    return x[:, :, : like.shape[2], : like.shape[3]]
