"""The gallery's picture of a policy that does what no gain does: `make gallery`, after the other pictures.

What is proved is read from a certificate that the checker has accepted in this run; what becomes of the gains is
simulated. A certificate that `out/gallery/swing_up` already has is checked again and not searched for again.
"""

from __future__ import annotations

import runpy
from fractions import Fraction
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

from certify.certificates import Certificate, read_certificate, run_checker
from certify.certificates.drawn import nonlinearity_of
from certify.certificates.membership import proved_set, region_of
from certify.certificates.ranked import count
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import in_floats, linearise
from certify.report.figures.style import INK, PAPER, RC, SET_FILL, START, figure_of, to_svg
from certify.report.words import below, nonlinearity_in_words

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).parent
FOLDER = ROOT / "out" / "gallery" / "swing_up"
SCRIPT: dict[str, Any] = runpy.run_path(str(ROOT / "examples" / "swing_up.py"))
BOX, POINTS = SCRIPT["BOX"], 180
LO, HI = np.array([0.0, -8.0]), np.array([2 * np.pi, 8.0])  # of the pictures: hanging is in the middle
Array = NDArray[np.float64]


def proved() -> Certificate:
    """The certificate of the example, accepted by both checkers, with its box in the proved set."""
    path = FOLDER / "certificate.json"
    if not path.exists():
        SCRIPT["main"](FOLDER)
    answers = {run_checker(path, program)["result"] for program in ("checker", "reference")}
    box = [(Fraction(lo), Fraction(hi)) for lo, hi in BOX]
    if answers != {"ACCEPTED"} or proved_set(path).locate(box).answer.value != "contained":
        raise SystemExit(f"{path} must be accepted, and hold the box. Remove the file and run this again.")
    return read_certificate(path)


def grid(points: int, lo: Array = LO, hi: Array = HI) -> Array:
    """Middles of equal cells, (points, points, 2), the first state along the second axis."""
    shares = (np.arange(points) + 0.5) / points
    return np.stack(np.meshgrid(*(a + shares * (b - a) for a, b in zip(lo, hi, strict=True))), -1)


def stabilising(loop: ClosedLoop) -> list[Array]:
    """Gains K (1, 2) on a grid that hold the linearised pendulum upright."""
    A, B = map(in_floats, linearise(loop.system))
    both = np.meshgrid(np.linspace(1, 60, 60), np.linspace(0.25, 15, 60))
    gains = [np.array([[a, b]]) for a, b in zip(*(each.ravel() for each in both), strict=True)]
    return [K for K in gains if np.abs(np.linalg.eigvals(A - B @ K)).max() < 1]


def picture(certificate: Certificate, laws: dict[str, Any]) -> str:
    """Three phase planes: the ranks under the network, and beside it from where the gains settle."""
    mpl.rcParams.update(RC)
    figure, axes = figure_of(9.9, 3.7, right=6.7)
    W, H = figure.get_size_inches()
    axes.set_position([0.66 / W, 0.52 / H, 2.54 / W, 2.8 / H])
    planes = [axes, *(figure.add_axes([left / W, 0.52 / H, 2.54 / W, 2.8 / H], sharey=axes) for left in (3.78, 6.9))]
    x, extent = grid(POINTS), (LO[0], HI[0], LO[1], HI[1])
    ranks = region_of(certificate).ranked.ranks_at(SCRIPT["nearest"](x.reshape(-1, 2))).reshape(POINTS, POINTS)
    show = {"extent": extent, "origin": "lower", "aspect": "auto", "interpolation": "nearest", "zorder": 1}
    planes[0].imshow(np.where(np.isnan(ranks), np.nan, ranks), cmap="viridis_r", vmin=0, **show)
    for plane, (name, law) in zip(planes, laws.items(), strict=True):
        if plane is not axes:
            here = SCRIPT["settled"](law, x.reshape(-1, 2)).reshape(POINTS, POINTS)
            plane.imshow(here, cmap=mpl.colors.ListedColormap([PAPER, SET_FILL]), vmin=0, vmax=1, **show)
            plane.tick_params(labelleft=False)
        _runs(plane, law)
        plane.set_title(name)
        plane.set_xlim(*extent[:2])
        plane.set_ylim(*extent[2:])
        plane.set_xticks([0, np.pi / 2, np.pi, 3 * np.pi / 2, 2 * np.pi], ["up", "π/2", "hanging", "3π/2", "up"])
    axes.set_ylabel("speed in rad/s")
    return to_svg(figure)


def _runs(plane: Any, law: Any) -> None:
    """The box, and runs from its corners and its middle, drawn anew at each full turn."""
    (a, b), (c, d) = BOX
    starts = np.array([[a, c], [a, d], [b, c], [b, d], [(a + b) / 2, (c + d) / 2]])
    path = np.array(SCRIPT["run"](law, starts, 130))
    for k in range(len(starts)):
        x = path[:, k].copy()
        x[:, 0] %= 2 * np.pi
        x[1:][np.abs(np.diff(x[:, 0])) > np.pi] = np.nan
        plane.plot(*x.T, color=PAPER, lw=1.8, zorder=3)
        plane.plot(*x.T, color=INK, lw=0.8, zorder=3)
    for colour, width in ((PAPER, 3.2), (START, 2.0)):
        plane.plot([a, b, b, a, a], [c, c, d, d, c], color=colour, lw=width, zorder=4)


def main() -> None:
    """The picture, and the text beside it."""
    certificate = proved()
    loop = ClosedLoop(certificate.system, certificate.network)
    gains = SCRIPT["laws"](loop.linearise()[2])
    laws = {f"{name[0].upper()}{name[1:]}, saturated *": law for name, law in gains.items()}
    svg = picture(certificate, {"The network: proved": loop.policy, **laws})
    (PAGE / "swing_up.svg").write_text(svg, "utf-8")
    x0 = grid(5, *np.array(BOX).T).reshape(-1, 2)
    several = stabilising(loop)
    best = max(int(SCRIPT["settled"](lambda x, K=K: np.clip(-x @ K.T, -2, 2), x0).sum()) for K in several)
    found, tree = nonlinearity_of(certificate), region_of(certificate).ranked.tree
    numbers = count(tree, (0,))
    said = [
        f"**Proved** for the network: from {below(100 * numbers.share, 4)} % of all angles and speeds up to 9 rad/s, "
        f"the box among them, the pendulum is upright within V ≤ {below(certificate.roa)} after {numbers.steps} steps "
        "of 0.05 s at the latest, stays there and converges. Both checkers accept it.",
        "",
        f"Simulated *: its own gain and the LQR's, saturated, settle from no state of the box; nor does any of "
        f"{len(several):,} gains on a grid that hold the linearised pendulum upright: from {len(x0)} states of the box "
        f"the best of them settles {best} times in 20 s. Sampled *: {nonlinearity_in_words(found.to_dict())}.",
    ]
    (PAGE / "swing_up.txt").write_text("\n".join(said) + "\n", "utf-8")
    print(*said, len(svg), sep="\n")


if __name__ == "__main__":
    main()
