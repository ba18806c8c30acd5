"""The sets of a certificate in their planes, as one figure of matplotlib: what `RoaResult.plot` gives.

Unlike the pictures of a page it is handed on as a figure, to be changed and saved by whoever asked for it; and nothing
in it is simulated or sampled: ellipses, and the domain's box.
"""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from certify.certificate import Certificate
from certify.report.figures.geometry import ellipse, shadow
from certify.report.figures.scene import Scene, planes
from certify.report.figures.style import INK, INNER, INNER_FILL, RC, SET, SET_FILL, line
from certify.report.words import below, inner_level

_SIDE, _HEIGHT = 4.2, 3.9  # inches of a plane


def sets(certificate: Certificate, accepted: bool) -> Figure:
    """For each plane the section of {V <= c2} and of the inner set, the projection, and the domain.

    Parameters
    ----------
    certificate : what is drawn.
    accepted : whether the checker accepted it; if not, the legend speaks of a claim.

    Raises
    ------
    CertificateFormatError : there is no ellipsoid to draw.
    """
    scene = Scene(certificate, accepted)
    pairs = planes(scene)
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(_SIDE * max(1, len(pairs)), _HEIGHT), layout="constrained")
        if not pairs:
            _on_the_line(scene, figure.add_subplot())
        for k, pair in enumerate(pairs):
            _in_a_plane(scene, pair, figure.add_subplot(1, len(pairs), k + 1))
        figure.legend(handles=_legend(scene), loc="outside lower center", ncols=2)
    return figure


def _in_a_plane(scene: Scene, pair: tuple[int, int], axes: Any) -> None:
    i, j = pair
    outer, inner = (ellipse(scene.P, pair, level) for level in (scene.outer, scene.inner))
    axes.fill(*outer, color=SET_FILL, lw=0)
    axes.plot(*outer, color=SET, lw=1.8)
    if scene.n > 2:
        axes.plot(*shadow(scene.P, pair, scene.outer), color=SET, lw=1.0, ls=":")
    axes.fill(*inner, color=INNER_FILL, lw=0)
    axes.plot(*inner, color=INNER, lw=1.4)
    corners = [(a, b) for a in (scene.lo[i], scene.hi[i]) for b in (scene.lo[j], scene.hi[j])]
    x, y = zip(*(corners[k] for k in (0, 1, 3, 2, 0)), strict=True)
    axes.plot(x, y, color=INK, lw=1.0)
    axes.set_xlabel(scene.labels[i])
    axes.set_ylabel(scene.labels[j])


def _on_the_line(scene: Scene, axes: Any) -> None:
    x = np.linspace(scene.lo[0], scene.hi[0], 401)
    for reach, fill, colour in ((scene.reach[0], SET_FILL, SET), (scene.inner_reach[0], INNER_FILL, INNER)):
        axes.axvspan(-reach, reach, facecolor=fill, edgecolor=colour, lw=1.4)
    axes.plot(x, scene.P[0, 0] * x * x, color=INK, lw=1.0)
    axes.set_xlim(scene.lo[0], scene.hi[0])
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel("V")


def _legend(scene: Scene) -> list[Any]:
    handles = [
        line(SET, 1.8, f"{scene.word} set, V = {below(scene.outer, 4)}"),
        line(INNER, 1.4, f"{scene.words.inner_set}, V = {inner_level(scene.kind, scene.inner, 3)}"),
        line(INK, 1.0, "V" if scene.n == 1 else "domain"),
    ]
    return [*handles, line(SET, 1.0, "its projection", ":")] if scene.n > 2 else handles
