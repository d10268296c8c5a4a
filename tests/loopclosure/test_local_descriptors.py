"""The shipped network of local descriptors, and the images of keyframes that it uses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from reference_local import LocalHead, LocalNetwork, doubled
from safetensors.torch import load_file

from vslam.loopclosure.local_matching import positions
from vslam.loopclosure.siamese import local_descriptors
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages, LocalDescriptors, resized
from vslam.loopclosure.siamese.weights import SHIPPED
from vslam.support.errors import InputError
from vslam_lab.training.siamese import load_network


@pytest.fixture(scope="module")
def network() -> LocalDescriptors:
    return LocalDescriptors()


def picture(seed: int, rows: int = 376, columns: int = 1241) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rough = rng.integers(0, 256, (rows // 12, columns // 12), np.uint8)
    return np.asarray(cv2.resize(rough, (columns, rows), interpolation=cv2.INTER_CUBIC))


@pytest.mark.slow
def test_the_shipped_file_says_what_torch_says(network):
    head = LocalHead()
    head.load_state_dict({k: v.float() for k, v in
                          load_file(SHIPPED / "local.safetensors").items()})  # fmt: skip
    extractor = load_network(SHIPPED / "capsule.safetensors")[0].branch.extractor
    reference = LocalNetwork(extractor, head).eval()
    assert sum(p.numel() for p in head.parameters()) < 0.3e6
    for shape in ((376, 1241), (480, 640), (360, 640)):
        image = picture(0, *shape)
        maps = network.describe(image)
        with torch.no_grad():
            coarse, fine = reference(torch.from_numpy(resized(image, 640)))
        assert np.abs(maps.coarse - coarse.numpy()).max() < 1e-3
        assert np.abs(maps.fine - fine.numpy()).max() < 1e-3
        assert maps.scale == 640 / shape[1]
        np.testing.assert_allclose(np.linalg.norm(maps.fine, axis=2), 1.0, atol=1e-5)


def test_cells_lie_where_their_features_are(network):
    """A change of the image around a cell changes the descriptor of this cell most."""
    image = picture(1, 192, 640)
    other = image.copy()
    other[88:105, 312:329] = 255 - other[88:105, 312:329]  # around cell (6, 20)
    a, b = network.describe(image), network.describe(other)
    for one, two, cell in ((a.coarse, b.coarse, (6, 20)), (a.fine, b.fine, (24, 80))):
        row, column = np.unravel_index((one * two).sum(2).argmin(), one.shape[:2])
        assert abs(row - cell[0]) <= 2
        assert abs(column - cell[1]) <= 2
    assert positions(np.array([6 * 40 + 20]), a).tolist() == [[320.0, 96.0]]


def test_doubling_keeps_what_lies_on_the_grid():
    x = torch.rand(1, 2, 5, 7)
    y = doubled(x, torch.empty(1, 1, 9, 13))
    assert y.shape == (1, 2, 9, 13)
    assert torch.equal(y[:, :, ::2, ::2], x)
    assert torch.allclose(y[:, :, 1, 0], 0.5 * (x[:, :, 0, 0] + x[:, :, 1, 0]))


def test_files_that_are_not_the_local_descriptors(tmp_path):
    with pytest.raises(InputError, match="are missing"):
        LocalDescriptors(tmp_path / "missing.onnx")
    with pytest.raises(InputError, match="not the local descriptors"):
        LocalDescriptors(SHIPPED / "capsule.onnx").describe(picture(0))


def test_keyframes_are_kept_small_and_described_when_asked_for(network, monkeypatch):
    monkeypatch.setattr(local_descriptors, "_CACHED", 2)
    images = KeyframeImages(network)
    for k in range(4):
        images.add(k, picture(k))
    assert 2 in images
    assert 4 not in images
    first = images.maps(0)
    assert images.maps(0) is first
    for k in (1, 2):
        images.maps(k)
    again = images.maps(0)  # computed again, because they are no longer cached
    assert again is not first
    assert np.array_equal(again.coarse, first.coarse)
    assert np.array_equal(again.fine, first.fine)
    # JPEG changes the descriptors only slightly.
    plain = network.describe(picture(0))
    assert (plain.coarse * first.coarse).sum(2).mean() > 0.98


def test_a_glance_keeps_no_memory_of_fine_descriptors(network):
    images = KeyframeImages(network)
    images.add(0, picture(0))
    glance = images.glance(0)
    assert glance.coarse.shape == (7, 20, 64)
    assert glance.fine.shape[0] == 0
    assert glance.fine.base is None
    assert glance.coarse.base is None


def test_images_of_culled_keyframes_are_forgotten(network):
    images = KeyframeImages(network)
    for k in range(3):
        images.add(k, picture(k))
        images.maps(k)
        images.glance(k)
    images.keep(np.array([True, False, True, False]))
    assert [k in images for k in range(3)] == [True, False, True]
    with pytest.raises(KeyError):
        images.glance(1)
    with pytest.raises(KeyError):
        images.maps(1)


def test_the_network_reads_any_size(network):
    assert network.describe(picture(0, 100, 640)).coarse.shape == (7, 40, 64)
    assert network.describe(picture(0, 480, 640)).fine.shape == (120, 160, 32)
