"""Capsules, routing, pruning and the interface of the Siamese networks."""

from __future__ import annotations

import numpy as np
import pytest
import reference_routing
import torch
from siamese_worlds import SMALL, masked, small_network

from vslam.loopclosure.siamese.images import to_size
from vslam.support.errors import InputError
from vslam_lab.training import capsules
from vslam_lab.training.branches import (
    CapsuleShape,
    standardised,
    textured,
)
from vslam_lab.training.extractors import LIGHT_BLOCKS, grid_side
from vslam_lab.training.preprocessing import to_tensor
from vslam_lab.training.pruning import lowest, mean_couplings, pruned
from vslam_lab.training.siamese import (
    build_network,
    for_inference,
    load_network,
    save_network,
)


def images(n: int = 3, pixels: int = 64, seed: int = 0) -> torch.Tensor:
    return torch.rand(n, 3, pixels, pixels, generator=torch.Generator().manual_seed(seed))


def test_squash_keeps_the_direction_and_bends_the_length():
    s = torch.tensor([[3.0, 4.0], [0.3, -0.4], [0.0, 0.0]])
    v = capsules.squash(s)
    assert v[0].tolist() == pytest.approx([25 / 26 * 0.6, 25 / 26 * 0.8], abs=1e-6)
    assert v[1].tolist() == pytest.approx([0.2 * 0.6, -0.2 * 0.8], abs=1e-6)
    assert v[2].tolist() == [0.0, 0.0]


def test_squash_has_a_finite_gradient_at_zero():
    s = torch.zeros(1, 4, requires_grad=True)
    capsules.squash(s).sum().backward()
    assert torch.isfinite(s.grad).all()


@pytest.mark.parametrize(("over", "axis"), [("primary", 2), ("output", 1)])
def test_couplings_sum_to_one(over, axis):
    u_hat = torch.randn(2, 5, 30, 4, generator=torch.Generator().manual_seed(1))
    for iterations in (1, 2, 3):
        _, c = reference_routing.route(u_hat, iterations, over)
        assert torch.allclose(c.sum(axis), torch.ones(()), atol=1e-6)
        assert (c > 0).all()


def test_routing_stays_at_a_fixed_point_where_all_capsules_agree():
    one = torch.tensor([2.0, -1.0, 0.5])
    u_hat = one.expand(1, 1, 6, 3)
    for iterations in (1, 2, 3, 10):
        v, c = reference_routing.route(u_hat, iterations)
        assert torch.allclose(c, torch.full((1, 1, 6), 1 / 6), atol=1e-6)
        assert torch.allclose(v[0, 0], capsules.squash(one), atol=1e-6)


def test_routing_turns_to_the_majority():
    many, one = torch.tensor([2.0, 0.0]), torch.tensor([0.0, 2.0])
    u_hat = torch.stack([many, many, many, one])[None, None]
    first = reference_routing.route(u_hat, 1)[1][0, 0]
    later = reference_routing.route(u_hat, 5)[1][0, 0]
    assert first.tolist() == pytest.approx([0.25] * 4)
    assert later[3] < 0.1
    assert later[0] > 0.3


def routed(u, W, iterations, over="primary", alive=None):
    v, e, total = capsules.route(u, W, iterations, over, alive)
    return v, capsules.couplings(e, total)


def test_one_iteration_by_hand():
    u = torch.tensor([[[[1.0, 0.0], [0.0, 1.0]]]])  # one image, one type, two places
    W = torch.tensor([[[[2.0, 0.0], [0.0, 4.0]]]])  # (J, T, A, D) = (1, 1, 2, 2)
    v, c = routed(u, W, iterations=2)
    # s = (1, 2), |s|² = 5; agreement of (2, 0) and (0, 4) with v = s sqrt(5) / 6
    b = torch.tensor([2.0, 8.0]) * 5**0.5 / 6
    expected = torch.softmax(b, 0)
    assert torch.allclose(c[0, 0], expected, atol=1e-6)
    s = expected[0] * torch.tensor([2.0, 0.0]) + expected[1] * torch.tensor([0.0, 4.0])
    assert torch.allclose(v[0, 0], capsules.squash(s), atol=1e-6)


