"""Parses ``--perturb``, and applies the perturbation to the frames of a source."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from zlib import crc32

import numpy as np

from vslam.datasets.frames import Source, TimedFrame
from vslam.datasets.imu import Imu
from vslam.datasets.perturbation.kinds import (
    EachSide,
    ImuLaw,
    LawKind,
    Pair,
    PairLaw,
    Scene,
    SceneLaw,
    check_need,
)
from vslam.datasets.perturbation.registry import LAWS, all_laws
from vslam.support.errors import DroppedFrameError, InputError, did_you_mean
from vslam.types.camera import DepthImage, Image, ImageMap
from vslam.types.geometry import Matrix
from vslam.types.imu import ImuNoise, tidied


@dataclass(frozen=True)
class Perturbation:
    """Perturbations that are applied to each frame, one after the other.

    A *law* is a perturbation of one kind. If there are no laws, the images stay unchanged.

    Attributes:
        name: canonical spelling, for example ``none`` or ``brightness:1.5,blur:0.5``.
        laws: the laws of images, in the order in which they are applied.
            `vslam.datasets.perturbation` describes them.
        imu_laws: the laws of an IMU by name, in the order in which they are applied.
    """

    name: str
    laws: tuple[PairLaw | SceneLaw, ...] = ()
    imu_laws: tuple[tuple[str, ImuLaw], ...] = ()

    def bound_to(self, source: Source) -> Perturbation:
        """Prepare the perturbation for one source, because some laws use its depth or its poses.

        Raises:
            InputError: the source does not have the data that the perturbation needs.
        """
        if not self.imu_laws and not any(isinstance(law, SceneLaw) for law in self.laws):
            return self
        scene = Scene.of(source)
        for name, _ in self.imu_laws:
            check_need(name, "imu", scene)
        laws = (law.bound_to(scene) if isinstance(law, SceneLaw) else law for law in self.laws)
        return replace(self, laws=tuple(laws))

    def of_imu(self, imu: Imu) -> Imu:
        """Return an IMU whose samples are perturbed when they are read.

        Args:
            imu: a recording.
        """
        if not self.imu_laws:
            return imu
        return replace(imu, read=partial(_perturbed_samples, imu, self.imu_laws))

    def apply(
        self, index: int, t: float, left: Image, second: Image | DepthImage | None
    ) -> tuple[Image, Image | DepthImage | None]:
        """Perturb the images of a frame. This method is thread-safe.

        Depth images stay unchanged, because depth sensors have their own light source.

        Args:
            index: index of the frame.
            t: seconds since the first frame.
            left: left image, ``(H, W)`` uint8.
            second: right image, ``(H, W)`` uint8. For RGB-D, it is the depth image, ``(H, W)``
                float32 metres. None for a monocular source.

        Raises:
            DroppedFrameError: the perturbation drops the frame.
        """
        pair = Pair(index, t, left, second, (left, second))
        for law in self.laws:
            pair = law(pair)
        return pair.left, pair.second


def parse_perturbation(spec: str, seed: int) -> Perturbation:
    """Make a perturbation from the value of ``--perturb``.

    Args:
        spec: one or more laws, each written as ``law[:strength]``, separated by commas. They are
            applied in this order. ``none`` or the empty string means no perturbation.
        seed: seed of all random numbers, not negative. Equal seeds produce equal images.

    Raises:
        InputError: a law is unknown or repeated, a strength is not a number in the law's range, the
            seed is negative, or a plug-in is broken.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: must not be negative.")
    if spec.strip() in ("", "none"):
        return Perturbation("none")
    strengths: dict[str, float] = {}
    names = {law.strip().partition(":")[0] for law in spec.split(",")}
    known = LAWS if names <= set(LAWS) else all_laws()
    for item in spec.split(","):
        law, _, strength = item.strip().partition(":")
        if law not in known:
            raise InputError(
                f"--perturb {spec}: unknown law '{law}'{did_you_mean(law, known)}; choose from "
                f"none, {', '.join(known)}."
            )
        if law in strengths:
            raise InputError(f"--perturb {spec}: {law} is given twice; give it once.")
        default = known[law].default
        strengths[law] = _parse_strength(spec, known[law], strength) if ":" in item else default
    streams = {law: (seed, crc32(law.encode())) for law in strengths}
    of_images = {law: s for law, s in strengths.items() if not known[law].of_imu}
    of_imu = {law: s for law, s in strengths.items() if known[law].of_imu}
    return Perturbation(
        ",".join(f"{law}:{strength:g}" for law, strength in strengths.items()),
        tuple(known[law].law(law, s, streams[law]) for law, s in of_images.items()),
        tuple((law, known[law].make(s, streams[law])) for law, s in of_imu.items()),  # type: ignore[misc]
    )


def _perturbed_samples(imu: Imu, laws: tuple[tuple[str, ImuLaw], ...]) -> Matrix:
    samples, noise = tidied(imu.read()).samples, imu.noise or ImuNoise()
    for _, law in laws:
        samples = law(samples, noise) if len(samples) > 1 else samples
    return samples


def perturbed(frames: Iterator[TimedFrame], perturbation: Perturbation) -> Iterator[TimedFrame]:
    """Yield the frames of a source. Their images are perturbed when they are read."""
    first = None
    laws = [law for law in perturbation.laws if isinstance(law, EachSide)]
    pair_needed = len(laws) < len(perturbation.laws)
    for index, frame in enumerate(frames):
        first = frame.timestamp if first is None else first
        t = frame.timestamp - first
        read = partial(_read_perturbed, frame, perturbation, index, t)
        sides = None
        if frame.sides is not None and not pair_needed:
            left, second = frame.sides
            sides = (
                partial(_read_left, left, laws, index, t),
                partial(_read_second, second, laws, index, t),
            )
        yield TimedFrame(frame.timestamp, read, sides, mask=frame.mask)


