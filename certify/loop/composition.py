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
from certify.loop.expressions import Expression, Number, Symbol, substitute, symbols_of
from certify.loop.networks import Affine, Concat, Network, Observe, Step, values
from certify.loop.plants import System
from certify.loop.plants.calls import Call, NetworkFile
from certify.loop.policies import PolicyNetwork, bounded_by_form, load_policy, program_of
from certify.loop.policies.importers import ImportOptions, content_of, read_bytes
from certify.loop.policies.importers.comparing import compare_reading
from certify.loop.policies.importers.folding import fold
from certify.loop.policies.importers.recognising import kind_of, read_kind

_SAMPLES = 1000  # arguments at which a network is compared with its file's own program
_FREE = 2.0**100  # the bounds of a result, beyond anything that is proved


def composed(system: System, policy: PolicyNetwork) -> tuple[System, PolicyNetwork]:
    """The same loop without calls; unchanged where the plant has none.

    With a centring the new policy is shifted as a whole, so that it is u_eq at the operating point: the results of
    calls have the u_eq that the plant's file gives them, or else their values there, rounded.

    Raises
    ------
    InputError : the policy has another number of states or inputs than the plant, or inputs are held, and the results
        of calls, which would become inputs, are not.
    """
    if not system.calls:
        return system, policy
    if system.sample is not None:
        called = ", ".join({call.name: 1 for call in system.calls})
        raise InputError(
            f"the equations of {system.name} call {called}, whose results move "
            "within a period, and with --sample-time they would be held as inputs are. Leave --sample-time out, or "
            'write the equations of a whole step, with time = "discrete".'
        )
    if (policy.n, policy.m) != (system.n, system.m):
        raise InputError(
            f"the policy must read the {system.n} states and command the {system.m} inputs of {system.name}; it reads "
            f"{policy.n} and commands {policy.m}."
        )
    built = _Built(system, policy)
    for call in system.calls:
        network = network_of(call)
        built.add(network, _exact(system, call.arguments), [(_entry(call, network, k), s) for k, s in call.results])
    network = built.network()
    at_rest = values(network, np.zeros(system.n))[system.m :]
    each = zip(built.results, at_rest.tolist(), strict=True)
    inner = _opened(system, built.results, [system.rest_of_calls.get(s.name, Fraction(v)) for s, v in each])
    ones, zeros, none = np.ones(network.gives), np.zeros(network.gives), policy.centre == "none"
    clip = _clip(system, policy, len(built.results))
    return inner, PolicyNetwork(network, ones, zeros, "identity", "none" if none else "output", clip)


def network_of(call: Call) -> Network:
    """The network that is called: itself, or read from a policy file of this program or another program's file.

    Raises
    ------
    InputError : the file cannot be read, or the network reads another number of arguments.
    """
    reads, network = len(call.arguments), call.network
    if isinstance(network, NetworkFile):
        try:
            network = _read(network, reads)
        except InputError as error:
            raise InputError(f"the network {call.name}: {error}") from error
    if network.reads != reads:
        raise InputError(f"the network {call.name} reads {network.reads} numbers; found {reads} arguments.")
    return network


def _entry(call: Call, network: Network, entry: int | None) -> int:
    """The number of an entry of the value."""
    if entry is None and network.gives != 1:
        raise InputError(
            f"the network {call.name} gives {network.gives} numbers; write which, as in {call.name}[0](...)."
        )
    if not 0 <= (entry or 0) < network.gives:
        raise InputError(f"the network {call.name} gives {network.gives} numbers, from 0 on; there is no {entry}.")
    return entry or 0


def _read(file: NetworkFile, reads: int) -> Network:
    raw = read_bytes(file.path)
    if content_of(raw, file.path.name) == "policy":
        policy = load_policy(file.path).network
        if policy.centre != "none":
            raise InputError(f"{file.path} must be without a centring; found {policy.centre!r}.")
        return program_of(policy)
    options = ImportOptions(**{"normaliser": "none", "squash": "identity", **file.options})
    kind = kind_of(raw, file.path.name, options)
    reading = read_kind(kind, raw, file.path.name, options, reads, file.gives, file.path.parent, None)
    if reading.n != reads:
        raise InputError(f"{file.path} reads {reading.n} numbers; found {reads} arguments.")
    folded = fold(reading.steps, reads, keep_clips=True)
    network = program_of(PolicyNetwork(folded.network, folded.scale, folded.offset, folded.squash, "none", folded.clip))
    x = np.random.default_rng(0).normal(size=(_SAMPLES, reads)).astype(np.float32).astype(np.float64)
    compare_reading(reading, (), (), x, values(network, x))
    return network


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
    for e in arguments:
        odd = [s.name for s, _ in system.uncertain if s in symbols_of(e)]
        if odd:
            raise InputError(f"an argument of a network must not depend on what is uncertain; {e} does on {odd[0]}.")
    return [substitute(e, numbers) for e in arguments]


def _clip(system: System, policy: PolicyNetwork, more: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The limits of the inputs: the policy's clip, or the bounds that it keeps by its form; results are free."""
    if policy.clip is None and not bounded_by_form(policy, system.input_bounds):
        return None
    ends = policy.clip or tuple(np.array([float(pair[k]) for pair in system.input_bounds]) for k in (0, 1))
    free = np.full(more, _FREE)
    return np.concatenate([ends[0], -free]), np.concatenate([ends[1], free])
