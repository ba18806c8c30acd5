"""The figures of a report, drawn as SVG with matplotlib's object-oriented interface (no pyplot, no display).

Lines of level sets come from the certificate's numbers rounded to floats; everything simulated or sampled on a grid
says so in its caption. Thousands of leaves are drawn as one collection and rasterised, which keeps the page small.
One figure a file; `scene` has what they share, `geometry` their curves, `style` their looks.
"""

from __future__ import annotations

from certify.certificate import Certificate
from certify.report.figures.decay import decay
from certify.report.figures.line import line_figure
from certify.report.figures.near_origin import near_origin
from certify.report.figures.partition import partition
from certify.report.figures.policy import curves, surface
from certify.report.figures.portrait import portrait
from certify.report.figures.scene import ON_BOUNDARY, Scene, planes, starts
from certify.report.figures.style import RC, Picture
from certify.report.sampling import SimulatedRoa, simulated_roa_fraction

__all__ = ["Picture", "draw"]


def draw(certificate: Certificate, accepted: bool) -> tuple[list[Picture], SimulatedRoa | None]:
    """All figures of a certificate, and the simulated region of attraction where there is one (n <= 2).

    Parameters
    ----------
    accepted : whether the checker accepted it; if not, the captions speak of claims.
    """
    import matplotlib

    with matplotlib.rc_context(RC):
        scene = Scene(certificate, accepted)
        roa = None
        if scene.n <= 2:
            roa = simulated_roa_fraction(
                scene.system, certificate.network, scene.P, scene.outer, settled=scene.settling_level
            )
        pictures = _on_the_line(scene, roa) if scene.n == 1 else _in_planes(scene, roa)
    return pictures, roa


def _on_the_line(scene: Scene, roa: SimulatedRoa | None) -> list[Picture]:
    reach = scene.reach[0]
    begin = [[share * reach] for share in (-0.999, -0.5, 0.5, 0.999)]
    return [line_figure(scene, roa), curves(scene), decay(scene, scene.simulate(begin))]


def _in_planes(scene: Scene, roa: SimulatedRoa | None) -> list[Picture]:
    pairs = planes(scene)
    paths = scene.simulate(starts(scene, pairs))
    pictures = [portrait(scene, pair, paths, roa, single=len(pairs) == 1) for pair in pairs]
    if scene.n == 2:
        pictures.append(near_origin(scene))
    if scene.leaves is not None:
        pictures.append(partition(scene, scene.leaves))
    pictures.append(surface(scene, pairs[0]))
    pictures.append(decay(scene, paths[:, :ON_BOUNDARY]))
    return pictures
