"""Networks that a plant's equations call: observers, filters, learned dynamics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol
from certify.loop.networks import Network

if TYPE_CHECKING:
    from certify.loop.plants.source import PlantFile

_OPTIONS = ("file", "gives", "rest", "kind", "prefix", "activation", "squash", "output", "ignore")


@dataclass(frozen=True, slots=True)
class NetworkFile:
    """A network by its file, and what that does not say: `gives` is the number of its outputs, others are those of
    `ImportOptions`."""

    path: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    gives: int = 1


@dataclass(frozen=True, slots=True)
class Call:
    """A network at arguments, which are expressions of states, inputs and results of calls before it.

    Parameters
    ----------
    name : the network's name, for people.
    network : a function of as many numbers as there are arguments, or its file.
    arguments : expressions in the deviations from the operating point, parameters and inputs.
    results : the symbols that stand in equations for entries of its value, with the entries' numbers from 0 on, or None
        for the only one.
    """

    name: str
    network: Network | NetworkFile
    arguments: tuple[Expression, ...]
    results: tuple[tuple[int | None, Symbol], ...]


@dataclass(slots=True)
class Named:
    """A network that equations may call by its name, and its calls so far; `taken` are the plant's other names."""

    file: PlantFile
    name: str
    taken: Sequence[str]
    calls: dict[tuple[Expression, ...], dict[int | None, Symbol]] = field(default_factory=dict)

    def __call__(self, entry: int | None, arguments: tuple[Expression, ...]) -> Symbol:
        """The symbol of an entry of the value at these arguments; None for the only one.

        Raises
        ------
        InputError : the symbol has the name of something else.
        """
        results = self.calls.setdefault(arguments, {})
        number = list(self.calls).index(arguments)
        symbol = f"{self.name}{f'_at{number + 1}' if number else ''}_{entry or 0}"
        if symbol in self.taken:
            raise InputError(f"the name {symbol} is that of a result of {self.name}, and must be no other")
        return results.setdefault(entry, Symbol(symbol))

    def made(self) -> list[Call]:
        """Its calls."""
        file = self._file()
        return [Call(self.name, file, at, tuple(results.items())) for at, results in self.calls.items()]

    def at_rest(self) -> dict[str, Fraction]:
        """The values of results at the operating point that the file states, by their symbols' names."""
        said = self.file.table("networks")[self.name]
        rest = said.get("rest") if isinstance(said, dict) else None
        if rest is None or not self.calls:
            return {}
        (results, *others) = self.calls.values()
        most = max(entry or 0 for entry in results)
        numbers = isinstance(rest, list) and all(type(q) in (int, Fraction) for q in rest)
        if others or not numbers or len(rest) <= most:
            raise self.file.refuse("`rest` must have a number for each entry, of one call.", "networks", self.name)
        return {symbol.name: Fraction(rest[entry or 0]) for entry, symbol in results.items()}

    def _file(self) -> NetworkFile:
        said = self.file.table("networks")[self.name]
        options = {"file": said} if isinstance(said, str) else said
        if not isinstance(options, dict) or not isinstance(options.get("file"), str) or set(options) - set(_OPTIONS):
            raise self.file.refuse(
                f"must be the path of a file, or a table of {', '.join(_OPTIONS)}; found {said!r}.",
                *("networks", self.name),
            )
        others = {key: value for key, value in options.items() if key not in ("file", "gives", "rest")}
        return NetworkFile(Path(self.file.path).parent / options["file"], others, options.get("gives", 1))
