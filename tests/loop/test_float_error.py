"""The bound of what binary32 changes: attacked by programs of many kinds, source by source, and held against Arb."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

from certify.cli.main import _run
from certify.errors import InputError
from certify.loop import binary32
from certify.loop.activations import ACTIVATIONS
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import symbols
from certify.loop.float32 import FloatError, FloatOptions, float_error
from certify.loop.plants import System, available_systems, get_system, load_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.rigorous import evaluate_policy, precision
from tests.support.loops import box, pendulum_network
from tests.support.marks import slow_after
from tests.support.single import Machine, adversarial, by_torch, f32, off_by, units

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
SHIPPED = sorted((EXAMPLES / "policies").rglob("*.pt"), key=lambda path: path.stat().st_size)
POLICIES = [path for path in SHIPPED if load_policy(path).network.network.observation is None]  # others are refused
U = 2.0**-24
MACHINES = [
    Machine(),
    Machine("backwards", fused=True),
    Machine("pairs", folded=False),
    Machine("rising", flush=True, tanh=off_by(4)),
    Machine("shuffled", fused=True, folded=False, tanh=off_by(4)),
]


def plant(n: int, m: int, half_width: str = "1", u_eq: str = "0") -> System:
    """A plant whose equations nobody looks at."""
    states, inputs = symbols(f"x{i}" for i in range(n)), symbols(f"u{i}" for i in range(m))
    return System(
        name="any",
        states=states,
        inputs=inputs,
        parameters={},
        dynamics=tuple(-s for s in states),
        u_eq=(Fraction(u_eq),) * m,
        domain=box(*[half_width] * n),
        input_bounds=box(*[1000] * m),
    )


def random_network(widths: tuple[int, ...], seed: int, size: float = 1.0, **kind: Any) -> PolicyNetwork:
    """Numbers of binary64 that are none of binary32."""
    generator = np.random.default_rng(seed)
    weights = tuple(size * generator.standard_normal((b, a)) / a**0.5 for a, b in itertools.pairwise(widths))
    biases = tuple(generator.uniform(-0.5, 0.5, b) for b in widths[1:])
    m = widths[-1]
    scale, offset = generator.uniform(0.5, 3, m) * np.where(np.arange(m) % 2, -1, 1), generator.uniform(-0.3, 0.3, m)
    return PolicyNetwork.of_layers(weights, biases, scale, offset, **kind)


def in_double(network: PolicyNetwork, system: System, x: np.ndarray) -> np.ndarray:
    return np.asarray(network(x, system.exact_u_eq()))


def errors(network: PolicyNetwork, system: System, x: np.ndarray, u: np.ndarray, worst: int = 3) -> np.ndarray:
    """|u - pi(x)| for each input, (m,), the largest of the states by Arb, rounded down."""
    loop, found = ClosedLoop(system, network), np.zeros(system.m)
    off = np.abs(u.astype(float) - in_double(network, system, x))
    for j in range(system.m):
        for i in np.argsort(-off[:, j])[:worst]:
            with precision():
                exact = abs(flint.arb(float(u[i, j])) - evaluate_policy(loop, x[i])[j]).lower()
            found[j] = max(found[j], float(exact) * (1 - 1e-15))
    return found


def require_within(
    found: FloatError, network: PolicyNetwork, system: System, x: np.ndarray, u: np.ndarray
) -> np.ndarray:
    off = errors(network, system, x, u)
    assert np.all(off <= found.bounds), f"off by {off}, and at most {found.bounds} was promised"
    return off


def ends(system: System) -> tuple[np.ndarray, np.ndarray]:
    """The domain's corners, within it."""
    lo, hi = np.array(system.domain, dtype=float).T
    return np.nextafter(lo, 0), np.nextafter(hi, 0)


