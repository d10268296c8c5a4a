"""The textures that are shared by a whole town."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vslam.datasets.synthetic import textures
from vslam.datasets.synthetic.scene import AtlasBuilder
from vslam.datasets.synthetic.textures import Rng


@dataclass(frozen=True)
class Palette:
    """Texture numbers in the atlas; ``signs`` has a pair of front and back for each sign."""

    sky: int
    twigs: list[int]
    later_twigs: list[int]
    needles: list[int]
    bark: list[int]
    hedges: list[int]
    leaves: int
    fences: list[int]
    walls: list[int]
    signs: list[tuple[int, int]]
    posters: list[int]
    metal: int
    lamp: int
    kerb: int
    tiles: list[int]
    plaster: int
    render: int


def make_palette(rng: Rng, atlas: AtlasBuilder, pool: int) -> Palette:
    """Paint the textures; ``pool`` is the number of variants of the most varied ones."""
    add = atlas.add
    return Palette(
        sky=add(textures.sky(rng)),
        twigs=[add(*textures.foliage(rng)) for _ in range(pool)],
        later_twigs=[add(*textures.foliage(rng, density=0.55)) for _ in range(pool)],
        needles=[add(*textures.foliage(rng, density=1.6)) for _ in range(6)],
        bark=[add(textures.bark(rng)) for _ in range(4)],
        hedges=[add(*textures.hedge(rng)) for _ in range(5)],
        leaves=add(40 + 22 * textures.noise(rng, 128, 128, 6.0, 3)),
        fences=[add(*textures.fence(rng)) for _ in range(pool)],
        walls=[add(textures.garden_wall(rng)) for _ in range(pool)],
        signs=[_sign(rng, atlas) for _ in range(2 * pool)],
        posters=[add(textures.poster(rng)) for _ in range(2 * pool)],
        metal=add(np.full((16, 16), 92.0) + rng.normal(0, 9, (16, 16))),
        lamp=add(np.full((8, 8), 215.0)),
        kerb=add(_kerb(rng)),
        tiles=[add(_roof_tiles(rng)) for _ in range(6)],
        plaster=add(textures.detail(rng, 0.07, 3.0)),
        render=add(np.clip(165 + 9 * textures.noise(rng, 256, 256, 90.0, 6), 0, 255)),
    )


def _sign(rng: Rng, atlas: AtlasBuilder) -> tuple[int, int]:
    face, alpha = textures.sign(rng)
    back = 95.0 + 5.0 * textures.noise(rng, face.shape[0], face.shape[1], 30.0)
    return atlas.add(face, alpha), atlas.add(back, alpha)


def _kerb(rng: Rng) -> textures.Grey:
    """Kerb stones, each a metre long; the texture covers 4 m."""
    tone = np.repeat(rng.uniform(135, 175, 4), 128)[None, :]
    grey = tone * (1.0 + 0.09 * textures.noise(rng, 32, 512, 8.0, 3))
    grey[:, ::128] = grey[:, 1::128] = 60.0
    return np.clip(grey, 10, 240)


def _roof_tiles(rng: Rng) -> textures.Grey:
    y, x = np.mgrid[0:256, 0:256]
    course = 60 + 40 * rng.random() + 13 * np.sin(2 * np.pi * x / 12.8)
    course = (
        course * np.where(y % 16 < 4, 0.55, 1.0) * rng.uniform(0.8, 1.2, (16, 20))[y // 16, x // 13]
    )
    return np.clip(course * (1 + 0.13 * textures.noise(rng, 256, 256, 60.0, 6)), 5, 240)
