"""The figures of a report, drawn as SVG with matplotlib's object-oriented interface (no pyplot, no display).

Lines of level sets come from the certificate's numbers rounded to floats; captions mark everything simulated or sampled
on a grid. Thousands of leaves are drawn as one collection and rasterised, which keeps the page small. There is one file
per figure; `scene` has their shared data, `geometry` their curves, `style` their looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from certify.certificates import Certificate
from certify.effort import Effort
from certify.report.figures.decay import decay
from certify.report.figures.line import line_figure
from certify.report.figures.near_origin import near_origin
from certify.report.figures.pairs import Pair
from certify.report.figures.partition import partition
from certify.report.figures.policy import curves, surface
from certify.report.figures.portrait import Region, portraits
from certify.report.figures.ranks import rank_maps
from certify.report.figures.scene import Scene
from certify.report.figures.style import RC, Picture
from certify.report.figures.trajectories import runs_from, starts
from certify.report.figures.tube import tube
from certify.report.sampling import SimulatedRoa, edge_of, simulated_roa_fraction

__all__ = ["Picture", "draw"]
_GRID = 0.5  # of the effort, at most, for the simulated region of attraction: the rest is for trajectories


def draw(
    certificate: Certificate, accepted: bool, *, pairs: Sequence[Pair] | None = None, effort: Effort | None = None
) -> tuple[list[Picture], SimulatedRoa | None]:
    """All figures of a certificate, and the simulated region of attraction where there is one (n <= 2).

    Parameters
    ----------
    accepted : True if the checker accepted it; if not, the captions speak of claims.
    pairs : states that are drawn against each other, by index; None for the default pairs.
    effort : counted work for simulation; by default some seconds of it. Sets are always drawn; where the effort is over
        less is simulated, and the captions say so.

    Raises
    ------
    CertifyError, ValueError, ArithmeticError : the certificate makes no sense, which cannot happen for an accepted one.
    """
    import matplotlib

    with matplotlib.rc_context(RC):
        scene = Scene(certificate, accepted, pairs, effort)
        roa = simulated_roa(scene)
        pictures = _on_the_line(scene, roa) if scene.n == 1 else _in_planes(scene, roa)
    return pictures, roa


def simulated_roa(scene: Scene) -> SimulatedRoa | None:
    """The simulated region of attraction where there is one (n <= 2); trajectories are drawn as long as its runs."""
    if scene.n > 2:
        return None
    found = simulated_roa_fraction(
        scene.system,
        scene.certificate.network,
        scene.P,
        scene.outer,
        settled=scene.settling_level,
        effort=scene.effort.share(_GRID),
        start=scene.start,
        centre=scene.centre,
        beyond=scene.in_more,
    )
    if found.horizon > 1.5 * scene.horizon:  # it was doubled, and half of it brings too few home
        scene.drawn = found.horizon
    return found


def region_of(scene: Scene, roa: SimulatedRoa | None) -> Region | None:
    """The simulated region of a plane, if it has a boundary in the domain, and runs are long enough to tell it."""
    if roa is None or len(roa.axes) != 2 or not roa.tells or roa.attracted.all() or not roa.attracted.any():
        return None
    return edge_of(scene.flow, roa, scene.P, scene.settling_level, scene.effort)


def _on_the_line(scene: Scene, roa: SimulatedRoa | None) -> list[Picture]:
    (low, high), shares = scene.begin_on_line, (-0.999, -0.5, 0.5, 0.999)
    begin = [[(low + high) / 2 + share * (high - low) / 2] for share in shares]
    runs = runs_from(scene, begin)
    return [
        line_figure(scene, roa),
        *rank_maps(scene),
        *tube(scene, runs),
        curves(scene),
        decay(scene, runs.path, runs.step),
    ]


def _in_planes(scene: Scene, roa: SimulatedRoa | None) -> list[Picture]:
    runs, region = runs_from(scene, starts(scene)), region_of(scene, roa)
    inside = len(scene.pairs) * scene.detail.starts  # starts along the domain's boundary come after these
    from_set = replace(runs, path=runs.path[:, :inside], settled=runs.settled[:inside], left=runs.left[:inside])
    pictures = [*portraits(scene, runs, region), *tube(scene, from_set)]
    if scene.n == 2 and scene.shows_inner:
        pictures.append(near_origin(scene))
    if scene.leaves is not None and not scene.local_is_enough:
        pictures.append(partition(scene, scene.leaves))
    pictures += rank_maps(scene)
    pictures.append(surface(scene, scene.pairs[0]))
    pictures.append(decay(scene, from_set.path, runs.step))
    return pictures
