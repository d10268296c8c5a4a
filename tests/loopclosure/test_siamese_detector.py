"""The plug-in that makes a Siamese network a loop detector, with its commands and its export."""

from __future__ import annotations

import functools
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper
from siamese_worlds import small_network, small_settings, views
from typer.testing import CliRunner

from vslam.cli.main import every_command
from vslam.config import Config, SiameseConfig
from vslam.loopclosure.reach import beyond_reach, within_reach
from vslam.loopclosure.registry import detector_with_images
from vslam.loopclosure.siamese.detector import SiameseDetector, open_detector
from vslam.loopclosure.siamese.inference import LateNetwork, OnnxNetwork, open_network
from vslam.loopclosure.siamese.local_descriptors import KeyframeImages, LocalDescriptors
from vslam.loopclosure.siamese.weights import SHIPPED
from vslam.loopclosure.verifier import Verifier
from vslam.method.closing import LoopClosing
from vslam.slam import Slam
from vslam.support.errors import InputError, ResultsError
from vslam.types.camera import Camera
from vslam.types.context import Context
from vslam.types.features import Features
from vslam.types.loops import LastSeen
from vslam.types.map import PREDICTED, UNPREDICTED, Map
from vslam.types.map_kernels import link
from vslam_lab.loopbench.detectors import NetworkScorer
from vslam_lab.training import export
from vslam_lab.training.export import (
    SIMILARITY_TOLERANCE,
    TOLERANCE,
    export_onnx,
    to_onnx,
    write_onnx,
)
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.siamese import for_inference, load_network


def features(n: int) -> Features:
    return Features(
        xy=np.zeros((n, 2), np.float32),
        octave=np.zeros(n, np.uint8),
        angle=np.zeros(n, np.float32),
        descriptors=np.zeros((n, 32), np.uint8),
        u_right=np.full(n, np.nan, np.float32),
    )


def a_map(keyframes: int, covisible: tuple[tuple[int, int], ...] = ()) -> Map:
    """Make a map of keyframes with 20 features. The keyframes of a pair share 16 landmarks."""
    map_ = Map(np.ones(8))
    for k in range(keyframes):
        map_.add_keyframe(features(100), np.eye(4), float(k), k)
    used = [0] * keyframes
    for pair in covisible:
        ids = map_.add_landmarks(np.zeros((16, 3)), np.zeros((16, 4), np.uint64), pair[0])
        for k in pair:
            for landmark in ids:
                link(map_.arrays, map_.rows(k).start + used[k], landmark)
                used[k] += 1
    return map_


SCENES = views(100).images[::2]
# Textures, which are unlike the training data.
WALLS = [
    cv2.resize(np.random.default_rng(k).integers(0, 256, (9, 13), np.uint8), (620, 188))
    for k in range(14)
]


