"""Networks: vector functions written as steps, read by one interpreter over an algebra."""

from __future__ import annotations

from certify.loop.networks.floats import (
    Gradients,
    Tangent,
    Tangents,
    Values,
    evaluated,
    has_kink_at,
    mean_tangent,
    tangent_at,
    values,
)
from certify.loop.networks.layers import clipped, frozen, frozen_layers, like, sha256_of, tanh, through, widths
from certify.loop.networks.steps import (
    Affine,
    Algebra,
    Clip,
    Concat,
    Map,
    Network,
    Observe,
    Product,
    Step,
    Sum,
    layered,
    repeated,
)

__all__ = [
    "Affine",
    "Algebra",
    "Clip",
    "Concat",
    "Gradients",
    "Map",
    "Network",
    "Observe",
    "Product",
    "Step",
    "Sum",
    "Tangent",
    "Tangents",
    "Values",
    "clipped",
    "evaluated",
    "frozen",
    "frozen_layers",
    "has_kink_at",
    "layered",
    "like",
    "mean_tangent",
    "repeated",
    "sha256_of",
    "tangent_at",
    "tanh",
    "through",
    "values",
    "widths",
]
