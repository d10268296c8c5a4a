"""The branches of the Siamese networks: what turns an image into a descriptor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from vslam.errors import InputError
from vslam.loopclosure.siamese.capsules import CapsuleLayer
from vslam.loopclosure.siamese.extractors import (
    LIGHT_BLOCKS,
    LightExtractor,
    OriginalExtractor,
    PrimaryCapsules,
    grid_side,
)
from vslam.loopclosure.siamese.images import Size
from vslam.loopclosure.siamese.lite import SKIPPABLE, STRIDE, LiteExtractor, lite_grid_side
from vslam.loopclosure.siamese.weights import read_pth

# ImageNet's statistics, which torchvision's weight files expect.
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_DEVIATION = (0.229, 0.224, 0.225)

_UNSEEN = 0.25  # of the width of an image, by each of two views


def _have_shortcuts(blocks: tuple[int, ...]) -> tuple[int, ...]:
    if not set(blocks) <= set(SKIPPABLE):
        raise ValueError(f"only blocks with a shortcut can be left out, {SKIPPABLE}")
    return blocks


Skipped = Annotated[tuple[int, ...], AfterValidator(_have_shortcuts)]


class CapsuleShape(BaseModel):
    """Everything that the weights of a capsule branch depend on; stored beside them."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    extractor: Literal["light", "original", "lite0"] = "light"
    pixels: int = Field(227, ge=32, description="Height of the input.")
    width: int | None = Field(None, ge=32, description="Of the input; None for a square.")
    views: Literal[1, 2] = Field(1, description="The whole image, or its left and right parts.")
    blocks: tuple[tuple[int, int, int], ...] = LIGHT_BLOCKS
    types: int = Field(32, ge=1, description="Types of primary capsules.")
    size: int = Field(8, ge=1, description="Numbers of a primary capsule.")
    outputs: int = Field(64, ge=1, description="Output capsules.")
    depth: int = Field(16, ge=1, description="Numbers of an output capsule.")
    iterations: int = Field(3, ge=1, description="Of the routing.")
    over: Literal["primary", "output"] = "primary"
    kept: int | None = Field(None, description="Places kept of each type; None before pruning.")
    skipped: Skipped = Field((), description="Blocks of a lite0 extractor left out.")

    @model_validator(mode="before")
    @classmethod
    def _without_what_is_gone(cls, given: Any) -> Any:
        """Weights of 0.1.0 before blocks were left out say that no channel was."""
        if isinstance(given, dict) and given.get("inner", 0) is None:
            return {key: value for key, value in given.items() if key != "inner"}
        return given

    @property
    def input(self) -> Size:
        """Height and width of the images it takes."""
        return self.pixels, self.width or self.pixels

    @property
    def view(self) -> Size:
        """Height and width of what a descriptor sees: the image, or three quarters of its width.

        What one view does not see is whole columns of the grid, so that those of both coincide.
        """
        height, width = self.input
        if self.views == 1:
            return height, width
        return height, width - STRIDE * max(1, round(_UNSEEN * width / STRIDE))

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of places of a view."""
        if self.extractor == "original":
            return 8, 8
        height, width = self.view
        if self.extractor == "lite0":
            return lite_grid_side(height), lite_grid_side(width)
        return grid_side(height, self.blocks), grid_side(width, self.blocks)

    @property
    def places(self) -> int:
        """Places of the grid."""
        rows, columns = self.grid
        return rows * columns

    def for_images_of(self, size: Size, views: int | None = None) -> CapsuleShape:
        """The same branch for images of another height and width, or another number of views."""
        height, width = size
        given = {
            "pixels": height,
            "width": None if width == height else width,
            "views": views or self.views,
        }
        return self.model_copy(update=given)


class CapsuleBranch(nn.Module):
    """Extractor, primary capsules, routing; the descriptor is all output capsules, flattened.

    With two views, those of the left view and then those of the right one.
    """

    def __init__(self, shape: CapsuleShape) -> None:
        super().__init__()
        self.shape = shape
        self.size = shape.input
        self.views = shape.views
        self.dimensions = shape.views * shape.outputs * shape.depth
        self.extractor: nn.Module
        self.primary: nn.Module
        if shape.extractor == "original":
            self.extractor = nn.Identity()
            self.primary = OriginalExtractor(shape.types, shape.size)
        else:
            lite = shape.extractor == "lite0"
            grid = LiteExtractor(shape.skipped) if lite else LightExtractor(shape.blocks)
            self.extractor = grid
            self.primary = PrimaryCapsules(grid.out_channels, shape.types, shape.size)
        # Depthwise convolutions are faster so, forward by a third and backward by a quarter.
        for module in (self.extractor, self.primary):
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.capsules = CapsuleLayer(
            shape.types, shape.places, shape.size, shape.outputs, shape.depth,
            shape.iterations, shape.over, shape.kept,
        )  # fmt: skip

    def forward(self, images: Tensor) -> Tensor:
        """``(N, 3, H, W)`` float32 in [0, 1] to ``(N, D)``, not yet normalised."""
        v = self.routed(images)[0].flatten(1)
        return v if self.views == 1 else torch.cat(v.chunk(2), 1)

    def routed(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Output capsules ``(V N, J, D)`` and couplings ``(V N, J, I)``: all left views first."""
        grey = images.mean(1, keepdim=True)
        if self.views == 2:
            width = self.shape.view[1]
            grey = torch.cat([grey[..., :width], grey[..., -width:]])
        x = standardised(grey).contiguous(memory_format=torch.channels_last)
        x = self.primary(self.extractor(x))
        # Routing sums thousands of products: never in half precision.
        with torch.autocast(x.device.type, enabled=False):
            routed: tuple[Tensor, Tensor] = self.capsules.routed(x.float())
        return routed


