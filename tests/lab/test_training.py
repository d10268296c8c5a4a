"""Training reduces the loss, resumes exactly after an interruption, and stops when it must."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from siamese_worlds import SMALL, small_network, small_settings, views

from vslam.support.errors import InputError, ResultsError
from vslam_lab.precision_recall import average_precision, precision_recall
from vslam_lab.training import training
from vslam_lab.training.augmentation import STRONG, Augmentation, augment
from vslam_lab.training.branches import Layout
from vslam_lab.training.checkpoint import CHECKPOINT
from vslam_lab.training.data import draw_pairs
from vslam_lab.training.initial_network import resized, starting_network
from vslam_lab.training.model_card import describe, write_card
from vslam_lab.training.objective import (
    calibrate,
    contrast,
    cross_entropy,
    embed_all,
    score_matrix,
)
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.pruning import lowest, pruned
from vslam_lab.training.settings import PRESETS, load_settings
from vslam_lab.training.siamese import load_network, save_network
from vslam_lab.training.training import train


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
def test_a_share_of_what_was_learned_is_kept(tmp_path):
    collection = views(20)
    before, settings = small_network(1).state_dict(), small_settings(learned_share=0.25, epochs=1)
    whole = settings.model_copy(update={"learned_share": 1.0})
    for name, each in (("whole", whole), ("share", settings)):
        train(collection, each, tmp_path / name, start=small_network(1), threads=1)
    # The decision is made once, after the end.
    for _ in range(2):
        train(
            collection, settings, tmp_path / "whole", start=small_network(1), threads=1, resume=True
        )
    after, later = (
        load_network(tmp_path / name / "capsule.safetensors")[0].state_dict()
        for name in ("share", "whole")
    )
    trained = torch.load(tmp_path / "share" / CHECKPOINT, weights_only=True)["network"]
    assert all(torch.equal(after[key], later[key]) for key in after if "head" not in key)
    W = "branch.capsules.W"
    kept, learned = after[W] - before[W], trained[W] - before[W]
    assert learned.abs().max() > 1e-3
    assert torch.allclose(kept, 0.25 * learned, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"learned_share": 0.5}, "needs a network to start from"),
        ({"emphasis": {"bulbs": 3.0}}, "there is no source bulbs; choose from blobs"),
    ],
)
def test_settings_that_would_do_nothing_are_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        train(views(8), small_settings(**changes), tmp_path, threads=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("loss", "epochs", "mixed"),
    [("bce", 14, False), ("bce+contrast", 12, False), ("bce+contrast", 12, True)],
)
def test_64_pairs_are_learned_by_heart(tmp_path, loss, epochs, mixed):
    collection = views(46)
    settings = small_settings(
        epochs=epochs, pairs=64, batch=32, loss=loss, patience=99, learning_rate=5e-3,
        mixed_precision=mixed,
    )  # fmt: skip
    outcome = train(collection, settings, tmp_path, threads=1)
    assert len(outcome.train) == 64
    network, _ = load_network(outcome.weights)
    cpu = torch.device("cpu")
    d = embed_all(network, collection.images, cpu)
    score = score_matrix(network, d, d, cpu)
    pairs = draw_pairs(collection, outcome.train, 64, np.random.default_rng(0))
    assert pairs.same.sum() == 32
    learned = precision_recall(pairs.same, score[pairs.a, pairs.b])
    assert average_precision(learned) == 1.0
    assert outcome.figures["average_precision"] > 0.9  # on places that are not in the training data


@pytest.mark.slow
@pytest.mark.parametrize("mixed", [True, False, None])
def test_mixed_precision_is_what_the_settings_say(tmp_path, mixed):
    start, computed_in = small_network(1), []
    start.branch.primary.register_forward_hook(
        lambda module, images, capsules: computed_in.append((module.training, capsules.dtype))
    )
    settings = small_settings(epochs=1, mixed_precision=mixed)
    train(views(20), settings, tmp_path, threads=1, start=start)
    expected = torch.bfloat16 if mixed else torch.float32
    assert {dtype for learning, dtype in computed_in if learning} == {expected}
    assert {dtype for learning, dtype in computed_in if not learning} == {torch.float32}


def test_a_gpu_without_bfloat16_is_not_asked_for_it(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: False)
    cuda = torch.device("cuda")
    assert training._mixed_precision(small_settings(), cuda) is False
    with pytest.raises(InputError, match="does not support bfloat16"):
        training._mixed_precision(small_settings(mixed_precision=True), cuda)


@pytest.mark.slow
def test_a_resumed_training_has_the_bits_of_an_uninterrupted_one(tmp_path):
    collection, settings = views(20), small_settings()
    whole = train(collection, settings, tmp_path / "whole", threads=1)
    steps = []

    def killed_in_the_middle() -> bool:
        steps.append(1)
        return len(steps) in (1, 3)  # in the first epoch, and in the second one after resuming

    parts = tmp_path / "parts"
    for finished in (False, False, True):
        part = train(
            collection, settings, parts, threads=2, resume=True, should_stop=killed_in_the_middle
        )
        assert part.finished is finished
    one, other = (
        torch.load(folder / CHECKPOINT, weights_only=True) for folder in (tmp_path / "whole", parts)
    )
    for name, tensor in one["network"].items():
        assert torch.equal(tensor, other["network"][name]), name
    timeless = [
        [{k: v for k, v in row.items() if k != "seconds"} for row in outcome.progress.history]
        for outcome in (whole, part)
    ]
    assert timeless[0] == timeless[1]
    assert whole.figures == part.figures
    lists = [sorted((tmp_path / name / "pairs").iterdir()) for name in ("whole", "parts")]
    assert [p.read_bytes() for p in lists[0]] == [p.read_bytes() for p in lists[1]]
    assert lists[0][0].read_text().startswith("# seed 0\na,b,same\n")


@pytest.mark.slow
def test_a_loss_that_is_not_finite_stops_and_keeps_the_last_good_checkpoint(tmp_path, monkeypatch):
    collection, settings = views(20), small_settings(epochs=3)
    calls = []

    def sometimes_nan(logits: torch.Tensor, same: torch.Tensor) -> torch.Tensor:
        calls.append(1)
        loss = cross_entropy(logits, same)
        return loss * float("nan") if len(calls) == 4 else loss

    monkeypatch.setattr(training, "cross_entropy", sometimes_nan)
    with pytest.raises(ResultsError, match=r"the loss is nan in epoch 1, step 1; the last good"):
        train(collection, settings, tmp_path, threads=1)
    kept = torch.load(tmp_path / CHECKPOINT, weights_only=True)
    assert kept["progress"]["epoch"] == 1
    assert all(torch.isfinite(t).all() for t in kept["network"].values())
    gentler = settings.model_copy(update={"learning_rate": 1e-4})
    assert train(collection, gentler, tmp_path, threads=1, resume=True).finished


@pytest.mark.slow
def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    collection = views(20)
    train(collection, small_settings(epochs=1), tmp_path, threads=1)
    with pytest.raises(InputError, match="other settings"):
        train(collection, small_settings(seed=1), tmp_path, threads=1, resume=True)
    assert load_settings(tmp_path / "settings.json") == small_settings(epochs=1)
    (tmp_path / CHECKPOINT).write_bytes(b"cut off")
    with pytest.raises(InputError, match="not a readable checkpoint"):
        train(collection, small_settings(), tmp_path, threads=1, resume=True)


@pytest.mark.slow
def test_no_better_epoch_for_long_ends_the_training(tmp_path):
    settings = small_settings(epochs=50, patience=2, learning_rate=1e-12)
    outcome = train(views(20), settings, tmp_path, threads=1)
    assert outcome.finished
    assert outcome.progress.epoch < 50
    assert outcome.progress.stale == 2
    with (tmp_path / "log.csv").open() as file:
        assert len(list(csv.DictReader(file))) == outcome.progress.epoch


@pytest.mark.slow
def test_the_card_tells_where_the_weights_come_from(tmp_path):
    collection, settings = views(20), small_settings(epochs=1)
    outcome = train(collection, settings, tmp_path, threads=1)
    network, _ = load_network(outcome.weights)
    card = describe(
        network, collection, settings, outcome, preset="paper", data=["pairs:x"], device="cpu"
    )
    paths = write_card(card, outcome.weights)
    written = json.loads(paths[0].read_text())
    assert written["sources"] == {"blobs": 40}
    assert written["validation"]["average_precision"] == outcome.figures["average_precision"]
    assert written["commit"]
    assert written["settings"]["seed"] == 0
    assert "blobs (40)" in paths[1].read_text()


@pytest.mark.slow
def test_a_network_goes_on_with_larger_images(tmp_path):
    collection, settings = views(20), small_settings(epochs=3)
    small = train(collection, settings, tmp_path / "small", threads=1)
    shape = settings.shape.with_layout(Layout((96, 96)))
    wanted = settings.model_copy(update={"shape": shape})
    start, fitted, report = starting_network(wanted, collection, small.weights, "cpu")
    assert (start.size, fitted.shape.input, report["resized_to"]) == ((96, 96),) * 3
    first, _ = load_network(small.weights)
    same = resized(first, first.branch.layout).eval()
    x = to_tensor(collection.images[:4])
    with torch.no_grad():
        assert torch.allclose(same.embed(x), first.eval().embed(x), atol=1e-6)
    # Gains are interpolated: the gain increases along the rows of the large grid, too.
    layer = first.branch.capsules
    side, columns = first.branch.shape.grid
    with torch.no_grad():
        row = torch.arange(side * columns) // columns
        layer.gains.copy_(row.float()[None, :, None].expand_as(layer.gains))
    grown = resized(first, Layout((96, 160))).branch
    assert grown.shape.grid == (12, 20)
    rows = grown.capsules.gains[0, :, 0].reshape(12, 20)
    assert torch.allclose(rows, rows[:, :1].expand_as(rows))
    assert (torch.diff(rows[:, 0]) >= 0).all()
    assert rows[-1, 0].item() == pytest.approx(side - 1)
    branch = pruned(first, lowest(torch.rand(8, SMALL.places), 0.2))
    with pytest.raises(InputError, match="a pruned network cannot be resized"):
        resized(branch, Layout((96, 96)))


@pytest.mark.slow
def test_pruning_and_fine_tuning(tmp_path):
    collection, settings = views(20), small_settings(epochs=1)
    full = train(collection, settings, tmp_path / "full", threads=1)
    wanted = settings.model_copy(update={"network": "capsule-pruned"})
    start, fitted, report = starting_network(wanted, collection, full.weights, "cpu")
    assert fitted.shape.kept == round(0.8 * SMALL.places)
    assert start.name == "capsule-pruned"
    of_paper = wanted.model_copy(update={"network": "capsule-paper"})
    assert starting_network(of_paper, collection, full.weights, "cpu")[0].name == "capsule-paper"
    half = wanted.model_copy(update={"prune_share": 0.5})
    fewer = starting_network(half, collection, full.weights, "cpu")[1]
    assert fewer.shape.kept == SMALL.places - round(0.5 * SMALL.places)
    quick = wanted.model_copy(update={"prune_iterations": 2})
    network, fewer, report = starting_network(quick, collection, full.weights, "cpu")
    assert (start.branch.capsules.iterations, fitted.shape.iterations) == (3, 3)
    assert (network.branch.capsules.iterations, fewer.shape.iterations) == (2, 2)
    assert report["iterations"] == 2
    save_network(network, tmp_path / "quick.safetensors", {})
    again, x = load_network(tmp_path / "quick.safetensors")[0], to_tensor(collection.images[:4])
    with torch.no_grad():
        assert torch.equal(again.embed(x), network.eval().embed(x))
        assert not torch.allclose(again.embed(x), start.eval().embed(x), atol=1e-4)
    start, fitted, report = starting_network(wanted, collection, full.weights, "cpu")
    assert {"average_precision_before", "average_precision_removed"} <= set(report)
    tuned = train(collection, fitted, tmp_path / "pruned", threads=1, start=start)
    assert load_network(tuned.weights)[0].name == "capsule-pruned"
    smaller = wanted.model_copy(update={"shape": wanted.shape.with_layout(Layout((48, 64)))})
    cut = replace(collection, images=collection.images[:, :48])
    network, _, report = starting_network(smaller, cut, full.weights, "cpu")
    assert network.size == report["resized_to"] == (48, 64)
    assert {"ms_before", "ms_resized", "ms_removed"} <= set(report)
    # Ranking capsules does not train: the statistics of normalisations do not change.
    before, after = load_network(full.weights)[0].state_dict(), network.state_dict()
    for name in before:
        if "running" in name:
            assert torch.equal(before[name], after[name]), name
    with pytest.raises(InputError, match="--weights"):
        starting_network(wanted, collection, None, "cpu")
    with pytest.raises(InputError, match="weights of capsule-pruned, not of capsule"):
        starting_network(settings, collection, tuned.weights, "cpu")


def test_cross_entropy_is_equation_3():
    p, y = torch.tensor([0.9, 0.2]), torch.tensor([1, 0])
    wanted = -(np.log(0.9) + np.log(0.8)) / 2
    assert cross_entropy(torch.logit(p), y).item() == pytest.approx(wanted, abs=1e-6)


def test_contrast_leaves_out_what_is_not_known():
    e = torch.eye(4)
    a, b, same = e[:2], torch.stack([e[0], e[3]]), torch.tensor([True, False])
    both = torch.cat([a, b])
    known = -torch.ones(4, 4, dtype=torch.int8)
    unknown = torch.zeros(4, 4, dtype=torch.int8)
    # Three others at cosine 0, the partner at cosine 1, temperature 0.5.
    wanted = np.log(np.exp(2) + 3 * np.exp(0)) - 2
    known[0, 2] = known[2, 0] = 1
    known.fill_diagonal_(1)
    wanted = np.log(np.exp(2) + 2) - 2
    assert contrast(both @ both.T, same, known, 0.5).item() == pytest.approx(wanted, abs=1e-5)
    assert contrast(both @ both.T, same, unknown, 0.5).item() == pytest.approx(0.0, abs=1e-6)


def test_calibration_finds_the_law_behind_the_labels():
    network = small_network()
    rng = np.random.default_rng(0)
    d = rng.uniform(0, 2, 20000)
    same = rng.random(20000) < 1 / (1 + np.exp(-(6 - 8 * d)))
    with torch.no_grad():
        score = torch.sigmoid(network.head.of_cosine(1 - torch.from_numpy(d) ** 2 / 2)).numpy()
    calibrate(network, score, same)
    a, b = network.head.log_a.exp().item(), network.head.log_b.exp().item()
    prior = np.log((~same).sum() / same.sum())  # balanced weights shift a by the prior
    assert b == pytest.approx(8.0, rel=0.1)
    assert a == pytest.approx(6.0 + prior, rel=0.1)


def test_augmentation_repeats_and_its_strengths_can_be_nothing():
    image = views(1).images[0]
    changed = [augment(image, STRONG, np.random.default_rng(k)) for k in (1, 1, 2)]
    assert np.array_equal(changed[0], changed[1])
    assert not np.array_equal(changed[0], changed[2])
    assert changed[0].shape == image.shape
    nothing = Augmentation(**dict.fromkeys(
        ("homography", "shift", "log_gain", "bias", "log_gamma", "masks", "noise", "blur"), 0
    ))  # fmt: skip
    assert np.array_equal(augment(image, nothing, np.random.default_rng(0)), image)


def test_a_zoom_is_what_driving_on_does():
    """Half of the images are zoomed.

    A dot beside the middle then moves away from the middle, at most by the given factor.
    """
    image = np.zeros((65, 65), np.uint8)
    image[32, 44:47] = 255
    only = Augmentation(**dict.fromkeys(
        ("homography", "shift", "log_gain", "bias", "log_gamma", "masks", "noise", "blur"), 0
    ), zoom=0.4)  # fmt: skip
    seen = [augment(image, only, np.random.default_rng(k)) for k in range(200)]
    columns = np.array([one[32] @ np.arange(65.0) / max(one[32].sum(), 1) for one in seen])
    factor = (columns - 32.5) / (45 - 32.5)
    assert 0.35 < (factor < 1.001).mean() < 0.65
    assert 1.3 < factor.max() < np.exp(0.4) + 0.05


def test_settings_are_read_and_checked(tmp_path):
    path = tmp_path / "settings.json"
    path.write_text(PRESETS["best"].model_dump_json())
    assert load_settings(path) == PRESETS["best"]
    path.write_text('{"batch": 0}')
    with pytest.raises(InputError, match=r"settings\.json: batch"):
        load_settings(path)


def test_cuda_is_refused_where_there_is_none(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="--device cpu"):
        train(views(20), small_settings(), tmp_path, device="cuda")