def shipped(path: Path) -> tuple[PolicyNetwork, System]:
    policy = load_policy(path)
    if policy.system in available_systems():
        return policy.network, get_system(policy.system).with_parameters(policy.parameters)
    plant = EXAMPLES / "plants" / path.relative_to(EXAMPLES / "policies").with_suffix(".toml")
    return policy.network, load_system(plant)


@pytest.mark.parametrize("path", slow_after(1, POLICIES), ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_no_program_in_binary32_is_further_off_than_the_bound(path: Path) -> None:
    """Corners, random states and ones that were climbed to; torch, and for small networks every order."""
    network, system = shipped(path)
    u_eq = system.exact_u_eq()
    found = float_error(network, system)
    states = adversarial(lambda x: by_torch(network, u_eq, x), lambda x: in_double(network, system, x), *ends(system))
    seen = require_within(found, network, system, states, by_torch(network, u_eq, states))
    one_by_one = np.concatenate([by_torch(network, u_eq, x[None]) for x in states[-50:]])
    require_within(found, network, system, states[-50:], one_by_one)
    if max(network.layers) <= 16:
        for machine in MACHINES:
            off = require_within(found, network, system, states, machine(network, u_eq, states))
            seen = np.maximum(seen, off)
        assert np.all(found.bounds < 150 * seen), f"{np.array(found.bounds) / seen} times the worst that was seen"


KINDS = [
    {"squash": "tanh", "centre": "preactivation"},
    {"squash": "tanh", "centre": "output"},
    {"squash": "tanh", "centre": "none"},
    {"squash": "identity", "centre": "output"},
    {"squash": "identity", "centre": "none"},
]


@pytest.mark.parametrize("clipped", [False, True])
@pytest.mark.parametrize("size", slow_after(1, [1.0, 0.01, 30.0]))
@pytest.mark.parametrize("kind", KINDS, ids=lambda k: "-".join(k.values()))
def test_any_network(kind: dict[str, Any], size: float, clipped: bool) -> None:
    """binary64 weights, three states, two inputs; small slopes, ordinary ones, saturated units; a clip that acts."""
    system = plant(3, 2, "3/2", "1/10")
    clip = (np.array([-0.3, -0.2]), np.array([0.7, 0.3])) if clipped else None
    network = random_network((3, 12, 9, 2), 7, size, clip=clip, **kind)
    found = float_error(network, system, FloatOptions(boxes=4))
    u_eq = system.exact_u_eq()
    for seed, machine in enumerate(MACHINES):
        states = adversarial(
            lambda x, act=machine: act(network, u_eq, x), lambda x: in_double(network, system, x), *ends(system), seed
        )
        require_within(found, network, system, states, machine(network, u_eq, states))


def sources(found: FloatError) -> dict[str, float]:
    return {part.source: part.errors[0] for part in found.parts}


def test_any_order_is_any_order() -> None:
    """A large term first and small ones after it, each of which is lost: half of what is allowed, and more than any
    bound allows that counts fewer additions."""
    count = 512
    W = np.concatenate([[1.0], np.full(count - 1, U)])[None]
    network = PolicyNetwork.of_layers((W,), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    system = plant(count, 1)
    x = np.full((1, count), 1 - 2.0**-24)
    x[0, 0] = 1 - 2.0**-24
    found = float_error(network, system, FloatOptions(boxes=1))
    off = require_within(found, network, system, x, Machine()(network, (Fraction(0),), x))[0]
    assert found.bounds[0] < 2.1 * off
    short = float_error(network, system, FloatOptions(chain=10, boxes=1))
    assert short.bounds[0] < off / 10
    require_within(short, network, system, x, Machine("pairs")(network, (Fraction(0),), x))


@pytest.mark.parametrize("chain", [1, 7])
def test_no_sum_has_shorter_chains_than_its_logarithm(chain: int) -> None:
    network = PolicyNetwork.of_layers((np.ones((1, 255)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    with pytest.raises(InputError, match="`chain` must be at least 8: in a sum of 256 terms"):
        float_error(network, plant(255, 1), FloatOptions(chain=chain))
    float_error(network, plant(255, 1), FloatOptions(chain=8, boxes=1))


def chained(depth: int, **kind: Any) -> PolicyNetwork:
    """Layers of one unit, at weights that binary32 has."""
    ones = tuple(np.ones((1, 1)) for _ in range(depth))
    return PolicyNetwork.of_layers(ones, (np.zeros(1),) * depth, np.ones(1), np.zeros(1), **{"centre": "none", **kind})


def test_the_state_is_rounded() -> None:
    network, system = chained(1, squash="identity"), plant(1, 1, "3/5")
    x = np.array([[0.5 + 2.0**-25]])  # in the middle of two binary32 numbers
    u = Machine()(network, (Fraction(0),), x)
    off = require_within(float_error(network, system), network, system, x, u)[0]
    part = sources(float_error(network, system, FloatOptions(boxes=1)))["state"]
    assert off == pytest.approx(2.0**-25) and off <= part <= 1.3 * off


@pytest.mark.parametrize("what", ["weight", "bias"])
def test_each_number_of_a_layer_is_rounded(what: str) -> None:
    """The sum itself is exact: nothing but the number's rounding is left."""
    value = 1 + 2.0**-24 - 2.0**-52
    weight, bias = (value, 0.0) if what == "weight" else (0.0, value)
    network = PolicyNetwork.of_layers(([[weight]],), ([bias],), [1.0], [0.0], "identity", "none")
    system, x = plant(1, 1), np.array([[1 - 2.0**-24]])
    found = float_error(network, system, FloatOptions(boxes=1))
    off = require_within(found, network, system, x, Machine()(network, (Fraction(0),), x))[0]
    part = sources(found)["layer 0, rounded numbers"]
    assert 0.99 * U < off <= part <= 1.1 * off


@pytest.mark.parametrize("scale", [1.0, 1 + 2.0**-24 - 2.0**-52, 1.1])
@pytest.mark.parametrize("offset", [0.0, 0.1, 1 + 2.0**-24 - 2.0**-52])
def test_scale_offset_and_their_sum_are_rounded(scale: float, offset: float) -> None:
    """The layer before them is exact, and so is the state: all of the error is the output map's."""
    network = PolicyNetwork.of_layers(([[1.0]],), ([0.0],), [scale], [offset], "identity", "none")
    system = plant(1, 1)
    x = np.random.default_rng(0).uniform(-1, 1, (200_000, 1)).astype(f32).astype(float)
    found = sources(float_error(network, system, FloatOptions(boxes=1)))["output"]
    off = np.abs(Machine()(network, (Fraction(0),), x) - (scale * x + offset)).max() - 2.0**-50
    assert off <= found
    assert scale == 1 or off > found / 4


def test_the_scale_its_product_and_the_sum_may_all_err_the_same_way() -> None:
    """A scale, products and sums just above 1, where half a unit is worth most: nearly 3 * 2^-24."""
    scale, offset = 1 + 4097 * 2.0**-23 + 2.0**-24 - 2.0**-50, float(f32(1e-6))
    network = PolicyNetwork.of_layers(([[1.0]],), ([0.0],), [scale], [offset], "identity", "none")
    x = np.random.default_rng(0).uniform(1, 1 + 2.0**-10, (100_000, 1)).astype(f32).astype(float)
    found = sources(float_error(network, plant(1, 1, "1025/1024"), FloatOptions(boxes=1)))["output"]
    off = np.abs(Machine()(network, (Fraction(0),), x) - (scale * x + offset)).max() - 2.0**-50
    assert 2.5 * U < off <= found <= 1.3 * off


def test_a_constant_of_centring_may_be_off_by_a_unit() -> None:
    """Rounded the wrong way, and then a sum that rounds the wrong way as well: still within the bound."""
    unit = 2.0**-23
    u_eq = Fraction(1) + Fraction(unit) / 100
    network = PolicyNetwork.of_layers(([[1.0]],), ([0.0],), [1.0], [0.0], "identity", "output")
    system = plant(1, 1, "1/1000000", str(u_eq))
    x = -0.49 * unit
    computed = f32(f32(1 + unit) + f32(x))
    off = abs(Fraction(float(computed)) - (u_eq + Fraction(x)))
    assert off > Fraction(147, 100) * Fraction(unit)
    part = sources(float_error(network, system, FloatOptions(boxes=1)))["output"]
    assert off <= part <= 1.1 * off


def test_each_input_has_the_bound_of_its_worst_part_of_the_domain() -> None:
    """Two inputs that are each other's mirror image: where one is steep the other is saturated."""
    network = PolicyNetwork.of_layers(([[32.0], [32.0]],), ([-16.0, 16.0],), [1.0, 1.0], [0.0, 0.0], "tanh", "none")
    first, second = float_error(network, plant(1, 2)).bounds
    assert first == pytest.approx(second, rel=1e-2)
    only = network.with_layers(weights=([[0.0], [32.0]],), biases=([0.0, 16.0],))
    assert float_error(only, plant(1, 2)).bounds[1] == pytest.approx(second, rel=1e-1)


def test_numbers_that_binary32_has_cost_nothing() -> None:
    parts = sources(float_error(chained(2), plant(1, 1)))
    assert parts["layer 0, rounded numbers"] == parts["layer 1, rounded numbers"] == 0


@pytest.mark.parametrize("layer", [0, 1])
@pytest.mark.parametrize("half_width", ["1/1000", "1/2", "20"])
def test_a_tanh_is_off_by_as_much_as_it_may(layer: int, half_width: str) -> None:
    """Its part is what a tanh makes that is off by 2^10 units, whose sums add next to nothing."""
    network, ulps = chained(2), 1024.0
    system = plant(1, 1, half_width)
    parts = sources(float_error(network, system, FloatOptions(tanh_ulp=ulps, boxes=1)))
    x = np.linspace(*ends(system), 2001).astype(f32).astype(float)
    y = x if layer == 0 else np.tanh(x)
    exact = np.tanh(y)
    off = exact + np.copysign(0.999 * ulps * units(exact), exact)
    moved = np.abs((np.tanh(off) if layer == 0 else off) - np.tanh(np.tanh(x))).max()
    part = parts[f"layer {layer}, tanh"]
    assert moved <= part <= 2.5 * moved


def test_units_of_tanh_are_those_of_binary32() -> None:
    for t, unit in [
        (0.75, 2.0**-24),
        (0.5, 2.0**-24),
        (np.nextafter(0.5, 0), 2.0**-25),
        (1.5, 2.0**-24),  # what a ball may reach beyond 1, where no tanh is
        (2.0**-20, 2.0**-43),
        (2.0**-140, 2.0**-149),
        (0.0, 2.0**-149),
    ]:
        assert float(binary32._ulp(flint.arb(float(t)), 1.0)) == unit
        assert float(binary32._ulp(flint.arb(-float(t)), 1.0)) == unit
    for t in np.random.default_rng(0).uniform(-1, 1, 1000).astype(f32):
        assert float(binary32._ulp(flint.arb(float(t)), 1.0)) == float(np.spacing(abs(t)))
        assert float(binary32._ulp(flint.arb(float(64 * t)))) == float(np.spacing(abs(64 * t)))


def test_the_tanh_of_torch_and_numpy_is_as_good_as_the_default_says() -> None:
    import torch

    generator = np.random.default_rng(0)
    y = np.concatenate([
        generator.uniform(-10, 10, 40_000), generator.standard_normal(20_000), 2.0 ** generator.uniform(-140, 4, 20_000)
    ]).astype(f32)  # fmt: skip
    exact = np.tanh(y.astype(float))
    unit = units(exact)
    for found in (torch.tensor(y).tanh().numpy(), np.tanh(y)):
        assert np.all(np.abs(found - exact) <= (FloatOptions().tanh_ulp - 0.01) * unit)


@pytest.mark.parametrize(("centre", "squash"), [("preactivation", "tanh"), ("output", "tanh"), ("output", "identity")])
def test_what_centring_adds_is_rounded(centre: str, squash: str) -> None:
    """A constant of centring far larger than what it is added to: most of the error is its rounding."""
    network = PolicyNetwork.of_layers(([[2.0**-20]],), ([0.0],), [3.0], [0.0], squash, centre)  # type: ignore[arg-type]
    system, x = plant(1, 1, u_eq="1/3"), np.array([[0.5]])
    found = float_error(network, system)
    seen = []
    for machine in MACHINES:
        seen.append(require_within(found, network, system, x, machine(network, system.exact_u_eq(), x))[0])
    part = sources(found)["layer 0, rounded numbers" if centre == "preactivation" else "output"]
    assert max(seen) > 2.0**-29 and max(seen) <= found.bounds[0] <= 40 * max(seen)
    assert part > found.bounds[0] / 4


def test_a_clip_is_rounded_too() -> None:
    """Where it always acts, its rounding is the error; it never makes others larger."""
    free = PolicyNetwork.of_layers(([[1.0]],), ([0.5],), [1.0], [0.0], "identity", "none")
    far = dataclasses.replace(free, clip=(np.array([0.1]), np.array([1e6 / 3])))
    system, x = plant(1, 1), np.array([[-0.9]])
    found = float_error(far, system)
    off = require_within(found, far, system, x, Machine()(far, (Fraction(0),), x))[0]
    assert off > 0.9 * abs(float(f32(0.1)) - 0.1)
    assert found.bounds[0] == abs(float(f32(1e6 / 3)) - 1e6 / 3) > float_error(free, system).bounds[0]
    near = dataclasses.replace(free, clip=(np.array([-0.25]), np.array([0.75])))
    assert float_error(near, system).bounds == float_error(free, system).bounds


@pytest.mark.parametrize("flush", [False, True])
@pytest.mark.parametrize(
    ("weight", "state", "large"),
    [(2.0**-120, 0.7 * 2.0**-8, 2.0**126), (2.0**-130, 0.7 * 2.0**20, 2.0**100), (0.5, 2.0**-126, 2.0**126)],
)
def test_tiny_numbers_may_be_lost(weight: float, state: float, large: float, flush: bool) -> None:
    """What is 0 to the machine comes out large behind a large weight."""
    network = PolicyNetwork.of_layers(([[weight]], [[large]]), ([0.0], [0.0]), [1.0], [0.0], "identity", "none")
    system, x = plant(1, 1, str(2**20)), np.array([[state]])
    machine = Machine(flush=flush, tanh=lambda y: y)  # of numbers that small
    found = float_error(network, system)
    off = require_within(found, network, system, x, machine(network, (Fraction(0),), x))[0]
    assert off == pytest.approx(weight * state * large) if flush else off < 1e-5 * weight * state * large


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        ({"weights": ([[1e39]],)}, "weight 0 of the policy must lie below 2\\^127"),
        ({"weights": ([[2.0**127]],)}, "weight 0 of the policy must lie below 2\\^127"),
        ({"biases": ([-1e300],)}, "bias 0 of the policy must lie below"),
        ({"scale": [1e39]}, "scale of the policy must lie below"),
        ({"offset": [-1e39]}, "offset of the policy must lie below"),
        ({"clip": ([-1e39], [1.0])}, "clip of the policy must lie below"),
        ({"weights": ([[1e38]],)}, "a sum in layer 0 must stay below 2\\^127"),
        ({"weights": ([[1e30]],), "scale": [1e9]}, "the output must stay below 2\\^127"),
    ],
)
def test_what_may_overflow_is_refused(edit: dict[str, Any], message: str) -> None:
    network = chained(1, squash="identity").with_layers(**edit)
    with pytest.raises(InputError, match=message):
        float_error(network, plant(1, 1, "4"))


def test_states_that_overflow_are_refused_even_where_no_weight_reads_them() -> None:
    network = PolicyNetwork.of_layers(([[0.0]],), ([0.0],), [1.0], [0.0], "tanh", "none")
    with pytest.raises(InputError, match="a state must stay below 2\\^127"):
        float_error(network, plant(1, 1, str(10**39)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tanh_ulp": -1.0}, "`tanh_ulp`"),
        ({"tanh_ulp": math.nan}, "`tanh_ulp`"),
        ({"tanh_ulp": math.inf}, "`tanh_ulp`"),
        ({"chain": 0}, "`chain`"),
        ({"boxes": 0}, "`boxes`"),
    ],
)
def test_options_out_of_range(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        FloatOptions(**options)


def test_a_policy_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="must read 3 states"):
        float_error(pendulum_network((4,)), plant(3, 1))


@pytest.mark.parametrize("seed", range(4))
def test_the_model_itself_is_nearly_attained(seed: int) -> None:
    """Every operation errs as the model allows and in the direction that hurts: within the bound, and not far from it.

    At a point, so that nothing is lost to ranges; terms of one sign first, so that partial sums are as large as may be.
    """
    network = random_network((2, 10, 8, 1), seed, squash="tanh", centre="none")
    network = network.with_layers(
        weights=tuple(w.astype(f32).astype(float) for w in network.weights),
        biases=tuple(b.astype(f32).astype(float) for b in network.biases),
        scale=network.scale.astype(f32).astype(float),
        offset=network.offset.astype(f32).astype(float),
    )
    x, ulps = np.zeros(2), 4.0
    system = plant(2, 1, "1/1000000000000")
    found = float_error(network, system, FloatOptions(tanh_ulp=ulps, boxes=1)).bounds[0]
    exact, values = x, []
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        exact = W @ (np.tanh(exact) if k else exact) + b
        values.append(exact)
    worst = 0.0
    for sign in (1.0, -1.0):
        gradient, directions = sign * network.scale * (1 - np.tanh(values[-1]) ** 2), []
        for k in range(2, -1, -1):
            directions.append(np.sign(gradient))
            if k:
                gradient = (gradient @ network.weights[k]) * (1 - np.tanh(values[k - 1]) ** 2)
        h = x
        for W, b, y, way in zip(network.weights, network.biases, values, reversed(directions), strict=True):
            rows = []
            for row, c, w in zip(W, b, way, strict=True):
                products = np.array([p * (1 + U * w * np.sign(p)) for p in row * h])
                terms = np.sort(np.append(products, c))
                terms = terms[::-1] if terms.sum() > 0 else terms
                total = terms[0]
                for t in terms[1:]:
                    total = (total + t) * (1 + U * w * np.sign(total + t))
                rows.append(total)
            t = np.tanh(np.array(rows))
            h = t + way * ulps * units(np.tanh(y))
        u = network.scale * h * (1 + U * sign * np.sign(network.scale * h)) + network.offset
        u = u * (1 + U * sign * np.sign(u))
        true = network.scale * np.tanh(values[-1]) + network.offset
        worst = max(worst, float(np.abs(u - true).max()))
    assert worst <= found <= 6 * worst


def test_a_norm_is_bounded_closely() -> None:
    generator = np.random.default_rng(0)
    for shape in ((20, 20), (5, 40), (40, 5), (1, 1)):
        W = generator.standard_normal(shape)
        true = float(np.linalg.norm(W, 2))
        assert true * (1 - 1e-12) <= float(binary32._spectral_norm(flint.arb_mat(W.tolist()))) <= 1.2 * true
    assert binary32._spectral_norm(flint.arb_mat(2, 3)) == 0


def test_more_parts_of_the_domain_give_no_larger_bound(pendulum: System) -> None:
    network = pendulum_network((8, 8))
    one, many = (float_error(network, pendulum, FloatOptions(boxes=b)) for b in (1, 64))
    assert many.bounds[0] < 0.9 * one.bounds[0] and (one.boxes, many.boxes) == (1, 64)


def test_the_parts_make_the_bound(pendulum: System) -> None:
    found = float_error(pendulum_network((8, 8)), pendulum)
    assert found.bounds[0] == pytest.approx(sum(part.errors[0] for part in found.parts), rel=1e-12)
    assert [part.source for part in found.parts][:3] == ["state", "layer 0, rounded numbers", "layer 0, sums"]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "p.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum"))
    assert _run(["float-error", str(path), "--boxes", "2", "--json"], True) == 0
    data = json.loads(capsys.readouterr().out)
    (only,) = data["inputs"]
    assert only["name"] == "u" and only["unit"] == "N m" and len(data["assumptions"]) == 6
    found = float_error(pendulum_network((8, 8)), get_system("pendulum"), FloatOptions(boxes=2))
    assert only["bound"] == found.bounds[0] and data["boxes"] == 2
    assert _run(["float-error", str(path), "--boxes", "2"], False) == 0
    said = capsys.readouterr().out
    typed = Fraction(next(line.split()[1] for line in said.splitlines() if line.startswith("  u ")))
    assert Fraction(found.bounds[0]) <= typed <= Fraction(found.bounds[0]) * Fraction(100001, 100000)
    assert "in any order" in said
    assert _run(["float-error", str(path), "--domain", "theta=0.1", "--domain", "theta_dot=0.1", "--json"], True) == 0
    assert json.loads(capsys.readouterr().out)["inputs"][0]["bound"] < found.bounds[0] / 2


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--chain", "2"], "--chain must be at least 4"),
        (["--tanh-ulp", "-1"], "--tanh-ulp must be a number"),
        (["--boxes", "0"], "--boxes must be at least 1"),
        (["--domain", "nothing=1"], "no state 'nothing'"),
        (["--system", "cartpole"], "must read 4 states"),
    ],
)
def test_the_command_refuses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], given: list[str], message: str
) -> None:
    path = tmp_path / "p.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum"))
    assert _run(["float-error", str(path), *given, "--json"], True) == 2
    assert message in json.loads(capsys.readouterr().out)["error"]


