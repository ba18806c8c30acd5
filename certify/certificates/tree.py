"""The bytes of a partition tree, decoded for pictures.

The checker has a decoder of its own; this one trades its small memory for speed on a million nodes.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertificateFormatError

Array = NDArray[np.float64]
LEAF = 255


def leaves(tree: bytes, root: Array) -> tuple[Array, Array]:
    """The boxes `lo <= z <= hi` of a partition of |z| <= root, both (N, n): `leaves_within` that box.

    Examples
    --------
    >>> leaves(bytes([0, 255, 255]), np.ones(1))[0].tolist()
    [[-1.0], [0.0]]
    """
    return leaves_within(tree, -np.asarray(root), np.asarray(root))


def leaves_within(tree: bytes, lo: Array, hi: Array) -> tuple[Array, Array]:
    """The boxes that the preorder bytes stand for, lower and upper corners, both (N, n), in the order of the tree.

    A byte below n splits that axis at the float `0.5 * lo + 0.5 * hi`, lower half first; 255 is a leaf. Parents are
    found in one pass over the bytes, boxes level by level, so that a million nodes take seconds, not minutes.

    Parameters
    ----------
    tree : one byte per node.
    lo, hi : (n,), the root box.

    Raises
    ------
    CertificateFormatError : the bytes are not exactly one tree over n axes.
    """
    nodes = np.frombuffer(tree, dtype=np.uint8)
    n = len(lo)
    if np.any((nodes >= n) & (nodes != LEAF)):
        raise CertificateFormatError(f"the partition tree splits an axis that does not exist; it has {n}.")
    parents, upper_child, depth = _parents(nodes)
    lower, upper = np.empty((len(nodes), n)), np.empty((len(nodes), n))
    lower[0], upper[0] = lo, hi
    order = np.argsort(depth, kind="stable")
    bounds = np.searchsorted(depth[order], np.arange(1, int(depth.max()) + 2))
    for start, stop in pairwise(bounds.tolist()):
        children = order[start:stop]
        above = parents[children]
        lower[children], upper[children] = lower[above], upper[above]
        axis = nodes[above]
        middle = 0.5 * lower[above, axis] + 0.5 * upper[above, axis]
        high = upper_child[children]
        lower[children[high], axis[high]] = middle[high]
        upper[children[~high], axis[~high]] = middle[~high]
    return lower[nodes == LEAF], upper[nodes == LEAF]


def _parents(nodes: NDArray[np.uint8]) -> tuple[NDArray[np.intp], NDArray[np.bool_], NDArray[np.intp]]:
    """Parent, whether it is the upper child, and depth of each node."""
    parents, high, depths = [-1] * len(nodes), [False] * len(nodes), [0] * len(nodes)
    waiting: list[tuple[int, bool, int]] = [(-1, False, 0)]  # parent, upper child?, depth
    for k, node in enumerate(nodes.tolist()):
        if not waiting:
            raise CertificateFormatError(f"the partition tree has {len(nodes) - k} bytes too many.")
        parents[k], high[k], depths[k] = waiting.pop()
        if node != LEAF:
            waiting.append((k, True, depths[k] + 1))
            waiting.append((k, False, depths[k] + 1))
    if waiting:
        raise CertificateFormatError(f"the partition tree ends early; {len(waiting)} subtrees are missing.")
    return np.array(parents), np.array(high), np.array(depths)
