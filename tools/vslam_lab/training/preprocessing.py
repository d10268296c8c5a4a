"""Preprocesses grey images before a network extracts features from them."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from vslam.loopclosure.siamese.images import Size

_TEXTURE = 1.5 / 255.0  # one grey level of difference is noise, two are texture


def to_tensor(images: NDArray[np.uint8]) -> Tensor:
    """Convert ``(N, H, W)`` uint8 images to ``(N, 3, H, W)`` float32 in [0, 1] with three equal
    channels."""
    x = torch.from_numpy(np.ascontiguousarray(images)).float().div_(255.0)
    return x[:, None].expand(-1, 3, -1, -1)


class Unrolling(nn.Module):
    """Projects images onto a cylinder (Szeliski, Image Alignment and Stitching: A Tutorial, 2006,
    section 2.3). In a projected image, a rotation of the camera appears as a horizontal shift.

    Zhou and Sun (2025) do not use this projection.

    Column ``x`` of the projected image, in [-1, 1], shows the direction ``x half_angle``. In this
    column, row ``y`` shows the row ``middle y / cos(x half_angle)`` of the flat image. The sides of
    the flat image are at ``tan(half_angle)``. Pixels outside the flat image are black.

    Args:
        size: height and width of the images.
        half_angle: angle from the middle of the image to either side, in degrees. If it is 0,
            images are not projected. The same value is used for all cameras, because some cameras
            are not calibrated. If the field of view of a camera differs, a rotation is only
            approximately a shift.
        middle: fraction of the image height that the middle column of the projected image shows. If
            it is the cosine of ``half_angle``, the outermost columns show the whole height, and no
            pixel is black. If it is 1, the middle column shows the whole height.
    """

    grid: Tensor | None

    def __init__(self, size: Size, half_angle: float, middle: float) -> None:
        super().__init__()
        half = math.radians(half_angle)
        grid = None
        if half > 0:
            height, width = size
            angle = ((torch.arange(width, dtype=torch.float64) + 0.5) / width * 2 - 1) * half
            y = (torch.arange(height, dtype=torch.float64) + 0.5) / height * 2 - 1
            column = (angle.tan() / math.tan(half)).expand(height, width)
            grid = torch.stack([column, middle * y[:, None] / angle.cos()], 2).float()[None]
        self.register_buffer("grid", grid, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Project ``(N, 1, H, W)`` images onto the cylinder. The result has the same shape."""
        if self.grid is None:
            return images
        grid = self.grid.expand(len(images), -1, -1, -1)
        return functional.grid_sample(images, grid, align_corners=False)


def textured(images: Tensor) -> Tensor:
    """Compute the texture masks of ``(N, 1, H, W)`` images in [0, 1].

    The mask is 1.0 where a pixel differs by more than one grey level from its right or lower
    neighbour. Elsewhere, for example in black, white or covered areas, the mask is 0.0.
    """
    right = functional.pad((images[..., 1:] - images[..., :-1]).abs(), (0, 1))
    lower = functional.pad((images[..., 1:, :] - images[..., :-1, :]).abs(), (0, 0, 0, 1))
    return (torch.maximum(right, lower) > _TEXTURE).to(images.dtype)


def standardised(images: Tensor, texture: Tensor | None = None) -> Tensor:
    """Scale each image to mean 0 and standard deviation 1 over its textured pixels.

    The scaling removes the gain and the bias of the camera. Overexposed or covered areas do not
    affect the other pixels.

    Args:
        images: ``(N, 1, H, W)`` images in [0, 1].
        texture: texture masks of the images from :func:`textured`. If it is None, the masks are
            computed.
    """
    texture = textured(images) if texture is None else texture
    weight = texture + 1e-3  # in an image without texture, all pixels count equally
    weight = weight / weight.sum((1, 2, 3), keepdim=True)
    centred = images - (images * weight).sum((1, 2, 3), keepdim=True)
    deviation = torch.sqrt((centred * centred * weight).sum((1, 2, 3), keepdim=True))
    return centred / (deviation + 1e-3)
