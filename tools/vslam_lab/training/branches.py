"""Defines the branch of a network that computes descriptors, and the layout of its input images."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from torch import Tensor, nn
from torch.nn import functional

from vslam.loopclosure.siamese.images import Size
from vslam.support.errors import InputError, plain_reason
from vslam_lab.training.capsules import CapsuleLayer
from vslam_lab.training.extractors import (
    LIGHT_BLOCKS,
    LightExtractor,
    PrimaryCapsules,
    grid_side,
)
from vslam_lab.training.lite import (
    EARLY_STRIDE,
    LiteExtractor,
    lite_grid_side,
)
from vslam_lab.training.preprocessing import Unrolling, standardised, textured

_LEAST_SHARE = 0.02  # least weight of a view, so that an image without texture has a descriptor


class Layout(NamedTuple):
    """The size of a network's input image, and how the image is divided into views.

    A view is a part of the image that has its own descriptor. Views are evenly spaced from left to
    right.

    Attributes:
        size: height and width of the input image.
        views: number of views.
        view_width: number of columns of a view. None if the whole image is the only view.
        half_angle, middle: see :class:`preprocessing.Unrolling`. If ``half_angle`` is 0, the image
            is not projected onto a cylinder.
    """

    size: Size
    views: int = 1
    view_width: int | None = None
    half_angle: float = 0.0
    middle: float = 1.0


class CapsuleShape(BaseModel):
    """The structure of a capsule branch, which is the part of a network that computes descriptors.
    It is stored together with the weights."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    extractor: Literal["light", "lite0"] = "light"
    pixels: int = Field(227, ge=32, description="Height of the input.")
    width: int | None = Field(None, ge=32, description="Width of the input; None for a square.")
    views: int = Field(
        1, ge=1, le=16, description="Number of views (parts of the image), from left to right."
    )
    view_width: int | None = Field(None, ge=32, description="Columns of a view; None for all.")
    half_angle: float = Field(
        0.0,
        ge=0,
        le=60,
        description="Degrees from the middle to a side for unrolling; 0 disables it.",
    )
    middle: float = Field(
        1.0, gt=0, le=1, description="Share of the height that the middle column keeps."
    )
    blocks: tuple[tuple[int, int, int], ...] = LIGHT_BLOCKS
    types: int = Field(32, ge=1, description="Number of types of primary capsules.")
    size: int = Field(8, ge=1, description="Dimension of a primary capsule.")
    outputs: int = Field(64, ge=1, description="Number of output capsules.")
    depth: int = Field(16, ge=1, description="Dimension of an output capsule.")
    iterations: int = Field(3, ge=1, description="Number of routing iterations.")
    over: Literal["primary", "output"] = "primary"
    kept: int | None = Field(
        None, description="Number of places that are kept per type; None before pruning."
    )

    @model_validator(mode="after")
    def _flat_images_keep_their_height(self) -> CapsuleShape:
        if self.middle < 1 and self.half_angle == 0:
            raise ValueError(f"middle {self.middle:g}: needs unrolled images; give half_angle")
        return self

    @model_validator(mode="after")
    def _views_lie_on_columns(self) -> CapsuleShape:
        width, view = self.input[1], self.view_width
        if self.views == 1 and view is not None:
            raise ValueError(f"view_width {view}: a single view is the whole image; leave it out")
        if self.views == 1:
            return self
        if view is None:
            raise ValueError(
                f"views {self.views}: needs view_width, the number of columns of a view"
            )
        if view >= width:
            raise ValueError(f"view_width {view}: must be less than the image width {width}")
        if (width - view) % (self.cut_stride * (self.views - 1)):
            raise ValueError(
                f"view_width {view}: {self.views} views in {width} columns must be spaced by a "
                f"multiple of {self.cut_stride} columns"
            )
        return self

    @property
    def input(self) -> Size:
        """Height and width of the input images."""
        return self.pixels, self.width or self.pixels

    @property
    def layout(self) -> Layout:
        return Layout(self.input, self.views, self.view_width, self.half_angle, self.middle)

    @property
    def view(self) -> Size:
        """Height and width of a view, which is a part of the image with its own descriptor."""
        return self.pixels, self.view_width or self.input[1]

    @property
    def cut_stride(self) -> int:
        """Stride of the array from which the views are cut, in pixels of the input image.

        For the extractor lite0, views are cut from the early features, which are computed once for
        all views. For other extractors, views are cut from the pixels.
        """
        return EARLY_STRIDE if self.extractor == "lite0" else 1

    @property
    def cuts(self) -> list[slice]:
        """For each view, the range of columns in the array from which the views are cut."""
        width, view = self.input[1], self.view[1]
        step = (width - view) // self.cut_stride // max(1, self.views - 1)
        columns = (view - 1) // self.cut_stride + 1
        return [slice(k * step, k * step + columns) for k in range(self.views)]

    def for_images_of(self, size: Size) -> CapsuleShape:
        """Adapt the shape to images of a different size. Each view still covers approximately the
        same fraction of the width."""
        view = None
        if self.view_width is not None:
            unit, width = self.cut_stride * (self.views - 1), size[1]
            outside_view = width * (1 - self.view_width / self.input[1])
            view = width - unit * max(1, round(outside_view / unit))
        return self.with_layout(self.layout._replace(size=size, view_width=view))

    @property
    def grid(self) -> tuple[int, int]:
        """Number of rows and number of columns of the feature grid of a view."""
        height, width = self.view
        if self.extractor == "lite0":
            return lite_grid_side(height), lite_grid_side(width)
        return grid_side(height, self.blocks), grid_side(width, self.blocks)

    @property
    def places(self) -> int:
        """Number of cells in the feature grid of a view. A cell is called a place."""
        rows, columns = self.grid
        return rows * columns

    def with_layout(self, layout: Layout) -> CapsuleShape:
        """Return a copy of the shape with a different layout of the input image.

        Raises:
            InputError: the views do not fit the image.
        """
        height, width = layout.size
        fields = {
            "pixels": height,
            "width": None if width == height else width,
            "views": layout.views,
            "view_width": layout.view_width,
            "half_angle": layout.half_angle,
            "middle": layout.middle,
        }
        try:
            return CapsuleShape(**{**self.model_dump(), **fields})
        except ValidationError as error:
            raise InputError(f"{height}x{width} pixels: {_first_fault(error)}.") from error


