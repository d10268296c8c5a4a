"""Opens image sets for tests of loop detectors: rendered towns, and collections of images."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError, counted
from vslam_lab.loopbench.conditions import Condition, Image, apply
from vslam_lab.sources.image_source import UNKNOWN, ImageSource
from vslam_lab.sources.source_registry import open_source, split_spec

ProgressBar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
"""A function of ``(text, number of steps)`` that returns a context manager with a progress bar.

The context manager yields a function that must be called after each step.
"""

_GAP = 50  # number of images just before a query of a drive in which no match is searched for


@dataclass(frozen=True)
class QuerySet:
    """Query images, gallery images in which their places are searched for, and the ground truth.

    Attributes:
        queries: Q images, each ``(H, W)`` uint8, with the change of the condition.
        gallery: G unchanged images, each ``(H, W)`` uint8.
        relation: ``(Q, G)`` int8. 1 means that a query and a gallery image show the same place, and
            -1 means that they show different places. Pairs with the value 0 (unknown) are left out.
        in_order: whether the queries and the gallery images are in the order of a drive.
    """

    queries: list[Image]
    gallery: list[Image]
    relation: NDArray[np.int8]
    in_order: bool = False


@dataclass(frozen=True)
class TestSet:
    """One set of images for tests of loop detectors.

    Attributes:
        title: title of the set in the report.
        query_set: function of ``(condition, seed)`` that returns the images of the set, with the
            change of the condition applied to the query images. None if the change cannot be
            applied to this set.
    """

    __test__ = False  # pytest must not collect this class because of its name

    title: str
    query_set: Callable[[Condition, int], QuerySet | None]


def open_set(spec: str, cache: Path, *, threads: int, progress_bar: ProgressBar) -> list[TestSet]:
    """Open a set of images for tests of loop detectors.

    A town is rendered into ``cache`` when its images are first needed. It is rendered again for
    each change in viewpoint and for each change of the town.

    Args:
        spec: ``town:ROUTE[seed=101,aliased=1,places=150]`` for a rendered town. Otherwise, a source
            of images in the same spelling as for ``vslam train``.
        cache: folder of rendered towns.

    Raises:
        InputError: the kind, route or an option is unknown, the data is missing or malformed, or a
            drive is too short for queries.
    """
    if split_spec(spec)[0] != "town":
        return [_images(spec, source) for source in open_source(spec)]
    route, given = rendered_route(spec, {"seed": 0, "aliased": 0, "places": 150})
    seed, aliased, places = given.values()
    return [
        _town(route, seed, bool(aliased), places, cache, threads=threads, progress_bar=progress_bar)
    ]


def rendered_route(spec: str, defaults: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Parse the route and the options of a text ``KIND:ROUTE[options]``, which names a town.

    Options that are not given have the values in ``defaults``.

    Raises:
        InputError: the route or an option is unknown, or an option is not a number.
    """
    from vslam_lab.towns import ROUTES

    kind, route, given = split_spec(spec)
    if route not in ROUTES or not set(given) <= set(defaults):
        raise InputError(
            f"--data {spec}: must be {kind}:ROUTE with a route of {', '.join(ROUTES)} and options "
            f"{', '.join(defaults)}."
        )
    try:
        return route, defaults | {name: type(defaults[name])(given[name]) for name in given}
    except ValueError as error:
        raise InputError(f"--data {spec}: one of the options is not a number.") from error


def _images(spec: str, source: ImageSource) -> TestSet:
    is_query = source.is_query
    if is_query is None and len(source) <= _GAP:
        raise InputError(
            f"--data {spec}: {source.name} has only {counted(len(source), 'image')}; give more "
            f"than {_GAP}."
        )
    index = np.arange(len(source))
    queries = index if is_query is None else np.flatnonzero(is_query)
    gallery = index if is_query is None else np.flatnonzero(~is_query)
    relation = source.relation[np.ix_(queries, gallery)].copy()
    if is_query is None:
        relation[index[:, None] - index[None] < _GAP] = UNKNOWN
        queries, gallery = queries[_GAP:], gallery[:-_GAP]
        relation = relation[_GAP:, :-_GAP]

    def query_set(condition: Condition, seed: int) -> QuerySet | None:
        if condition.kind == "change":
            return None
        as_taken = [source.grey(int(i)) for i in gallery]
        changed = apply(condition, [source.grey(int(i)) for i in queries], seed, rendered=False)
        return QuerySet(changed, as_taken, relation, in_order=is_query is None)

    return TestSet(source.name, query_set)


def _town(
    name: str,
    seed: int,
    aliased: bool,
    places: int,
    cache: Path,
    *,
    threads: int,
    progress_bar: ProgressBar,
) -> TestSet:
    from vslam_lab.towns import built_in_route, store
    from vslam_lab.towns.pairs import Moves, render_pairs
    from vslam_lab.towns.site import Variation

    def query_set(condition: Condition, draw: int) -> QuerySet | None:
        change, view = condition.change, condition.view
        town = f"{name}-seed{seed}{'-aliased' if aliased else ''}-{places}"
        folder = store.place_folder(cache) / f"{town}-view{view:g}-change{change:g}"
        if not (folder / "pairs.csv").exists():
            variation = Variation(seed, aliased, change)
            moves = Moves(condition.lateral, condition.heading)
            with progress_bar(f"rendering {folder.name}", places) as advance:
                render_pairs(
                    built_in_route(name), variation, folder, places, moves,
                    kinds=("shift",), threads=threads, on_frame=lambda done, of: advance(),
                )  # fmt: skip
        (source,) = open_source(f"pairs:{folder}")
        assert source.is_query is not None
        queries, gallery = np.flatnonzero(source.is_query), np.flatnonzero(~source.is_query)
        changed = apply(condition, [source.grey(int(i)) for i in queries], draw, rendered=True)
        relation = source.relation[np.ix_(queries, gallery)]
        return QuerySet(changed, [source.grey(int(i)) for i in gallery], relation)

    return TestSet(f"{name} {'aliased ' if aliased else ''}town {seed}", query_set)