@pytest.mark.parametrize("over", ["primary", "output"])
@pytest.mark.parametrize("iterations", [1, 2, 3])
@pytest.mark.parametrize("some_dead", [False, True])
def test_factored_routing_is_the_paper_s_routing(over, iterations, some_dead):
    torch.manual_seed(2)
    u, W = capsules.squash(torch.randn(3, 5, 9, 4) * 2), torch.randn(6, 5, 4, 7)
    alive = torch.rand(45) > 0.3 if some_dead else None
    wanted = reference_routing.route(reference_routing.predict(u, W), iterations, over, alive)
    for mine, reference in zip(routed(u, W, iterations, over, alive), wanted, strict=True):
        assert torch.allclose(mine, reference, atol=1e-5)


@pytest.mark.parametrize("over", ["primary", "output"])
@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("some_dead", [False, True])
def test_gradients_are_finite_and_pass_through_the_last_iteration_only(over, iterations, some_dead):
    torch.manual_seed(3)
    u = capsules.squash(torch.randn(2, 3, 4, 5)).requires_grad_()
    W = torch.randn(2, 3, 5, 6, requires_grad=True)
    alive = torch.rand(12) > 0.3 if some_dead else None
    v, c = routed(u, W, iterations, over, alive)
    assert not c.requires_grad
    by_hand = capsules.squash(reference_routing.combine(c, reference_routing.predict(u, W)))
    weight = torch.randn_like(v)
    mine = torch.autograd.grad((v * weight).sum(), [u, W])
    wanted = torch.autograd.grad((by_hand * weight).sum(), [u, W])
    for gradient, reference in zip(mine, wanted, strict=True):
        assert torch.isfinite(gradient).all()
        assert torch.allclose(gradient, reference, atol=1e-5)


@torch.no_grad()
def test_routing_is_never_in_half_precision():
    layer = small_network().branch.capsules
    u = capsules.squash(torch.randn(2, 8, layer.places, 8)).bfloat16()
    exact = layer.routed(u.float())
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(layer(u), exact[0])
        for mine, wanted in zip(layer.routed(u), exact, strict=True):
            assert torch.equal(mine, wanted)


def test_every_parameter_learns():
    network = small_network().train()
    descriptors = network.embed(images(4))
    network.similarity(descriptors[:2], descriptors[2:]).sum().backward()
    for name, parameter in network.named_parameters():
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().max() > 0, name


def test_the_contract():
    network = small_network().eval()
    with torch.no_grad():
        descriptors = network.embed(images(5))
        p = network.similarity(descriptors, descriptors.roll(1, 0))
        compared = network.compare(descriptors[0], descriptors)
    assert descriptors.shape == (5, network.dimensions)
    assert descriptors.dtype == torch.float32
    assert torch.allclose(descriptors.norm(dim=1), torch.ones(5), atol=1e-5)
    assert ((p > 0) & (p < 1)).all()
    assert torch.allclose(compared[4], p[0], atol=1e-5)
    assert compared.argmax() == 0


def test_similarity_falls_with_distance():
    network = small_network()
    e = torch.eye(3)
    near = torch.nn.functional.normalize(torch.tensor([[1.0, 0.1, 0.0]]))
    assert network.similarity(e[:1], near) > network.similarity(e[:1], e[1:2])


@pytest.mark.slow
def test_the_default_network_is_within_the_budget():
    network = build_network("capsule")
    assert network.n_parameters() <= 3_000_000
    assert grid_side(227, LIGHT_BLOCKS) ** 2 == CapsuleShape().places
    with torch.no_grad():
        assert network.eval().embed(images(1, 227)).shape == (1, 1024)


def test_gain_and_bias_of_the_camera_drop_out():
    x = images(1)
    assert torch.allclose(standardised(0.5 * x + 0.2), standardised(x), atol=0.02)


def test_what_shows_no_texture_changes_nothing_else():
    """An object without texture hides a part of the image."""
    x = images(1)[:, :1]
    dark, bright = x.clone(), x.clone()
    dark[..., 40:], bright[..., 40:] = 0.0, 1.0
    assert textured(dark)[..., 40:].sum() == 0
    seen = slice(0, 39)  # columns that the object does not touch
    standard = [standardised(image)[..., seen] for image in (dark, bright)]
    assert torch.allclose(*standard, atol=0.05)
    blank = standardised(torch.full((1, 1, 64, 64), 0.7))
    assert torch.allclose(blank, torch.zeros(()), atol=1e-3)


