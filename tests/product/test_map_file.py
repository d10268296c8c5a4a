"""Map files are complete, are written atomically, load within a second, and are not trusted."""

from __future__ import annotations

import errno
import json
import os
import pickle
from contextlib import suppress
from dataclasses import is_dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import valid_files
from ring import CAMERA, Ring

from vslam.config import Config, OrbConfig
from vslam.loopclosure.registry import create_detector, create_images
from vslam.maps import new_output
from vslam.maps.storage import load_checkpoint, load_map, save_map
from vslam.maps.stored_map import StoredMap, TruthAlignment
from vslam.slam import Slam
from vslam.support.errors import InputError
from vslam.types.features import Extracted, Features
from vslam.types.geometry import se3_exp
from vslam.types.loops import LoopEdge, PerKeyframe
from vslam.types.map import UNPREDICTED, Map
from vslam.types.map_kernels import refresh_landmarks
from vslam.types.revisits import Revisits

CONFIG = Config()


def driven(slam: Slam, ring: Ring, places, start: float = 0.0) -> Slam:
    for i, k in enumerate(places):
        slam.step_features(Extracted(ring.see(k, seed=int(start))), start + 0.1 * i)
    slam.finish()
    return slam


@pytest.fixture(scope="module")
def ring() -> Ring:
    return Ring.create()


@pytest.fixture(scope="module")
def slam(ring) -> Slam:
    """A ``Slam`` after half a lap. One of its keyframes is culled."""
    done = driven(Slam(CAMERA, CONFIG, create_detector("bow", CONFIG), threads=1), ring, range(100))
    assert len(done.map.living_keyframes()) < done.map.n_keyframes
    done.map.revisits = as_revisit(done.map, int(done.map.living_keyframes()[2]))
    return done


def as_revisit(map_: Map, keyframe: int) -> Revisits:
    """Return a revisit that observes what a keyframe observes."""
    a, rows = map_.arrays, map_.rows(keyframe)
    seen = np.flatnonzero(a.landmark[rows] >= 0) + rows.start
    return Revisits(
        np.array([keyframe]),
        np.eye(4)[None],
        np.array([0, len(seen)]),
        a.landmark[seen],
        np.column_stack([a.xy[seen], a.u_right[seen]]),
        a.octave[seen],
        a.certainty[seen],
    )


