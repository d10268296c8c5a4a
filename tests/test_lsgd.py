"""The descriptor of LSGDDN-LCD against its definition."""

import numpy as np
import pytest

from vslam.errors import InputError
from vslam.lab.loopbench.detectors import DescribedImage
from vslam.lab.loopbench.lsgd import (
    LsgdScorer,
    centres,
    grid,
    histograms,
    lsgd,
    similarities,
    superpixels,
)
from vslam.lab.loopbench.node_matching import index_nodes
from vslam.lab.loopbench.registry import comparable_scorer, require_comparable


def textured(seed: int, height: int = 130, width: int = 210) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 10, width // 10))
    return np.kron(coarse, np.ones((10, 10), np.int64)).astype(np.uint8)


def described(image: np.ndarray) -> DescribedImage:
    none = np.empty(0, np.int32)
    return DescribedImage(image, np.empty((0, 2)), np.empty((0, 32)), none, index_nodes(none))


def by_the_definition(image: np.ndarray, rounds: int) -> np.ndarray:
    """Superpixels by whole arrays: at each centre, distances to all pixels of its window."""
    rows, columns = grid(image)
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    grey = image.astype(np.float64)
    label, nearest = np.full(image.shape, -1), np.full(image.shape, np.inf)
    position = centres(image)
    for _ in range(rounds):
        for k, (cy, cx) in enumerate(position):
            far = (grey - grey[cy, cx]) ** 2 / 2.3 + (y - cy) ** 2 + (x - cx) ** 2
            window = (abs(y - cy) <= height // rows) & (abs(x - cx) <= width // columns)
            better = window & (far.astype(np.float32) < nearest.astype(np.float32))
            label[better], nearest[better] = k, far[better]
        for k in range(len(position)):
            mine = label == k
            if mine.any():
                position[k] = y[mine].sum() // mine.sum(), x[mine].sum() // mine.sum()
    return label


def test_the_grid_has_cells_of_about_a_hundred_pixels():
    assert grid(np.zeros((376, 1241), np.uint8)) == (4, 13)
    assert grid(np.zeros((99, 100), np.uint8)) == (1, 2)


def test_a_centre_goes_where_the_image_differs_least():
    image = textured(0, 90, 90)
    image[44:47, 44:47] = [[0, 0, 0], [0, 100, 98], [0, 0, 101]]
    # Beside it 2 levels in 1 pixel; diagonally 1 level in 1.41.
    assert centres(image).tolist() == [[46, 46]]
    image[46, 46] = 104  # 4 / 1.41 = 2.8
    assert centres(image).tolist() == [[45, 46]]


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 2), (2, 250), (250, 1)])
def test_centres_of_tiny_images_lie_within_them(shape):
    image = textured(0, *shape)
    assert ((centres(image) >= 0) & (centres(image) < shape)).all()
    assert lsgd(image).sum() == image.size


@pytest.mark.parametrize("rounds", [1, 3])
def test_superpixels_are_those_of_the_definition(rounds):
    image = textured(1)
    found = superpixels(image, rounds)
    assert np.array_equal(found, by_the_definition(image, rounds))
    assert len(np.unique(found)) == np.prod(grid(image)) == 6


def test_superpixels_follow_an_edge():
    image = np.zeros((90, 190), np.uint8)
    image[:, 60:] = 200  # cells end at column 95
    found = superpixels(image, 10)
    assert (found[:, :55] == 0).all()
    assert (found[:, 100:] == 1).all()
    # Column 75 is 200 levels, worth 131 pixels, from the left centre, and 67 pixels from the right.
    assert found[45, 75] == 1


def test_the_descriptor_counts_grey_levels():
    image = np.array([[1, 1, 7], [7, 7, 255]], np.uint8)
    counts = histograms(image, np.array([[0, 0, 0], [1, 1, 1]]), 2)
    assert counts.shape == (2, 256)
    assert counts[0, [1, 7]].tolist() == [2, 1]
    assert counts[1, [7, 255]].tolist() == [2, 1]
    picture = textured(2)
    assert lsgd(picture).sum() == picture.size
    assert np.array_equal(lsgd(picture).sum(0), np.bincount(picture.ravel(), minlength=256))


def test_similarity_of_a_case_by_hand():
    a, b = np.zeros((2, 2, 256), np.int32)
    a[0, 10], b[0, 20] = 8, 8  # 16 pixels differ: root 4
    a[1, 5], b[1, 5] = 3, 3  # none do
    found = similarities(np.stack([a, b]), np.stack([a, b]))
    apart = 1 / (1 + 2 / 256)
    assert np.allclose(found, [[1, apart], [apart, 1]], rtol=0, atol=1e-15)


def test_a_scorer_finds_the_same_picture_brighter():
    pictures = [textured(seed) // 2 for seed in range(4)]
    scorer = comparable_scorer("lsgd", None, None)
    assert isinstance(scorer, LsgdScorer)
    stored = scorer.store([described(one) for one in pictures])
    noisy = [one + np.uint8(seed) for seed, one in enumerate(pictures)]
    found = scorer.scores([described(one) for one in noisy], stored)
    assert found.shape == (4, 4)
    assert found[0].argmax() == 0
    assert found[0, 0] == 1
    # Another light moves all counts to other levels: the descriptor has no defence, as published.
    assert found[3, 3] < 0.9


def test_images_of_two_sizes_are_refused():
    scorer = LsgdScorer()
    small, large = described(textured(0)), described(textured(0, 330, 210))
    with pytest.raises(InputError, match="one size"):
        scorer.store([small, large])
    with pytest.raises(InputError, match="one size"):
        scorer.scores([small], scorer.store([large]))


def test_both_protocols_take_it():
    require_comparable("lsgd", None, "retrieval")
    require_comparable("lsgd", None, "online")
    with pytest.raises(InputError, match="has no weights"):
        require_comparable("lsgd", "file.onnx", "online")
