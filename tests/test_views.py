"""Networks that read an image as two views, and images that are no squares."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from siamese_worlds import SMALL, small_network, small_settings, views

from vslam.errors import InputError
from vslam.loopclosure.siamese.augmentation import STRONG, augment
from vslam.loopclosure.siamese.branches import CapsuleShape
from vslam.loopclosure.siamese.images import parse_size, to_size
from vslam.loopclosure.siamese.onnx import export_onnx
from vslam.loopclosure.siamese.pruning import lowest, masked, mean_couplings, pruned
from vslam.loopclosure.siamese.siamese import arrangements, cosines, load_network, save_network
from vslam.loopclosure.siamese.start import resized, starting_network
from vslam.loopclosure.siamese.training import train

WIDE = {"pixels": 48, "width": 81, "views": 2}
SHIFT = 16  # columns between the two views of 81


def wide_images(n: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(n, 3, 48, 81, generator=torch.Generator().manual_seed(seed))


def wide_views(places: int) -> object:
    """As ``views``, squashed to images of 48x81."""
    collection = views(places)
    resize = [cv2.resize(image, (81, 48)) for image in collection.images]
    return replace(collection, images=np.stack(resize))


def test_views_cover_three_quarters_on_columns_of_the_grid():
    shape = CapsuleShape(extractor="lite0", pixels=81, width=145, views=2)
    assert shape.view == (81, 113)
    assert shape.grid == (6, 8)
    assert shape.places == 48
    assert (shape.input[1] - shape.view[1]) % 16 == 0
    assert CapsuleShape(extractor="lite0", pixels=81, width=145).view == (81, 145)


@torch.no_grad()
def test_what_both_cameras_see_is_compared():
    """A camera turned by the distance between the views sees on its left what was on the right."""
    network = small_network(**WIDE).eval()
    assert network.branch.shape.view == (48, 65)
    world = torch.rand(1, 3, 48, 81 + SHIFT, generator=torch.Generator().manual_seed(1))
    ahead, right = network.embed(world[..., :81]), network.embed(world[..., SHIFT:])
    assert ahead.shape == (1, network.dimensions)
    assert ahead.norm().item() == pytest.approx(1.0, abs=1e-5)
    assert network.cosines(ahead, right).item() == pytest.approx(1.0, abs=1e-5)
    assert network.cosines(right, ahead).item() == pytest.approx(1.0, abs=1e-5)
    assert (ahead @ right.T).item() < 0.999
    assert network.similarity(ahead, right).item() == pytest.approx(
        network.similarity(ahead, ahead).item(), abs=1e-3
    )


@torch.no_grad()
def test_cosines_are_the_best_of_three():
    a, b = (
        torch.nn.functional.normalize(torch.randn(k, 2, 8), dim=2).flatten(1) / 2**0.5
        for k in (4, 6)
    )
    found = cosines(a, b, 2)
    by_hand = torch.tensor([
        [max((x @ y), 2 * (x[:8] @ y[8:]), 2 * (x[8:] @ y[:8])) for y in b] for x in a
    ])  # fmt: skip
    assert torch.allclose(found, by_hand, atol=1e-6)
    assert torch.allclose(cosines(b, a, 2), by_hand.T, atol=1e-6)
    assert arrangements(a, 2).shape == (3, 4, 16)
    assert torch.equal(cosines(a, b), a @ b.T)


@torch.no_grad()
def test_one_against_many_is_pair_by_pair():
    network = small_network(**WIDE).eval()
    stored = network.embed(wide_images(5))
    p = network.compare(stored[0], stored)
    assert torch.allclose(p, network.similarity(stored[:1].expand(5, -1), stored), atol=1e-5)


@torch.no_grad()
def test_pruned_views_are_masked_views():
    network = small_network(**WIDE).eval()
    activity = mean_couplings(network, [wide_images(4), wide_images(3, seed=1)])
    assert activity.sum().item() == pytest.approx(1.0, abs=1e-4)
    drop, x = lowest(activity, 0.2), wide_images(3, seed=2)
    assert torch.allclose(pruned(network, drop).embed(x), masked(network, drop).embed(x), atol=1e-5)


def test_a_network_learns_with_views_and_is_read_again(tmp_path):
    collection = wide_views(20)
    shape = SMALL.model_copy(update=WIDE)
    settings = small_settings(shape=shape, epochs=3, loss="bce+contrast")
    done = train(collection, settings, tmp_path, threads=1)
    losses = [row["loss"] for row in done.progress.history]
    assert losses[-1] < losses[0]
    network, _ = load_network(done.weights)
    assert (network.size, network.branch.views) == ((48, 81), 2)
    assert network.head.views == 2


def test_whole_images_become_views(tmp_path):
    """Weights for whole squares are what a training with views starts from."""
    path = tmp_path / "capsule.safetensors"
    whole = small_network().eval()
    save_network(whole, path, {})
    settings = small_settings(shape=SMALL.model_copy(update=WIDE))
    start, fitted, report = starting_network(settings, wide_views(8), path, "cpu")
    assert (start.size, start.branch.views, fitted.shape.views) == ((48, 81), 2, 2)
    assert report["resized_to"] == (48, 81)
    x = wide_images(2)
    with torch.no_grad():
        left = resized(whole, (48, 65)).eval().embed(x[..., :65])
        assert torch.allclose(start.eval().embed(x).chunk(2, 1)[0] * 2**0.5, left, atol=1e-5)


def test_views_are_exported(tmp_path):
    pytest.importorskip("onnxscript")
    assert export_onnx(small_network(**WIDE), tmp_path / "capsule.onnx") < 1e-4


def test_augmentation_keeps_the_size():
    image = np.tile(np.arange(145, dtype=np.uint8), (81, 1))
    strength = STRONG.model_copy(update={"turn": 30.0, "zoom": 0.4})
    changed = [augment(image, strength, np.random.default_rng(seed)) for seed in range(40)]
    assert {c.shape for c in changed} == {(81, 145)}
    assert len({c.tobytes() for c in changed}) == 40


def test_crop_keeps_the_aspect():
    image = np.zeros((30, 90), np.uint8)
    image[:, 15:75] = 200
    assert to_size(image, (20, 40), "crop").min() == 200
    assert to_size(image, (20, 40), "squash")[:, 0].max() == 0
    tall = np.zeros((90, 30), np.uint8)
    tall[38:52] = 200
    assert to_size(tall, (20, 60), "crop").min() == 200
    assert to_size(tall, (20, 20), "crop").min() == 0


def test_sizes_are_read():
    assert parse_size("129") == (129, 129)
    assert parse_size("81x145") == (81, 145)
    for given in ("81x", "x81", "81x145x2", "wide", "-81", ""):
        with pytest.raises(InputError, match="write the side"):
            parse_size(given)
    with pytest.raises(InputError, match="needs 32 pixels"):
        parse_size("20x145")