@pytest.mark.parametrize("name", [name for name in ACTIVATIONS if name != "tanh"])
def test_other_activations_stay_within_the_bound(name: str) -> None:
    """In torch's binary32, at states of the domain and across the corners of units."""
    import torch

    plant, network = get_system("pendulum"), pendulum_network((12, 8), "output").with_layers(activation=name)
    network = network.with_layers(weights=(*network.weights[:-1], network.weights[-1] / 8))
    found = float_error(network, plant, FloatOptions(boxes=8))
    half = np.array([float(hi) for _, hi in plant.domain])
    x = (half * np.random.default_rng(0).uniform(-1, 1, (20_000, 2))).astype(f32)
    exact = network(x.astype(np.float64), plant.exact_u_eq())
    h = torch.tensor(x)
    folded = network.folded(plant.exact_u_eq())
    for k, (W, b) in enumerate(zip(folded.weights, folded.biases, strict=True)):
        h = (ACTIVATIONS[name](h) if k else h) @ torch.tensor(W.astype(f32).T) + torch.tensor(b.astype(f32))
    single = torch.tanh(h) * torch.tensor(folded.scale.astype(f32)) + torch.tensor(folded.offset.astype(f32))
    worst = float(np.max(np.abs(single.numpy().astype(np.float64) - exact)))
    assert 0 < worst <= found.bounds[0] < 1e4 * worst
    assert any(part.source == f"layer 0, {name}" for part in found.parts)
    assert any(name in said for said in found.assumptions) is (name != "relu")
