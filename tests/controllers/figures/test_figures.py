"""What figures show: every method with its name, nothing cut off or on top of each other, no more than was found."""

from __future__ import annotations

import io
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.plants import get_system
from controllers.comparison.learning_curve import CurvePoint
from controllers.comparison.methods import BASELINES, OURS, Method
from controllers.comparison.options import CompareOptions
from controllers.comparison.table import Response, table
from controllers.figures import (
    draw_curves,
    draw_gain,
    draw_growth,
    draw_over_time,
    draw_positions,
    draw_space,
    draw_states,
)
from controllers.figures.style import WIDTH, spread
from controllers.history.gain_distance import Distances
from controllers.history.proofs import Proof, ProvingOptions

PPO, SAC = Method("sb3-ppo", False), Method("sac", False)
TIME = 0.5 * np.arange(41)  # 20 s


@pytest.fixture
def kept(monkeypatch):
    """The figures that are drawn, as objects, laid out as they are saved; their pixels take too much time."""
    figures = []

    def keep(figure, file, **options):
        Image.new("RGB", (1, 1)).save(file, format=options["format"])
        figure.set_dpi(options["dpi"])
        figure.draw_without_rendering()
        figures.append(figure)

    monkeypatch.setattr(Figure, "savefig", keep)
    return figures


def _responses(system, methods=BASELINES, seeds=(0, 1), states=6):
    """Decay to a floor of each method's own; sampled actions keep shaking."""
    generator, found = np.random.default_rng(0), []
    for k, method in enumerate(methods):
        for seed in seeds:
            start = generator.uniform(-0.4, 0.4, (states, system.n))
            floor = 0.0 if method == OURS else 10.0 ** -(k % 4)
            shaking = 0.05 * generator.standard_normal((len(TIME), states, system.n)) if method.sampled else 0.0
            x = start * np.exp(-TIME)[:, None, None] + floor * np.ones(system.n) / math.sqrt(system.n) + shaking
            cost = np.cumsum((x**2).sum(axis=2), axis=0)
            found.append(Response(method, seed, 100, x, np.concatenate([0 * cost[:1], cost[:-1]])))
    return found


def _over_time(what, responses, name="pendulum"):
    system = get_system(name)
    rows = table(system, 0.5, responses, CompareOptions(seeds=2))
    return draw_over_time(what, system, 0.5, responses, rows)


def _texts(figure):
    """All letters of a figure, with where they are in pixels."""
    found = [figure._suptitle] if figure._suptitle else []
    for axes in figure.axes:
        found += [*axes.texts, axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label]
    return [(text.get_text(), text.get_window_extent()) for text in found if text.get_visible() and text.get_text()]


def _assert_nothing_is_cut_off(figure):
    width, height = figure.bbox.width, figure.bbox.height
    for text, box in _texts(figure):
        assert box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1, (text, box)


def _png(content):
    assert content.startswith(b"\x89PNG")
    return Image.open(io.BytesIO(content))


@pytest.mark.parametrize("what", ["cost", "norm"])
def test_over_time_every_method_has_its_name_beside_its_line_and_none_covers_another(kept, what):
    _over_time(what, _responses(get_system("pendulum")))
    [figure] = kept
    assert figure.get_size_inches()[0] == WIDTH
    _assert_nothing_is_cut_off(figure)
    above, below = figure.axes
    for panel, kinds in ((above, 4), (below, 4)):
        names = [(text.get_text(), Text.get_window_extent(text)) for text in panel.texts]  # without its pointer
        assert len(names) == kinds and {n.split("\n")[0] for n, _ in names} == {
            "ours",
            "SAC without gain",
            "SB3 SAC",
            "SB3 PPO",
        }
        for (one, a), (other, b) in itertools.combinations(names, 2):
            assert a.y0 >= b.y1 - 1 or b.y0 >= a.y1 - 1, (one, other)
    title = figure._suptitle.get_text()
    assert "seeds 0 to 1" in title and "2 seeds × 6 initial states" in title
    if what == "norm":
        assert any(text.get_text() == "SB3 PPO\nfloor 0.1" for text in above.texts)


