"""A plant whose equations call networks, and its policy, as a plant without calls and one larger policy.

Each result of a call becomes an input of the plant, and the policy computes it beside its own inputs: so provers,
certificates and checkers need nothing of their own for observers, filters and learned dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Symbol, substitute
from certify.loop.networks import Affine, Clip, Concat, Map, Network, Observe, Step, values
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork, bounded_by_form

_FREE = 2.0**100  # the bounds of a result, beyond anything that is proved


def composed(system: System, policy: PolicyNetwork) -> tuple[System, PolicyNetwork]:
    """The same loop without calls; unchanged where the plant has none.

    With a centring the new policy is shifted as a whole, so that it is u_eq at the operating point: the results of
    calls have the u_eq that the plant's file gives them, or else their values there, rounded.

    Raises
    ------
    InputError : the policy has another number of states or inputs than the plant.
    """
    if not system.calls:
        return system, policy
    if (policy.n, policy.m) != (system.n, system.m):
        raise InputError(
            f"the policy must read the {system.n} states and command the {system.m} inputs of {system.name}; it reads "
            f"{policy.n} and commands {policy.m}."
        )
    built = _Built(system, policy)
    for call in system.calls:
        built.add(call.network, _exact(system, call.arguments), call.results)
    network = built.network()
    at_rest = values(network, np.zeros(system.n))[system.m :]
    each = zip(built.results, at_rest.tolist(), strict=True)
    inner = _opened(system, built.results, [system.rest_of_calls.get(s.name, Fraction(v)) for s, v in each])
    ones, zeros, none = np.ones(network.gives), np.zeros(network.gives), policy.centre == "none"
    clip = _clip(system, policy, len(built.results))
    return inner, PolicyNetwork(network, ones, zeros, "identity", "none" if none else "output", clip)


def program_of(policy: PolicyNetwork, u_eq: Sequence[Fraction] = ()) -> Network:
    """pi as one network, with squash, scale, offset and clip as steps; the numbers of a centring are rounded."""
    plain, eye = policy.folded(u_eq), np.eye(policy.m)
    steps = list(plain.network.steps)
    if plain.squash == "tanh":
        steps.append(Map((len(steps),), "tanh"))
    if np.any(plain.scale != 1) or np.any(plain.offset):
        steps.append(Affine((len(steps),), plain.scale * eye, plain.offset))
    if plain.clip is not None:
        steps.append(Clip((len(steps),), *plain.clip))
    return Network(policy.n, tuple(steps))


def with_results_as_inputs(system: System) -> System:
    """The plant in which the results of its calls are inputs, 0 at the operating point if its file says nothing else:
    for looking at it alone."""
    results = [symbol for call in system.calls for _, symbol in call.results]
    return _opened(system, results, [system.rest_of_calls.get(s.name, Fraction(0)) for s in results])


def _opened(system: System, results: Sequence[Symbol], at_rest: Sequence[Fraction]) -> System:
    bounds = (Fraction(-_FREE), Fraction(_FREE))
    return replace(
        system,
        inputs=(*system.inputs, *results),
        u_eq=(*system.u_eq, *map(Number, at_rest)),
        input_bounds=(*system.input_bounds, *[bounds] * len(results)),
        calls=(),
        rest_of_calls={},
    )


class _Built:
    """The steps of the policy and of the calls after it; `parts` are the vectors of states, inputs and results."""

    def __init__(self, system: System, policy: PolicyNetwork) -> None:
        program = program_of(policy, system.exact_u_eq())
        self.n, self.steps = system.n, list[Step](program.steps)
        self.symbols: list[Symbol] = [*system.states, *system.inputs]
        self.parts, self.results = [0, len(self.steps)], list[Symbol]()

    def add(self, network: Network, arguments: Sequence[Expression], results: Sequence[tuple[int, Symbol]]) -> None:
        """A call, and those of its results that equations use."""
        known = self._then(Concat(tuple(self.parts)))
        if all(isinstance(e, Symbol) for e in arguments):
            chosen = np.array([[float(s is e) for s in self.symbols] for e in arguments])
            at = self._then(Affine((known,), chosen, np.zeros(len(chosen))))
        else:
            at = self._then(Observe((known,), tuple(self.symbols), tuple(arguments)))
        for step in network.steps:
            self._then(replace(step, of=tuple(i + at for i in step.of)))
        rows = np.zeros((len(results), network.gives))
        rows[range(len(results)), [entry for entry, _ in results]] = 1.0
        self.parts.append(self._then(Affine((len(self.steps),), rows, np.zeros(len(rows)))))
        self.symbols += [symbol for _, symbol in results]
        self.results += [symbol for _, symbol in results]

    def network(self) -> Network:
        """The inputs, and all results behind them."""
        self._then(Concat(tuple(self.parts[1:])))
        return Network(self.n, tuple(self.steps))

    def _then(self, step: Step) -> int:
        self.steps.append(step)
        return len(self.steps)


def _exact(system: System, arguments: Sequence[Expression]) -> list[Expression]:
    numbers = {Symbol(name): Number(q) for name, q in system.parameters.items()}
    return [substitute(e, numbers) for e in arguments]


def _clip(system: System, policy: PolicyNetwork, more: int) -> tuple[np.ndarray, np.ndarray] | None:
    """What limits the inputs: the policy's clip, or the bounds that it keeps by its form; results are free."""
    if policy.clip is None and not bounded_by_form(policy, system.input_bounds):
        return None
    ends = policy.clip or tuple(np.array([float(pair[k]) for pair in system.input_bounds]) for k in (0, 1))
    free = np.full(more, _FREE)
    return np.concatenate([ends[0], -free]), np.concatenate([ends[1], free])
