"""Products of vectors in the prover: bounds on boxes and balls, derivatives, files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

from certify.certificates.encoding import network_section, read_network
from certify.checker import networks as theirs
from certify.checker.calls import enclose
from certify.checker.near import Above, Form
from certify.checker.schema import Value
from certify.errors import InputError
from certify.loop.expressions import Symbol, sqrt
from certify.loop.networks import Affine, Map, Network, Observe, Product, Step, Sum, tangent_at, values
from certify.loop.networks.floats import Gradients
from certify.loop.policies import PolicyNetwork
from certify.loop.policies.file import Policy, load_policy, save_policy
from certify.loop.rigorous import network_on
from certify.provers.bounds.policy import norm_of
from certify.provers.bounds.steps import StepsOnBoxes

V = Symbol("v")


def program(seed: int) -> Network:
    """A gate, a vector times itself, a layer normalisation, and a skip connection that is multiplied."""
    rng, width = np.random.default_rng(seed), 5
    steps: list[Step] = []

    def then(step: Step) -> int:
        steps.append(step)
        return len(steps)

    first = then(Affine((0,), rng.normal(size=(width, 2)), rng.normal(size=width)))
    centred = then(Affine((first,), np.eye(width) - 1 / width, np.zeros(width)))
    square = then(Product((centred, centred)))
    mean = then(Affine((square,), np.full((1, width), 1 / width), np.array([1e-3])))
    normal = then(Product((then(Observe((mean,), (V,), (1 / sqrt(V),))), centred)))
    gated = then(Product((then(Map((normal,), "sigmoid")), then(Map((first,), "tanh")))))
    total = then(Sum((gated, then(Product((gated, mean))))))
    then(Affine((total,), rng.normal(size=(2, width)), rng.normal(size=2)))
    return Network(2, tuple(steps))


@pytest.mark.parametrize("seed", range(10))
def test_values_and_derivatives_of_a_program_agree(seed: int) -> None:
    net, rng = program(seed), np.random.default_rng(seed)
    x, h = rng.normal(size=(6, 2)), 1e-6
    y, each = values(net, x), [tangent_at(net, p) for p in x]
    slopes = np.stack([(values(net, x + h * e) - values(net, x - h * e)) / (2 * h) for e in np.eye(2)], -1)
    assert np.allclose([t.y for t in each], y) and np.allclose([t.J for t in each], slopes, atol=1e-6)
    w = rng.normal(size=(6, 2))
    assert np.allclose(Gradients(net, x).backwards(w), np.einsum("bi,bij->bj", w, slopes), atol=1e-6)
    balls = network_on(net, [flint.arb(float(v)) for v in x[0]])
    assert np.allclose([float(b) for b in balls], y[0])


@pytest.mark.parametrize("seed", range(20))
def test_bounds_on_boxes_hold_and_are_the_checkers(seed: int) -> None:
    net, rng = program(seed), np.random.default_rng(seed)
    radius = 10.0 ** rng.uniform(-4, -1, 5)
    x = np.concatenate([rng.normal(size=(1, 2, 5)), rng.normal(size=(2, 2, 5)) * radius])
    doubt = np.abs(rng.normal(size=(2, 5))) * radius * rng.choice([0.0, 0.05])
    boxes = StepsOnBoxes({step: norm_of(step.weight) for step in net.steps if isinstance(step, Affine)})
    with np.errstate(all="ignore"):
        value = boxes.value(net, x.transpose(1, 0, 2), doubt)
        error = boxes.backwards(np.eye(2))
        u = enclose(as_checked(net), Form(x, Above(doubt)), (0, 1))
    for _ in range(60):
        d = np.sign(rng.normal(size=(2, 5))) * rng.random((2, 5)) ** rng.choice([0.0, 1.0])
        at = x[0] + np.einsum("kb,knb->nb", d, x[1:]) + doubt * np.sign(rng.normal(size=(2, 5)))
        off = np.abs(values(net, at.T).T - value.h[:, 0] - np.einsum("kb,nkb->nb", d, value.h[:, 1:]))
        assert not np.any(off > error + 1e-12)
    finite = np.isfinite(error) & np.isfinite(u.error.top)
    assert np.count_nonzero(finite) > 4
    assert np.allclose(error[finite], u.error.top[finite], rtol=0.02, atol=1e-11)


def as_checked(net: Network) -> theirs.Network:
    return theirs.read(Value([network_section("net", net)], "networks"))["net"]


def test_a_program_is_kept_in_files(tmp_path: Path) -> None:
    net = program(0)
    again = read_network(network_section("net", net))
    x = np.random.default_rng(0).normal(size=(4, 2))
    assert again.words() == net.words() == as_checked(net).words() and np.array_equal(values(again, x), values(net, x))
    policy = PolicyNetwork(net, np.ones(2), np.zeros(2), "tanh", "none")
    save_policy(tmp_path / "policy.pt", Policy(policy, "pendulum"))
    read = load_policy(tmp_path / "policy.pt").network
    assert read.network.words() == net.words() and np.array_equal(values(read.network, x), values(net, x))


@pytest.mark.parametrize("of", [(1,), (1, 2), (1, 1, 1)])
def test_a_product_is_of_two_vectors_that_fit(of: tuple[int, ...]) -> None:
    three, two = (Affine((0,), np.ones((rows, 2)), np.zeros(rows)) for rows in (3, 2))
    steps: list[Any] = [three, two, Product(of)] if 2 in of else [three, Product(of)]
    with pytest.raises(InputError, match="two vectors of equal length"):
        Network(2, tuple(steps))
