"""The networks that the capsule network is compared with: as their papers say, PCANet's PCA."""

from __future__ import annotations

import importlib.util
import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from siamese_worlds import small_settings, views
from sklearn.decomposition import PCA
from typer.testing import CliRunner

from vslam.cli.main import app
from vslam.cli.options import DetectorName
from vslam.cli.train import NetworkName, PresetName
from vslam.errors import InputError
from vslam.lab.loopbench.schema import Cost, Curve, LoopsJson, Score
from vslam.loopclosure.registry import DETECTORS
from vslam.loopclosure.siamese.inference import open_network
from vslam.loopclosure.siamese.weights import NETWORKS
from vslam.loopclosure.training.branches import CapsuleShape
from vslam.loopclosure.training.component_training import learn_components
from vslam.loopclosure.training.convolutional import (
    CONVOLUTIONAL,
    INCEPTIONS,
    Inception,
    alexnet,
    googlenet,
)
from vslam.loopclosure.training.export import HASHED_TOLERANCE, TOLERANCE, export_onnx
from vslam.loopclosure.training.initial_network import starting_network
from vslam.loopclosure.training.pcanet import COMPONENTS, FILTERS, KERNEL, PcaNetBranch
from vslam.loopclosure.training.pcanet import principal_filters as principal_filters_of
from vslam.loopclosure.training.preprocessing import standardised, to_tensor
from vslam.loopclosure.training.settings import PRESETS
from vslam.loopclosure.training.siamese import (
    ConcatenationHead,
    DistanceHead,
    build_network,
    load_network,
    save_network,
)

ROOT = Path(__file__).parents[1]


def script(path: str) -> ModuleType:
    """A script of tools/ as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def numbers(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def weights_only(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters() if p.ndim > 1)


# Parameters with a last layer for 1000 classes, in millions, and the shape of the last features of
# an image of 224 pixels (227 for AlexNet). Sources: Krizhevsky 2014 as in torchvision; Simonyan and
# Zisserman, Table 2 (138); Redmon and Farhadi, Table 6, counted by hand; Szegedy et al., Table 1
# (widths; its own column of parameters sums to less); Howard et al., Table 8 (4.2); the release of
# SqueezeNet 1.1 (1.24).
PAPERS = {
    "alexnet": (61.1, (256, 6, 6), 227),
    "vgg16": (138.4, (512, 7, 7), 224),
    "darknet19": (20.8, (1024, 7, 7), 224),
    "googlenet": (7.0, (1024, 7, 7), 224),
    "mobilenet": (4.2, (1024, 7, 7), 224),
    "squeezenet": (1.24, (512, 13, 13), 224),
}


@pytest.mark.parametrize("name", PAPERS)
def test_a_branch_has_the_parameters_and_shapes_of_its_paper(name):
    millions, shape, side = PAPERS[name]
    with torch.device("meta"):  # shapes without numbers: VGG16 takes seconds to draw
        branch = CONVOLUTIONAL[name]((side, side))
        features = branch.features(torch.empty(1, 3, side, side))
        descriptors = branch(torch.empty(2, 3, side, side))
    classes = 1000 * branch.width + 1000
    total = numbers(branch) - numbers(branch.descriptor) + classes
    assert round(total / 1e6, 2 if millions < 2 else 1) == millions
    assert features.shape == (1, *shape)
    assert descriptors.shape == (2, branch.dimensions) == (2, 1024)


def test_exact_counts_where_the_authors_release_is_known():
    """torchvision's AlexNet, VGG16 and SqueezeNet 1.1, of the same layers."""
    exact = {"alexnet": 61_100_840, "vgg16": 138_357_544, "squeezenet": 1_235_496}
    for name, wanted in exact.items():
        with torch.device("meta"):
            branch = CONVOLUTIONAL[name]((227, 227))
        assert (
            numbers(branch)
            - numbers(branch.descriptor)
            + 1001 * branch.width
            + (1000 - branch.width)
            == wanted
        )


