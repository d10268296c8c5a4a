"""Train the local descriptors: ``local.safetensors`` and ``local.onnx``.

The extractor of the shipped capsule network stays fixed, so that its features are computed only
once. Pairs come from ``render_matches.py`` (exact correspondences) and from photographs: an image
and its homography in another light, or images of a fixed camera at different hours.

    python tools/training/render_matches.py --out matches --pairs 60
    python tools/training/train_local.py --rendered matches --photos PLACES --kitti $KITTI_ROOT \\
        --out local

On two cores, this takes 15 minutes of rendering, 7 of preparation and 30 of training. The training
of the shipped weights ended after 4,500 steps of batch 4, on a machine that was also rendering.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from vslam.loopclosure.local_matching import COARSE_STRIDE, FINE_STRIDE
from vslam.loopclosure.siamese.images import read_grey
from vslam.loopclosure.siamese.weights import SHIPPED
from vslam.loopclosure.training.branches import CapsuleBranch
from vslam.loopclosure.training.export import export_local
from vslam.loopclosure.training.lite import LiteExtractor
from vslam.loopclosure.training.local import LocalHead, LocalNetwork
from vslam.loopclosure.training.siamese import load_network

SIZE = (192, 640)  # rows and columns of a training image
COARSE = ((SIZE[0] - 1) // COARSE_STRIDE + 1, (SIZE[1] - 1) // COARSE_STRIDE + 1)
FINE = ((SIZE[0] - 1) // FINE_STRIDE + 1, (SIZE[1] - 1) // FINE_STRIDE + 1)
POINTS = 256  # of a pair, in each direction
HELD_OUT = ("81", "82", "83", "84", "webcams/frankfurt", "webcams/panorama_w5")
SETS = ("multiview", "stitch_pairs", "pano360", "bsds500", "camvid", "strecha", "highway_us",
        "imagenet_outdoor", "landmarks_misc", "megadepth_landmarks", "pano_rotation",
        "kitti_city_pedestrian")  # fmt: skip
TEMPERATURE = 0.07
WINDOW = 6  # cells to either side in which the fine descriptor is searched

Image = NDArray[np.uint8]
Points = NDArray[np.float32]


@dataclass(frozen=True)
class Pair:
    """Two images ``SIZE``, and points ``(N, 2)`` of each with their positions in the other."""

    unit: str
    images: tuple[Image, Image]
    grid: tuple[Points, Points]  # where the coarse cells of a lie in b, and of b in a; NaN
    points: tuple[Points, Points, Points, Points]  # in a, there in b; in b, there in a


def corners(image: Image, rng: np.random.Generator) -> Points:
    """The keypoints that tracking would use, and additional random points."""
    found = cv2.goodFeaturesToTrack(image, 500, 0.002, 5)
    some = rng.uniform(0, 1, (100, 2)) * [SIZE[1] - 1, SIZE[0] - 1]
    return np.vstack([some, *([] if found is None else [found[:, 0]])]).astype(np.float32)


def cells() -> Points:
    rows, columns = np.mgrid[: COARSE[0], : COARSE[1]]
    xy = np.stack([columns, rows], 2).reshape(-1, 2) * COARSE_STRIDE
    return np.asarray(xy, np.float32)


def within(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
    inside = (xy >= 0).all(1) & (xy <= [SIZE[1] - 1, SIZE[0] - 1]).all(1)
    return np.asarray(inside)


Warp = Callable[[Points], NDArray[np.float64]]


def pair_of(
    unit: str, images: tuple[Image, Image], warps: tuple[Warp, Warp], rng: np.random.Generator
) -> Pair:
    """``warps`` map points of a to points of b, NaN if unknown, and points of b to points of a."""
    grids, points = [], []
    for side in (0, 1):
        there = warps[side](cells())
        there[~within(there)] = np.nan
        grids.append(there.astype(np.float32))
        here = corners(images[side], rng)
        there = warps[side](here)
        good = np.flatnonzero(within(there))
        chosen = rng.choice(good, POINTS, replace=len(good) < POINTS) if len(good) else good
        points += [here[chosen], there[chosen].astype(np.float32)]
    return Pair(unit, images, (grids[0], grids[1]), tuple(points))  # type: ignore[arg-type]


@dataclass(frozen=True)
class DepthWarp:
    """Maps pixels of one view to pixels of another by depth and relative pose."""

    intrinsics: NDArray[np.float64]  # fx, fy, cx, cy
    depth: NDArray[np.float64]  # of this view; 0 is sky
    depth_there: NDArray[np.float64]
    T_there_here: NDArray[np.float64]

    def __call__(self, xy: Points) -> NDArray[np.float64]:
        focal, centre = self.intrinsics[:2], self.intrinsics[2:]
        x, y = np.rint(xy).astype(int).T
        z = self.depth[y.clip(0, SIZE[0] - 1), x]
        rays = np.c_[(xy - centre) / focal, np.ones(len(xy))]
        p = rays * z[:, None] @ self.T_there_here[:3, :3].T + self.T_there_here[:3, 3]
        uv = np.full((len(xy), 2), np.nan)
        ahead = (z > 0.5) & (p[:, 2] > 0.5)
        uv[ahead] = p[ahead, :2] / p[ahead, 2:] * focal + centre
        seen = np.flatnonzero(within(uv))
        u, v = np.rint(uv[seen]).astype(int).T
        hidden = np.abs(self.depth_there[v, u] - p[seen, 2]) > 0.05 * p[seen, 2]
        uv[seen[hidden]] = np.nan
        return uv


@dataclass(frozen=True)
class HomographyWarp:
    H: NDArray[np.float64]

    def __call__(self, xy: Points) -> NDArray[np.float64]:
        p = np.c_[xy, np.ones(len(xy))] @ self.H.T
        return np.asarray(p[:, :2] / p[:, 2:])


def rendered(folder: Path, rng: np.random.Generator) -> Iterator[Pair]:
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as file:
            stored = {key: file[key] for key in file.files}
        rows = zip(stored["image"], stored["depth"], stored["T_b_a"], strict=True)
        for images, depths, T_b_a in rows:
            a, b = (depth[: SIZE[0]].astype(np.float64) for depth in depths)
            K = stored["intrinsics"]
            warps = DepthWarp(K, a, b, T_b_a), DepthWarp(K, b, a, np.linalg.inv(T_b_a))
            cropped = images[0][: SIZE[0]], images[1][: SIZE[0]]
            yield pair_of(path.stem, cropped, warps, rng)


def relit(image: Image, rng: np.random.Generator) -> Image:
    """Change the light of an image: gamma, gain, lamps and shadows, noise, blur."""
    height, width = image.shape
    x = (image / 255.0) ** np.exp(rng.normal(0, 0.5))
    if rng.random() < 0.7:
        small = rng.normal(0, rng.uniform(0.2, 1.0), (3, 8)).astype(np.float32)
        x = x * np.exp(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC))
    x = x * np.exp(rng.normal(-0.3, 0.7)) + rng.normal(0, 0.05)
    if rng.random() < 0.5:
        x = cv2.GaussianBlur(x, (0, 0), float(rng.uniform(0.3, 1.5)))
    x = x + rng.normal(0, 1, x.shape) * rng.choice([0.005, 0.02, 0.05])
    return np.clip(np.rint(255 * x), 0, 255).astype(np.uint8)


def homography(height: int, width: int, rng: np.random.Generator) -> NDArray[np.float64]:
    corner = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    moved = corner + rng.uniform(-0.09, 0.09, (4, 2)) * [width, height]
    zoom, angle = np.exp(rng.uniform(-0.25, 0.25)), np.radians(rng.normal(0, 4))
    R = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.array([width / 2, height / 2])
    shift = rng.uniform(-1, 1, 2) * [80.0, 15.0]
    moved = (moved - middle) @ R.T + middle + shift
    return np.asarray(cv2.getPerspectiveTransform(corner, moved.astype(np.float32)))


def homographic(unit: str, first: Image, second: Image, rng: np.random.Generator) -> Pair | None:
    """A pair of two aligned images, of which the second is warped; both are cropped to ``SIZE``."""
    scale = max(SIZE[1] / first.shape[1], SIZE[0] / first.shape[0])
    size = (
        max(SIZE[1], round(first.shape[1] * scale)),
        max(SIZE[0], round(first.shape[0] * scale)),
    )
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    a, b = (cv2.resize(one, size, interpolation=way) for one in (first, second))
    H = homography(size[1], size[0], rng)
    b = cv2.warpPerspective(b, H, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
    top = [int(rng.integers(size[1] - SIZE[0] + 1))] * 2
    top[1] = int(np.clip(top[1] + rng.integers(-40, 41), 0, size[1] - SIZE[0]))
    left = int(rng.integers(size[0] - SIZE[1] + 1))
    crops = [
        np.ascontiguousarray(image[y : y + SIZE[0], left : left + SIZE[1]])
        for image, y in zip((a, b), top, strict=True)
    ]
    to_a, to_b = (np.array([[1, 0, -left], [0, 1, -y], [0, 0, 1.0]]) for y in top)
    forward = to_b @ H @ np.linalg.inv(to_a)

    warps = HomographyWarp(forward), HomographyWarp(np.linalg.inv(forward))
    pair = pair_of(unit, (crops[0], crops[1]), warps, rng)
    return pair if min(len(p) for p in pair.points) == POINTS else None


def photographs(photos: Path, kitti: Path | None, rng: np.random.Generator) -> Iterator[Pair]:
    for camera in sorted((photos / "webcams").iterdir()):
        files = sorted(camera.glob("*.webp"))
        for k in range(50 if files else 0):
            one, other = (read_grey(files[i]) for i in rng.choice(len(files), 2, replace=False))
            if one.shape != other.shape:
                continue
            if k % 3 == 0:
                other = relit(other, rng)
            pair = homographic(f"webcams/{camera.name}", one, other, rng)
            if pair is not None:
                yield pair
    for scene in sorted((photos / "mefb_exposure").iterdir()):
        files = sorted(scene.glob("*.webp"))
        if len(files) == 2:
            one, other = map(read_grey, files)
            pair = homographic("mefb", one, other, rng) if one.shape == other.shape else None
            if pair is not None:
                yield pair
    singles = [p for name in SETS for p in sorted((photos / name).rglob("*.webp"))]
    singles = [singles[i] for i in rng.permutation(len(singles))[:700]]
    if kitti is not None:
        folder = kitti / "sequences" / "00" / "image_0"
        frames = sorted(p for p in folder.iterdir() if 250 <= int(p.stem) < 1500)
        singles += frames[::3]
    for path in singles:
        image = read_grey(path)
        pair = homographic("photos", relit(image, rng) if rng.random() < 0.5 else image,
                           relit(image, rng), rng)  # fmt: skip
        if pair is not None:
            yield pair


@dataclass(frozen=True)
class Prepared:
    """All pairs: features of the images (two per pair), and correspondences."""

    x4: Tensor
    x8: Tensor
    x16: Tensor
    grid: Tensor  # (P, 2, cells, 2)
    points: Tensor  # (P, 4, POINTS, 2)
    units: list[str]


@torch.no_grad()
def prepare(pairs: list[Pair], network: LocalNetwork) -> Prepared:
    n = 2 * len(pairs)
    x4 = torch.empty((n, 24, *FINE), dtype=torch.float16)
    x8 = torch.empty((n, 40, (SIZE[0] - 1) // 8 + 1, (SIZE[1] - 1) // 8 + 1), dtype=torch.float16)
    x16 = torch.empty((n, 112, *COARSE), dtype=torch.float16)
    images = np.stack([image for pair in pairs for image in pair.images])
    for k in range(0, n, 8):
        given = torch.from_numpy(images[k : k + 8])[:, None].float() / 255.0
        found = network.features(given.contiguous(memory_format=torch.channels_last))
        for store, x in zip((x4, x8, x16), found, strict=True):
            store[k : k + 8] = x.half()
    grid = torch.from_numpy(np.stack([np.stack(pair.grid) for pair in pairs]))
    points = torch.from_numpy(np.stack([np.stack(pair.points) for pair in pairs]))
    return Prepared(x4, x8, x16, grid, points, [pair.unit for pair in pairs])


def targets(there: Tensor) -> Tensor:
    """Index of the cell at each of ``(B, cells, 2)`` pixels, or -1."""
    cell = torch.round(there / COARSE_STRIDE)
    known = torch.isfinite(there).all(-1)
    index = cell[..., 1].nan_to_num(0) * COARSE[1] + cell[..., 0].nan_to_num(0)
    inside = (cell[..., 1] < COARSE[0]) & (cell[..., 0] < COARSE[1])
    return torch.where(known & inside, index, -1.0).long()


def coarse_loss(coarse: Tensor, grid: Tensor) -> Tensor:
    """Negative log of the dual softmax at true matches (LoFTR, section 3.3)."""
    a, b = coarse[0::2].flatten(2), coarse[1::2].flatten(2)
    alike = torch.einsum("nci,ncj->nij", a, b) / TEMPERATURE
    losses = []
    for side, logits in ((0, alike), (1, alike.transpose(1, 2))):
        target = targets(grid[:, side])
        known = target >= 0
        log_p = torch.log_softmax(logits, 2) + torch.log_softmax(logits, 1)
        losses.append(-log_p[known, target[known]])
    return torch.cat(losses).mean()


def sampled(fine: Tensor, xy: Tensor) -> Tensor:
    """Sample ``(N, C, h, w)`` at ``(N, P, 2)`` pixels; returns ``(N, P, C)`` of length 1."""
    size = torch.tensor([FINE[1] - 1, FINE[0] - 1]) * FINE_STRIDE
    at = 2 * xy / size - 1
    found = functional.grid_sample(fine, at[:, None], align_corners=True)[:, :, 0]
    return functional.normalize(found.transpose(1, 2), dim=2)


def fine_loss(fine: Tensor, points: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Cross entropy over a window of cells near the true position, and over all points of an image;
    the second one makes the points of an image distinguishable."""
    around = torch.arange(-WINDOW, WINDOW + 1)
    offset = torch.stack(torch.meshgrid(around, around, indexing="xy"), 2).reshape(-1, 2)
    near, apart = [], []
    for here, there, source, goal in ((0, 1, 0, 1), (2, 3, 1, 0)):
        a, b = fine[source::2], fine[goal::2]
        xy_a, xy_b = points[:, here], points[:, there]
        query = sampled(a, xy_a)
        jitter = 4 * (torch.rand(xy_b.shape, generator=generator) - 0.5) * 2
        middle = torch.round(xy_b / FINE_STRIDE + jitter)
        cell = middle[:, :, None] + offset
        inside = (cell >= 0).all(-1) & (cell <= torch.tensor([FINE[1] - 1, FINE[0] - 1])).all(-1)
        row = cell[..., 1].clamp(0, FINE[0] - 1).long()
        column = cell[..., 0].clamp(0, FINE[1] - 1).long()
        index = (row * FINE[1] + column).flatten(1)
        window = b.flatten(2).transpose(1, 2)
        window = torch.gather(window, 1, index[..., None].expand(-1, -1, window.shape[2]))
        window = window.view(*cell.shape[:3], -1)
        alike = torch.einsum("npc,npkc->npk", query, window) / TEMPERATURE
        alike = alike.masked_fill(~inside, -1e4)
        # The four cells around the true position are weighted as in bilinear interpolation.
        away = (xy_b[:, :, None] / FINE_STRIDE - cell).abs()
        share = (1 - away).clamp_min(0).prod(-1) * inside
        share = share / share.sum(-1, keepdim=True).clamp_min(1e-6)
        near.append(-(share * torch.log_softmax(alike, -1)).sum(-1).mean())
        key = sampled(b, xy_b)
        all_ = torch.einsum("npc,nqc->npq", query, key) / TEMPERATURE
        close = torch.cdist(xy_b, xy_b) < 12.0
        close &= ~torch.eye(close.shape[1], dtype=torch.bool)
        all_ = all_.masked_fill(close, -1e4)
        label = torch.arange(all_.shape[1]).expand(len(all_), -1)
        apart.append(functional.cross_entropy(all_.flatten(0, 1), label.flatten()))
    return torch.stack(near).mean(), torch.stack(apart).mean()