@pytest.fixture(scope="module")
def file(slam, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "ring.npz"
    slam.save(path, "ring 0")
    return path


def changed(file: Path, to: Path, **arrays: np.ndarray) -> Path:
    """Return the file with some of its arrays replaced. None removes an array."""
    with np.load(file) as before:
        data = {name: before[name] for name in before.files}
    data |= arrays
    np.savez(to, **{name: array for name, array in data.items() if array is not None})
    return to


def header_of(file: Path) -> dict:
    with np.load(file) as data:
        return json.loads(bytes(data["header"]))


def as_header(header: dict) -> np.ndarray:
    return np.frombuffer(json.dumps(header).encode(), np.uint8)


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as stop:
        load_map(path)
    message = str(stop.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_the_folder_of_a_run_stands_for_its_map(file, tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (run / "map.npz").write_bytes(file.read_bytes())
    assert load_map(run).map.n_keyframes == load_map(file).map.n_keyframes


def test_all_of_a_map_comes_back(slam, file, check_map):
    before, after = slam.map, load_map(file).map
    check_map(after)
    keyframes, landmarks = before.living_keyframes(), before.living_landmarks()
    a, b = before.arrays, after.arrays
    n, m = after.n_keyframes, after.n_landmarks
    assert (n, m) == (len(keyframes), len(landmarks))
    assert np.array_equal(b.T_cw[:n], a.T_cw[keyframes])
    assert np.array_equal(after.timestamps, before.timestamps[keyframes])
    assert np.array_equal(after.frames, before.frames[keyframes])
    for k in range(n):
        old, new = before.rows(keyframes[k]), after.rows(k)
        for name in ("xy", "u_right", "octave", "angle", "descriptor"):
            assert np.array_equal(getattr(a, name)[old], getattr(b, name)[new], equal_nan=True)
        # Both maps see the same points, with the same data.
        ids, same = a.landmark[old], b.landmark[new]
        assert np.array_equal(ids >= 0, same >= 0)
        ids, same = ids[ids >= 0], same[same >= 0]
        for name in (
            "xyz", "normal", "distance_range", "landmark_descriptor", "visible", "found",
            "n_observations",
        ):  # fmt: skip
            assert np.array_equal(getattr(a, name)[ids], getattr(b, name)[same])
    assert (np.diff(b.first_keyframe[:m]) >= 0).all()
    assert np.array_equal(keyframes[after.parents[1:]], before.parents[keyframes[1:]])


def test_revisits_come_back(slam, file):
    before, after = slam.map, load_map(file).map
    keyframe = int(after.revisits.keyframe[0])
    assert before.living_keyframes()[keyframe] == before.revisits.keyframe[0]
    expected = as_revisit(after, keyframe)
    for name, values in vars(after.revisits).items():
        assert np.array_equal(values, getattr(expected, name), equal_nan=True), name


def test_observations_keep_their_order(slam, file):
    """Only the newest observations determine the descriptor of a landmark."""
    before, after = slam.map, load_map(file).map
    keyframe = int(before.living_keyframes()[5])
    old = before.landmarks_of(keyframe)
    new = after.arrays.landmark[after.rows(5)]
    new = new[new >= 0]
    for map_, ids in ((before, old), (after, new)):
        refresh_landmarks(map_.arrays, ids.astype(np.int32), map_.scales)
    a, b = before.arrays, after.arrays
    assert np.array_equal(a.landmark_descriptor[old], b.landmark_descriptor[new])


def test_the_same_map_gives_the_same_bytes(file, tmp_path):
    save_map(tmp_path / "again.npz", load_map(file))
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()


def test_frames_placed_by_culled_keyframes_stay_where_they_are(slam, file):
    before = slam.trajectory()
    after = Slam.load(file, threads=1, resume=True).trajectory()
    assert np.array_equal(after.timestamps, before.timestamps)
    np.testing.assert_allclose(after.T_wc, before.T_wc, atol=1e-9)


def test_loops_images_drives_and_world_come_back(slam, tmp_path):
    living = slam.map.living_keyframes().tolist()
    culled = next(k for k in range(slam.map.n_keyframes) if k not in living)
    T = se3_exp(np.array([0.5, 0.0, 1.0, 0.0, 0.1, 0.0]))
    loop = LoopEdge(living[-1], culled, 0.25, True, "closed", 90, 60, T, scale=1.5)
    first = np.arange(slam.map.n_keyframes + 1)
    images = PerKeyframe(first, np.arange(slam.map.n_keyframes, dtype=np.uint8))
    world = TruthAlignment("kitti 06", np.diag([2.0, 2.0, 2.0, 1.0]))
    stored = replace(slam.stored_map("x"), loops=(loop,), images=images, truth_alignment=world)
    save_map(tmp_path / "m.npz", stored)
    found = load_map(tmp_path / "m.npz")
    (edge,) = found.loops
    parent = slam.map.parents[culled]
    assert (edge.query, edge.match) == (len(living) - 1, living.index(parent))
    assert (edge.score, edge.n_matches, edge.n_inliers, edge.scale) == (0.25, 90, 60, 1.5)
    np.testing.assert_allclose(
        edge.T_query_match, T @ slam.map.keyframes.T_c_parent[culled], atol=1e-9
    )
    assert found.images is not None
    assert found.images.values.tolist() == living
    assert found.drives == ("x",)
    assert found.truth_alignment is not None
    assert found.truth_alignment.name == "kitti 06"
    assert np.array_equal(found.truth_alignment.S_truth_world, world.S_truth_world)


def test_what_the_detector_knew_comes_back(file, ring):
    """The candidates have the same scores, and the words need not be looked up again."""
    again = create_detector("bow", CONFIG)
    stored = load_map(file)
    again.restore(stored.detector)
    fresh = create_detector("bow", CONFIG)
    map_ = stored.map
    for k in range(map_.n_keyframes):
        rows, a = map_.rows(k), map_.arrays
        descriptors = a.descriptor[rows].view(np.uint8)
        fresh.add(
            k,
            None,
            Features(a.xy[rows], a.octave[rows], a.angle[rows], descriptors, a.u_right[rows]),
        )
    seen = ring.see(40, seed=3)
    assert again.locate(None, seen, map_)
    assert again.locate(None, seen, map_) == fresh.locate(None, seen, map_)
    last = map_.n_keyframes - 1
    assert again.query(last, map_) == fresh.query(last, map_)


def test_descriptors_and_images_of_learned_detectors_come_back(tmp_path):
    def create():
        images = create_images("both", CONFIG)
        assert images is not None
        return create_detector("both", CONFIG, None, images), images

    rng = np.random.default_rng(0)
    noise = rng.uniform(0, 255, (3, 12, 32)).astype(np.float32)
    pictures = [cv2.resize(n, (640, 240), interpolation=cv2.INTER_CUBIC) for n in noise]
    pictures = [np.clip(picture, 0, 255).astype(np.uint8) for picture in pictures]
    detector, images = create()
    map_ = Map(1.2 ** np.arange(8))
    for k in range(4):
        map_.add_keyframe(Features.none(), np.eye(4), float(k), k)
        map_.parents[k] = k - 1
        # The second keyframe is culled. The image of the last one was not kept.
        picture = pictures[min(k, 2)] if k < 3 else None
        detector.add(k, picture, Features.none())
        if picture is not None:
            images.add(k, picture)
    map_.cull_keyframe(1)
    stored = StoredMap(map_, CAMERA, detector=detector.memory(), images=images.files(4))
    save_map(tmp_path / "m.npz", stored)

    found = load_map(tmp_path / "m.npz")
    again, kept = create()
    again.restore(found.detector)
    assert found.images is not None
    kept.restore(found.images, 640)
    assert [k in kept for k in range(3)] == [True, True, False]
    assert np.array_equal(kept.image(1), images.image(2))
    (before,) = detector.locate(pictures[2], Features.none(), map_)[:1]
    (after,) = again.locate(pictures[2], Features.none(), found.map)[:1]
    assert (before.match, after.match) == (2, 1)
    assert (before.score, before.similarity) == (after.score, after.similarity)

    values = found.images.values.copy()
    values[:2] = 0
    with pytest.raises(ValueError, match="keyframe 0 is not a JPEG"):
        create()[1].restore(replace(found.images, values=values), 640)
    seen = again.memory()  # as if a lost frame had been searched for with the network
    table = seen.tables["capsule/descriptors"]
    assert len(table.values) == 2
    other = replace(table, values=np.full_like(table.values, np.nan))
    tables = {**seen.tables, "capsule/descriptors": other}
    with pytest.raises(ValueError, match="do not belong to the network"):
        create()[0].restore(replace(seen, tables=tables))


def test_a_restart_that_was_culled_still_begins_its_submap(slam):
    map_ = load_and_restart(slam)
    selected = StoredMap(map_, CAMERA).compact().map
    assert selected.restarts == [int(np.searchsorted(map_.living_keyframes(), map_.restarts[0]))]
    assert selected.unpredicted_restarts == selected.restarts


def load_and_restart(slam: Slam) -> Map:
    map_ = slam.stored_map().compact().map
    map_.keyframes.restart[9] = UNPREDICTED
    map_.cull_keyframe(9)
    return map_


def test_a_part_of_a_map_is_a_map(slam, check_map):
    stored = slam.stored_map().compact()
    kept = np.array([3, 4, 5, 11, 12, 13])
    part = stored.select(kept)
    check_map(part.map)
    assert part.frames is None
    assert part.map.n_keyframes == 6
    assert np.array_equal(part.map.arrays.T_cw[:6], stored.map.arrays.T_cw[kept])
    seen = [set(stored.map.landmarks_of(int(k)).tolist()) for k in kept]
    assert part.map.n_landmarks == len(set.union(*seen))
    assert all(parent < k for k, parent in enumerate(part.map.parents))


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_a_file_cut_off_is_refused(file, tmp_path, share):
    cut = tmp_path / "cut.npz"
    cut.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert "damaged" in refusal(cut) or "not a map" in refusal(cut)


def test_flipped_bytes_never_load_as_another_map(file, tmp_path):
    content, rng = bytearray(file.read_bytes()), np.random.default_rng(0)
    same = load_map(file).map.arrays
    for position in rng.integers(0, len(content), 60):
        damaged = content.copy()
        damaged[position] ^= 1 << int(rng.integers(8))
        path = tmp_path / "flipped.npz"
        path.write_bytes(damaged)
        with suppress(InputError):  # otherwise, the damaged bytes are redundant in a zip file
            found = load_map(path).map.arrays
            assert np.array_equal(found.xyz, same.xyz)
            assert np.array_equal(found.T_cw, same.T_cw)


def test_foreign_files_are_refused(tmp_path):
    path = tmp_path / "m.npz"
    assert "No such file" in refusal(path)
    with pytest.raises(InputError, match=r"map\.npz: cannot be read \(No such file"):
        load_map(tmp_path)
    path.write_text("not a map")
    assert "not a map" in refusal(path)
    np.savez(path, a=np.zeros(3))
    assert "not a map" in refusal(path)
    with path.open("wb") as out:
        np.save(out, np.zeros(3))
    assert "not a map" in refusal(path)
    path.write_bytes(pickle.dumps({"schema": 2}))
    assert "not a map" in refusal(path)
    np.savez(path, header=np.array([{"kind": "vslam map"}], object), allow_pickle=True)
    assert "not a map" in refusal(path)
    np.savez(path, header=as_header({"kind": "vslam map"})[:-3])
    assert "not a map" in refusal(path)


def test_other_schemas_are_named(file, tmp_path):
    newer = as_header(header_of(file) | {"schema": 16})
    assert "schema 16, but this version of vslam reads schema 15" in refusal(
        changed(file, tmp_path / "n.npz", header=newer)
    )
    old = tmp_path / "old.npz"
    np.savez(old, schema=1, keyframe_first_row=np.zeros(1, np.int64))
    assert "reads schema 15; make the map again" in refusal(old)


def damage(name: str, position: tuple[int, ...], value: float):
    def apply(file: Path, to: Path) -> Path:
        with np.load(file) as data:
            array = data[name].copy()
        array[position] = value
        return changed(file, to, **{name: array})

    return pytest.param(apply, id=f"{name}-{value}")


def mirror(file: Path, to: Path) -> Path:
    with np.load(file) as data:
        T_cw = data["keyframe_T_cw"].copy()
    T_cw[2, :, 0] *= -1.0
    return changed(file, to, keyframe_T_cw=T_cw)


@pytest.mark.parametrize(
    "apply",
    [
        mirror,
        damage("keyframe_T_cw", (2, 0, 3), np.nan),
        damage("keyframe_T_cw", (2, 0, 0), 5.0),
        damage("keyframe_T_cw", (2, 3, 0), 1.0),
        damage("keyframe_first_row", (3,), 10**9),
        damage("keyframe_first_row", (0,), 1),
        damage("keyframe_parent", (4,), 4),
        damage("keyframe_parent", (4,), -1),
        damage("keyframe_timestamp", (1,), np.inf),
        damage("keyframe_unit_scale", (1,), 0.0),
        damage("keyframe_motion_seconds", (1,), -0.5),
        damage("keyframe_motion_seconds", (1,), 0.5),  # the rest of the motion is zero
        damage("landmark_xyz", (7, 1), np.nan),
        damage("landmark_xyz", (7, 1), 1e200),
        damage("row_xy", (5, 0), 1e30),
        damage("landmark_first_keyframe", (-1,), 10**6),
        damage("landmark_first_keyframe", (5,), -1),
        damage("landmark_first_observation", (3,), 0),
        damage("observation_row", (3,), -1),
        damage("observation_row", (3,), 10**8),
        damage("row_octave", (5,), 200),
        damage("row_u_right", (5,), np.inf),
        damage("scales", (1,), 0.5),
        damage("frame_reference", (2,), 10**6),
        damage("frame_timestamp", (2,), -1.0),
        damage("detector_words_first", (2,), 10**9),
        damage("revisit_keyframe", (0,), 10**6),
        damage("revisit_first", (1,), 10**9),
        damage("revisit_landmark", (0,), 10**8),
        damage("revisit_octave", (0,), 200),
        damage("revisit_certainty", (0,), 0),
        damage("revisit_uvr", (0, 0), np.nan),
        damage("revisit_T_c_keyframe", (0, 0, 0), 5.0),
    ],
)
def test_damage_by_hand_is_refused(apply, file, tmp_path):
    assert "damaged" in refusal(apply(file, tmp_path / "hand.npz"))


LAST, PLACE = "checkpoint.last", "checkpoint.published.known_place"
FAR = {"keyframes": [10**6], "length": 1, "age": 0}


@pytest.fixture(scope="module")
def at_checkpoint(slam, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("checkpoint") / "ring.npz"
    slam.save(path, resumable=True)
    return path


def test_a_map_at_a_checkpoint_comes_back_with_what_died(slam, at_checkpoint, tmp_path):
    stored, checkpoint = load_checkpoint(at_checkpoint), slam.stored_map().checkpoint
    before, after = slam.map, stored.map
    assert not after.arrays.keyframe_alive.all() or not after.arrays.landmark_alive.all()
    columns = after.columns()
    for name, column in before.columns().items():
        assert same(column, columns[name]), name
    assert checkpoint is not None
    assert stored.checkpoint is not None
    assert same(checkpoint, stored.checkpoint)
    save_map(tmp_path / "one.npz", slam.stored_map())
    save_map(tmp_path / "again.npz", load_map(at_checkpoint))
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "one.npz").read_bytes()


def same(one: object, other: object) -> bool:
    """Return whether two states have the same contents."""
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    if is_dataclass(one):
        names = vars(one)
        return all(same(value, getattr(other, name)) for name, value in names.items())
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def entry(part: str, **fields: object):
    def apply(file: Path, to: Path) -> Path:
        header = header_of(file)
        header["checkpoint"]["state"][part] |= fields
        return changed(file, to, header=as_header(header))

    return pytest.param(apply, id=next(iter(fields)))


def recent(field: str, value: object):
    def apply(file: Path, to: Path) -> Path:
        header = header_of(file)
        header["checkpoint"]["state"]["published"]["recent"][0][field] = value
        return changed(file, to, header=as_header(header))

    return pytest.param(apply, id=f"{field} {value}")


def without_checkpoint(file: Path, to: Path) -> Path:
    return changed(file, to, header=as_header(header_of(file) | {"checkpoint": None}))


def merged_in_a_circle(file: Path, to: Path) -> Path:
    with np.load(file) as data:
        merged, culled = (
            data["landmark_merged_into"].copy(),
            np.flatnonzero(~data["landmark_alive"]),
        )
    merged[culled[:2]] = culled[[1, 0]]
    return changed(file, to, landmark_merged_into=merged)


def alive_that_died(file: Path, to: Path) -> Path:
    with np.load(file) as data:
        alive = np.ones_like(data["landmark_alive"])
    return changed(file, to, landmark_alive=alive)


@pytest.mark.parametrize(
    "apply",
    [
        damage(f"{LAST}.landmark", (3,), 10**6),
        damage(f"{LAST}.landmark", (3,), -2),
        damage(f"{LAST}.visible", (3,), 10**6),
        damage(f"{LAST}.xyz", (3, 0), np.inf),
        damage(f"{LAST}.extracted.features.xy", (3, 0), np.nan),
        damage(f"{LAST}.extracted.features.xy", (3, 0), 1e30),
        damage(f"{LAST}.extracted.features.octave", (3,), 8),
        damage(f"{LAST}.extracted.features.u_right", (3,), np.inf),
        damage("keyframe_alive", (1,), False),
        damage("landmark_merged_into", (0,), 10**6),
        entry("published", reference=10**6),
        entry("published", reference=0.5),
        entry("published", last_frame=2**31),
        entry("published", last_timestamp=np.inf),
        entry("last", index=2**31),
        entry("last", index=-1),
        entry("motion", lost_frames=10**30),
        entry("last", timestamp=np.inf),
        entry("last", n_inliers="many"),
        entry("last", unknown=1),
        entry("last", T_cw="checkpoint.last.twist"),
        entry("last", T_cw=None),
        entry("last", T_cw="nothing"),
        entry("closing", consistency={"places": [[1]], "verified": [], "turn": 1}),
        entry("closing", consistency={"places": [FAR], "verified": [], "turn": 1}),
        entry("closing", consistency={"places": [], "verified": [], "turn": np.inf}),
        entry("closing", verifier={"resting_until": 0, "failed_similarity": np.nan}),
        entry("policy", gained_close="many"),
        entry("policy", gained_close=np.inf),
        pytest.param(without_checkpoint, id="none"),
        pytest.param(merged_in_a_circle, id="circle"),
        pytest.param(alive_that_died, id="alive"),
    ],
)
def test_a_damaged_checkpoint_is_refused(apply, at_checkpoint, tmp_path):
    assert "damaged" in refusal(apply(at_checkpoint, tmp_path / "hand.npz"))


@pytest.fixture(scope="module")
def at_known_place(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("known")
    valid_files.map_file(folder)
    return folder / "map.npz"


def test_the_patches_of_a_known_place_come_back(at_known_place, tmp_path):
    stored = load_checkpoint(at_known_place)
    known_place = stored.checkpoint.published.known_place
    with np.load(at_known_place) as data:
        for name, values in known_place._asdict().items():
            wanted = 2 if name == "frame" else data[f"{PLACE}.{name}"]
            np.testing.assert_array_equal(values, wanted)
    save_map(tmp_path / "again.npz", stored, resumable=True)
    assert (tmp_path / "again.npz").read_bytes() == at_known_place.read_bytes()


@pytest.mark.parametrize(
    "apply",
    [
        damage(f"{PLACE}.landmark", (0,), 11),
        damage(f"{PLACE}.landmark", (9,), 10**6),
        damage(f"{PLACE}.landmark", (0,), -1),
        damage(f"{PLACE}.octave", (3,), 8),
        damage(f"{PLACE}.angle", (3,), np.inf),
        damage(f"{PLACE}.shift", (3, 0), np.nan),
        entry("published", known_place=3),
        entry("published", known_place="last"),
    ],
)
def test_damaged_patches_of_a_known_place_are_refused(apply, at_known_place, tmp_path):
    assert "damaged" in refusal(apply(at_known_place, tmp_path / "hand.npz"))


RECENT = "checkpoint.published.recent.0"


@pytest.mark.parametrize(
    "apply",
    [
        damage(f"{RECENT}.landmark", (0,), 10**6),
        damage(f"{RECENT}.landmark", (0,), -2),
        damage(f"{RECENT}.xy", (3, 0), np.nan),
        damage(f"{RECENT}.sigma", (3,), 0.0),
        damage(f"{RECENT}.T_c_keyframe", (0, 0), np.inf),
        recent("index", 3),
        recent("index", -1),
        recent("keyframe", 3),
        recent("keyframe", -1),
        recent("unit_scale", 0.0),
    ],
)
def test_damaged_observations_of_a_recent_frame_are_refused(apply, at_known_place, tmp_path):
    assert "damaged" in refusal(apply(at_known_place, tmp_path / "hand.npz"))


def test_a_checkpoint_of_another_version_is_refused(at_checkpoint, tmp_path):
    header = header_of(at_checkpoint)
    header["checkpoint"] = header["checkpoint"]["state"]  # as before checkpoints had a schema
    older = changed(at_checkpoint, tmp_path / "older.npz", header=as_header(header))
    assert refusal(older).endswith("another version of vslam; resume the run with that version.")


def test_a_drive_that_has_made_no_keyframe_yet_is_resumed(at_checkpoint, tmp_path):
    """The drive began in the map of a different drive."""
    path = tmp_path / "m.npz"
    begun = {"last_frame": -1, "last_timestamp": -np.inf}
    header = header_of(at_checkpoint)
    header["checkpoint"]["state"]["published"] |= begun
    changed(at_checkpoint, path, header=as_header(header))
    published = load_checkpoint(path).checkpoint.published
    assert {name: getattr(published, name) for name in begun} == begun


def test_observations_that_contradict_each_other_are_refused(file, tmp_path):
    with np.load(file) as data:
        rows, first = data["observation_row"].copy(), data["landmark_first_observation"]
    rows[1] = rows[0]
    path = tmp_path / "m.npz"
    assert "two landmarks" in refusal(changed(file, path, observation_row=rows))
    with np.load(file) as data:
        rows, starts = data["observation_row"].copy(), data["keyframe_first_row"]
    free = np.setdiff1d(np.arange(starts[1]), rows)[0]
    several = int(np.flatnonzero(np.diff(first) > 1)[0])
    keyframe_of = np.searchsorted(starts, rows, side="right") - 1
    here = slice(first[several], first[several + 1])
    assert 0 in keyframe_of[here]
    other = first[several] + int(np.flatnonzero(keyframe_of[here] != 0)[0])
    rows[other] = free
    assert "a landmark twice" in refusal(changed(file, path, observation_row=rows))


def test_culled_landmarks_and_their_observations_must_agree(file, tmp_path):
    with np.load(file) as data:
        not_culled, first = data["landmark_alive"].copy(), data["landmark_first_observation"].copy()
    path = tmp_path / "m.npz"
    not_culled[3] = False
    message = refusal(changed(file, path, landmark_alive=not_culled))
    assert "a culled landmark with observations" in message
    first[4] = first[3]
    message = refusal(changed(file, path, landmark_first_observation=first))
    assert "a landmark without observations that is not culled" in message


@pytest.mark.parametrize("name", ["keyframe_T_cw", "row_descriptor", "frame_tracked", "loop_ends"])
def test_arrays_that_lack_or_are_of_another_kind_are_refused(file, tmp_path, name):
    path = tmp_path / "m.npz"
    assert name in refusal(changed(file, path, **{name: None}))
    with np.load(file) as data:
        array = data[name]
    assert name in refusal(changed(file, path, **{name: array.astype(np.complex128)}))
    assert name in refusal(changed(file, path, **{name: array[..., None]}))
    if array.ndim > 1 and array.size:
        assert name in refusal(changed(file, path, **{name: np.asfortranarray(array)}))


def test_headers_that_lack_something_are_refused(file, tmp_path):
    header = header_of(file)
    for name in ("camera", "detector", "scalars", "images", "drives"):
        less = {key: value for key, value in header.items() if key != name}
        assert name in refusal(changed(file, tmp_path / "m.npz", header=as_header(less)))
    for wrong in ({"session": -1}, {"session": np.inf}, {"disparity_offset": np.nan}):
        scalars = as_header(header | {"scalars": header["scalars"] | wrong})
        assert "damaged" in refusal(changed(file, tmp_path / "m.npz", header=scalars))
    for wrong in ({"fx": -1.0}, {"height": 0.5}, {"cx": np.inf}, {"baseline": 1e200}):
        no_camera = as_header(header | {"camera": header["camera"] | wrong})
        assert "camera" in refusal(changed(file, tmp_path / "m.npz", header=no_camera))


def test_a_full_disk_leaves_the_file_that_was_there(slam, file, tmp_path, monkeypatch):
    path = tmp_path / "m.npz"
    path.write_bytes(file.read_bytes())

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(new_output.os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        slam.save(path)
    assert path.read_bytes() == file.read_bytes()
    assert os.listdir(tmp_path) == ["m.npz"]


def test_a_map_of_something_else_is_refused(file, tmp_path):
    with pytest.raises(InputError, match="made with the detector bow, not none"):
        Slam.load(file, detector=create_detector("none", CONFIG))
    with pytest.raises(InputError, match=r"another image pyramid \(8 levels, scale factor 1\.2\)"):
        Slam.load(file, Config(orb=OrbConfig(n_levels=4)))
    header = header_of(file)
    header["detector"]["fingerprint"] = "0" * 16
    other = changed(file, tmp_path / "other.npz", header=as_header(header))
    with pytest.raises(InputError, match="another vocabulary or other weights of bow"):
        Slam.load(other)
    with np.load(file) as data:
        words = data["detector_words_values"].copy()
    words[3] = 10**7
    other = changed(file, tmp_path / "words.npz", detector_words_values=words)
    with pytest.raises(InputError, match=r"words.npz: the words of the keyframes do not belong"):
        Slam.load(other)


def test_an_empty_map_is_a_map(tmp_path):
    path = tmp_path / "empty.npz"
    Slam(CAMERA, threads=1).save(path)
    assert load_map(path).map.n_keyframes == 0
    with pytest.raises(InputError, match="no map to localise in"):
        Slam.load(path, localize=True)
