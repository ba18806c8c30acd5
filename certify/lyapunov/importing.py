"""Import the Lyapunov network in another program's policy file.

The import takes only the numbers of a function: no level, no decrease, no proof. Its value is the last layer's. Some
methods add a sigmoid or the like; a strictly increasing function leaves the sublevel sets as they are and only changes
their levels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from certify.errors import InputError
from certify.loop.policies.importers.comparing import Difference, compare_reading
from certify.loop.policies.importers.folding import fold
from certify.loop.policies.importers.importing import read_bytes
from certify.loop.policies.importers.normalisers import rsl_normaliser
from certify.loop.policies.importers.observing import observed, over_states, require_equilibrium, sample, shift
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.recognising import Content, kind_of, tensors_in
from certify.loop.policies.importers.state_dict import read_lyapunov
from certify.lyapunov.file import StoredLyapunov
from certify.lyapunov.neural import Neural

if TYPE_CHECKING:
    from certify.loop.files.arrays import Numbers
    from certify.loop.plants import System

_SIGMOID = "the file's V is sigmoid(N): {V <= v} is {N <= log(v / (1 - v))}"
_UNKNOWN = "the value of the last layer; what increases strictly behind it leaves the sets {N <= level} as they are"


@dataclass(frozen=True, slots=True)
class ImportedLyapunov:
    """A Lyapunov network with what its import found.

    Parameters
    ----------
    function : N, of deviations from the plant's operating point.
    stored : the same with its plant, and the record of its origin in `training`.
    words : its location in the file, and its widths.
    meaning : the relation of N to the file's own function, for people.
    difference : its difference from numpy with the same numbers, in units of N: this checks the folding. The file has
        no program to compare with.
    assumed : the source of the functions between the numbers.
    not_read : the reason why each unread tensor of the file is left out, by its name.
    at_origin : N(0).
    """

    function: Neural
    stored: StoredLyapunov
    words: str
    meaning: str
    difference: Difference
    assumed: str
    not_read: Mapping[str, str]
    at_origin: float


def import_lyapunov(
    path: Path, plant: System, options: ImportOptions | None = None, prefix: str | None = None
) -> ImportedLyapunov:
    """Read the Lyapunov network in a state_dict, a two-stage checkpoint or a file of safetensors.

    Parameters
    ----------
    path : the file.
    plant : the plant whose states it reads.
    options : facts that the file does not contain; those about the policy alone are ignored.
    prefix : keys of the network's layers up to their numbers; None for a two-stage file, where they are known.

    Raises
    ------
    InputError : the file is of another kind, a fact is missing from file and options, it has no such network or an
    unread tensor that could belong to it, or the folding is wrong by more than rounding.

    Notes
    -----
    N reads deviations from the plant's operating point in the plant's order of states. Where the network reads absolute
    states, its first bias becomes `W x_eq + b`, computed exactly and rounded once; all else stays as it is.
    """
    options = options if options is not None else ImportOptions()
    raw = read_bytes(path)
    try:
        return _imported(raw, path.name, plant, options, prefix)
    except InputError as error:
        raise InputError(f"Lyapunov network of {path}: {error}") from error


def _imported(raw: bytes, name: str, plant: System, options: ImportOptions, prefix: str | None) -> ImportedLyapunov:
    kind = kind_of(raw, name, options)
    if kind not in ("state-dict", "safetensors", "two-stage"):
        raise InputError(
            "it must lie in a state_dict, a two-stage checkpoint or a file of safetensors, whose tensors have names; "
            f"the file is {kind}."
        )
    tensors = tensors_in(kind, raw, name)
    _require_answers(kind, options, prefix, plant, tensors)
    reading = read_lyapunov(tensors, prefix, options)
    states = options.states if options.states is not None else tuple(s.name for s in plant.states)
    reads = observed(states, plant, options)
    if reads.index is None:
        raise InputError(f"it must read states themselves; --states names {', '.join(states)}.")
    if (reading.n, reading.m) != (len(states), 1):
        raise InputError(
            f"it must read the {len(states)} states {', '.join(states)} and have one output; "
            f"{reading.words} reads {reading.n} and has {reading.m}. Name what it reads with --states."
        )
    x_eq = [plant.exact_x_eq()[i] for i in reads.index]
    before = shift(x_eq, options)
    require_equilibrium(reading, x_eq if before else [Fraction(0)] * len(states))
    layers = fold((*before, *reading.steps), len(states)).network.affine
    first, biases = over_states(layers[0].weight, reads.index, plant.n), tuple(step.bias for step in layers)
    function = Neural((first, *(step.weight for step in layers[1:])), biases)
    x = sample(plant, None)
    difference = compare_reading(reading, before, (), reads(x), function(x)[:, None])
    record = {
        "file": name,
        "sha256": hashlib.sha256(raw).hexdigest(),
        "kind": kind,
        "network": reading.words,
        "states": ", ".join(states),
        "options": options.given | ({} if prefix is None else {"--lyapunov-prefix": prefix}),
        "compared_with": None,
        "folding_difference": difference.largest,
        "not_read": dict(reading.unread),
    }
    parameters = {parameter: str(value) for parameter, value in plant.parameters.items()}
    return ImportedLyapunov(
        function=function,
        stored=StoredLyapunov(function, plant.name, parameters, {"imported": record}),
        words=reading.words,
        meaning=_SIGMOID if kind == "two-stage" else _UNKNOWN,
        difference=difference,
        assumed=reading.assumed,
        not_read=reading.unread,
        at_origin=float(function(np.zeros(plant.n))),
    )


def _require_answers(
    kind: Content, options: ImportOptions, prefix: str | None, plant: System, tensors: dict[str, Numbers]
) -> None:
    """Ask for everything that the file cannot say, in one sentence."""
    wanted, own = [], kind == "two-stage"
    normalised = not own and (options.normaliser not in (None, "none") or rsl_normaliser(tensors, options.epsilon))
    if normalised:
        raise InputError(
            "it must read the states as they are; the policy's observations are normalised, and whether the Lyapunov "
            "network's are too is not known. Fold the normaliser into its first layer and write the file again."
        )
    if options.states is None and plant.n > 1:
        wanted.append(f"--states {','.join(s.name for s in plant.states)} (what the network reads, in its order)")
    if options.observes is None and any(plant.exact_x_eq()):
        wanted.append(f"--observes absolute or deviation (the operating point of {plant.name} is not 0)")
    if prefix is None and not own:
        wanted.append("--lyapunov-prefix (its keys up to their numbers, as in lyapunov.layers)")
    if options.activation is None and not own:
        wanted.append("--activation tanh (between the layers)")
    if options.normaliser is None and not own:
        wanted.append("--normaliser none (nothing was done to the states)")
    if options.activation not in (None, "tanh"):
        raise InputError(f"--activation must be tanh for a Lyapunov network; found {options.activation!r}.")
    if wanted:
        raise InputError(
            f"the file does not fully define the function; these options are required: {'; '.join(wanted)}."
        )
    if prefix is not None and own:
        raise InputError("--lyapunov-prefix must be left out: a file of two-stage says it itself.")
