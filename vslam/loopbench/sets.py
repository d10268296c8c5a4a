"""Images to test loop detectors on: rendered towns, drives and collections with ground truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.errors import InputError
from vslam.loopbench.conditions import Condition, Image, apply
from vslam.loopclosure.siamese.places import UNKNOWN, Places, open_source, split_spec
from vslam.progress import count_bar

_GAP = 50  # images of a drive: it does not ask for the place where it just was
_OPTIONS = {"seed": "0", "aliased": "0", "places": "150"}


@dataclass(frozen=True)
class Questions:
    """Images that ask for their place, images asked for, and what is true.

    Attributes:
        queries: Q images ``(H, W)`` uint8, under the condition.
        gallery: G images as they were taken.
        relation: ``(Q, G)`` int8, 1 same place, -1 another, 0 not known: left out.
    """

    queries: list[Image]
    gallery: list[Image]
    relation: NDArray[np.int8]


@dataclass(frozen=True)
class TestSet:
    """One set of images.

    Attributes:
        title: of the report.
        ask: questions under a condition, None where the set cannot be put under it.
    """

    __test__ = False  # no test, whatever pytest thinks of its name

    title: str
    ask: Callable[[Condition, int], Questions | None]


def open_set(spec: str, cache: Path, *, threads: int, shown: bool) -> list[TestSet]:
    """Open ``town:ROUTE[seed=101,aliased=1,places=150]`` or a source as of ``vslam train``.

    A town is rendered on first use, anew for each viewpoint and change, into ``cache``.

    Raises:
        InputError: unknown kind, route or option, or data that is missing or malformed.
    """
    kind, route, given = split_spec(spec)
    if kind != "town":
        return [_images(source) for source in open_source(spec)]
    from vslam.datasets.synthetic import ROUTES

    options = {**_OPTIONS, **given}
    if route not in ROUTES or set(options) != set(_OPTIONS):
        raise InputError(
            f"--data {spec}: must be town:ROUTE with a route of {', '.join(ROUTES)} and options "
            f"{', '.join(_OPTIONS)}."
        )
    try:
        seed, aliased, places = (int(options[key]) for key in _OPTIONS)
    except ValueError as error:
        raise InputError(f"--data {spec}: an option is not a number.") from error
    return [_town(route, seed, bool(aliased), places, cache, threads=threads, shown=shown)]


def _images(source: Places) -> TestSet:
    asks = source.asks
    index = np.arange(len(source))
    queries = index if asks is None else np.flatnonzero(asks)
    gallery = index if asks is None else np.flatnonzero(~asks)
    relation = source.relation[np.ix_(queries, gallery)].copy()
    if asks is None:
        relation[index[:, None] - index[None] < _GAP] = UNKNOWN
        queries, gallery = queries[_GAP:], gallery[:-_GAP]
        relation = relation[_GAP:, :-_GAP]

    def ask(condition: Condition, seed: int) -> Questions | None:
        if condition.kind == "change":
            return None
        asked = [source.grey(int(i)) for i in gallery]
        asking = apply(condition, [source.grey(int(i)) for i in queries], seed, rendered=False)
        return Questions(asking, asked, relation)

    return TestSet(source.name, ask)


def _town(
    name: str, seed: int, aliased: bool, places: int, cache: Path, *, threads: int, shown: bool
) -> TestSet:
    from vslam.datasets.synthetic import built_in_route, store
    from vslam.datasets.synthetic.pairs import Moves, render_pairs
    from vslam.datasets.synthetic.site import Variation

    def ask(condition: Condition, draw: int) -> Questions | None:
        change, view = condition.change, condition.view
        town = f"{name}-seed{seed}{'-aliased' if aliased else ''}-{places}"
        folder = store.place_folder(cache) / f"{town}-view{view:g}-change{change:g}"
        if not (folder / "pairs.csv").exists():
            variation = Variation(seed, aliased, change)
            moves = Moves(condition.lateral, condition.heading)
            with count_bar(f"rendering {folder.name}", places, shown=shown) as advance:
                render_pairs(
                    built_in_route(name), variation, folder, places, moves,
                    kinds=("shift",), threads=threads, on_frame=lambda done, of: advance(),
                )  # fmt: skip
        (source,) = open_source(f"pairs:{folder}")
        assert source.asks is not None
        queries, gallery = np.flatnonzero(source.asks), np.flatnonzero(~source.asks)
        asking = apply(condition, [source.grey(int(i)) for i in queries], draw, rendered=True)
        relation = source.relation[np.ix_(queries, gallery)]
        return Questions(asking, [source.grey(int(i)) for i in gallery], relation)

    return TestSet(f"{name} {'aliased ' if aliased else ''}town {seed}", ask)
