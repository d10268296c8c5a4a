"""Measures loop detectors on test sets, before and after geometric verification."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.loopclosure.local_matching import (
    MIN_COARSE_SIMILARITY,
    MIN_FINE_SIMILARITY,
    REACH,
    fine_agreement,
    homography_inliers,
    locate,
    match_coarse,
)
from vslam.loopclosure.verification import MATCH_DISTANCE, MATCH_RATIO
from vslam.types.geometry import Matrix
from vslam_lab.loopbench.conditions import Condition
from vslam_lab.loopbench.detectors import (
    DescribedImage,
    DetectorSet,
    LocalDescriptorCache,
    Scorer,
)
from vslam_lab.loopbench.node_matching import match_by_node
from vslam_lab.loopbench.schema import Curve, Gain, Score, Verified
from vslam_lab.loopbench.sets import QuerySet, TestSet
from vslam_lab.precision_recall import (
    PrecisionRecall,
    accepted_at,
    average_precision,
    balanced_accuracy,
    precision_recall,
    summary,
    top_k_precision_recall,
)
from vslam_lab.sources.image_source import DIFFERENT, SAME, UNKNOWN

# Verification by learned descriptors: the least number of confirmed cells (`confirmed_cells`), and
# the least cosine similarity of a coarse match that is counted.
MIN_CONFIRMED, LEAST_COSINE = 28, 0.5
_KEYPOINTS = 600  # ORB features of the first image that are located in the second image, at most
# Verification by ORB: the least number of matches that fit one epipolar geometry. ORB-SLAM (VII-B)
# requires 20 matches that fit a motion in 3D.
MIN_MATCHES = 20
_EPIPOLAR_PIXELS = 2.0
_CURVE_POINTS = 200
TOP = 5  # the largest number of candidates of a query in the curves over the top K candidates
_RESAMPLES = 200  # bootstrap resamples of the queries
# Matching of sequences, as in OpenSeqSLAM (Sünderhauf et al., ICRA 2013 workshop).
LENGTH = 10  # number of queries in a sequence
SPEEDS = (0.8, 0.9, 1.0, 1.1, 1.2)  # number of gallery images per query
_LEAST_P = 1e-6  # probabilities that are nearer to 0 or 1 are clipped


def measure(
    test_set: TestSet,
    condition: Condition,
    detectors: DetectorSet,
    seed: int,
) -> tuple[list[Score], list[Gain]]:
    """Evaluate all loop detectors on a set of images under one condition.

    A condition is a change that is applied to the query images. If it cannot be applied to this
    set, two empty lists are returned.

    Returns:
        Two lists. The first list contains the scores of the detectors. The second list contains,
        for each detector except the first one, its average precision minus that of the first one.
    """
    query_set = test_set.query_set(condition, seed)
    if query_set is None:
        return [], []
    queries = detectors.describe(query_set.queries)
    gallery, stored = detectors.gallery(query_set.gallery)
    verify = Verification(queries, gallery, detectors.local)
    found = {one.name: one.scores(queries, stored[one.name]) for one in detectors.scorers}
    scores = [
        _score(test_set.title, condition, scorer, found[scorer.name], query_set, verify)
        for scorer in detectors.scorers
    ]
    first, *others = found
    gains = [
        _gain(test_set.title, condition, first, other, found, query_set.relation)
        for other in others
    ]
    return scores, gains


def _score(
    title: str,
    condition: Condition,
    scorer: Scorer,
    scores: Matrix,
    query_set: QuerySet,
    verify: Verification,
) -> Score:
    known = query_set.relation != UNKNOWN
    same, score = query_set.relation[known] == SAME, scores[known]
    accuracy: dict[str, float | None] = {
        str(threshold): balanced_accuracy(same, score, threshold) if scorer.probability else None
        for threshold in (0.5, 0.9)
    }
    curve = precision_recall(same, score)
    top = [
        top_k_precision_recall(query_set.relation == SAME, scores, k, known)
        for k in range(1, TOP + 1)
    ]
    answerable = (query_set.relation == SAME).any(1)
    best, truth = _best_images(scores, query_set.relation)
    sequence_right = None
    if query_set.in_order:
        over_sequences = sequence_scores(log_odds(scores) if scorer.probability else scores)
        _, found = _best_images(over_sequences, query_set.relation)
        sequence_right = float((found == SAME)[answerable].mean())
    right, wrong = (truth == SAME)[answerable], truth == DIFFERENT
    orb = np.array([verify.by_orb(q, int(g)) for q, g in enumerate(best)])
    learned = np.array([verify.by_learned(q, int(g)) for q, g in enumerate(best)])
    verified = {
        name: Verified(
            right=float((accepted[answerable] & right).mean()),
            wrong=int((accepted & wrong).sum()),
        )
        for name, accepted in (("orb", orb), ("learned", learned), ("both", orb | learned))
    }
    return Score(
        data=title,
        condition=condition.name,
        detector=scorer.name,
        figures=summary(same, score),
        accuracy=accuracy,
        accepted=accepted_at(curve, 0.9) if scorer.probability else None,
        queries=int(answerable.sum()),
        first_right=float(right.mean()),
        sequence_right=sequence_right,
        verified=verified,
        curve=thinned(curve),
        top_average_precision=tuple(map(average_precision, top)),
        top_curve=thinned(top[-1]),
    )


def _best_images(
    scores: Matrix, relation: NDArray[np.int8]
) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
    """For each query, find the most similar gallery image whose relation to the query is known.

    Returns the indices of these images, and their relations to the queries.
    """
    best = np.where(relation != UNKNOWN, scores, -np.inf).argmax(1)
    return best, relation[np.arange(len(best)), best]


def thinned(curve: PrecisionRecall) -> Curve:
    """Reduce the number of points of a precision-recall curve, using equal intervals of recall.

    Equal steps in the number of accepted pairs would not be suitable. A good detector ranks the few
    true pairs before thousands of false pairs, so that nearly the whole curve would lie within the
    first step.
    """
    points = drawn_points(curve)
    return Curve(
        precision=curve.precision[points].round(5).tolist(),
        recall=curve.recall[points].round(5).tolist(),
    )


def drawn_points(curve: PrecisionRecall) -> NDArray[np.int64]:
    """Return the indices of the points of a precision-recall curve that are drawn.

    These are the first point, and the points that are nearest to equal steps of recall.
    """
    wanted = np.linspace(0.0, curve.recall[0], _CURVE_POINTS)
    reached = len(curve.recall) - 1 - np.searchsorted(curve.recall[::-1], wanted)
    return np.unique(np.append(reached, 0))


def _gain(
    title: str,
    condition: Condition,
    first: str,
    second: str,
    found: dict[str, Matrix],
    relation: NDArray[np.int8],
) -> Gain:
    """Compute the difference between the average precision (AP) of two detectors.

    The 95 % confidence interval is computed by a bootstrap over the queries.
    """
    known, rng = relation != UNKNOWN, np.random.default_rng(0)

    def gain(rows: NDArray[np.integer]) -> float:
        mask = known[rows]
        same = relation[rows][mask] == SAME
        if not same.any():
            return 0.0
        ap = [average_precision(precision_recall(same, found[name][rows][mask]))
              for name in (first, second)]  # fmt: skip
        return ap[1] - ap[0]

    n = len(relation)
    drawn = [gain(rng.integers(n, size=n)) for _ in range(_RESAMPLES)]
    low, high = np.quantile(drawn, [0.025, 0.975])
    return Gain(
        data=title, condition=condition.name, first=first, second=second,
        difference=gain(np.arange(n)), low=float(low), high=float(high),
    )  # fmt: skip


class Verification:
    """Decides whether two images show the same place, using local features (with a cache)."""

    def __init__(
        self,
        queries: list[DescribedImage],
        gallery: list[DescribedImage],
        local: LocalDescriptorCache,
    ) -> None:
        self._queries, self._gallery, self._local = queries, gallery, local
        self._by_orb: dict[tuple[int, int], bool] = {}
        self._by_learned: dict[tuple[int, int], bool] = {}

    def by_orb(self, query: int, image: int) -> bool:
        """Return whether enough ORB matches of two images are inliers of one epipolar geometry."""
        key = query, image
        if key not in self._by_orb:
            inliers = epipolar_inliers(self._queries[query], self._gallery[image])
            self._by_orb[key] = inliers >= MIN_MATCHES
        return self._by_orb[key]

    def by_learned(self, query: int, image: int) -> bool:
        """Return whether learned local descriptors of two images confirm enough cells."""
        key = query, image
        if key not in self._by_learned:
            confirmed = confirmed_cells(self._queries[query], self._gallery[image], self._local)
            self._by_learned[key] = confirmed >= MIN_CONFIRMED
        return self._by_learned[key]


def confirmed_cells(a: DescribedImage, b: DescribedImage, local: LocalDescriptorCache) -> float:
    """Count the cells of two images that match, weighted by how well their keypoints agree.

    There is one coarse descriptor for each cell of a grid of the image. The number of coarse
    matches that fit one homography is multiplied by the share of fine matches that fit another one
    (``fine_agreement``). Coarse matches in the sky and on repeated facades then count little.

    Fewer than ``MIN_CONFIRMED`` coarse matches are returned without a search for fine matches.
    """
    coarse_a, coarse_b = local.of(a), local.of(b)
    counted = match_coarse(coarse_a, coarse_b, LEAST_COSINE)
    cells = homography_inliers(counted, coarse_a, coarse_b)
    if cells < MIN_CONFIRMED:
        return float(cells)
    guides = match_coarse(coarse_a, coarse_b, MIN_COARSE_SIMILARITY)
    chosen = np.linspace(0, len(a.xy) - 1, min(_KEYPOINTS, len(a.xy))).astype(np.int64)
    xy, fine_a, fine_b = a.xy[chosen], local.with_fine(a), local.with_fine(b)
    located = locate(xy, fine_a, fine_b, guides, REACH, MIN_FINE_SIMILARITY)
    return cells * fine_agreement(xy, located, fine_a, fine_b)


def epipolar_inliers(a: DescribedImage, b: DescribedImage) -> int:
    """Count the ORB matches between two images that are inliers of the best fundamental matrix."""
    import cv2

    match = match_by_node(
        *a.nodes, a.descriptors.view(np.uint64), *b.nodes, b.descriptors.view(np.uint64),
        MATCH_DISTANCE, MATCH_RATIO,
    )  # fmt: skip
    rows = np.flatnonzero(match >= 0)
    if len(rows) < MIN_MATCHES:
        return 0
    _, inlier = cv2.findFundamentalMat(
        a.xy[rows], b.xy[match[rows]], cv2.USAC_DEFAULT, _EPIPOLAR_PIXELS, 0.999, 2000
    )
    return 0 if inlier is None else int(inlier.sum())


def sequence_scores(scores: Matrix) -> Matrix:
    """Compute the similarity of sequences of images (SeqSLAM; Milford and Wyeth, ICRA 2012).

    The scores are averaged along straight lines of the matrix of scores. Each line corresponds to
    two sequences, one of queries and one of gallery images. The slope of the line is the ratio of
    the speeds of the two drives. The result is the highest mean score over several slopes.

    Args:
        scores: ``(Q, G)`` scores of queries and gallery images, both in driving order. A higher
            score means more similar.

    Returns:
        ``(Q, G)`` mean scores of the lines that end at each pair of images. If a line extends
        beyond the gallery, each missing score is replaced with the mean score of the query. The
        lines of the first queries are shorter.
    """
    n_queries, n_images = scores.shape
    usual = scores.mean(1)
    found = np.full(scores.shape, -np.inf)
    for speed in SPEEDS:
        along = np.zeros(scores.shape)
        for back in range(min(LENGTH, n_queries)):
            shift = min(round(speed * back), n_images)
            along[back:, shift:] += scores[: n_queries - back, : n_images - shift]
            along[back:, :shift] += usual[: n_queries - back, None]
        np.maximum(found, along, out=found)
    return np.asarray(found / np.minimum(np.arange(n_queries) + 1, LENGTH)[:, None])


def log_odds(p: Matrix) -> Matrix:
    """Compute the log odds of probabilities. Log odds of independent observations can be added."""
    p = np.clip(p, _LEAST_P, 1.0 - _LEAST_P)
    return np.asarray(np.log(p / (1.0 - p)))