def test_numbers_on_a_logarithmic_axis_are_readable(kept):
    _over_time("norm", _responses(get_system("pendulum")))
    labels = [label for axes in kept[0].axes for label in axes.get_yticklabels() if label.get_text()]
    powers = [label for label in labels if "10^" in label.get_text()]
    assert powers and all(label.get_parse_math() for label in powers)


def test_what_diverges_is_said_and_everything_may(kept):
    responses = _responses(get_system("pendulum"), (OURS, PPO), seeds=(3,))
    gone = [
        Response(r.method, 3, 100, np.where(TIME[:, None, None] > 1, np.nan, r.x), r.cost + np.inf) for r in responses
    ]
    for what in ("cost", "norm"):
        _png(_over_time(what, gone))
        assert "ours\nmedian infinite\n6 of 6 diverge" in [t.get_text() for t in kept[0].axes[0].texts]
        assert "seed 3" in kept[-1]._suptitle.get_text()
        _assert_nothing_is_cut_off(kept[-1])
    assert "ours\nfloor infinite\n6 of 6 diverge" in [t.get_text() for t in kept[1].axes[0].texts]


def test_the_figure_of_the_states_shows_every_one_of_them(kept):
    methods = BASELINES[:4]
    draw_states(get_system("pendulum"), 0.5, _responses(get_system("pendulum"), methods))
    panels = kept[-1].axes
    assert len(panels) == 2 * len(methods)
    assert [axes.get_ylabel() for axes in panels if axes.get_ylabel()] == ["theta (rad)", "theta_dot (rad/s)"]
    width, height = kept[-1].get_size_inches()
    assert width / len(methods) >= 2 and height / 2 >= 1.5  # inches a panel
    for axes in panels:
        title = axes.title.get_window_extent()
        assert title.width <= axes.get_window_extent().width * 1.25, axes.get_title()


@pytest.mark.slow
def test_positions_are_a_column_a_run_with_sampled_actions_below(kept):
    system = get_system("quadrotor2d")
    responses = _responses(system)
    _png(draw_positions(system, 0.5, responses))
    [figure] = kept
    assert figure.get_size_inches()[0] == WIDTH
    _assert_nothing_is_cut_off(figure)
    panels = np.array(figure.axes).reshape(6, 4)
    assert [axes.get_ylabel() for axes in panels[:, 0]] == 2 * ["x (m)", "y (m)", "theta (rad)"]
    for line, (k, sampled) in zip(panels, itertools.product((False, True), (0, 1, 2)), strict=True):
        assert line[-1].texts[-1].get_text() == ("stochastic" if k else "mean")
        assert bool(line[0].texts) == k and len(line[0].lines) == (0 if k else 7)  # six trajectories and a line at 0
        ppo = next(r for r in responses if r.method == Method("sb3-ppo", k) and r.seed == 0)
        np.testing.assert_array_equal(line[3].lines[0].get_ydata(), ppo.x[:, 0, sampled])


@pytest.mark.parametrize("name", ["pendulum", "cartpole"])
def test_what_does_not_move_in_space_has_no_figure_there(name):
    system = get_system(name)
    assert draw_space(system, 0.5, _responses(system, (OURS,))) is None