def test_texture_is_more_than_a_grey_level():
    x = torch.zeros(1, 1, 4, 5)
    x[..., 1, 2] = 0.9 / 255
    assert textured(x).sum() == 0
    x[..., 1, 2] = 3.0 / 255
    at = textured(x)[0, 0].nonzero().tolist()
    assert at == [[0, 2], [1, 1], [1, 2]]  # pixels that differ from the one on the right or below


@pytest.mark.slow
def test_a_pruned_network_is_the_masked_network():
    network = small_network().eval()
    branch = network.branch
    torch.nn.init.uniform_(branch.capsules.gains, 0.5, 1.5)
    activity = mean_couplings(network, [images(4, seed=5), images(3, seed=6)])
    assert activity.shape == (8, branch.shape.places)
    assert activity.sum().item() == pytest.approx(1.0, abs=1e-4)  # the mean over j of sums of 1
    drop = lowest(activity, 0.2)
    dropped = round(0.2 * branch.shape.places)
    assert drop.sum(1).tolist() == [dropped] * 8
    assert (
        activity[drop].view(8, -1).max(1).values.le(activity[~drop].view(8, -1).min(1).values).all()
    )
    smaller, silenced = pruned(network, drop), masked(network, drop)
    with torch.no_grad():
        x = images(6, seed=7)
        mine, wanted, before = smaller.embed(x), silenced.embed(x), network.embed(x)
    assert torch.allclose(mine, wanted, atol=1e-5)
    assert not torch.allclose(before, wanted, atol=1e-3)
    assert smaller.branch.capsules.gains.numel() == 8 * (branch.shape.places - dropped) * 8


def test_a_pruned_network_can_be_pruned_again():
    network = small_network().eval()
    once = pruned(network, lowest(mean_couplings(network, [images()]), 0.2))
    drop = lowest(mean_couplings(once, [images()]), 0.2)
    with torch.no_grad():
        x = images(2, seed=9)
        assert torch.allclose(pruned(once, drop).embed(x), masked(once, drop).embed(x), atol=1e-5)


@pytest.mark.slow
def test_folding_changes_nothing_but_the_time():
    network = small_network().train()
    with torch.no_grad():
        for seed in range(5):
            network.embed(images(8, seed=seed))  # running means away from 0
        network.eval()
        before = network.embed(images(2, seed=11))
        after = for_inference(network).embed(images(2, seed=11))
    assert torch.allclose(before, after, atol=1e-5)


@pytest.mark.parametrize("half", [False, True])
def test_weights_survive_a_file(tmp_path, half):
    network = small_network().eval()
    drop = lowest(mean_couplings(network, [images()]), 0.2)
    network = pruned(network, drop)
    path = tmp_path / "weights" / "w.safetensors"
    save_network(network, path, {"seed": 3}, half=half)
    read, about = load_network(path)
    assert about == {"seed": 3}
    assert (read.name, read.branch.shape) == ("capsule-pruned", network.branch.shape)
    with torch.no_grad():
        x = images(2)
        assert torch.allclose(read.embed(x), network.embed(x), atol=1e-2 if half else 0)


def test_weights_may_be_read_by_whoever_may_read_other_files(tmp_path):
    (tmp_path / "other").touch()
    save_network(small_network(), tmp_path / "w.safetensors", {})
    assert (tmp_path / "w.safetensors").stat().st_mode == (tmp_path / "other").stat().st_mode


@pytest.mark.parametrize("content", [None, b"", b"no weights at all, but long enough to parse"])
def test_bad_weights_are_named(tmp_path, content):
    path = tmp_path / "w.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"w\.safetensors: .*vslam train"):
        load_network(path)


def test_an_unknown_network_is_refused():
    with pytest.raises(InputError, match="resnet"):
        build_network("resnet", SMALL)


def test_squash_and_crop():
    image = np.zeros((40, 100), np.uint8)
    image[:, 30:70] = 200
    assert to_size(image, (20, 20), "crop").min() == 200
    assert to_size(image, (20, 20), "squash")[:, 0].max() == 0
    tensor = to_tensor(to_size(image, (20, 20), "crop")[None])
    assert tensor.shape == (1, 3, 20, 20)
    assert tensor.max().item() == pytest.approx(200 / 255)
