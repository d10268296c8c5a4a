"""Networks that divide an image into several views, and images that are not square."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from siamese_worlds import SMALL, masked, small_network, small_settings, views

from vslam.loopclosure.siamese.images import to_size
from vslam.support.errors import InputError
from vslam_lab.sources.image_source import parse_size
from vslam_lab.training.augmentation import STRONG, augment
from vslam_lab.training.branches import CapsuleShape, Layout
from vslam_lab.training.export import export_onnx
from vslam_lab.training.initial_network import resized, starting_network
from vslam_lab.training.lite import LiteExtractor
from vslam_lab.training.preprocessing import Unrolling
from vslam_lab.training.pruning import lowest, mean_couplings, pruned
from vslam_lab.training.siamese import (
    SiameseNetwork,
    aligned,
    build_network,
    cosines,
    load_network,
    save_network,
)
from vslam_lab.training.training import train

WIDE = {"pixels": 48, "width": 81, "views": 2, "view_width": 65}
SHIFT = 16  # columns between the two views of 81


def wide_images(n: int, seed: int = 0, width: int = 81) -> torch.Tensor:
    """Make noise with equal mean and contrast in every column, so that no part is distinctive."""
    x = torch.randn(n, 1, 48, width, generator=torch.Generator().manual_seed(seed))
    x = (x - x.mean(2, keepdim=True)) / x.std(2, keepdim=True)
    return (0.5 + 0.1 * x).expand(-1, 3, -1, -1)


def wide_views(places: int) -> object:
    collection = views(places)
    resize = [cv2.resize(image, (81, 48)) for image in collection.images]
    return replace(collection, images=np.stack(resize))


def test_views_are_equally_far_apart():
    shape = CapsuleShape(extractor="lite0", pixels=97, width=217, views=4, view_width=97)
    assert (shape.view, shape.grid, shape.places) == ((97, 97), (7, 7), 49)
    # 40 pixels, and 5 columns of early features with a stride of 8.
    assert shape.cuts == [slice(0, 13), slice(5, 18), slice(10, 23), slice(15, 28)]
    assert CapsuleShape(extractor="lite0", pixels=81, width=145).cuts == [slice(0, 19)]
    assert CapsuleShape(**WIDE).cuts == [slice(0, 65), slice(16, 81)]


@pytest.mark.parametrize(
    ("views", "view_width", "why"),
    [
        (2, None, "views 2: needs view_width"),
        (1, 65, "view_width 65: a single view is the whole image"),
        (2, 81, "view_width 81: must be less than the image width 81"),
        (3, 64, "view_width 64: 3 views in 81 columns must be spaced by a multiple of 1 columns"),
        (2, 20, "view_width: must be at least 32"),
    ],
)
def test_views_that_do_not_fit_are_refused(views, view_width, why):
    with pytest.raises(ValidationError):
        CapsuleShape(pixels=48, width=81, views=views, view_width=view_width)
    with pytest.raises(InputError, match=f"48x81 pixels: {why}"):
        SMALL.with_layout(Layout((48, 81), views, view_width))


def test_views_keep_their_share_of_another_size():
    shape = CapsuleShape(extractor="lite0", pixels=97, width=217, views=4, view_width=97)
    assert shape.for_images_of((97, 217)) == shape
    smaller = shape.for_images_of((65, 129))
    assert smaller.layout == Layout((65, 129), 4, 57)  # 0.44 of the width in place of 0.45
    assert shape.for_images_of((64, 100)).view_width == 52
    with pytest.raises(InputError, match="48x48 pixels: view_width"):
        shape.for_images_of((48, 48))
    assert SMALL.for_images_of((48, 81)).layout == Layout((48, 81))


@torch.no_grad()
@pytest.mark.parametrize("extractor", ["light", "lite0"])
def test_only_lite0_sees_a_little_beyond_a_view(extractor):
    """The early features of this network are computed once for the whole image."""
    torch.manual_seed(0)
    network = build_network("capsule", SMALL.model_copy(update={"extractor": extractor})).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.Conv2d):  # keeps the response visible
            module.weight *= 2.4
    network = resized(network, Layout((48, 81), 2, 33)).eval()
    x = wide_images(1)
    other = torch.cat([x[..., :33], x[..., 33:].flip(3)], 3)
    firsts = [network.embed(image).chunk(2, 1)[0] for image in (x, other)]
    left, left_too = (torch.nn.functional.normalize(first, dim=1) for first in firsts)
    assert torch.allclose(left, left_too, atol=1e-5) == (extractor == "light")


@torch.no_grad()
def test_early_features_of_a_view_lie_where_its_pixels_do():
    extractor = LiteExtractor().eval()
    shape = CapsuleShape(extractor="lite0", pixels=65, width=369, views=3, view_width=257)
    assert [cut.start * shape.cut_stride for cut in shape.cuts] == [0, 56, 112]
    x = wide_images(1, width=369)[:, :1]
    whole, alone = extractor.early(x), extractor.early(x[..., 56:313])
    view = whole[..., shape.cuts[1]]
    assert view.shape == alone.shape
    # Padding changes the result within 60 pixels of both sides.
    assert torch.allclose(view[..., 8:-8], alone[..., 8:-8], atol=1e-5)
    assert not torch.allclose(view, alone, atol=1e-5)
    assert torch.equal(extractor.late(whole), extractor(x))


@torch.no_grad()
def test_what_both_cameras_see_is_compared():
    """One camera is rotated by the angle between two views.

    What it sees on the left is what the other sees on the right.
    """
    network = small_network(**WIDE).eval()
    assert network.branch.shape.view == (48, 65)
    world = torch.rand(1, 3, 48, 81 + SHIFT, generator=torch.Generator().manual_seed(1))
    ahead, right = network.embed(world[..., :81]), network.embed(world[..., SHIFT:])
    assert ahead.shape == (1, network.dimensions)
    assert ahead.norm().item() == pytest.approx(1.0, abs=1e-5)
    # Other alignments of such a small network are nearly as good, and contribute.
    assert 1.0 - 1e-5 < network.cosines(ahead, right).item() < 1.0 + 0.04 * np.log(3)
    assert network.cosines(right, ahead).item() == pytest.approx(
        network.cosines(ahead, right).item(), abs=1e-5
    )
    assert (ahead @ right.T).item() < 0.999
    assert network.similarity(ahead, right).item() == pytest.approx(
        network.similarity(ahead, ahead).item(), abs=1e-3
    )


@pytest.mark.parametrize("views", [1, 2, 3, 4])
def test_cosines_are_the_soft_maximum_of_all_alignments(views):
    generator = torch.Generator().manual_seed(views)
    a, b = (torch.randn(n, views, 8, generator=generator) for n in (4, 6))
    a, b = (d / d.flatten(1).norm(dim=1)[:, None, None] for d in (a, b))

    def by_hand(x: torch.Tensor, y: torch.Tensor) -> float:
        found = []
        for shift in range(1 - views, views):
            met = [(x[k], y[k + shift]) for k in range(views) if 0 <= k + shift < views]
            if 2 * len(met) >= views:
                most = sum(float(one.norm() * other.norm()) for one, other in met)
                found.append(sum(float(one @ other) for one, other in met) / most)
        return 0.04 * float(np.log(np.exp(np.array(found) / 0.04).sum()))

    expected = torch.tensor([[by_hand(x, y) for y in b] for x in a])
    x, y = a.flatten(1), b.flatten(1)
    assert torch.allclose(cosines(x, y, views), expected, atol=1e-6)
    assert torch.allclose(cosines(y, x, views), expected.T, atol=1e-6)
    if views == 1:
        assert torch.equal(cosines(x, y), x @ y.T)


def test_views_that_meet_by_chance_count_little():
    """If only one of four views matches somewhere, the images do not show the same place."""
    alike, most = torch.zeros(4, 4), torch.ones(4, 4)
    alike[0, 3] = 1.0
    nothing = 0.04 * np.log(5)  # five alignments, none better than another
    assert aligned(alike, most).item() == pytest.approx(nothing, abs=1e-6)
    alike[0, 3], alike[0, 2], alike[1, 3] = 0.0, 1.0, 1.0
    assert aligned(alike, most).item() == pytest.approx(1.0, abs=1e-6)


@torch.no_grad()
def test_a_view_counts_as_much_as_it_shows():
    """Half of an image is covered. The result depends only on the other half."""
    network = small_network(pixels=48, width=96, views=2, view_width=48).eval()
    place, other = wide_images(2, width=96).split(1)
    covered = place.clone()
    covered[..., 48:] = 0.3
    ask = network.embed(covered)
    left, right = ask.view(2, -1).norm(dim=1).tolist()
    assert ask.norm().item() == pytest.approx(1.0, abs=1e-5)
    assert right / left < 0.021
    stored = network.embed(torch.cat([place, other]))
    assert (ask @ stored.T)[0, 0] < 0.8
    alike = network.cosines(ask, stored)[0]
    assert alike[0].item() == pytest.approx(1.0, abs=0.03)
    assert alike[0] > alike[1]


@torch.no_grad()
def test_one_against_many_is_pair_by_pair():
    network = small_network(**WIDE).eval()
    stored = network.embed(wide_images(5))
    p = network.compare(stored[0], stored)
    assert torch.allclose(p, network.similarity(stored[:1].expand(5, -1), stored), atol=1e-5)


def lite_network() -> SiameseNetwork:
    """Make a network with three views of 49 of the 81 columns, which are 16 columns apart."""
    shape = CapsuleShape(
        extractor="lite0", pixels=48, width=81, views=3, view_width=49, types=4, outputs=4
    )
    torch.manual_seed(0)
    return build_network("capsule", shape)


@torch.no_grad()
@pytest.mark.parametrize("network", [small_network(**WIDE), lite_network()], ids=["light", "lite0"])
def test_pruned_views_are_masked_views(network):
    network = network.eval()
    activity = mean_couplings(network, [wide_images(4), wide_images(3, seed=1)])
    assert activity.sum().item() == pytest.approx(1.0, abs=1e-4)
    drop, x = lowest(activity, 0.2), wide_images(3, seed=2)
    assert torch.allclose(pruned(network, drop).embed(x), masked(network, drop).embed(x), atol=1e-5)


@pytest.mark.slow
def test_a_network_learns_with_views_and_is_read_again(tmp_path):
    collection = wide_views(20)
    shape = SMALL.model_copy(update=WIDE)
    settings = small_settings(shape=shape, epochs=6, pairs=64, loss="bce+contrast", hard_share=0.0)
    done = train(collection, settings, tmp_path, threads=1)
    ap = [row["average_precision"] for row in done.progress.history]
    assert ap[0] < 0.5 < 0.9 < ap[-1]
    network, _ = load_network(done.weights)
    assert (network.size, network.branch.views) == ((48, 81), 2)
    assert network.head.views == 2


def test_whole_images_become_views(tmp_path):
    """Training with views starts from weights that were trained on whole square images."""
    path = tmp_path / "capsule.safetensors"
    whole = small_network().eval()
    save_network(whole, path, {})
    settings = small_settings(shape=SMALL.model_copy(update=WIDE))
    start, fitted, report = starting_network(settings, wide_views(8), path, "cpu")
    assert (start.size, start.branch.views, fitted.shape.views) == ((48, 81), 2, 2)
    assert report["resized_to"] == (48, 81)
    x = wide_images(2)
    with torch.no_grad():
        left = resized(whole, Layout((48, 65))).eval().embed(x[..., :65])
        first = torch.nn.functional.normalize(start.eval().embed(x).chunk(2, 1)[0], dim=1)
        assert torch.allclose(first, left, atol=1e-5)


def test_networks_for_flat_images_become_those_for_unrolled_ones(tmp_path):
    path = tmp_path / "capsule.safetensors"
    flat = small_network(**WIDE).eval()
    save_network(flat, path, {})
    shape = SMALL.model_copy(update=WIDE | {"half_angle": 30.0, "middle": 0.9})
    assert shape.for_images_of((48, 113)).layout[3:] == (30.0, 0.9)
    start, fitted, _ = starting_network(small_settings(shape=shape), wide_views(8), path, "cpu")
    assert fitted.shape == shape
    save_network(start, path, {})
    x = wide_images(2)
    with torch.no_grad():
        unrolled = Unrolling((48, 81), 30.0, 0.9)(x[:, :1]).expand(-1, 3, -1, -1)
        assert not torch.allclose(flat.embed(x), flat.embed(unrolled), atol=1e-2)
        again = load_network(path)[0]
        assert torch.allclose(again.embed(x), flat.embed(unrolled), atol=1e-5)
        # The measure by which pruning ranks capsules.
        for seen, expected in zip(
            again.branch.routed(x), flat.branch.routed(unrolled), strict=True
        ):
            assert torch.allclose(seen, expected, atol=1e-5)


def test_flat_images_keep_their_height():
    with pytest.raises(ValidationError, match=r"middle 0.9: needs unrolled images"):
        CapsuleShape(middle=0.9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "network",
    [small_network(**WIDE), lite_network(), small_network(**WIDE, half_angle=30.0, middle=0.9)],
    ids=["light", "lite0", "unrolled"],
)
def test_views_are_exported(network, tmp_path):
    assert export_onnx(network, tmp_path / "capsule.onnx") < 1e-4


@torch.no_grad()
def test_no_images_are_like_no_others():
    network = small_network(**WIDE).eval()
    nothing = torch.zeros(0, network.dimensions)
    assert network.cosines(network.embed(wide_images(2)), nothing).shape == (2, 0)
    assert network.similarity(nothing, nothing).shape == (0,)


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