@pytest.mark.parametrize("name, dimensions", [("quadrotor2d", 2), ("quadrotor3d", 3)])
def test_space_has_a_panel_a_method_and_ends_paths_at_the_frame(kept, name, dimensions):
    system = get_system(name)
    responses = _responses(system, seeds=(4,))
    ours, ppo = (next(r for r in responses if r.method == m) for m in (OURS, PPO))
    ppo.x[10:, 0, 0] = 3 * float(max(map(abs, system.domain[0])))  # leaves the domain, and then the frame
    ppo.x[20:, 1] = np.nan
    _png(draw_space(system, 0.5, responses))
    [figure] = kept
    _assert_nothing_is_cut_off(figure)
    assert len(figure.axes) == 4 and "seed 4" in figure._suptitle.get_text()
    titles = {axes.get_title(loc="center" if dimensions == 3 else "left"): axes for axes in figure.axes}
    assert "ours" in titles and "SB3 PPO: 2 leave the frame" in titles
    cut, whole = titles["SB3 PPO: 2 leave the frame"], titles["ours"]

    def paths(axes):
        lines = [line.get_data_3d() if dimensions == 3 else line.get_data() for line in axes.lines]
        return [np.array(line) for line in lines if len(line[0]) > 2]

    drawn = paths(cut)
    assert [path.shape[1] for path in drawn[:3]] == [10, 20, 41]
    np.testing.assert_array_equal(paths(whole)[2].T, ours.x[:, 2, :dimensions])
    ends = [line for line in cut.lines if line.get_marker() == "o"]
    assert len(ends) == 4  # of six trajectories
    assert len([line for line in cut.lines if line.get_marker() == "x"]) == 1


def _rows(values, every=10):
    return [CurvePoint(every * (k + 1), floor, 2 * floor, 0, 1, 1.0, 1.0) for k, floor in enumerate(values)]


def test_curves_have_a_line_a_seed_their_median_and_a_ring_where_a_run_ended(kept):
    curves = [
        ("ours", 0, _rows([1.0, 0.1])),
        ("sb3-ppo", 0, _rows([8.0, 4.0, 2.0, 1.0])),
        ("sb3-ppo", 1, _rows([6.0, math.inf, 4.0])),
        ("sb3-ppo", 2, _rows([1.0, 1.0, 3.0])),
    ]
    _png(draw_curves(get_system("pendulum"), curves))
    [figure] = kept
    _assert_nothing_is_cut_off(figure)
    assert "seeds 0 to 2" in figure._suptitle.get_text()
    floor, cost = figure.axes
    assert floor.get_xscale() == floor.get_yscale() == "log"
    for axes, factor in ((floor, 1.0), (cost, 2.0)):
        data = [np.array(line.get_data()) for line in axes.lines]
        rings = [d for line, d in zip(axes.lines, data, strict=True) if line.get_marker() == "o"]
        np.testing.assert_array_equal(np.concatenate(rings, axis=1)[0], [20, 40, 30, 30])
        bold = [d for line, d in zip(axes.lines, data, strict=True) if line.get_linewidth() > 2]
        np.testing.assert_array_equal(bold[0], [[10, 20], [factor, 0.1 * factor]])
        np.testing.assert_array_equal(bold[1], [[10, 20, 30], factor * np.array([6.0, 4.0, 3.0])])
    assert [t.get_text() for t in floor.texts] == ["ours\n1 run", "SB3 PPO\n3 runs"]


def test_curves_without_a_finite_number_and_without_a_run(kept):
    _png(draw_curves(get_system("pendulum"), [("sac", 0, _rows([math.inf, math.inf]))]))
    _assert_nothing_is_cut_off(kept[0])
    with pytest.raises(InputError, match="must have a run with an evaluation"):
        draw_curves(get_system("pendulum"), [("sac", 0, [])])


def test_the_gain_is_drawn_as_far_as_there_is_one(kept):
    found = [Distances(100, 1e-2, 1e-3, 1e-1, 1.0), Distances(200, 1e-4, 1e-5, 1e-3, 1e-2)]
    _png(draw_gain(get_system("pendulum"), 7, found, [(50, 0.0), (200, 0.5)]))
    _assert_nothing_is_cut_off(kept[0])
    above, below = kept[0].axes
    assert above.get_yscale() == "log" and "seed 7" in kept[0]._suptitle.get_text()
    assert [line.get_ydata().tolist() for line in above.lines] == [[0.1, 1e-3], [1.0, 1e-2], [1e-2, 1e-4], [1e-3, 1e-5]]
    assert "learned K 1.0e-03" in [t.get_text() for t in above.texts]
    np.testing.assert_array_equal(below.lines[0].get_data(), [[50, 200], [0.0, 0.5]])
    plain = [Distances(100, math.nan, math.nan, math.nan, 1.0)]
    draw_gain(get_system("pendulum"), 7, plain)
    [axes] = kept[1].axes
    assert len(axes.lines) == 1 and len(axes.texts) == 1


