"""The images from which the networks learn: readers, splits and pairs."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from siamese_worlds import views

from vslam.support.errors import InputError, UnreadableImageError
from vslam.support.untrusted import is_image
from vslam.types.geometry import se3_exp
from vslam.types.trajectory import write_kitti
from vslam_lab.sources.image_source import images_in, read_loop_matrix, undistorted
from vslam_lab.sources.kitti_source import relation_of_poses
from vslam_lab.sources.pack import write_pack
from vslam_lab.sources.source_registry import open_source
from vslam_lab.training.data import (
    Collection,
    divide,
    draw_pairs,
    load,
    mine,
    refuse_test_data,
    write_pairs,
)


def write_image(path, grey=100, size=(48, 32)):
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.full(size[::-1], grey, np.uint8))


def write_kitti_root(root, seq="00", frames=range(6), step=10.0):
    poses = np.tile(np.eye(4), (max(frames) + 1, 1, 1))
    poses[:, 2, 3] = step * np.arange(len(poses))
    for k in frames:
        write_image(root / "sequences" / seq / "image_0" / f"{k:06d}.png", 10 * (k % 25))
    (root / "poses").mkdir(exist_ok=True)
    write_kitti(root / "poses" / f"{seq}.txt", poses)


def test_poses_tell_same_places_from_others_and_leave_out_what_is_between():
    turn = se3_exp(np.array([0, 0, 0, 0, np.radians(40), 0]))
    back = np.diag([-1.0, 1.0, -1.0, 1.0])
    T = np.stack([np.eye(4)] * 6)
    T[1, 0, 3], T[2, 2, 3], T[3, 2, 3] = 4.9, 10.0, 25.1
    T[4], T[5] = turn, back
    row = relation_of_poses(T)[0].tolist()
    assert row == [1, 1, 0, -1, 0, 0]
    relation = relation_of_poses(T)
    assert np.array_equal(relation, relation.T)


def test_kitti_takes_frames_by_number(tmp_path):
    write_kitti_root(tmp_path, frames=range(250, 262))
    (source,) = open_source(f"kitti:{tmp_path}[seq=00,first=252,last=260,every=2]")
    assert [name.split("/")[1] for name in source.names] == [
        f"{k:06d}.png" for k in (252, 254, 256, 258, 260)
    ]
    assert source.relation[0].tolist() == [1, 0, -1, -1, -1]
    refuse_test_data([source])
    assert source.read(0, (20, 20), "squash").shape == (20, 20)
    (source,) = open_source(f"kitti:{tmp_path}[seq=00,first=252,last=260,every=2,near=21]")
    assert source.relation[0].tolist() == [1, 1, -1, -1, -1]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("kitti:{}[seq=00,first=900,last=990]", "no images numbered 900 to 990"),
        ("kitti:{}[seq=00,from=1]", "unknown option 'from'"),
        ("kitti:{}[first=x]", "not a number"),
        ("kitti:{}[every,first=3]", "'every' has no value; write every=VALUE"),
        ("kitti:{}[every=0]", "every=0: must be at least 1"),
        ("kitti:{}[frames=5]", "frames=5: must be ranges, such as 0-249"),
        ("kitti:{}[seq=00,first=0,last=5,near=25]", "near=25: must be above 0 and below 25 m"),
        ("kitti:{}[seq=00,first=0,last=5,near=nan]", "near=nan: must be above 0"),
        ("films:{}", "where KIND is one of"),
        ("pairs:{}", r"pairs\.csv: missing or not a list of pairs"),
        ("photos:{}", "no set of photographs"),
        ("fabmap:{}", "no images"),
        ("fabmap:{}[side=Right]", "side=Right: must be left or right"),
        ("pack:{}/none.npz", "not a pack of places"),
    ],
)
def test_bad_sources_are_named(tmp_path, spec, message):
    write_kitti_root(tmp_path)
    with pytest.raises(InputError, match=message):
        open_source(spec.format(tmp_path))


def test_test_frames_and_both_collections_are_refused(tmp_path):
    write_kitti_root(tmp_path, frames=range(248, 256))
    with pytest.raises(InputError, match="frames 248 to 255 include test data"):
        refuse_test_data(open_source(f"kitti:{tmp_path}[seq=00]"))
    sources = []
    for name in ("CityCentre", "NewCollege"):
        for k in range(2):
            write_image(tmp_path / name / f"{k:04d}.jpg")
        savemat(tmp_path / name / "truth.mat", {"truth": np.eye(2)})
        sources += open_source(f"fabmap:{tmp_path / name}")
    with pytest.raises(InputError, match="leave no test data"):
        refuse_test_data(sources)


def fabmap_folder(folder, images, truth):
    for k in range(1, images + 1):
        write_image(folder / f"{k:04d}.jpg", k)
    savemat(folder / "truth.mat", {"truth": truth})
    return folder


def test_fabmap_matrix_of_pairs_goes_with_the_images_of_one_camera(tmp_path):
    truth = np.zeros((30, 30), np.uint8)
    truth[29, 2] = 1
    folder = fabmap_folder(tmp_path / "c", 60, truth)
    (left,) = open_source(f"fabmap:{folder}")
    (right,) = open_source(f"fabmap:{folder}[side=right]")
    assert [left.names[1], right.names[1]] == ["c/0003.jpg", "c/0004.jpg"]
    assert (left.relation[2, 29], left.relation[29, 2]) == (1, 1)
    assert left.relation[0, 25] == -1
    assert left.relation[0, 1] == 0  # neighbours in time are neither the same place nor different
    (single,) = open_source(f"fabmap:{fabmap_folder(tmp_path / 's', 30, truth)}")
    assert len(single) == 30


def test_fabmap_ground_truth_must_fit_and_hold_something(tmp_path):
    folder = fabmap_folder(tmp_path / "c", 7, np.eye(4))
    with pytest.raises(InputError, match=r"the matrix has 4 rows, but .* has 7 images"):
        open_source(f"fabmap:{folder}")
    savemat(folder / "truth.mat", {"truth": np.zeros((7, 7))})
    with pytest.raises(InputError, match="contains no ground truth"):
        open_source(f"fabmap:{folder}")
    (folder / "truth.mat").write_bytes(b"not a matrix")
    with pytest.raises(InputError, match=r"not a readable \.mat file"):
        open_source(f"fabmap:{folder}")


def test_a_loop_matrix_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="no such file; give the loop matrix"):
        read_loop_matrix(tmp_path / "none.mat")


def test_undistortion_straightens_lines():
    K = [40.0, 40.0, 50.0, 50.0]
    image = np.zeros((101, 101), np.uint8)
    image[20] = 255
    assert np.array_equal(undistorted(image, np.array([*K, 0, 0, 0, 0.0])), image)
    bent = undistorted(image, np.array([*K, -0.2, 0, 0, 0.0]))
    centre, edge = bent[:, 50].argmax(), bent[:, 85].argmax()
    assert edge != centre


def photo_set(folder, kind, subfolders, images=4):
    for name in subfolders:
        for k in range(images):
            write_image(folder / name / f"{k:04d}.png", 20 * k)
    (folder / "NOTES.txt").write_text(f"{folder.name}: kind ({kind}), some images\n")


def test_photographs_follow_the_kind_in_their_notes(tmp_path):
    photo_set(tmp_path / "rooms", "a", ["hall", "yard"])
    photo_set(tmp_path / "drive", "b", ["x"])
    photo_set(tmp_path / "zoo", "c", ["photos"])
    photo_set(tmp_path / "pano_rotation", "a", ["p"])
    drive, pano, rooms, zoo = open_source(f"photos:{tmp_path}")
    assert rooms.relation[0].tolist() == [1, 1, 1, 1, -1, -1, -1, -1]
    assert drive.relation[1].tolist() == [1, 1, 1, 0]
    assert zoo.relation[1].tolist() == [-1, 1, -1, -1]
    assert pano.relation[0].tolist() == [1, 1, 0, 0]  # distant photographs differ
    assert len(set(zoo.unit)) == 4
    assert len(set(rooms.unit)) == 2
    (tmp_path / "zoo" / "NOTES.txt").write_text("animals\n")
    with pytest.raises(InputError, match="must state the kind of the set"):
        open_source(f"photos:{tmp_path}")


def test_images_of_sources_are_those_of_runs(tmp_path):
    for name in ("a.bmp", "b.TIF", "c.jpg", "._c.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in images_in(tmp_path)] == ["a.bmp", "b.TIF", "c.jpg"]
    assert images_in(tmp_path) == list(filter(is_image, sorted(tmp_path.iterdir())))


def test_rendered_pairs_know_their_own_pairs_only(tmp_path):
    for name in ("0a", "0b", "1a", "1b"):
        write_image(tmp_path / "images" / f"{name}.png")
    rows = "a,b,same,lateral_m\nimages/0a.png,images/0b.png,1,0.5\n"
    (tmp_path / "pairs.csv").write_text(rows + "images/1a.png,images/1b.png,0,0.0\n")
    (source,) = open_source(f"pairs:{tmp_path}")
    assert source.relation.tolist() == [[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, -1], [0, 0, -1, 1]]
    (tmp_path / "images" / "1b.png").unlink()
    with pytest.raises(UnreadableImageError, match=r"1b\.png: the file is missing"):
        load([source], (20, 20), "squash")


def test_sources_together(tmp_path):
    photo_set(tmp_path / "strecha", "a", ["castle"])
    photo_set(tmp_path / "multiview", "a", ["church"])
    photo_set(tmp_path / "zoo", "c", ["photos"])
    sources = open_source(f"photos:{tmp_path}")
    collection = load(sources, (20, 20), "crop")
    assert collection.images.shape == (12, 20, 20)
    assert (collection.relation[:4, 4:8] == 0).all()  # landmarks of one family
    assert (collection.relation[:8, 8:] == -1).all()
    with pytest.raises(InputError, match="two sources have the name"):
        load([sources[0], sources[0]], (20, 20), "crop")
    with pytest.raises(InputError, match="at least one source"):
        load([], (20, 20), "crop")


def test_a_pack_is_the_same_data(tmp_path):
    write_kitti_root(tmp_path)
    (source,) = open_source(f"kitti:{tmp_path}")
    n = len(source)
    split = replace(source, is_query=np.arange(n) % 2 == 0, times=np.arange(float(n)))
    write_pack([source, split], tmp_path / "p.npz", (20, 20), "squash")
    first, second = open_source(f"pack:{tmp_path / 'p.npz'}")
    assert first.is_query is None
    assert np.array_equal(second.is_query, split.is_query)
    assert np.array_equal(second.times, split.times)
    assert (first.name, first.names) == (source.name, source.names)
    assert np.array_equal(first.relation, source.relation)
    assert np.array_equal(first.unit, source.unit)
    for k in range(len(source)):
        mine, wanted = first.read(k, (20, 20), "squash"), source.read(k, (20, 20), "squash")
        assert np.abs(mine.astype(int) - wanted).max() <= 3  # JPEG


def test_no_place_is_on_both_sides_of_a_division():
    collection = views(30)
    train, validation = divide(collection, seed=3, share=0.2)
    assert len(validation) == 12
    assert (collection.relation[np.ix_(train, validation)] != 1).all()
    assert not set(collection.unit[train]) & set(collection.unit[validation])
    again = divide(collection, seed=3, share=0.2)
    assert np.array_equal(train, again[0])
    with pytest.raises(InputError, match="too few places"):
        divide(views(1), seed=0)


def test_stretches_of_road_are_parted_where_they_overlap(tmp_path):
    write_kitti_root(tmp_path, seq="05", frames=range(300), step=2.0)
    collection = load(open_source(f"kitti:{tmp_path}[seq=05]"), (8, 8), "squash")
    train, validation = divide(collection, seed=0, share=0.3)
    gap = np.abs(train[:, None] - validation[None]) * 2.0
    assert gap.min() >= 5.0
    assert len(train) + len(validation) < 300


def test_pairs_are_balanced_true_and_hard():
    collection = views(30)
    chosen = np.arange(10, 60)
    rng = np.random.default_rng(0)
    descriptors = rng.standard_normal((50, 8)).astype(np.float32)
    hard = mine(collection, chosen, descriptors @ descriptors.T, k=3)
    for k, image in enumerate(chosen):
        assert (collection.relation[image, hard[k]] == -1).all()
        alike = descriptors @ descriptors[k]
        alike[collection.relation[image, chosen] != -1] = -np.inf
        assert set(hard[k]) == set(chosen[np.argsort(-alike)[:3]])
    pairs = draw_pairs(collection, chosen, 200, np.random.default_rng(1), hard, hard_share=1.0)
    truth = collection.relation[pairs.a, pairs.b]
    assert np.array_equal(truth == 1, pairs.same)
    assert pairs.same.sum() == 100
    assert np.isin(pairs.a, chosen).all()
    assert np.isin(pairs.b, chosen).all()
    mined = [b in hard[a - 10] for a, b in zip(pairs.a, pairs.b, strict=True)]
    assert np.array_equal(mined, ~pairs.same)


def test_lists_of_pairs_repeat_with_their_seed(tmp_path):
    collection = views(6)
    texts = []
    for name in ("a.csv", "b.csv"):
        pairs = draw_pairs(collection, np.arange(12), 6, np.random.default_rng(5))
        write_pairs(tmp_path / name, collection, pairs, 5)
        texts.append((tmp_path / name).read_text())
    assert texts[0] == texts[1]
    assert texts[0].splitlines()[0] == "# seed 5"
    assert len(texts[0].splitlines()) == 8


def test_pairs_in_a_row_begin_in_one_source_and_most_are_of_one_place():
    relation = np.where(np.arange(30)[:, None] // 2 == np.arange(30)[None] // 2, 1, -1)
    collection = Collection(
        tuple(f"s{k // 10}/f/{k}" for k in range(30)),
        np.zeros((30, 8, 8), np.uint8),
        relation.astype(np.int8),
        np.arange(30) // 2,
        (("s0", 10), ("s1", 10), ("s2", 10)),
    )
    chosen = np.arange(3, 30)
    pairs = draw_pairs(collection, chosen, 80, np.random.default_rng(0), same_share=0.8, together=8)
    begins = (pairs.a // 10).reshape(10, 8)
    assert (begins == begins[:, :1]).all()
    assert set(begins[:, 0]) == {0, 1, 2}
    again = draw_pairs(
        collection, chosen, 4000, np.random.default_rng(0), together=8, emphasis={"s2": 3.0}
    )
    share = np.mean(again.a // 10 == 2)
    assert share == pytest.approx(3 * 10 / (7 + 10 + 3 * 10), abs=0.06)
    assert pairs.same.sum() == 64
    assert pairs.same.reshape(16, 5).sum(1).tolist() == [4] * 16
    assert np.isin(pairs.a, chosen).all()
    assert np.array_equal(collection.relation[pairs.a, pairs.b] == 1, pairs.same)