@torch.no_grad()
def validate(head: LocalHead, data: Prepared, chosen: list[int]) -> dict[str, float]:
    """Share of mutual coarse matches within 24 pixels, and their number; share of points that are
    found within 1.5 pixels in a window around the true position."""
    right, count, hit, total = 0, 0, 0.0, 0
    for k in chosen:
        coarse, fine = head(*features_of(data, [k]))
        a, b = coarse[0].flatten(1), coarse[1].flatten(1)
        alike = a.T @ b
        there = alike.argmax(1)
        mutual = alike.argmax(0)[there] == torch.arange(len(there))
        found = torch.stack([there % COARSE[1], there // COARSE[1]], 1) * float(COARSE_STRIDE)
        truth = data.grid[k, 0]
        known = torch.isfinite(truth).all(1) & mutual
        good = (found - truth).norm(dim=1) < 1.5 * COARSE_STRIDE
        right, count = right + int((good & known).sum()), count + int(known.sum())
        xy_a, xy_b = data.points[k, 0][None], data.points[k, 1]
        query = sampled(fine[:1], xy_a)[0]
        scores = torch.einsum("pc,chw->phw", query, fine[1])
        rows, columns = torch.meshgrid(torch.arange(FINE[0]), torch.arange(FINE[1]), indexing="ij")
        far = torch.maximum(
            (columns[None] * FINE_STRIDE - xy_b[:, 0, None, None]).abs(),
            (rows[None] * FINE_STRIDE - xy_b[:, 1, None, None]).abs(),
        ) > 24  # fmt: skip
        scores = scores.masked_fill(far, -1.0)
        best = scores.flatten(1).argmax(1)
        at = torch.stack([best % FINE[1], best // FINE[1]], 1) * float(FINE_STRIDE)
        hit += float(((at - xy_b).norm(dim=1) < FINE_STRIDE).float().sum())
        total += len(at)
    n = max(len(chosen), 1)
    return {"coarse_right": right / max(count, 1), "coarse_matches": right / n,
            "fine_right": hit / max(total, 1)}  # fmt: skip


def features_of(data: Prepared, chosen: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    images = torch.tensor([i for k in chosen for i in (2 * k, 2 * k + 1)])
    return data.x4[images].float(), data.x8[images].float(), data.x16[images].float()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--rendered", type=Path, required=True)
    parser.add_argument("--photos", type=Path, required=True)
    parser.add_argument("--kitti", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--minutes", type=float, default=600.0)
    given = parser.parse_args()
    torch.manual_seed(0)
    given.out.mkdir(parents=True, exist_ok=True)
    branch = load_network(SHIPPED / "capsule.safetensors")[0].branch
    assert isinstance(branch, CapsuleBranch)
    assert isinstance(branch.extractor, LiteExtractor)
    head = LocalHead()
    network = LocalNetwork(branch.extractor, head)
    rng = np.random.default_rng(0)
    began = time.perf_counter()
    pairs = [*rendered(given.rendered, rng), *photographs(given.photos, given.kitti, rng)]
    pairs = [pair for pair in pairs if min(len(p) for p in pair.points) == POINTS]
    say(f"{len(pairs)} pairs, {time.perf_counter() - began:.0f} s")
    data = prepare(pairs, network)
    del pairs
    say(f"features: {time.perf_counter() - began:.0f} s")
    held = [k for k, unit in enumerate(data.units) if unit in HELD_OUT]
    towns = [k for k in held if data.units[k].isdigit()][::4]
    webcams = [k for k in held if not data.units[k].isdigit()]
    train = [k for k in range(len(data.units)) if k not in set(held)]
    optimiser = torch.optim.AdamW(head.parameters(), 2e-3, weight_decay=1e-2)
    generator = torch.Generator().manual_seed(0)
    until = time.perf_counter() + 60.0 * given.minutes
    order: list[int] = []
    log = []
    sums = np.zeros(3)
    for step in range(given.steps):
        passed = max(step / given.steps, 1 - (until - time.perf_counter()) / 60 / given.minutes)
        if passed >= 1:
            break
        for group in optimiser.param_groups:
            group["lr"] = 2e-3 * min(1, (step + 1) / 100) * (0.5 + 0.5 * np.cos(np.pi * passed))
        if len(order) < given.batch:
            order = [train[i] for i in rng.permutation(len(train))]
        chosen, order = order[: given.batch], order[given.batch :]
        coarse, fine = head(*features_of(data, chosen))
        losses = (coarse_loss(coarse, data.grid[chosen]),
                  *fine_loss(fine, data.points[chosen], generator))  # fmt: skip
        loss = 0.3 * losses[0] + losses[1] + 0.3 * losses[2]
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        sums += [float(x.detach()) for x in losses]
        if (step + 1) % 250 == 0:
            line = {"step": step + 1, "seconds": round(time.perf_counter() - began)}
            line |= dict(zip(("coarse", "near", "apart"), sums / 250, strict=True))
            for name, part in (("towns", towns), ("webcams", webcams)):
                line |= {f"{name}_{k}": v for k, v in validate(head, data, part).items()}
            log.append(line)
            say("  ".join(f"{k} {v:.3f}" for k, v in line.items()))
            sums[:] = 0
            save_file(head.state_dict(), given.out / "local.safetensors")
            with (given.out / "log.csv").open("w", newline="") as file:
                rows = csv.DictWriter(file, list(line))
                rows.writeheader()
                rows.writerows(log)
    half = {key: value.half() for key, value in head.state_dict().items()}
    save_file(half, given.out / "local.safetensors")
    head.load_state_dict({key: value.float() for key, value in half.items()})
    export_local(network, given.out / "local.onnx")


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