def test_operations_are_those_that_the_papers_count():
    """Multiplications and additions of an image of 224 pixels, with the layer of 1000 classes.

    5.58 billion operations (YOLO9000, Table 6's caption), 569 million pairs of them (MobileNets,
    Table 8).
    """
    for name, counted, classified_at in (("darknet19", 5.58e9 / 2, 49), ("mobilenet", 569e6, 1)):
        with torch.device("meta"):
            branch = CONVOLUTIONAL[name]((224, 224))
            x, found = torch.empty(1, 3, 224, 224), classified_at * branch.width * 1000
            for layer in branch.features:
                x = layer(x)
                if isinstance(layer, torch.nn.Conv2d):
                    found += layer.weight.numel() * x.shape[2] * x.shape[3]
        assert found == pytest.approx(counted, rel=0.002)


def test_inceptions_are_those_of_table_1():
    """The depths of its output column are exact. Its parameters, in units of 1,024, agree roughly,
    because the table departs from its own widths by up to 7 %."""
    inputs, found, outputs = 192, [], []
    for widths in INCEPTIONS:
        if widths is not None:
            module = Inception(inputs, *widths)
            inputs = module.outputs
            outputs.append(inputs)
            found.append(weights_only(module) / 1024)
    assert outputs == [256, 480, 512, 512, 512, 528, 832, 832, 1024]
    table = [159, 380, 364, 437, 463, 580, 840, 1072, 1388]
    assert found == pytest.approx(table, rel=0.08)


def test_googlenet_halves_five_times():
    with torch.device("meta"):
        assert googlenet((97, 97)).features(torch.empty(1, 3, 97, 97)).shape == (1, 1024, 3, 3)


def test_images_that_are_too_small_are_refused():
    with pytest.raises(InputError, match=r"alexnet: needs images of at least 64 pixels"):
        alexnet((63, 227))


def test_principal_filters_are_those_of_scikit_learn():
    """PCANet subtracts from each patch its own mean, not the mean of all patches, which is zero for
    patches together with their negatives."""
    rng = np.random.default_rng(0)
    images = torch.from_numpy(rng.standard_normal((6, 1, 24, 31))).float().cumsum(3)
    filters = principal_filters_of(iter(images.split(4)))
    windows = np.lib.stride_tricks.sliding_window_view(images[:, 0].numpy(), (7, 7), (1, 2))
    patches = windows.reshape(-1, KERNEL**2).astype(np.float64)
    patches -= patches.mean(1, keepdims=True)
    wanted = PCA(FILTERS).fit(np.concatenate([patches, -patches])).components_
    found = filters.flatten(1).numpy()
    assert np.abs(np.abs((found * wanted).sum(1)) - 1).max() < 1e-4
    assert np.abs(found.sum(1)).max() < 1e-3
    assert (found.max(1) >= -found.min(1)).all()


def test_histograms_count_the_codes_of_each_block():
    torch.manual_seed(0)
    branch = PcaNetBranch((20, 24))
    branch.first.copy_(torch.randn_like(branch.first))
    branch.second.copy_(torch.randn_like(branch.second))
    images = to_tensor(views(1).images[:2, :20, :24])
    histograms = branch.histograms(images).view(2, FILTERS, 4, 4, 256)
    pad = KERNEL // 2
    grey = standardised(images[:, :1])
    first = torch.nn.functional.conv2d(grey, branch.first, padding=pad)
    second = torch.nn.functional.conv2d(first[1:, 3:4], branch.second, padding=pad)[0].numpy()
    codes = sum(2**k * (second[k] > 0) for k in range(FILTERS))
    block = codes[5:10, 12:18]  # second of four rows, third of four columns
    wanted = np.bincount(block.ravel(), minlength=256)
    assert histograms[1, 3, 1, 2].tolist() == wanted.tolist()
    assert histograms.sum((2, 3, 4)).unique().tolist() == [20 * 24]


@pytest.mark.slow
def test_descriptors_of_learned_images_are_white():
    branch = PcaNetBranch((64, 64))
    images = views(10).images
    branch.learn(images)
    d = branch(to_tensor(images)).double()
    assert d.shape == (20, COMPONENTS)
    covariance = (d.T @ d / len(d))[:19, :19]
    assert torch.allclose(covariance, torch.eye(19).double(), atol=0.02)
    assert not d[:, 19:].any()