P = np.array([[2.0, 0.5], [0.5, 1.0]])
PROOFS = [
    Proof(100, Verdict.REFUTED, "unstable linearisation"),
    Proof(200, Verdict.PROVED, "", "asymptotic", P, 0.5, 1.0),
    Proof(300, Verdict.UNKNOWN, "time"),
    Proof(400, Verdict.PROVED, "", "asymptotic", P, 1.5, 3.0),
]


def test_only_what_was_accepted_is_drawn_as_proved_and_gaps_are_told(kept):
    _png(draw_growth(get_system("pendulum"), 5, PROOFS, ProvingOptions(effort=0.2)))
    _assert_nothing_is_cut_off(kept[0])
    sets, sizes = kept[0].axes[:2]
    outlines = [np.array(line.get_data()) for line in sets.lines if len(line.get_xdata()) > 5]
    assert len(outlines) == 2
    for outline, level in zip(outlines, (0.5, 1.5), strict=True):
        np.testing.assert_allclose(np.einsum("ik,ij,jk->k", outline, P, outline), level, rtol=1e-12)
    assert sets.lines[0].get_color() != sets.lines[1].get_color()
    line, unknown, refuted = sizes.lines
    np.testing.assert_array_equal(line.get_data(), [[100, 200, 300, 400], [np.nan, 1.0, np.nan, 3.0]])
    assert (unknown.get_xdata().tolist(), refuted.get_xdata().tolist()) == ([300], [100])
    told = [text.get_text() for text in sizes.get_legend().get_texts()]
    assert told[0] == "accepted by the checker" and told[1].startswith("gap: unknown") and "refuted" in told[2]
    title = kept[0]._suptitle.get_text()
    assert "seed 5" in title and "2 of 4 policies, effort 0.2 each" in title


def test_growth_in_many_states_is_a_volume_and_may_have_nothing(kept):
    system = get_system("quadrotor2d")
    few = [Proof(1, Verdict.UNKNOWN, "time"), Proof(2, Verdict.TRUSTED, "dReal's word")]
    for proofs in (few, [*few, Proof(3, Verdict.PROVED, "", "practical", np.eye(6), 1.0, 5.0)]):
        _png(draw_growth(system, 0, proofs, ProvingOptions()))
        [axes] = kept[-1].axes
        assert np.isfinite(axes.lines[0].get_ydata()).sum() == len(proofs) - 2
        _assert_nothing_is_cut_off(kept[-1])
    _png(draw_growth(get_system("pendulum"), 0, few, ProvingOptions()))


@pytest.mark.parametrize("verdict", [Verdict.UNKNOWN, Verdict.REFUTED, Verdict.TRUSTED])
def test_a_set_that_was_not_accepted_cannot_be_said(verdict):
    with pytest.raises(InputError, match="has a set exactly if it is PROVED"):
        Proof(1, verdict, "", "asymptotic", P, 1.0, 1.0)
    with pytest.raises(InputError, match="has a set exactly if it is PROVED"):
        Proof(1, Verdict.PROVED)


def test_equal_figures_are_equal_bytes_as_wide_as_a_page():
    proofs = [proof for proof in PROOFS if proof.P is not None]
    one, other = (draw_growth(get_system("quadrotor2d"), 0, proofs, ProvingOptions()) for _ in range(2))
    assert one == other
    assert 1000 < _png(one).width < 1400 and _png(one).getcolors() is not None  # a palette


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=8), st.floats(0.01, 2.0))
def test_labels_keep_their_distance_and_their_order(places, room):
    found = spread(places, room)
    order = sorted(range(len(places)), key=lambda k: places[k])
    for one, other in itertools.pairwise(order):
        assert found[other] - found[one] >= room * (1 - 1e-9)
    if all(b - a >= room for a, b in itertools.pairwise(sorted(places))):
        assert found == places
    assert sum(found) == pytest.approx(sum(places), abs=1e-9)
