"""What is done to grey images before a network looks for features in them."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from vslam.loopclosure.siamese.images import Size

_TEXTURE = 1.5 / 255.0  # between one grey level, which is noise, and two


def to_tensor(images: NDArray[np.uint8]) -> Tensor:
    """``(N, H, W)`` grey images to ``(N, 3, H, W)`` float32 in [0, 1], the grey replicated."""
    x = torch.from_numpy(np.ascontiguousarray(images)).float().div_(255.0)
    return x[:, None].expand(-1, 3, -1, -1)


class Unrolling(nn.Module):
    """Cylindrical projection, where a camera that turns moves everything alike.

    Szeliski, Image Alignment and Stitching: A Tutorial, 2006, section 2.3. On a flat image what
    moves to the side becomes wider and taller, so that an image turned by 30 degrees is no moved
    copy of what it was, and no alignment of views fits all of it. (Not in the paper.)

    Column ``x`` in [-1, 1] is the direction ``x half_angle``; there, with the sides of the flat
    image at ``tan(half_angle)``, row ``y`` shows the flat row ``middle y / cos(x half_angle)``.
    What lies beyond the image is black.

    Args:
        size: height and width of the images.
        half_angle: degrees from the middle to either side; 0 leaves images flat. One for all
            cameras, since one that is not calibrated may ask, too: turning is a shift exactly
            where it is the camera's own, and nearly so elsewhere.
        middle: share of the height that the column in the middle keeps. With the cosine of
            ``half_angle`` the sides keep all of it and nothing is black; with 1 the middle does.
    """

    grid: Tensor | None

    def __init__(self, size: Size, half_angle: float, middle: float) -> None:
        super().__init__()
        half = math.radians(half_angle)
        grid = None
        if half > 0:
            height, width = size
            x = ((torch.arange(width, dtype=torch.float64) + 0.5) / width * 2 - 1) * half
            y = (torch.arange(height, dtype=torch.float64) + 0.5) / height * 2 - 1
            across = (x.tan() / math.tan(half)).expand(height, width)
            grid = torch.stack([across, middle * y[:, None] / x.cos()], 2).float()[None]
        self.register_buffer("grid", grid, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """``(N, 1, H, W)`` to the same shape."""
        if self.grid is None:
            return images
        grid = self.grid.expand(len(images), -1, -1, -1)
        return functional.grid_sample(images, grid, align_corners=False)


def textured(images: Tensor) -> Tensor:
    """``(N, 1, H, W)`` in [0, 1] to 1.0 where a pixel differs from one beside or below it, else 0.

    By more than a grey level: what is black, white or covered does not.
    """
    beside = functional.pad((images[..., 1:] - images[..., :-1]).abs(), (0, 1))
    below = functional.pad((images[..., 1:, :] - images[..., :-1, :]).abs(), (0, 0, 0, 1))
    return (torch.maximum(beside, below) > _TEXTURE).to(images.dtype)


def standardised(images: Tensor, shown: Tensor | None = None) -> Tensor:
    """Each image with mean 0 and deviation 1 where it shows texture.

    Gain and bias of the camera drop out, and what is overexposed or covered does not change the
    rest.

    Args:
        images: ``(N, 1, H, W)``.
        shown: what :func:`textured` says of them, where that is known.
    """
    shown = textured(images) if shown is None else shown
    weight = shown + 1e-3  # of an image without any all pixels count
    weight = weight / weight.sum((1, 2, 3), keepdim=True)
    centred = images - (images * weight).sum((1, 2, 3), keepdim=True)
    deviation = torch.sqrt((centred * centred * weight).sum((1, 2, 3), keepdim=True))
    return centred / (deviation + 1e-3)
