"""How a monocular map begins: a frame is kept until a later one forms a pair with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vslam.backend.two_views import adjust_two_views
from vslam.frontend.initialization import match_views, reconstruct
from vslam.frontend.tracking import Frame, Tracker

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class FirstView:
    """A frame that a map may begin with.

    Attributes:
        frame: with its features, and the pose that the map is to begin at.
        timestamp: seconds.
        index: number of the frame in the run.
        image: the left image, for loop detectors that look at it.
    """

    frame: Frame
    timestamp: float
    index: int
    image: NDArray[np.uint8] | None


@dataclass(frozen=True)
class Start:
    """Two views that make a map.

    Attributes:
        first: the earlier one; the later one is the frame in hand.
        T_2_1: ``(4, 4)`` motion from the first to the second.
        features: ``(N,)`` int64 features of both that see the same point.
        points: ``(N, 3)`` in the first camera.
    """

    first: FirstView
    T_2_1: Matrix
    features: tuple[NDArray[np.int64], NDArray[np.int64]]
    points: Matrix

    def scaled(self, factor: float) -> Start:
        """The same views in another unit."""
        T_2_1 = self.T_2_1.copy()
        T_2_1[:3, 3] *= factor
        return replace(self, T_2_1=T_2_1, points=factor * self.points)


class Initialiser:
    """Looks for two views that make a map, one frame after the other."""

    def __init__(self, tracker: Tracker) -> None:
        self._tracker = tracker
        self._first: FirstView | None = None

    def reset(self) -> None:
        """Forget the frame kept."""
        self._first = None

    def offer(self, view: FirstView) -> Start | None:
        """Try a frame with the one kept; where they have too little in common, keep this one."""
        config = self._tracker.config.initialization
        if self._first is None or view.timestamp - self._first.timestamp > config.max_seconds:
            self._keep(view)
            return None
        features = match_views(self._first.frame, view.frame, self._tracker)
        if len(features[0]) < config.min_matches:
            self._keep(view)
            return None
        return self._pair(self._first, view, features)

    def _keep(self, view: FirstView) -> None:
        enough = len(view.frame.features) >= self._tracker.config.initialization.min_features
        self._first = view if enough else None

    def _pair(
        self, first: FirstView, second: FirstView, features: tuple[NDArray, NDArray]
    ) -> Start | None:
        config, camera = self._tracker.config.initialization, self._tracker.camera
        of_1, of_2 = first.frame.features, second.frame.features
        xy_1, xy_2 = of_1.xy[features[0]].astype(float), of_2.xy[features[1]].astype(float)
        sigma = self._tracker.scales[of_1.octave[features[0]]]
        found = reconstruct(xy_1, xy_2, sigma, camera, config, seed=second.index)
        if found is None:
            return None
        match = found.match
        T_2_1, points, kept = adjust_two_views(
            found.T_2_1,
            found.points,
            np.stack([xy_1[match], xy_2[match]], axis=1),
            sigma[match],
            camera,
            config.median_depth,
        )
        if np.count_nonzero(kept) < config.min_landmarks:
            return None
        match = match[kept]
        return Start(first, T_2_1, (features[0][match], features[1][match]), points[kept])