def _read_left(read: Callable[[], Image], laws: list[EachSide], index: int, t: float) -> Image:
    image = read()
    for each in laws:
        image = each.law(index, t, 0, image)
    return image


def _read_second(
    read: Callable[[], Image | DepthImage], laws: list[EachSide], index: int, t: float
) -> Image | DepthImage:
    image = read()
    if image.dtype != np.uint8:
        return image  # depth is not changed
    for each in laws:
        image = each.law(index, t, 1, np.asarray(image, np.uint8))
    return image


def _read_perturbed(
    frame: TimedFrame, perturbation: Perturbation, index: int, t: float, image_map: ImageMap
) -> tuple[Image, Image | DepthImage | None]:
    return perturbation.apply(index, t, *frame.read(image_map))


# Contact sheets.
_WIDTH, _TITLE, _GUTTER = 480, 22, 8  # px
_PAPER, _MIDDLE = 255, 128  # grey values of the background, and of pixels that do not change
_AMPLIFIED = 4.0  # factor by which the changes of grey values are amplified


def contact_sheet(
    sequence: Source,
    perturbation: Perturbation,
    indices: Collection[int],
    start: int = 0,
    every: int = 1,
) -> Image:
    """Draw a grey image that shows a perturbation, with one row for each frame.

    Each row shows the original left image, the perturbed images, and the amplified difference
    between the original and the perturbed image. For a stereo pair, it is the difference of the
    image that changes more.

    Args:
        indices: indices of the frames to show.
        start: if ``sequence`` is a selection of frames, the number of its first frame in the data
            set.
        every: step with which the frames were selected. The labels show the number of each frame in
            the data set.

    Raises:
        InputError: the sequence does not have the data that the perturbation needs.
        UnreadableImageError: one of the frames cannot be read.
    """
    perturbation = perturbation.bound_to(sequence)
    rows = []
    for index in indices:
        label = f"frame {start + every * index}, {sequence.timestamps[index]:.1f} s"
        rows.append(_row(sequence, perturbation, index, label))
    return np.vstack(rows)


def sheet_of_laws(sequence: Source, specs: Collection[str], index: int, seed: int) -> Image:
    """Draw a grey image that shows several perturbations of one frame.

    Each perturbation has a row with the original left image, the perturbed images, and their
    difference multiplied by a factor. Several rows are arranged in two columns.

    Raises:
        InputError: the sequence does not have the data that a perturbation needs.
        UnreadableImageError: the frame cannot be read.
    """
    rows = [
        _row(sequence, parse_perturbation(spec, seed).bound_to(sequence), index, spec)
        for spec in specs
    ]
    if len(rows) == 1:
        return rows[0]
    if len(rows) % 2:
        rows.append(np.full_like(rows[0], _PAPER))
    half = len(rows) // 2
    return np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])])


def laws_for(sequence: Source) -> tuple[list[str], dict[str, str]]:
    """Return the names of the laws (kinds of perturbation) that can be applied to a source.

    The second result maps the name of each other law to the reason why it cannot be applied.
    """
    applicable, reasons = [], {}
    for name in all_laws():
        try:
            parse_perturbation(name, 0).bound_to(sequence)
        except InputError as error:
            reasons[name] = str(error)
        else:
            applicable.append(name)
    return applicable, reasons


def _row(sequence: Source, perturbation: Perturbation, index: int, label: str) -> Image:
    t = float(sequence.timestamps[index] - sequence.timestamps[0])
    left, second = sequence.read(index)
    try:
        new_left, new_second = perturbation.apply(index, t, left, second)
    except DroppedFrameError:
        new_left, new_second = (
            np.zeros_like(left),
            None if second is None else np.zeros_like(second),
        )
    pairs = {"left": (left, new_left)}
    if new_second is not None and new_second.dtype == np.uint8:
        pairs["right"] = np.asarray(second, np.uint8), np.asarray(new_second, np.uint8)
    changes = {side: after.astype(float) - before for side, (before, after) in pairs.items()}
    side = max(changes, key=lambda name: float(np.abs(changes[name]).mean()))
    change = np.clip(_MIDDLE + _AMPLIFIED * changes[side], 0, 255).astype(np.uint8)
    panels = {f"{label}: original left image": left}
    panels |= {f"{name} perturbed": after for name, (_, after) in pairs.items()}
    panels[f"change of {side}, times {_AMPLIFIED:g}"] = change
    return np.hstack([_titled(title, image) for title, image in panels.items()])


def _titled(title: str, image: Image) -> Image:
    import cv2

    height = round(_WIDTH * image.shape[0] / image.shape[1])
    panel = np.full((_TITLE + height + _GUTTER, _WIDTH + _GUTTER), _PAPER, np.uint8)
    panel[_TITLE : _TITLE + height, :_WIDTH] = cv2.resize(
        image, (_WIDTH, height), interpolation=cv2.INTER_AREA
    )
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(panel, title, (2, _TITLE - 7), font, 0.45, 0, 1, cv2.LINE_AA)
    return panel


def _parse_strength(spec: str, kind: LawKind, text: str) -> float:
    try:
        strength = float(text)
    except ValueError:
        strength = float("nan")
    if not (isfinite(strength) and kind.least <= strength <= kind.most):
        unit = "" if kind.unit == "x" else f" {kind.unit}"
        raise InputError(
            f"--perturb {spec}: bad strength '{text}'; give a number from {kind.least:g} to "
            f"{kind.most:g}{unit}; the default is {kind.default:g}."
        )
    return strength