@pytest.mark.slow
def test_pcanet_learns_without_gradients_and_knows_a_place_again(tmp_path):
    settings = small_settings(network="pcanet")
    outcome = learn_components(views(30), settings, tmp_path)
    assert outcome.finished
    assert outcome.figures["average_precision"] > 0.6  # of places it never saw
    network, _ = load_network(outcome.weights)
    assert network.size == (64, 64)
    assert network.n_parameters() == 2 * 8 * 49 + 32768 * (COMPONENTS + 1) + 2
    assert not any(p.requires_grad for p in network.branch.parameters())
    path = tmp_path / "pcanet.onnx"
    assert export_onnx(network, path) < HASHED_TOLERANCE
    assert open_network("pcanet", path).dimensions == COMPONENTS
    with pytest.raises(InputError, match="learns from images alone"):
        starting_network(settings, views(3), path, "cpu")


@pytest.mark.slow
def test_size_is_stored_with_the_weights_and_onnx_says_what_torch_says(tmp_path):
    """GoogLeNet: the one whose layers (paths side by side, responses normalised) others lack."""
    torch.manual_seed(0)
    network = build_network("googlenet", CapsuleShape(pixels=64, width=80)).eval()
    save_network(network, tmp_path / "w.safetensors", {})
    again, _ = load_network(tmp_path / "w.safetensors")
    assert again.size == (64, 80)
    x = to_tensor(np.random.default_rng(0).integers(0, 256, (2, 64, 80), np.uint8))
    with torch.no_grad():
        assert torch.equal(network.embed(x), again.embed(x))
    assert export_onnx(again, tmp_path / "w.onnx") < TOLERANCE
    assert open_network("googlenet", tmp_path / "w.onnx").size == (64, 80)


def test_alexnet_has_the_head_of_the_paper_unless_told_otherwise(tmp_path):
    shape = CapsuleShape(pixels=64)
    with torch.device("meta"):
        assert isinstance(build_network("alexnet", shape).head, ConcatenationHead)
        assert isinstance(build_network("vgg16", shape, "distance").head, DistanceHead)
        assert isinstance(build_network("googlenet", shape).head, DistanceHead)
    other = build_network("squeezenet", shape, "concatenation")
    save_network(other, tmp_path / "w.safetensors", {})
    assert isinstance(load_network(tmp_path / "w.safetensors")[0].head, ConcatenationHead)


def test_every_network_can_be_named_on_the_command_line():
    assert set(NetworkName.__args__) == set(NETWORKS)
    assert set(DetectorName.__args__) == set(DETECTORS)
    assert set(PresetName.__args__) == set(PRESETS)
    done = CliRunner().invoke(app, ["run", "--detector", "darknet19"])
    assert isinstance(done.exception, InputError)
    assert "vslam train darknet19" in str(done.exception)


@pytest.mark.slow
def test_the_script_plans_trains_and_goes_on(tmp_path, monkeypatch):
    tool = script("tools/training/train_rivals.py")
    seconds = {"capsule": 0.5, "capsule-pruned": 0.25, "vgg16": 3.0}
    monkeypatch.setattr(tool, "seconds_of_a_step", lambda name, *_: seconds[name])
    settings, file = small_settings(epochs=2), tmp_path / "plan.json"
    networks = ["capsule", "capsule-pruned", "pcanet"]
    jobs = tool.plan(file, settings, networks, 64, 0.1, "cpu")
    assert [(job.way, job.network) for job in jobs] == [
        ("images", "capsule"), ("images", "capsule-pruned"), ("minutes", "capsule"),
        ("minutes", "capsule-pruned"), ("images", "pcanet"),
    ]  # fmt: skip
    steps = 16 // settings.batch  # of an epoch that shows 32 images; the pruned one has one epoch
    assert [job.pairs for job in jobs] == [16, 16, 6 * settings.batch, 12 * settings.batch, 0]
    assert [job.core_seconds for job in jobs] == [2 * steps * 0.5, steps * 0.25, 6.0, 3.0, 0.0]
    seconds["capsule"] = 5.0  # what is planned stays, and what joins is added
    joined = tool.plan(file, settings, ["vgg16", "capsule"], 64, 0.0, "cpu")
    assert [(job.way, job.network, job.pairs) for job in joined] == [
        ("images", "vgg16", 16), ("images", "capsule", 16)
    ]  # fmt: skip
    assert joined[1] == jobs[0]
    assert tool.plan(file, settings, networks, 64, 0.1, "cpu") == jobs
    results = [tool.run(jobs[0], views(20), settings, tmp_path, "cpu")]
    assert results[0].images_shown == 64
    assert (tmp_path / results[0].weights).exists()
    tool.write_results(tmp_path / "rivals.csv", results)
    assert tool.read_results(tmp_path / "rivals.csv") == results
    tool.write_progress(tmp_path, results)
    head, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    assert head == "way,network,images_shown,loss,validation_ap"
    assert [row.split(",")[:3] for row in rows] == [
        ["images", "capsule", "32"], ["images", "capsule", "64"]
    ]  # fmt: skip
    assert float(rows[-1].split(",")[-1]) == results[0].ap_last


