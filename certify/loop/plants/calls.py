"""Networks that a plant's equations call: observers, filters, learned dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol

if TYPE_CHECKING:
    from certify.loop.networks import Network
    from certify.loop.plants.source import PlantFile

_OPTIONS = ("file", "gives", "rest", "kind", "prefix", "activation", "squash", "output", "ignore")
_SAMPLES = 1000


@dataclass(frozen=True, slots=True)
class Call:
    """A network at arguments, which are expressions of states, inputs and results of calls before it.

    Parameters
    ----------
    name : the network's name, for people.
    network : a function of as many numbers as there are arguments.
    arguments : expressions in the deviations from the operating point, parameters and inputs.
    results : the symbols that stand in equations for entries of its value, with the entries' numbers from 0 on.
    """

    name: str
    network: Network
    arguments: tuple[Expression, ...]
    results: tuple[tuple[int, Symbol], ...]


@dataclass(slots=True)
class Named:
    """A network that equations may call by its name, and its calls so far."""

    file: PlantFile
    name: str
    taken: Sequence[str]
    known: dict[int, Network] = field(default_factory=dict)  # by the number of arguments
    calls: dict[tuple[Expression, ...], dict[int, Symbol]] = field(default_factory=dict)

    def __call__(self, entry: int | None, arguments: tuple[Expression, ...]) -> Symbol:
        """The symbol of an entry of the value at these arguments; None for the only one.

        Raises
        ------
        InputError : the network reads another number of arguments, or has no such entry.
        """
        network = self._network(len(arguments))
        if entry is None and network.gives != 1:
            raise InputError(f"{self.name} gives {network.gives} numbers; write which, as in {self.name}[0](...)")
        if not 0 <= (entry or 0) < network.gives:
            raise InputError(f"{self.name} gives {network.gives} numbers, counted from 0; there is no {entry}")
        results = self.calls.setdefault(arguments, {})
        number = list(self.calls).index(arguments)
        symbol = f"{self.name}{f'_at{number + 1}' if number else ''}_{entry or 0}"
        if symbol in self.taken:
            raise InputError(f"the name {symbol} is that of a result of {self.name}, and must be no other")
        return results.setdefault(entry or 0, Symbol(symbol))

    def made(self) -> list[Call]:
        """Its calls."""
        return [
            Call(self.name, self._network(len(arguments)), arguments, tuple(sorted(results.items())))
            for arguments, results in self.calls.items()
        ]

    def at_rest(self) -> dict[str, Fraction]:
        """The values of results at the operating point that the file states, by their symbols' names."""
        said = self.file.table("networks")[self.name]
        rest = said.get("rest") if isinstance(said, dict) else None
        if rest is None or not self.calls:
            return {}
        if not isinstance(rest, list) or len(self.calls) > 1 or len(rest) != next(iter(self.known.values())).gives:
            raise self.file.refuse("`rest` must have a number for each entry, of one call.", "networks", self.name)
        results = next(iter(self.calls.values()))
        return {symbol.name: Fraction(rest[entry]) for entry, symbol in results.items()}

    def _network(self, reads: int) -> Network:
        if not self.known:
            self.known[reads] = read(self.file, self.name, reads)
        network = next(iter(self.known.values()))
        if network.reads != reads:
            raise InputError(f"{self.name} reads {network.reads} numbers; found {reads} arguments")
        return network


def read(file: PlantFile, name: str, reads: int) -> Network:
    """The network that the table `networks` names: a policy file of this program, or another program's file.

    Raises
    ------
    InputError : the file cannot be read, or the network reads another number of arguments.
    """
    from certify.loop.policies.importers import content_of

    said = file.table("networks")[name]
    options = {"file": said} if isinstance(said, str) else said
    if not isinstance(options, dict) or not isinstance(options.get("file"), str) or set(options) - set(_OPTIONS):
        raise file.refuse(
            f"must be the path of a file, or a table of {', '.join(_OPTIONS)}; found {said!r}.", "networks", name
        )
    path = Path(file.path).parent / options["file"]
    try:
        raw = path.read_bytes()
        if content_of(raw, path.name) == "policy":
            return _own(path)
        return _imported(raw, path, reads, options)
    except OSError as error:
        raise file.refuse(f"{path} cannot be read: {error.strerror}.", "networks", name) from error
    except InputError as error:
        raise file.refuse(str(error), "networks", name) from error


def _own(path: Path) -> Network:
    from certify.loop.composition import program_of
    from certify.loop.policies import load_policy

    policy = load_policy(path).network
    if policy.centre != "none":
        raise InputError(f"{path} must be without a centring; found {policy.centre!r}.")
    return program_of(policy)


def _imported(raw: bytes, path: Path, reads: int, said: dict[str, Any]) -> Network:
    from certify.loop.composition import program_of
    from certify.loop.networks import values
    from certify.loop.policies import PolicyNetwork
    from certify.loop.policies.importers import ImportOptions
    from certify.loop.policies.importers.comparing import compare_reading
    from certify.loop.policies.importers.folding import fold
    from certify.loop.policies.importers.recognising import kind_of, read_kind

    given = {key: value for key, value in said.items() if key not in ("file", "gives", "rest")}
    options = ImportOptions(**{"normaliser": "none", "squash": "identity"} | given)
    kind = kind_of(raw, path.name, options)
    reading = read_kind(kind, raw, path.name, options, reads, said.get("gives", 1), path.parent, None)
    if reading.n != reads:
        raise InputError(f"{path} reads {reading.n} numbers; it is called with {reads}.")
    folded = fold(reading.steps, reads, keep_clips=True)
    plain = PolicyNetwork(folded.network, folded.scale, folded.offset, folded.squash, "none", folded.clip)
    network = program_of(plain)
    x = np.random.default_rng(0).normal(size=(_SAMPLES, reads)).astype(np.float32).astype(np.float64)
    compare_reading(reading, (), (), x, values(network, x))
    return network