@functools.cache
def exported() -> OnnxNetwork:
    """The small network in the form in which a run uses it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "capsule.onnx"
        export_onnx(small_network(), path)
        return OnnxNetwork(path)


def detector(config: SiameseConfig | None = None, places: list[int] | None = None):
    """Make a detector with one image for each keyframe, from the scenes in ``places``."""
    config = config or SiameseConfig(recent_keyframes=3, threshold=0.0)
    found = SiameseDetector(exported(), config)
    for keyframe, place in enumerate(places or []):
        found.add(keyframe, SCENES[place], Features.none())
    return found


@pytest.mark.slow
def test_the_same_image_is_the_best_match():
    places = list(range(90))
    places[80] = 12
    found = detector(places=places).query(80, a_map(90))
    assert (found[0].query, found[0].match) == (80, 12)
    assert len(found) == 5
    scores = [candidate.score for candidate in found]
    assert scores == sorted(scores, reverse=True)
    assert min(scores) > 0
    assert max(scores) < 1


@pytest.mark.slow
def test_recent_covisible_culled_and_unseen_keyframes_are_not_asked():
    places = [0] * 12
    one = detector(places=places)
    one.add(12, None, Features.none())
    one.add(13, SCENES[0], Features.none())
    map_ = a_map(14, covisible=((13, 2),))
    map_.arrays.keyframe_alive[5] = False
    matches = {candidate.match for candidate in one.query(13, map_)}
    assert matches <= {0, 1, 3, 4, 6, 7, 8, 9}
    assert one.query(12, map_) == []
    assert one.query(1, map_) == []


@pytest.mark.slow
def test_neighbours_of_a_candidate_do_not_crowd_out_other_places():
    places = [7, 7, 7, 7, 20, 21, 22, 23, 7]
    config = SiameseConfig(recent_keyframes=1, threshold=0.0, max_candidates=2)
    map_ = a_map(9, covisible=((0, 1), (0, 2), (0, 3)))
    matches = [c.match for c in detector(config, places).query(8, map_)]
    assert matches[0] == 0
    assert matches[1] in (4, 5, 6)


@pytest.mark.slow
def test_the_threshold_holds_for_loops_and_not_for_relocalisation():
    one = detector(SiameseConfig(recent_keyframes=0, threshold=1.0), list(range(6)))
    map_ = a_map(6)
    assert one.query(5, map_) == []
    found = one.locate(SCENES[3], Features.none(), map_)
    assert (found[0].query, found[0].match) == (-1, 3)
    assert one.locate(None, Features.none(), map_) == []


@pytest.mark.slow
def test_detectors_are_opened_by_name(tmp_path):
    path = tmp_path / "capsule.onnx"
    export_onnx(small_network(), path)
    assert open_detector("capsule", SiameseConfig(), path).name == "capsule"
    with pytest.raises(InputError, match="weights of capsule, not of capsule-pruned"):
        open_detector("capsule-pruned", SiameseConfig(), path)
    with pytest.raises(InputError, match="unknown; choose one of"):
        open_detector("bow", SiameseConfig())
    with pytest.raises(InputError, match="vslam export onnx --weights"):
        open_detector("capsule", SiameseConfig(), SHIPPED / "capsule.safetensors")


@pytest.mark.slow
def test_files_that_are_no_network_are_told_in_a_sentence(tmp_path):
    missing, damaged = tmp_path / "missing.onnx", tmp_path / "damaged.onnx"
    with pytest.raises(InputError, match=r"missing\.onnx: no such file"):
        open_network("capsule", missing)
    export_onnx(small_network(), damaged)
    damaged.write_bytes(damaged.read_bytes()[:5000])
    with pytest.raises(InputError, match="not a readable ONNX file"):
        open_network("capsule", damaged)
    for name, inputs in (("foreign", ["x"]), ("unlabelled", ["image"])):
        foreign = to_onnx(torch.nn.Flatten(), (torch.zeros(8, 8),), inputs, ["y"])
        write_onnx(foreign, tmp_path / f"{name}.onnx", {})
        with pytest.raises(InputError, match="write one with 'vslam export onnx'"):
            open_network("capsule", tmp_path / f"{name}.onnx")


def test_without_onnxruntime_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="pip install onnxruntime"):
        open_network("capsule")


@pytest.mark.slow
def test_a_late_network_is_loaded_by_the_first_image_and_missed_before(monkeypatch):
    script = (
        "import sys\n"
        "import numpy as np\n"
        "from vslam.config import Config\n"
        "from vslam.types.features import Features\n"
        "from vslam.loopclosure.registry import create_detector, create_images\n"
        "images = create_images('capsule', Config())\n"
        "detector = create_detector('capsule', Config(), None, images, on_demand=True)\n"
        "image = np.zeros((188, 620), np.uint8)\n"
        "detector.add(0, image, Features.none())\n"
        "images.add(0, image)\n"
        "detector.restore(detector.memory())\n"
        "sys.stdout.write(str('onnxruntime' in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd="/")
    assert (done.returncode, done.stdout) == (0, "False"), done.stderr
    late, loaded = LateNetwork("capsule"), open_network("capsule")
    assert late.fingerprint == loaded.fingerprint
    assert (late.size, late.dimensions) == (loaded.size, loaded.dimensions)
    image = cv2.resize(SCENES[0], loaded.size[::-1])
    descriptor = loaded.embed(image)
    assert np.array_equal(late.embed(image), descriptor)
    assert late.compare(descriptor, descriptor[None]) == loaded.compare(
        descriptor, descriptor[None]
    )
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match="pip install onnxruntime"):
        LateNetwork("capsule")


class CountingNetwork:
    """The network of ``exported()``. ``seen`` counts the images that it was given."""

    def __init__(self) -> None:
        self.seen = 0

    def __getattr__(self, name: str) -> object:
        return getattr(exported(), name)

    def embed(self, image: np.ndarray) -> np.ndarray:
        self.seen += 1
        return exported().embed(image)


def driven(x: list[float], *, stereo: bool = True) -> Map:
    """Make a map whose keyframes have the given positions along x, in metres."""
    map_ = a_map(len(x))
    map_.arrays.u_right[: map_.n_rows] = 1.0 if stereo else np.nan
    map_.arrays.T_cw[: len(x), 0, 3] = [-one for one in x]
    return map_


def test_reach_grows_with_the_way_and_knows_nothing_of_lost_cameras_and_units():
    config = SiameseConfig(reach=20.0, reach_share=0.1, monocular_reach_share=0.5)
    x = [0.0, 100.0, 200.0, 100.0, 30.0]  # there and back
    beyond = beyond_reach(driven(x), 4, config)
    np.testing.assert_allclose(
        beyond, [30 - 20 - 37, 70 - 20 - 27, 170 - 20 - 17, 70 - 20 - 7, -20]
    )
    np.testing.assert_allclose(  # in the arbitrary unit of the map
        beyond_reach(driven(x, stereo=False), 4, config),
        [30 - 185, 70 - 135, 170 - 85, 70 - 35, 0],
    )
    lost = driven(x)
    lost.keyframes.restart[3] = PREDICTED
    lost.parents[:] = [0, 0, 1, 2, 3]
    assert (beyond_reach(lost, 4, config)[:3] == 0).all()
    assert beyond_reach(lost, 4, config)[3] == pytest.approx(70 - 20 - 7)


def test_a_lost_camera_reaches_more_the_longer_it_is_lost():
    config = SiameseConfig(reach=20.0, reach_share=0.1, reach_speedup=2.0)
    x = [0.0, 100.0, 200.0, 300.0]  # at 10 m/s
    map_ = driven(x)
    map_.timestamps[:] = [0.0, 10.0, 20.0, 30.0]

    def reached(seconds: float) -> list[bool]:
        return within_reach(map_, LastSeen(3, seconds), config).tolist()

    assert reached(0.1) == [False, False, False, True]
    # The limits are 30, 40 and 50 m without motion.
    assert reached(3.4) == [False, False, False, True]
    assert reached(3.6) == [False, False, True, True]
    assert reached(12.6) == [True, True, True, True]
    map_.keyframes.restart[3] = PREDICTED  # the camera was lost for 10 s before keyframe 3
    map_.parents[:] = [0, 0, 1, 2]
    assert reached(0.1) == [False, True, True, True]
    map_.keyframes.restart[3] = UNPREDICTED
    assert reached(0.1) == [True, True, True, True]
    map_.keyframes.restart[3] = 0
    map_.keyframes.session[2:] = 1  # other drives have their own clocks
    map_.timestamps[2:] = [0.0, 10.0]
    assert reached(0.1) == [True, True, False, True]


def test_a_lost_monocular_camera_may_be_in_any_submap():
    map_ = driven([0.0, 100.0, 200.0, 300.0], stereo=False)
    map_.timestamps[:] = [0.0, 10.0, 20.0, 30.0]
    config = SiameseConfig(monocular_reach_share=0.5)
    assert within_reach(map_, LastSeen(3, 0.1), config).tolist() == [False, False, False, True]
    map_.keyframes.restart[2] = PREDICTED
    map_.parents[:] = [0, 0, 1, 2]
    assert within_reach(map_, LastSeen(3, 0.1), config).tolist() == [True, True, False, True]


def test_a_keyframe_that_looks_another_way_is_out_of_reach_if_the_way_between_is_known():
    map_ = driven([0.0, 1.0, 2.0, 3.0])
    for keyframe, degrees in enumerate([-70.0, 50.0, 180.0]):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        map_.arrays.T_cw[keyframe, :3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    map_.arrays.T_cw[:3, :3, 3] = 0.0  # all at one place
    beyond = beyond_reach(map_, 3, SiameseConfig(reach_angle=60.0))
    assert (beyond > 0).tolist() == [True, False, True, False]
    map_.keyframes.restart[3] = PREDICTED
    map_.parents[:] = [0, 0, 1, 2]
    assert (beyond_reach(map_, 3, SiameseConfig())[:3] == 0).all()


def test_the_network_sees_nothing_until_the_camera_may_be_back():
    network = CountingNetwork()
    images = KeyframeImages(LocalDescriptors())
    config = SiameseConfig(
        recent_keyframes=3, offered=0.0, embedded_at_once=2, reach=20.0, reach_share=0.1
    )
    one = SiameseDetector(network, config, images=images)
    x = [50.0 * k for k in range(10)] + [0.0]
    map_ = driven(x)
    for keyframe in range(11):
        image = SCENES[keyframe % 10]
        one.add(keyframe, image, Features.none())
        images.add(keyframe, image)
    assert one.query(9, map_) == []
    assert network.seen == 0
    # At the start again, the limit is 20 m and a tenth of 900 m. The two nearest are compared.
    assert {found.match for found in one.query(10, map_)} == {0, 1}
    assert network.seen == 3
    assert {found.match for found in one.query(10, map_)} <= {0, 1, 2}
    assert network.seen == 4
    # A lost frame may be anywhere, so that each keyframe is compared once.
    assert one.locate(SCENES[5], Features.none(), map_)[0].match == 5
    assert network.seen == 4 + 7 + 1
    one.locate(SCENES[6], Features.none(), map_)
    assert network.seen == 4 + 7 + 2
    restored = SiameseDetector(network, config, images=images)
    restored.restore(one.memory())
    assert restored.query(10, map_) == one.query(10, map_)


def test_in_real_time_a_lost_frame_waits_only_for_its_own_descriptor():
    network, images = CountingNetwork(), KeyframeImages(LocalDescriptors())
    one = SiameseDetector(network, SiameseConfig(), images=images, on_demand=False)
    later = SiameseDetector(CountingNetwork(), SiameseConfig(), images=images)
    map_ = driven([50.0 * k for k in range(5)])
    for keyframe in range(5):
        for detector in (one, later):
            detector.add(keyframe, SCENES[keyframe], Features.none())
        images.add(keyframe, SCENES[keyframe])
        one.query(keyframe, map_)
    assert network.seen == 5
    found = one.locate(SCENES[3], Features.none(), map_)
    assert network.seen == 5 + 1
    assert found == later.locate(SCENES[3], Features.none(), map_)


@pytest.mark.slow
def test_a_run_takes_the_weights_of_a_file(kitti_tree, tmp_path):
    """With random weights, many wrong places are similar. Geometric verification rejects them."""
    path = tmp_path / "capsule.onnx"
    export_onnx(small_network(), path)
    settings = tmp_path / "config.json"
    settings.write_text(Config(siamese=SiameseConfig(threshold=0.0)).model_dump_json())
    words = ["run", "--data", str(kitti_tree), "--detector", "capsule", "--weights", str(path)]
    words += ["--config", str(settings), "--no-record", "--quiet", "--out", str(tmp_path)]
    done = CliRunner().invoke(every_command(), words)
    assert done.exit_code == 0, done.output
    report = json.loads((tmp_path / "latest" / "report.json").read_text())
    assert (report["detector"], report["weights"]) == ("capsule", str(path))
    assert report["lost_frames"] == report["loops_wrong"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["capsule", "capsule-pruned", "capsule-paper"])
def test_onnx_says_what_torch_says(name):
    torch_network = for_inference(load_network(SHIPPED / f"{name}.safetensors")[0])
    network = open_network(name)
    assert (network.size, network.dimensions) == (torch_network.size, torch_network.dimensions)
    images = np.random.default_rng(1).integers(0, 256, (5, *network.size), np.uint8)
    images[1] = cv2.GaussianBlur(images[1], (0, 0), 3.0)
    images[2] = 0
    descriptors = np.stack([network.embed(image) for image in images])
    expected = torch_network.embed(to_tensor(images))
    # The blurred image has little contrast. Normalisation to a deviation of 1 magnifies rounding.
    assert np.abs(descriptors - expected.numpy()).max() < 2 * TOLERANCE
    alike = torch_network.compare(expected[0], expected).numpy()
    alike_here = network.compare(descriptors[0], descriptors)
    assert np.abs(alike_here - alike).max() < SIMILARITY_TOLERANCE


@pytest.mark.parametrize("differs", ["itself", "others"])
def test_export_compares_different_images(tmp_path, monkeypatch, differs):
    """At distance 0, the square root magnifies rounding, which is no fault of the export."""

    class Rounding(OnnxNetwork):
        def compare(self, query, gallery):
            itself = (gallery == query).all(1)
            return super().compare(query, gallery) + 0.1 * (itself == (differs == "itself"))

    monkeypatch.setattr(export, "OnnxNetwork", Rounding)
    path = tmp_path / "capsule.onnx"
    if differs == "itself":
        export_onnx(small_network(), path)
    else:
        with pytest.raises(ResultsError, match=r"similarities by 1\.0e-01"):
            export_onnx(small_network(), path)
    assert path.exists() == (differs == "itself")


@pytest.mark.slow
def test_train_writes_weights_and_card(tmp_path):
    data = tmp_path / "pairs"
    (data / "images").mkdir(parents=True)
    rows = ["a,b,same"]
    squares = views(40).images
    for k in range(40):
        same = k % 2 == 0
        names = [f"images/{k}a.png", f"images/{k}b.png"]
        cv2.imwrite(str(data / names[0]), squares[2 * k])
        cv2.imwrite(str(data / names[1]), squares[2 * k + 1 if same else 2 * k - 1])
        rows.append(f"{names[0]},{names[1]},{int(same)}")
    (data / "pairs.csv").write_text("\n".join(rows) + "\n")
    settings = tmp_path / "settings.json"
    settings.write_text(small_settings(epochs=1, seed=3).model_dump_json())
    out = tmp_path / "out"
    command = ["train", "capsule", "--data", f"pairs:{data}", "--settings", str(settings)]
    done = CliRunner().invoke(every_command(), [*command, "--out", str(out), "--threads", "1"])
    assert done.exit_code == 0, done.output
    assert "average_precision" in done.stdout
    files = {path.name for path in out.iterdir()}
    assert files >= {"capsule.safetensors", "capsule.onnx", "capsule.json", "capsule.md",
                     "log.csv", "checkpoint.pt", "settings.json", "pairs"}  # fmt: skip
    assert json.loads((out / "capsule.json").read_text())["seed"] == 3  # the seed of the settings
    full, shipped = out / "capsule.safetensors", tmp_path / "ship" / "capsule.safetensors"
    # Without settings, training uses the image size of the weights.
    command = ["train", "capsule-pruned", "--data", f"pairs:{data}", "--weights", str(full)]
    command += ["--pairs", "16", "--epochs", "1", "--out", str(tmp_path / "p"), "--threads", "1"]
    done = CliRunner().invoke(every_command(), command)
    assert done.exit_code == 0, done.output
    assert load_network(tmp_path / "p" / "capsule-pruned.safetensors")[0].size == (64, 64)
    done = CliRunner().invoke(
        every_command(), ["export", "weights", "--weights", str(full), "--out", str(shipped)]
    )
    assert done.exit_code == 0, done.output
    assert shipped.stat().st_size < 0.6 * full.stat().st_size
    assert {path.name for path in shipped.parent.iterdir()} == {
        "capsule.safetensors", "capsule.onnx", "capsule.json", "capsule.md"
    }  # fmt: skip
    x = torch.rand(2, 3, 64, 64)
    with torch.no_grad():
        a, b = (load_network(path)[0].eval().embed(x) for path in (full, shipped))
    assert torch.allclose(a, b, atol=2e-2)


def test_train_refuses_a_file_as_its_folder_before_it_reads_images(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    command = ["train", "capsule", "--data", "pairs:nowhere", "--out", str(file)]
    done = CliRunner().invoke(every_command(), command)
    assert "notes.txt: cannot be written (Not a directory); give another" in str(done.exception)


@pytest.mark.parametrize("name", ["capsule", "capsule-pruned", "capsule-paper"])
def test_shipped_weights_know_a_place_again(name):
    """The images are moved and darker, but show the same place."""
    about = open_network(name).about
    assert about["validation"]["average_precision"] > 0.4
    again = [np.uint8(np.roll(wall, 12, 1) * 0.7) for wall in WALLS]
    network = NetworkScorer(name)
    gallery = network.embed(WALLS)
    p = np.stack([network.compare(one, gallery) for one in network.embed(again)])
    assert network.parameters < 3e6
    assert (p.argmax(1) == np.arange(len(WALLS))).mean() > 0.8
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 14e6


@pytest.mark.slow
def test_no_run_loads_torch():
    script = (
        "import sys\nimport numpy as np\nimport vslam.cli.main, vslam.run.pipeline\n"
        "from vslam.config import Config\nfrom vslam.types.features import Features\n"
        "from vslam.loopclosure.registry import create_detector\n"
        "detector = create_detector('capsule', Config())\n"
        "detector.add(0, np.zeros((188, 620), np.uint8), Features.none())\n"
        "sys.stdout.write(' '.join({'torch', 'onnx', 'safetensors'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd="/")
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_the_paper_s_detector_compares_with_all_keyframes_and_verifies_by_orb():
    config = Config()
    detector, images = detector_with_images("capsule-paper", config)
    assert images is None  # local descriptors neither rerank nor verify
    camera = Camera(400.0, 400.0, 310.0, 94.0, 0.5, 620, 188)
    context = Context.create(camera, config)
    closing = LoopClosing(detector, Verifier(context, images), context, threads=1)
    # According to odometry, the last keyframe is 700 m from the first one, but shows its place.
    map_ = driven([50.0 * k for k in range(15)])
    for keyframe, place in enumerate([*range(14), 0]):
        image = WALLS[place] if keyframe < 14 else np.uint8(np.roll(WALLS[place], 12, 1) * 0.7)
        closing.process(map_, keyframe, features(100), image)
    best = max((edge for edge in closing.edges if edge.query == 14), key=lambda edge: edge.score)
    assert best.match == 0
    assert best.score >= config.siamese.threshold == 0.9
    assert {edge.matched_by for edge in closing.edges} == {"orb"}


@pytest.mark.parametrize("realtime", [True, False])
def test_in_real_time_a_keyframe_is_described_when_it_is_made(realtime):
    slam = Slam(Camera(400.0, 400.0, 310.0, 94.0, 0.5, 620, 188), {}, "capsule", realtime=realtime)
    map_ = driven([50.0 * k for k in range(3)])
    closing = slam._session.closing
    for keyframe in range(3):
        closing.process(map_, keyframe, features(100), WALLS[keyframe])
    stored = [keyframe for keyframe in range(3) if keyframe in closing.verifier.images]
    described = slam.detector.memory().tables["descriptors"]
    assert np.flatnonzero(np.diff(described.first)).tolist() == (stored if realtime else [])


def graph_of(
    nodes: list[onnx.NodeProto],
    weights: list[onnx.TensorProto],
    shape: tuple[int, ...] = (8, 8),
    **more: object,
) -> bytes:
    image = helper.make_tensor_value_info("image", TensorProto.UINT8, shape)
    result = helper.make_tensor_value_info("descriptor", TensorProto.UINT8, None)
    graph = helper.make_graph(nodes, "g", [image], [result], weights, **more)
    opsets = [helper.make_opsetid("", 20)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=9).SerializeToString()


def number(name: str, *values: int) -> onnx.TensorProto:
    return helper.make_tensor(name, TensorProto.INT64, [len(values)], values)


def endless() -> bytes:
    """Make a loop that never ends, because it continues while a constant is true."""
    outputs = [
        helper.make_tensor_value_info("still", TensorProto.BOOL, []),
        helper.make_tensor_value_info("kept", TensorProto.UINT8, [8, 8]),
    ]
    inputs = [
        helper.make_tensor_value_info("turn", TensorProto.INT64, []),
        helper.make_tensor_value_info("on", TensorProto.BOOL, []),
        helper.make_tensor_value_info("now", TensorProto.UINT8, [8, 8]),
    ]
    copies = [
        helper.make_node("Identity", ["on"], ["still"]),
        helper.make_node("Identity", ["now"], ["kept"]),
    ]
    body = helper.make_graph(copies, "body", inputs, outputs)
    loop = helper.make_node("Loop", ["", "true", "image"], ["descriptor"], body=body)
    return graph_of([loop], [helper.make_tensor("true", TensorProto.BOOL, [], [True])])


def promised() -> bytes:
    """Make a network that names weights that are not in the file."""
    weights = TensorProto(name="w", data_type=TensorProto.UINT8, dims=[2**16, 2**16])
    return graph_of([helper.make_node("Add", ["image", "w"], ["descriptor"])], [weights])


def squares() -> bytes:
    """Make a chain of products of an image with itself. The image may have any size."""
    cast = helper.make_node("Cast", ["image"], ["x0"], to=TensorProto.FLOAT)
    nodes = [cast, *(helper.make_node("MatMul", [f"x{k}"] * 2, [f"x{k + 1}"]) for k in range(5000))]
    nodes.append(helper.make_node("Cast", ["x5000"], ["descriptor"], to=TensorProto.UINT8))
    return graph_of(nodes, [], ("H", "W"))


HUGE = helper.make_node("Expand", ["image", "shape"], ["descriptor"])
UNKNOWN = [
    helper.make_node("Cast", ["image"], ["shape"], to=TensorProto.INT64),
    helper.make_node("Expand", ["image", "shape"], ["descriptor"]),
]


@pytest.mark.parametrize(
    ("file", "says"),
    [
        (endless(), "vslam does not use the operator 'Loop'"),
        (graph_of([HUGE], [number("shape", 2**27, 8, 8)]), "it computes 8.6e+09 numbers"),
        (squares(), "numbers and 6.7e+11 products"),
        (graph_of(UNKNOWN, [], (2,)), "the sizes of its tensors are unknown"),
        (promised(), "it does not contain its weights"),
    ],
    ids=["endless", "huge", "slow", "unknown", "promised"],
)
def test_a_foreign_graph_is_refused_before_it_runs(tmp_path, file: bytes, says: str):
    assert len(file) < 200_000
    (tmp_path / "a.onnx").write_bytes(file)
    with pytest.raises(InputError, match=re.escape(says)):
        OnnxNetwork(tmp_path / "a.onnx")


@pytest.mark.slow
def test_metadata_that_say_something_else_are_told_in_a_sentence(tmp_path):
    written = tmp_path / "capsule.onnx"
    export_onnx(small_network(), written)
    OnnxNetwork(written)
    model = onnx.load(written)
    metadata = {one.key: one.value for one in model.metadata_props}
    for key, value in [
        ("about", "{"), ("about", "[]"), ("about", "{}"), ("comparison", "no base64!"),
        ("name", None), ("about", None), ("comparison", None),
    ]:  # fmt: skip
        changed = {k: v for k, v in {**metadata, key: value}.items() if v is not None}
        helper.set_model_props(model, changed)
        (tmp_path / "a.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(InputError, match="not a network of this version of vslam"):
            OnnxNetwork(tmp_path / "a.onnx")