def test_a_folder_of_rivals_keeps_to_its_options(tmp_path, monkeypatch):
    tool = script("tools/training/train_rivals.py")
    monkeypatch.setattr(tool, "seconds_of_a_step", lambda *_: 0.5)
    words = ["--data", "photos:x", "--out", str(tmp_path), "--dry-run"]
    tool.main(words)
    tool.main(words)
    with pytest.raises(SystemExit, match=r"was made with --images 65536, not 999; name another"):
        tool.main([*words, "--images", "999"])
    for names, why in (("lsgd", "lsgd is none of"), ("capsule-pruned", "name that before it")):
        with pytest.raises(SystemExit, match=why):
            tool.main([*words, "--networks", names])


@pytest.mark.parametrize("option", ["--resume", "--epochs=2", "--pairs=8", "--max-minutes=1"])
def test_pcanet_refuses_options_of_epochs(option):
    done = CliRunner().invoke(app, ["train", "pcanet", "--data", "photos:x", option])
    assert isinstance(done.exception, InputError)
    assert str(done.exception).endswith(f"leave out {option.partition('=')[0]}.")


def loops_report(*detectors: str) -> LoopsJson:
    """Two sets of images; each figure is the number of the detector plus that of the set."""
    cells, conditions = [], ("none", "light:1", "viewpoint:1", "occlusion:1")
    for place, data in enumerate(("kitti00", "town")):
        for condition in conditions:
            for number, name in enumerate(detectors):
                value = 0.1 * number + 0.5 * place
                cells.append(Score(
                    data=data, condition=condition, detector=name,
                    figures={"average_precision": value, "precision_at_70_recall": value + 0.1},
                    accuracy={"0.5": None if name in ("bow", "lsgd") else value + 0.2}, queries=1,
                    first_right=1.0, verified={}, curve=Curve(precision=[], recall=[]),
                ))  # fmt: skip
    costs = [
        Cost(detector=name, load_s=1.0, image_ms=2.0, query_ms={"5000": 3.0}, parameters=4_000_000,
             memory_mb=5.0)
        for name in detectors
    ]  # fmt: skip
    return LoopsJson(
        seed=0, cells=cells, gains=[], costs=costs, machine="", versions={},
        created=datetime(2026, 1, 1, tzinfo=UTC),
    )  # fmt: skip


