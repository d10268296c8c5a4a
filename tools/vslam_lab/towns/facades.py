"""Paints the textures of buildings: walls, windows, doors, shops, signs and stains."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vslam_lab.towns.textures import Grey, Rng, letters, noise, write


@dataclass(frozen=True)
class FacadeStyle:
    """Properties that the four sides of a house have in common.

    Attributes:
        wall, frame, glass: grey levels of walls, window frames and panes.
        storey: height of a storey in metres.
        pitch: horizontal distance between windows in metres.
        window: ``(width, height)`` of a window in metres.
    """

    wall: float
    frame: float
    glass: float
    brick: bool
    storey: float
    pitch: float
    window: tuple[float, float]
    shutters: bool
    balconies: bool
    shop: bool
    bands: bool


def random_style(rng: Rng, *, town: bool) -> FacadeStyle:
    """Draw a random style of a house. In a town, the house may have a shop."""
    brick = bool(rng.random() < 0.22)
    low, high = (70, 125) if brick else (185, 238) if rng.random() < 0.6 else (120, 180)
    return FacadeStyle(
        wall=float(rng.uniform(low, high)),
        frame=float(rng.choice([235.0, 240.0, 50.0, 120.0], p=[0.4, 0.25, 0.25, 0.1])),
        glass=float(rng.uniform(10, 32)),
        brick=brick,
        storey=float(rng.uniform(2.6, 3.3)),
        pitch=float(rng.uniform(1.9, 3.2)),
        window=(float(rng.uniform(0.8, 1.7)), float(rng.uniform(1.1, 1.7))),
        shutters=bool(rng.random() < (0.2 if town else 0.4)),
        balconies=bool(rng.random() < 0.25),
        shop=bool(town and rng.random() < 0.4),
        bands=bool(rng.random() < 0.4),
    )


def facade(
    rng: Rng, lived: Rng, style: FacadeStyle, size: tuple[float, float], *, front: bool
) -> tuple[Grey, Grey]:
    """Paint one side of a house.

    Args:
        rng: random generator for the parts of the building.
        lived: random generator for things that residents change, such as blinds, curtains and
            lights.
        size: width and height in metres.
        front: whether the side is the front, which has a door and perhaps a shop.

    Returns:
        ``(H, W)`` albedo, 0 to 255, and ``(H, W)`` brightness of the windows at night, 0 to 1.
    """
    width, height = size
    columns, rows = (_texels(x) for x in size)
    painter = _Painter(rng, np.empty((rows, columns), np.float32), columns / width, rows / height)
    image = painter.image
    image[:] = style.wall
    if style.brick:
        _lay_bricks(rng, image, columns / width, rows / height)
    image *= 1.0 + 0.035 * noise(rng, rows, columns, 0.4 * columns, 7)
    streaks = cv2.resize(noise(rng, 4, columns, 14.0, 3), (columns, rows))
    image *= 1.0 - 0.035 * np.clip(streaks, 0, 3)
    lights = np.zeros_like(image)

    base = float(rng.uniform(0.3, 0.9))
    painter.scale(0, height - base, width, height, float(rng.uniform(0.55, 0.85)))
    if style.bands:
        for y in np.arange(height - style.storey, 0.5, -style.storey):
            painter.box(0, y - 0.08, width, y + 0.08, style.wall * 1.12)
    painter.scale(0, 0, width, 0.25, 0.6)
    storeys = max(1, int((height - 0.5) / style.storey))
    across = max(1, int((width - 0.6) / style.pitch))
    keep = 1.0 if front else float(rng.choice([0.0, 0.35, 0.7]))
    has_window = rng.random((storeys, across)) < keep
    margin = (width - across * style.pitch) / 2
    door = int(rng.integers(across)) if front else -1
    for level in range(storeys):
        top = height - (level + 1) * style.storey + 0.45
        for k in range(across):
            middle = margin + (k + 0.5) * style.pitch
            if level == 0 and front and style.shop:
                continue
            if level == 0 and k == door:
                painter.door(middle, height, style)
            elif has_window[level, k] and top > 0.3:
                painter.window(lived, middle, top, style, lights, balcony=level > 0 and front)
    if front and style.shop:
        painter.shop(height, width, style, lights)
    if rng.random() < 0.6:  # drainpipe
        x = float(rng.choice([0.15, width - 0.25]))
        painter.box(x, 0, x + 0.1, height, style.wall * float(rng.uniform(0.5, 0.8)))
        painter.box(x + 0.1, 0, x + 0.15, height, style.wall * 0.45)
    image *= 1.0 + 0.035 * noise(rng, rows, columns, 2.0, 1)
    return np.clip(image, 6, 250), lights


def _texels(metres: float) -> int:
    """Return a number of texels that is a power of two and gives about 2.5 cm per texel."""
    return int(np.clip(2 ** round(np.log2(metres / 0.025)), 64, 512))


def _lay_bricks(rng: Rng, image: Grey, px: float, py: float) -> None:
    rows, columns = image.shape
    course, length = max(py * 0.085, 3.0), max(px * 0.25, 6.0)
    y = np.arange(rows) / course
    row = y.astype(int)
    x = np.arange(columns)[None, :] / length + 0.5 * (row % 2)[:, None]
    tone = rng.normal(1.0, 0.13, (row[-1] + 1, int(x.max()) + 1)).astype(np.float32)
    image *= tone[row[:, None], x.astype(int)]
    mortar = (y % 1.0 < 1.0 / course)[:, None] | (x % 1.0 < 1.0 / length)
    image[mortar] *= 1.3


@dataclass(frozen=True)
class _Painter:
    """Draws on ``image`` with coordinates in metres, using ``px`` and ``py`` texels per metre."""

    rng: Rng
    image: Grey
    px: float
    py: float

    def _slices(self, x0: float, y0: float, x1: float, y1: float) -> tuple[slice, slice]:
        a, b = round(y0 * self.py), round(y1 * self.py)
        c, d = round(x0 * self.px), round(x1 * self.px)
        return slice(max(a, 0), max(b, a + 1, 0)), slice(max(c, 0), max(d, c + 1, 0))

    def box(self, x0: float, y0: float, x1: float, y1: float, grey: float) -> None:
        self.image[self._slices(x0, y0, x1, y1)] = grey

    def scale(self, x0: float, y0: float, x1: float, y1: float, factor: float) -> None:
        self.image[self._slices(x0, y0, x1, y1)] *= factor

    def window(
        self, lived: Rng, x: float, y: float, style: FacadeStyle, lights: Grey, *, balcony: bool
    ) -> None:
        w, h = style.window
        w, h = w * float(self.rng.uniform(0.9, 1.1)), h * float(self.rng.uniform(0.93, 1.07))
        x0, x1, y1 = x - w / 2, x + w / 2, y + h
        self.scale(x0 - 0.08, y - 0.05, x1 + 0.16, y1 + 0.2, 0.8)  # shadow of the reveal
        self.box(x0 - 0.06, y - 0.06, x1 + 0.06, y1 + 0.06, style.frame)
        self._pane(lived, x0, y, x1, y1, style.glass, lights)
        parts = int(self.rng.integers(1, 4))
        for k in range(1, parts):
            bar = x0 + (x1 - x0) * k / parts
            self.box(bar - 0.03, y, bar + 0.03, y1, style.frame)
        if self.rng.random() < 0.4:
            self.box(x0, y + 0.3 * h, x1, y + 0.3 * h + 0.05, style.frame)
        self.box(x0 - 0.15, y1 + 0.05, x1 + 0.15, y1 + 0.13, min(style.wall * 1.25, 235.0))
        stain = float(self.rng.uniform(0.8, 0.98))
        self.scale(x0 - 0.1, y1 + 0.13, x0 + 0.05, y1 + float(self.rng.uniform(0.3, 1.0)), stain)
        if style.shutters:
            tone = style.frame * 0.45 + 20
            for a in (x0 - 0.1 - w / 2, x1 + 0.1):
                self.box(a, y - 0.04, a + w / 2, y1 + 0.04, tone)
                for slat in np.arange(y + 0.05, y1, 0.14):
                    self.box(a + 0.05, slat, a + w / 2 - 0.05, slat + 0.04, tone * 0.6)
        elif balcony and style.balconies and self.rng.random() < 0.6:
            self.box(x0 - 0.4, y1 - 0.1, x1 + 0.4, y1 + 0.25, style.wall * 0.8)
            self.box(x0 - 0.4, y1 + 0.25, x1 + 0.4, y1 + 0.35, style.wall * 0.35)
            for a in np.arange(x0 - 0.4, x1 + 0.4, 0.13):
                self.box(a, y1 - 0.9, a + 0.04, y1 - 0.1, 45.0)
            self.box(x0 - 0.4, y1 - 0.95, x1 + 0.4, y1 - 0.88, 45.0)

    def _pane(
        self, lived: Rng, x0: float, y0: float, x1: float, y1: float, glass: float, lights: Grey
    ) -> None:
        rows, columns = self._slices(x0, y0, x1, y1)
        pane = self.image[rows, columns]
        if pane.size == 0:
            return
        slope = np.linspace(0, 1, pane.shape[0], dtype=np.float32)[:, None]
        ramp = np.linspace(0, 1, pane.shape[1], dtype=np.float32)[None, :]
        mirrored = 45.0 * np.clip(1.0 - 2.0 * slope - ramp + float(self.rng.uniform(0, 1)), 0, 1)
        pane[:] = glass * float(self.rng.uniform(0.6, 1.4)) + mirrored
        state, amount = lived.random(), float(lived.uniform(0.15, 1.0))
        if state < 0.45:  # a partly lowered blind
            lowered = int(amount * pane.shape[0])
            slats = 150.0 + 60.0 * float(lived.random()) + 18.0 * (np.arange(lowered) % 4 < 1)
            pane[:lowered] = slats[:, None]
        elif state < 0.75:  # curtains
            part = max(1, int(0.3 * amount * pane.shape[1]))
            cloth = 110.0 + 90.0 * float(lived.random())
            pane[:, :part] = 0.4 * pane[:, :part] + 0.6 * cloth
            pane[:, -part:] = 0.4 * pane[:, -part:] + 0.6 * cloth
        if lived.random() < 0.4:
            lights[rows, columns] = float(lived.uniform(0.4, 1.0))

    def door(self, x: float, height: float, style: FacadeStyle) -> None:
        w = float(self.rng.uniform(0.5, 0.7))
        tone = float(self.rng.uniform(30, 150))
        self.box(x - w - 0.12, height - 2.4, x + w + 0.12, height, style.frame)
        self.box(x - w, height - 2.3, x + w, height, tone)
        for k in range(int(self.rng.integers(1, 4))):
            y = height - 2.15 + 0.68 * k
            self.box(x - 0.7 * w, y, x + 0.7 * w, y + 0.5, tone * float(self.rng.uniform(0.5, 1.5)))
        self.box(x - w - 0.5, height - 2.75, x + w + 0.5, height - 2.6, style.wall * 0.5)
        self.box(x - w - 0.3, height - 0.15, x + w + 0.3, height, 120.0)
        self.box(x + w + 0.3, height - 1.6, x + w + 0.55, height - 1.25, 50.0)

    def _goods(self, pane: Grey) -> None:
        height, width = pane.shape
        for _ in range(int(self.rng.integers(4, 12))):
            w, h = (max(2, int(n * self.rng.uniform(0.06, 0.3))) for n in (width, height))
            x = int(self.rng.integers(0, width))
            y = height - h - int(self.rng.integers(0, height // 2))
            pane[max(y, 0) : y + h, x : x + w] = float(self.rng.uniform(15, 190))
        x = int(self.rng.integers(0, width))
        pane[: height // 2, x : x + width // 3] += 28.0

    def shop(self, height: float, width: float, style: FacadeStyle, lights: Grey) -> None:
        top = height - 2.5
        self.box(0.3, top - 0.75, width - 0.3, top - 0.1, float(self.rng.uniform(30, 220)))
        sign = self.image[self._slices(0.3, top - 0.75, width - 0.3, top - 0.1)]
        ink = 235.0 if sign.size and sign[0, 0] < 130 else 25.0
        label = np.ascontiguousarray(sign)
        text = letters(self.rng, 4, 11)
        write(label, self.rng, text, (4, 2, sign.shape[1] - 4, sign.shape[0] - 2), ink)
        sign[:] = label
        x = 0.4
        while x < width - 1.2:
            w = float(self.rng.uniform(1.0, 2.6))
            x1 = min(x + w, width - 0.4)
            self.box(x, top, x1, height - 0.35, style.frame)
            rows, columns = self._slices(x + 0.07, top + 0.07, x1 - 0.07, height - 0.42)
            pane = self.image[rows, columns]
            if min(pane.shape) > 4:
                tall, wide = pane.shape
                pane[:] = 34 + 10 * noise(self.rng, tall, wide, 0.8 * self.px, 3)
                self._goods(pane)
                lights[rows, columns] = 0.7
            x = x1 + 0.25
