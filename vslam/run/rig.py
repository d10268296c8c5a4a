"""Faults of a stereo rig that show in a run, said in sentences for its report."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from vslam.frontend.sides import Sides

_FEWEST = 3  # frames: below that it was a reflection or a hand


def rig_warnings(sides: Sequence[Sides]) -> list[str]:
    """What set the sides apart during a run, nothing for a rig without a fault."""
    found = []
    for side, other, effect in (
        ("left", "right", "they could not be tracked"),
        ("right", "left", "they were tracked with the left side alone"),
    ):
        black = sum(pair.black == side for pair in sides)
        if black >= _FEWEST:
            found.append(
                f"The {side} side was black in {black} of {len(sides)} frames while the {other} "
                f"one was not: {effect}. Check its cable, shutter and lens cap."
            )
    darker = [pair.darker_stops for pair in sides if pair.darker_stops]
    if len(darker) >= _FEWEST:
        stops = statistics.median(darker)
        side, other = ("right", "left") if stops > 0 else ("left", "right")
        found.append(
            f"The {side} side was {abs(stops):.1f} stops darker than the {other} one in "
            f"{len(darker)} of {len(sides)} frames: it was brightened to match. Check exposure, "
            "gain and aperture of both."
        )
    return found