def standardised(images: Tensor) -> Tensor:
    """Each image with mean 0 and deviation 1: gain and bias of the camera drop out."""
    mean = images.mean((1, 2, 3), keepdim=True)
    deviation = images.std((1, 2, 3), keepdim=True)
    return (images - mean) / (deviation + 1e-3)


class ConvolutionalBranch(nn.Module):
    """AlexNet or VGG16 up to the second fully connected layer, then one to the descriptor.

    Modules are laid out and named as in torchvision, whose weight files can be loaded into
    ``features`` and ``classifier``.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(
        self, name: str, features: nn.Sequential, classifier: nn.Sequential, side: int
    ) -> None:
        super().__init__()
        self.name = name
        self.size = (227, 227)
        self.views = 1
        self.dimensions = 1024
        self.features = features
        self.pool = nn.AdaptiveAvgPool2d(side)
        self.classifier = classifier
        self.descriptor = nn.Linear(4096, self.dimensions)
        self.register_buffer("mean", torch.tensor(_IMAGENET_MEAN).view(3, 1, 1), persistent=False)
        deviation = torch.tensor(_IMAGENET_DEVIATION).view(3, 1, 1)
        self.register_buffer("deviation", deviation, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """``(N, 3, 227, 227)`` float32 in [0, 1] to ``(N, 1024)``, not yet normalised."""
        x: Tensor = self.features((images - self.mean) / self.deviation)
        x = self.classifier(self.pool(x).flatten(1))
        return self.descriptor(x)

    def load_torchvision(self, path: Path) -> None:
        """Take over the weights of a torchvision file (``alexnet-*.pth``, ``vgg16-*.pth``).

        The last layer, which names ImageNet's classes, is left out.

        Raises:
            InputError: no such file, not a weight file, or one of another network.
        """
        fix = f"name torchvision's weight file of {self.name}"
        state = read_pth(path, fix)
        own = {key: value for key, value in self.state_dict().items() if "descriptor" not in key}
        if not isinstance(state, dict) or any(
            key not in state or state[key].shape != value.shape for key, value in own.items()
        ):
            raise InputError(f"{path}: layers of another network; {fix}.")
        self.load_state_dict({key: state[key] for key in own}, strict=False)


def alexnet() -> ConvolutionalBranch:
    """Krizhevsky et al., NIPS 2012, in torchvision's one-tower form (Krizhevsky 2014)."""
    features = nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(inplace=True),
        nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(inplace=True),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(inplace=True), nn.MaxPool2d(3, 2),
    )  # fmt: skip
    classifier = nn.Sequential(
        nn.Dropout(), nn.Linear(256 * 36, 4096), nn.ReLU(inplace=True),
        nn.Dropout(), nn.Linear(4096, 4096), nn.ReLU(inplace=True),
    )  # fmt: skip
    return ConvolutionalBranch("alexnet", features, classifier, 6)


def vgg16() -> ConvolutionalBranch:
    """Simonyan and Zisserman, ICLR 2015, configuration D."""
    layers: list[nn.Module] = []
    inputs = 3
    for outputs, repeats in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for _ in range(repeats):
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True)]
            inputs = outputs
        layers.append(nn.MaxPool2d(2, 2))
    classifier = nn.Sequential(
        nn.Linear(512 * 49, 4096), nn.ReLU(inplace=True), nn.Dropout(),
        nn.Linear(4096, 4096), nn.ReLU(inplace=True), nn.Dropout(),
    )  # fmt: skip
    return ConvolutionalBranch("vgg16", nn.Sequential(*layers), classifier, 7)
