"""The vocabulary tree: words, training, scores, files and commands."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from vslam.cli import main as cli
from vslam.config import Config
from vslam.loopclosure.registry import create_detector
from vslam.loopclosure.vocabulary import (
    SHIPPED,
    BowVector,
    Vocabulary,
    bow_vector,
    from_children,
    load,
    save,
    score,
)
from vslam.loopclosure.vocabulary_text import read_text, write_text
from vslam.loopclosure.vocabulary_training import train
from vslam.support.errors import InputError, ResultsError


def bits(descriptors: np.ndarray) -> np.ndarray:
    return np.unpackbits(descriptors.view(np.uint8).reshape(len(descriptors), 32), axis=1)


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (bits(a)[:, None] != bits(b)[None]).sum(axis=2)


def random_descriptors(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(0, 256, (n, 32), dtype=np.uint8)


def noisy(rng: np.random.Generator, centres: np.ndarray, n: int, flips: int) -> np.ndarray:
    """Return ``n`` successive copies of each centre, with ``flips`` bits flipped in each copy."""
    copies = np.repeat(bits(centres), n, axis=0)
    for row in copies:
        row[rng.choice(256, flips, replace=False)] ^= 1
    return np.packbits(copies, axis=1)


@pytest.fixture(scope="module")
def small() -> Vocabulary:
    """A vocabulary with up to 4 levels and 5 children per node, trained on 15 images.

    The images have different numbers of features. The leaves are at several levels.
    """
    rng = np.random.default_rng(3)
    return train([random_descriptors(rng, n) for n in range(3, 33, 2)], 5, 4, seed=1)


def same(a: Vocabulary, b: Vocabulary) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))


# -- words ----------------------------------------------------------------------------------------


def test_words_are_those_of_a_descent_in_plain_python(small):
    assert len(set(small.level[small.word >= 0].tolist())) > 1, "the tree is not regular"
    queries = random_descriptors(np.random.default_rng(4), 300)
    expected = []
    for query in queries:
        node = 0
        while small.n_children[node]:
            first = int(small.first_child[node])
            children = np.arange(first, first + int(small.n_children[node]))
            node = children[np.argmin(distances(query[None], small.descriptors[children])[0])]
        expected.append(small.word[node])
    np.testing.assert_array_equal(small.words(queries), expected)
    assert len(set(expected)) > 60


def test_words_of_one_level_are_nearest_neighbours():
    rng = np.random.default_rng(5)
    tree = train([random_descriptors(rng, 200)], 20, 1)
    queries = random_descriptors(rng, 400)
    nearest = distances(queries, tree.descriptors[1:]).argmin(axis=1)
    assert tree.n_words == 20
    np.testing.assert_array_equal(tree.words(queries), nearest)


def test_ancestors_are_on_the_way_from_the_root(small):
    leaves = np.flatnonzero(small.word >= 0)
    for level in range(5):
        for leaf, ancestor in zip(leaves, small.ancestors(level), strict=True):
            node = leaf
            while small.level[node] > level:
                node = small.parent[node]
            assert ancestor == node


# -- training -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_training_finds_planted_clusters_and_their_centres(seed):
    rng = np.random.default_rng(6)
    centres = random_descriptors(rng, 8)
    data = noisy(rng, centres, 60, flips=4)
    tree = train([data[::2], data[1::2]], 8, 1, seed=seed)
    words = tree.words(data).reshape(8, 60)
    assert (words == words[:, :1]).all(), "a cluster is torn"
    assert len(set(words[:, 0].tolist())) == 8, "two clusters are one"
    # The majority of 60 copies, with few flipped bits each, is the centre.
    np.testing.assert_array_equal(
        tree.descriptors[1:][words[:, 0]].view(np.uint8), centres.view(np.uint8)
    )


@pytest.mark.parametrize("seed", range(4))
def test_training_finds_clusters_within_clusters(seed):
    rng = np.random.default_rng(7)
    coarse = random_descriptors(rng, 4)
    fine = noisy(rng, coarse, 4, flips=50)
    data = noisy(rng, fine, 40, flips=2)
    tree = train([data], 4, 2, seed=seed)
    words, nodes = tree.words(data), tree.ancestors(1)
    assert (words.reshape(16, 40) == words.reshape(16, 40)[:, :1]).all()
    assert (nodes[words].reshape(4, 160) == nodes[words].reshape(4, 160)[:, :1]).all()
    assert tree.n_words == 16


def test_the_seed_decides_the_words():
    rng = np.random.default_rng(8)
    images = [random_descriptors(rng, 300) for _ in range(3)]
    first = train(images, 6, 3, seed=5)
    assert same(first, train(images, 6, 3, seed=5))
    assert not same(first, train(images, 6, 3, seed=6))


def test_equal_descriptors_are_one_word():
    rng = np.random.default_rng(9)
    three = random_descriptors(rng, 3)
    tree = train([np.repeat(three, 50, axis=0)], 10, 5)
    assert tree.n_words == 3
    assert sorted(map(bytes, tree.descriptors[1:].view(np.uint8))) == sorted(map(bytes, three))


def test_idf_counts_images_not_features():
    rng = np.random.default_rng(10)
    a, b = random_descriptors(rng, 2)
    tree = train([np.stack([a, a, a, b]), np.stack([a]), np.stack([a]), np.stack([a])], 2, 1)
    word_a, word_b = tree.words(np.stack([a, b]))
    assert tree.weight[word_a] == 0
    assert tree.weight[word_b] == pytest.approx(np.log(4), rel=1e-6)


@pytest.mark.parametrize(
    ("images", "k", "levels", "why"),
    [
        ([], 10, 5, "no descriptors"),
        ([np.zeros((50, 32), np.uint8)], 10, 5, "the same"),
        ([np.eye(32, dtype=np.uint8)], 21, 5, "branching is 21"),
        ([np.eye(32, dtype=np.uint8)], 10, 11, "levels is 11"),
    ],
)
def test_training_refuses(images, k, levels, why):
    with pytest.raises(ValueError, match=why):
        train(images, k, levels)


# -- score ----------------------------------------------------------------------------------------


def test_bag_and_score_by_hand():
    centres = np.concatenate([np.zeros((1, 4)), np.eye(4)]).astype(np.uint64)
    idf = np.array([1.0, 2.0, 0.0, 4.0], np.float32)
    tree = from_children(4, 1, centres, np.array([4, 0, 0, 0, 0], np.uint8), idf)
    # Counts 2, 1 of words 0, 1, times idf: 2, 2. Word 2 weighs nothing.
    a = bow_vector(tree, np.array([1, 0, 2, 0, 2], np.int32))
    assert a.words.tolist() == [0, 1]
    assert a.weights.tolist() == [0.5, 0.5]
    # Counts 2, 1 of words 1, 3: 4, 4. One word shared, half of each.
    b = bow_vector(tree, np.array([3, 1, 1], np.int32))
    assert score(a, b) == pytest.approx(0.5)
    # Counts 1, 3, 1 of words 0, 1, 3: 1, 6, 4 of 11; |a - c| = 9/22 + 1/22 + 8/22 = 18/22.
    c = bow_vector(tree, np.array([0, 1, 1, 1, 3], np.int32))
    assert score(a, c) == pytest.approx(1 - 0.5 * 18 / 22)
    assert score(a, a) == pytest.approx(1.0)
    nothing = bow_vector(tree, np.array([2], np.int32))
    assert len(nothing.words) == 0
    assert score(a, nothing) == 0.0


def test_score_is_one_less_half_the_l1_distance():
    rng = np.random.default_rng(11)
    for _ in range(20):
        dense = rng.random((2, 60)) * (rng.random((2, 60)) < 0.4)
        dense /= dense.sum(axis=1, keepdims=True)
        bags = [
            BowVector(np.flatnonzero(v).astype(np.int32), v[v > 0].astype(np.float32))
            for v in dense
        ]
        expected = 1 - 0.5 * np.abs(dense[0] - dense[1]).sum()
        assert score(*bags) == pytest.approx(expected, abs=1e-6)


# -- files ----------------------------------------------------------------------------------------


def test_npz_round_trip(small, tmp_path):
    save(small, tmp_path / "v.npz")
    assert same(load(tmp_path / "v.npz"), small)


def test_a_detector_takes_another_vocabulary(small, tmp_path):
    write_text(small, tmp_path / "own.txt")
    detector = create_detector("bow", Config(), tmp_path / "own.txt")
    assert detector.vocabulary.n_words == small.n_words


def test_the_shipped_vocabulary_is_small():
    assert SHIPPED.stat().st_size <= 5_000_000
    tree = load()
    assert (tree.branching, tree.levels) == (10, 5)
    assert 90_000 < tree.n_words <= 100_000
    assert np.count_nonzero(tree.weight == 0) == 0


def parts_of(tree: Vocabulary) -> dict[str, object]:
    names = ("branching", "levels", "descriptors", "n_children", "weight")
    return {"schema": 1} | {name: getattr(tree, name) for name in names}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"schema": 9}, "has schema 9, but this version of vslam reads schema 1"),
        ({"branching": 3}, "a node has 5 children, more than 3"),
        ({"levels": 2}, "deeper than 2 levels"),
        ({"levels": 99}, "must be 1 to 10"),
        ({"weight": np.ones(7, np.float32)}, "leaves have 7 weights"),
        ({"n_children": np.zeros(9, np.uint8)}, "9 nodes"),
    ],
)
def test_an_npz_that_does_not_fit_together(small, tmp_path, change, why):
    path = tmp_path / "v.npz"
    np.savez(path, **(parts_of(small) | change))
    with pytest.raises(InputError, match=why) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("which", ["children", "negative weight", "nan weight"])
def test_an_npz_with_nonsense_inside(small, tmp_path, which):
    parts = parts_of(small)
    n_children, weight = small.n_children.copy(), small.weight.copy()
    if which == "children":
        n_children[[0, -1]] = 0, n_children[0]  # the root's children move to the last leaf
    weight[3] = {"negative weight": -1.0, "nan weight": np.nan}.get(which, weight[3])
    np.savez(tmp_path / "v.npz", **(parts | {"n_children": n_children, "weight": weight}))
    with pytest.raises(InputError, match=r"do not form a tree|negative or not finite"):
        load(tmp_path / "v.npz")


def test_files_that_are_no_npz(small, tmp_path):
    with pytest.raises(InputError, match="No such file"):
        load(tmp_path / "none.npz")
    path = tmp_path / "v.npz"
    path.write_bytes(b"")
    with pytest.raises(InputError, match=r"v\.npz: "):
        load(path)
    path.write_text("10 5 0 0")
    with pytest.raises(InputError, match=r"v\.npz: "):
        load(path)
    np.savez(path, other=3)
    with pytest.raises(InputError, match="not a vocabulary"):
        load(path)
    save(small, path)
    whole = path.read_bytes()
    for cut in (100, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError, match=r"v\.npz: "):
            load(path)
    flipped = bytearray(whole)
    flipped[len(whole) // 3] ^= 0xFF
    path.write_bytes(bytes(flipped))
    with pytest.raises(InputError, match=r"v\.npz: "):
        load(path)
    with pytest.raises(ResultsError, match="cannot be written"):
        save(small, path / "v.npz")


# -- DBoW2's text ---------------------------------------------------------------------------------


def node_line(parent: int, leaf: int, value: int = 0, weight: float = 0.0) -> str:
    return f"{parent} {leaf} " + " ".join([str(value)] * 32) + f" {weight}"


# Depth first: 1 (2 4) 3. 2 and 4 are the children of 1, and 3 is a child of the root.
BY_HAND = [
    "3 2 0 0",
    node_line(0, 0, 1),
    node_line(1, 1, 2, 0.25),
    node_line(0, 1, 3, 1.5e-1),
    node_line(1, 1, 4, 7),
]


def written(tmp_path: Path, lines: list[str], end: str = "") -> Path:
    path = tmp_path / "voc.txt"
    path.write_text("\n".join(lines) + end)
    return path


@pytest.mark.parametrize("end", ["", "\n", " \r\n\n"])
def test_text_in_any_order_of_nodes(tmp_path, end):
    tree = read_text(written(tmp_path, BY_HAND, end))
    assert (tree.branching, tree.levels) == (3, 2)
    assert tree.n_children.tolist() == [2, 2, 0, 0, 0]
    assert tree.descriptors.view(np.uint8)[:, 0].tolist() == [0, 1, 3, 2, 4]
    assert tree.word.tolist() == [-1, -1, 0, 1, 2]
    np.testing.assert_allclose(tree.weight, [0.15, 0.25, 7.0], rtol=1e-7)


def test_text_round_trip(small, tmp_path):
    path = tmp_path / "voc.txt"
    write_text(small, path)
    assert same(read_text(path), small)
    lines = path.read_text().split("\n")
    assert lines[0] == "5 4 0 0"
    assert len(lines) == len(small.word), "one line for the header, none for the root"
    numbers = np.array([line.split() for line in lines[1:]], float)
    assert np.array_equal(numbers[:, 0], small.parent[1:])
    assert np.array_equal(numbers[:, 2:34], small.descriptors[1:].view(np.uint8))
    write_text(read_text(path), tmp_path / "again.txt")
    assert (tmp_path / "again.txt").read_bytes() == path.read_bytes()
    with pytest.raises(ResultsError, match="cannot be written"):
        write_text(small, path / "voc.txt")


@pytest.mark.parametrize(
    ("number", "line", "why"),
    [
        (1, "", "line 1 is not 'k L scoring weighting'"),
        (1, "ten 6 0 0", "line 1 is not 'k L scoring weighting'"),
        (1, "3 2 0", "line 1 is not 'k L scoring weighting'"),
        (1, "99 2 0 0", "k 99 and L 2"),
        (1, "3 0 0 0", "k 3 and L 0"),
        (1, "3 2 1 0", "scoring 1 and weighting 0"),
        (1, "3 1 0 0", "line 3 is at level 2, but line 1 says 1 levels"),
        (3, "", "line 3 has fewer than 35 numbers"),
        (3, "1 1 5 5 5", "line 3 has fewer than 35 numbers"),
        (3, node_line(1, 1) + " 9", "line 3 has more than 35 numbers"),
        (3, node_line(1, 1, 256), "line 3 has a descriptor byte"),
        (3, node_line(1, 1, -1), "line 3 has a descriptor byte"),
        (3, node_line(1, 1).replace("1 1 0", "1 1 0.5"), "line 3 has a descriptor byte"),
        (3, node_line(1, 1).replace("1 1 0", "1 1 x"), "line 3 contains something that is not a"),
        (3, node_line(1, 1).replace("1 1 0", "1 1 7a"), "line 3 contains something that is not a"),
        (3, node_line(1, 2), "line 3 has a leaf flag"),
        (3, node_line(2, 1), "line 3 names a parent that does not come before it"),
        (3, node_line(-1, 1), "line 3 names a parent that does not come before it"),
        (3, node_line(1, 1, 0, -2), "line 3 has a weight"),
        (3, node_line(1, 1, 0, 1e39), "line 3 has a weight"),
        (3, node_line(1, 1)[:-3] + "nan", "line 3 contains something that is not a number"),
        (2, node_line(0, 1), "line 2 is a leaf but has children"),
        (4, node_line(0, 0), "line 4 is not a leaf but has no children"),
    ],
)
def test_damaged_text_is_named_by_line(tmp_path, number, line, why):
    lines = BY_HAND.copy()
    lines[number - 1] = line
    path = written(tmp_path, lines)
    with pytest.raises(InputError) as caught:
        read_text(path)
    assert why in str(caught.value)
    assert str(path) in str(caught.value)


def test_text_of_the_wrong_length(tmp_path):
    with pytest.raises(InputError, match="line 2 has fewer"):
        read_text(written(tmp_path, BY_HAND[:1]))
    with pytest.raises(InputError, match="the root has more children than the 3"):
        read_text(written(tmp_path, BY_HAND + [node_line(0, 1)] * 2))
    with pytest.raises(InputError, match="the file is empty"):
        read_text(written(tmp_path, []))
    with pytest.raises(InputError, match="No such file"):
        read_text(tmp_path / "none.txt")
    (tmp_path / "noise.txt").write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(InputError, match="line 1"):
        read_text(tmp_path / "noise.txt")


# -- commands -------------------------------------------------------------------------------------


@pytest.fixture
def call(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["vslam", "vocabulary", *map(str, words)])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = int(stop.code or 0)
        return code, *capsys.readouterr()

    return run


def test_commands_train_convert_and_show(call, tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "photos" / "deep").mkdir(parents=True)
    for k, folder in enumerate(("photos", "photos/deep", ".")):
        image = cv2.resize(rng.integers(0, 256, (40, 60), dtype=np.uint8), (240, 160))
        cv2.imwrite(str(tmp_path / folder / f"{k}.png"), image)
    (tmp_path / "photos" / "broken.jpg").write_text("no image")
    code, out, err = call("train", "photos", "*.png", "--k", 4, "--levels", 3)
    assert code == 0, err
    assert "of 3 images, k 4, levels 3, seed 0" in out
    assert call("train", "photos", "--k", 4, "--levels", 3, "--quiet", "--out", "q.npz")[1] == ""
    assert "photos/broken.jpg: cannot be read as an image; skipped" in err
    assert call("convert", "vocabulary.npz", "v.txt")[0] == 0
    assert call("convert", "v.txt", "back.npz")[0] == 0
    assert same(load(tmp_path / "back.npz"), load(tmp_path / "vocabulary.npz"))
    code, out, _ = call("info", "v.txt")
    assert code == 0
    n_words = load(tmp_path / "back.npz").n_words
    assert f"words     {n_words}, {n_words} of them with weight 0" in out
    assert call("info")[0] == 0


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("train", "nowhere"), "nowhere: no images found"),
        (("train", "broken.jpg"), "1 of 1 images cannot be read"),
        (("train", "broken.jpg", "--out", "v.dat"), "must end in .npz or in .txt"),
        (("train", "broken.jpg", "--out", "none/v.npz"), "the folder none does not exist"),
        (("convert", "v.npz", "v.dat"), "must end in .npz or in .txt"),
        (("convert", "v.npz", "v.txt"), "v.npz: not a vocabulary (No such file"),
        (("info", "broken.jpg"), "must end in .npz or in .txt"),
    ],
)
def test_commands_refuse(call, tmp_path, words, why):
    (tmp_path / "broken.jpg").write_text("no image")
    code, _, err = call(*words)
    assert code == 2
    assert why in err
    assert "Traceback" not in err


def test_a_full_disk_is_said(call, tmp_path):
    shutil.copy(SHIPPED, tmp_path / "v.npz")
    (tmp_path / "folder.npz").mkdir()
    code, _, err = call("convert", "v.npz", "folder.npz")
    assert code == 1
    assert "cannot be written" in err
