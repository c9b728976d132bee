"""From which of many points of one problem searches start: multi-level single linkage."""

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import gammaln

from mpmjax._types import Float, Int, Scalar


def linked(shares: Float[np.ndarray, "k n"], costs: Float[np.ndarray, "k"], fraction: Scalar) -> Int[np.ndarray, "k"]:
    """For each point the number of the one that stands for it, from which a search starts; its own where one starts
    there, and -1 where the cost is not finite.

    Multi-level single linkage (A. H. G. Rinnooy Kan, G. T. Timmer, Mathematical Programming 39 (1987) 57-78): a search
    starts from each point that has no better one within the critical distance

        r = π^(-1/2) (Γ(1 + n/2) σ ln k / k)^(1/n),  σ = 2,

    of k even points of the unit cube: in a ball of this radius lie σ ln k of them. Any other point is linked to the
    nearest better one, and so on to one that is searched from. Of a rough function that is too few: a fraction of all
    points, the best ones, is searched from besides, whatever their neighbours.

    Args:
        shares: the points, evenly spread over the unit cube.
        costs: the function there; not finite where it is not known.
        fraction: from 0, none besides, to 1, all.
    """
    count, size = shares.shape
    stands = np.full(count, -1)
    known = np.isfinite(costs)
    order = np.argsort(np.where(known, costs, np.inf), kind="stable")[: known.sum()]
    near = critical_distance(count, size)
    for place, k in enumerate(order):
        better = order[:place]
        distances = cdist(shares[k : k + 1], shares[better])[0]
        alone = place < fraction * count or (distances > near).all()
        stands[k] = k if alone else stands[better[distances.argmin()]]
    return stands


def critical_distance(count: int, size: int) -> float:
    """The radius of a ball in which σ ln k of k points of the unit cube of n dimensions lie, but for its boundary."""
    if count < 2:
        return 0.0
    logarithm = gammaln(1 + size / 2) + np.log(_SIGMA * np.log(count) / count)
    return float(np.exp(logarithm / size) / np.sqrt(np.pi))


_SIGMA = 2.0
"""σ of the critical distance."""