@pytest.mark.slow
def test_the_tables_of_the_page(tmp_path):
    tool = script("tools/experiments/rivals/rivals_table.py")
    names = {"images": ("capsule", "capsule-pruned", "pcanet"), "minutes": ("capsule", "pcanet"),
             "untrained": ("lsgd",), "shipped": ("bow", "capsule", "capsule-pruned")}  # fmt: skip
    for way, detectors in names.items():
        (tmp_path / "bench").mkdir(exist_ok=True)
        (tmp_path / "bench" / f"{way}.json").write_text(loops_report(*detectors).model_dump_json())
    (tmp_path / "rivals.csv").write_text(
        "way,network,images_shown,core_seconds,first_loss,last_loss,ap_before_last,ap_last,weights\n"
        "images,capsule,4096,90.0,2.5,1.5,0.4,0.5,images/c.onnx\n"
        "images,capsule-pruned,1024,30.0,1.5,1.5,0.4,0.4,images/q.onnx\n"
        "minutes,capsule,1024,60.0,2.5,1.5,0.4,0.5,minutes/c.onnx\n"
        "images,pcanet,1500,30.0,nan,nan,0.3,0.3,images/p.onnx\n"
    )
    for way in ("images", "minutes"):
        (tmp_path / way).mkdir()
        for file in "cqp":
            (tmp_path / way / f"{file}.onnx").write_text(f"{way} {file}")
    kept = {"images": [4.0, 2.0, 0.5], "shipped": [4.0, 3.0, 0.75]}
    (tmp_path / "bench" / "pruning.json").write_text(json.dumps(kept))
    page = tmp_path / "page.md"
    page.write_text("before <!-- tables --> old <!-- end of tables --> after")
    words = ["--trained", str(tmp_path), "--data", "x", "--page", str(page)]
    tool.main(words)
    text = page.read_text()
    assert text.startswith("before <!-- tables -->")
    assert text.endswith("<!-- end of tables --> after")
    assert " old " not in text
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    # Means of the two sets: 0.25 and 0.1 more for each further detector.
    assert ["pcanet", "0.550", "0.450", "0.350", "2.0", "3.0", "4.00"] in lines
    assert ["bow", "-", "0.350", "0.250", "2.0", "3.0", "4.00"] in lines
    assert ["FLCNN", "no definition found", *"-----"] in lines
    assert ["lsgd", "-", "0.350", "0.250", "2.0", "3.0", "4.00"] in lines
    assert lines.count(["vgg16", "not trained", *"-----"]) == 2
    assert ["pcanet", *["0.550, 0.450, 0.350"] * 4] in lines
    assert ["nothing", "pcanet", "1,500", "0.50", "-", "0.300, 0.300"] in lines
    # What it continues is added: 4,096 images and 90 s.
    assert ["images", "capsule-pruned", "5,120", "2.00", "1.50, 1.50", "0.400, 0.400"] in lines
    assert ["Same number of images shown", "4.00", "2.00", "50 %"] in lines
    for number, data in enumerate(("kitti00", "town")):
        assert f"recall on {data}" in text
        assert f"(page/precision_recall_{number}.png)" in text
        picture = (tmp_path / "page" / f"precision_recall_{number}.png").read_bytes()
        assert 10_000 < len(picture) < 150_000
    rows = (tmp_path / "page" / "conditions.csv").read_text().splitlines()
    assert "minutes,pcanet,town,light:1,0.8000,0.7000,0.6000,1.0000" in rows
    assert len(rows) == 1 + 9 * 4 * 2
    training = tool.read_training(tmp_path / "rivals.csv")
    assert tool.weights_of("minutes", training, Path("d")) == {
        "capsule": Path("d/minutes/c.onnx"), "pcanet": Path("d/images/p.onnx")
    }  # fmt: skip
    assert tool.weights_of("shipped", training, Path("d")) == dict.fromkeys(tool.SHIPPED)
    # A section of its own: the other one stays, the figure of validation joins.
    (tmp_path / "progress.csv").write_text(
        "way,network,images_shown,loss,validation_ap\n"
        "images,capsule,2048,2.5,0.4\nimages,capsule,4096,1.5,0.5\n"
    )
    words += ["--section", "longer", "--ways", "images"]
    with pytest.raises(SystemExit, match="has no marks <!-- longer --> and <!-- end of longer"):
        tool.main(words)
    page.write_text(f"{text}\n<!-- longer --><!-- end of longer -->")
    tool.main(words)
    assert page.read_text().startswith(text)
    added = page.read_text().removeprefix(text)
    assert "(page/longer/precision_recall_1.png)" in added
    assert "(page/longer/progress.png)" in added
    assert tool.WAYS["minutes"] not in added
    assert tool.WAYS["shipped"] not in added
    assert (tmp_path / "page" / "longer" / "progress.csv").read_text().endswith("1.5,0.5\n")
    with pytest.raises(SystemExit, match="--ways: hours is none of images, minutes"):
        tool.main([*words, "--ways", "hours"])
    (tmp_path / "images" / "c.onnx").write_text("trained again")
    with pytest.raises(
        SystemExit, match=r"bench: was made with weights of images/capsule \w+, not"
    ):
        tool.main(words)
