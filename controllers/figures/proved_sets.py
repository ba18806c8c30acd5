"""The proved set growing over training, as the checker accepted it of each policy, and gaps where it had nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.verdict import Verdict
from certify.loop.plants import System
from controllers.figures.states import named
from controllers.figures.style import DEEP, INK, MUTED, WIDTH, drawn
from controllers.history.proofs import Proof, ProvingOptions

Array = NDArray[np.float64]
_MAP = "viridis"
_LEAST = 20  # times the smallest volume that the largest is, from where on the axis is logarithmic


def draw_growth(system: System, seed: int, proofs: Sequence[Proof], options: ProvingOptions) -> bytes:
    """Volume of the proved set against steps; in two states also the sets, their outlines coloured by step, as PNG.

    A policy of which nothing was proved is a gap, marked below with a sign that says why: refuted or unknown.
    """

    def build() -> Any:
        from matplotlib.figure import Figure

        plane = system.n == 2
        figure = Figure(figsize=(WIDTH, 7.0 if plane else 3.6), layout="constrained")
        panels = figure.subplots(2 if plane else 1, 1, squeeze=False, height_ratios=[1.9, 1] if plane else None)[:, 0]
        if plane:
            _draw_sets(figure, panels[0], system, proofs)
        _draw_volumes(panels[-1], system, proofs)
        accepted = sum(proof.P is not None for proof in proofs)
        claims = sorted({proof.claim for proof in proofs if proof.claim}) or ["none"]
        figure.suptitle(
            f"{system.name}, seed {seed}: the proved set over training (claim: {', '.join(claims)})\n"
            f"accepted by the checker for {accepted} of {len(proofs)} policies, effort {options.effort:g} each",
            x=0.01,
            ha="left",
        )
        return figure

    return drawn(build)


def _draw_sets(figure: Any, panel: Any, system: System, proofs: Sequence[Proof]) -> None:
    """The sets {x'Px <= level}, the domain's boundary, and a scale of steps."""
    import matplotlib
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = matplotlib.colormaps[_MAP].reversed()
    outlines = {proof.step: _outline(proof.P, proof.level) for proof in proofs if proof.P is not None}
    steps = list(outlines) or [proof.step for proof in proofs]
    scale = Normalize(min(steps), max(steps))
    for step, outline in outlines.items():
        panel.plot(*outline, color=colours(scale(step)), lw=1.2)
    (left, right), (bottom, top) = (tuple(map(float, side)) for side in system.domain)
    panel.plot(
        [left, right, right, left, left],
        [bottom, bottom, top, top, bottom],
        color=INK,
        lw=1.0,
        label="domain's boundary",
    )
    panel.plot(0, 0, color=INK, marker="x", ls="", label="equilibrium")
    panel.set_xlabel(named(system, 0))
    panel.set_ylabel(named(system, 1))
    panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    panel.set_xlim(1.04 * left, 1.04 * right)
    panel.set_ylim(1.04 * bottom, 1.04 * top)
    figure.colorbar(ScalarMappable(scale, colours), ax=panel, label="environment steps", pad=0.01)


def _draw_volumes(panel: Any, system: System, proofs: Sequence[Proof]) -> None:
    steps = np.array([proof.step for proof in proofs])
    sizes = np.array([proof.volume if proof.P is not None else np.nan for proof in proofs])
    panel.plot(steps, sizes, color=DEEP["ours"], marker="o", ms=3.5, label="accepted by the checker")
    known = sizes[np.isfinite(sizes)]
    if known.size and known.max() > _LEAST * known.min():
        panel.set_yscale("log")
    elif known.size:
        panel.set_ylim(0, 1.1 * known.max())
    for verdict, marker, said in (
        (Verdict.UNKNOWN, "|", "gap: unknown, nothing proved in the time"),
        (Verdict.REFUTED, "x", "gap: refuted, the claim fails as stated"),
        (Verdict.TRUSTED, "+", "gap: a solver's word only, not checked"),
    ):
        at = [proof.step for proof in proofs if proof.verdict is verdict]
        if at:
            panel.plot(
                at, np.full(len(at), 0.03), transform=panel.get_xaxis_transform(), color=MUTED, marker=marker, ms=7,
                ls="", label=f"{said} ({len(at)})", clip_on=False,
            )  # fmt: skip
    panel.set_xlim(0, steps.max())
    panel.set_xlabel("environment steps")
    unit = "units of the states"
    panel.set_ylabel(f"area ({unit})" if system.n == 2 else f"volume in {system.n} states\n({unit})")
    panel.grid(axis="y")
    panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


def _outline(P: Array, level: float) -> tuple[Array, Array]:
    """The ellipse x'Px = level in the plane."""
    angle = np.linspace(0, 2 * np.pi, 361)
    x = np.linalg.solve(np.linalg.cholesky(P).T, np.sqrt(level) * np.stack([np.cos(angle), np.sin(angle)]))
    return x[0], x[1]