class CapsuleBranch(nn.Module):
    """The part of a Siamese network that computes descriptors: feature extractor, primary capsules
    and routing.

    The descriptor consists of the flattened output capsules. With several views, it is the
    concatenation of the descriptors of the views, from left to right. The descriptor of each view
    is multiplied by the fraction of the view that shows texture, because areas without texture,
    such as fog, do not distinguish places.

    With the extractor lite0, the views are cut from the early features of the whole image.
    Therefore, the features at the border of a view depend on the image next to the view, not on
    padding.
    """

    def __init__(self, shape: CapsuleShape) -> None:
        super().__init__()
        self.shape = shape
        self.size, self.views, self.layout = shape.input, shape.views, shape.layout
        self.dimensions = shape.views * shape.outputs * shape.depth
        self.unrolling = Unrolling(shape.input, shape.half_angle, shape.middle)
        lite = shape.extractor == "lite0"
        self.extractor = LiteExtractor() if lite else LightExtractor(shape.blocks)
        self.primary = PrimaryCapsules(self.extractor.out_channels, shape.types, shape.size)
        # With the memory format channels-last, depthwise convolutions take a third less time
        # forwards and a quarter less backwards.
        for module in (self.extractor, self.primary):
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.capsules = CapsuleLayer(
            shape.types, shape.places, shape.size, shape.outputs, shape.depth,
            shape.iterations, shape.over, shape.kept,
        )  # fmt: skip

    def forward(self, images: Tensor) -> Tensor:
        """Compute ``(N, D)`` descriptors of ``(N, 3, H, W)`` float32 images in [0, 1]. The
        descriptors are not normalised."""
        grey = self._unrolled(images)
        texture = textured(grey)
        v = self.capsules(self._primary_capsules(grey, texture)).flatten(1)
        views = functional.normalize(torch.stack(v.chunk(self.views), 1), dim=2)
        return (views * self._textured_share(texture)[:, :, None]).flatten(1)

    def routed(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the output capsules, ``(V N, J, D)``, and the coupling coefficients,
        ``(V N, J, I)``, of V views of N images. The leftmost views of all images come first."""
        grey = self._unrolled(images)
        return self.capsules.routed(self._primary_capsules(grey, textured(grey)))

    def _unrolled(self, images: Tensor) -> Tensor:
        """Convert ``(N, 3, H, W)`` images to ``(N, 1, H, W)`` grey images that are projected onto a
        cylinder."""
        grey: Tensor = self.unrolling(images.mean(1, keepdim=True))
        return grey

    def _primary_capsules(self, grey: Tensor, texture: Tensor) -> Tensor:
        """Compute the primary capsules, ``(V N, T, P, A)``, of ``(N, 1, H, W)`` images and their
        texture masks."""
        if isinstance(self.extractor, LiteExtractor):
            x = standardised(grey, texture).contiguous(memory_format=torch.channels_last)
            x = self.extractor.late(self._views(self.extractor.early(x)))
        else:
            x = self.extractor(standardised(self._views(grey)))
        capsules: Tensor = self.primary(x)
        return capsules

    def _textured_share(self, texture: Tensor) -> Tensor:
        """Compute the fraction of each view that shows texture, as an ``(N, V)`` tensor."""
        starts = [cut.start * self.shape.cut_stride for cut in self.shape.cuts]
        width = self.shape.view[1]
        shares = [texture[..., k : k + width].mean((1, 2, 3)) for k in starts]
        return torch.stack(shares, 1).clamp_min(_LEAST_SHARE)

    def _views(self, x: Tensor) -> Tensor:
        """Cut ``(N, C, h, w)`` arrays into V views each. The result has the shape
        ``(V N, C, h, v)``."""
        if self.views > 1:
            x = torch.cat([x[..., columns] for columns in self.shape.cuts])
        return x.contiguous(memory_format=torch.channels_last)


def _first_fault(error: ValidationError) -> str:
    first = error.errors()[0]
    return ": ".join([*map(str, first["loc"]), plain_reason(first["msg"])])
