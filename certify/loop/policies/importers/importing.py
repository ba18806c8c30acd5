"""Import another program's policy file: read it, ask for missing facts, fold, compare, and report.

The bytes determine the file's kind; nothing in it is executed. Proofs are about the folded policy: each folded number
differs from the file's real-number policy by at most half a unit in the last place, an end of a clip by one, inwards.
"""

from __future__ import annotations

import hashlib
import math
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.archives import MAX_BYTES
from certify.loop.files.foreign import folder_described
from certify.loop.networks import Affine, Network
from certify.loop.policies.exact import require_centred
from certify.loop.policies.file import Policy
from certify.loop.policies.importers.centring import without_centring
from certify.loop.policies.importers.comparing import Difference, compare_reading
from certify.loop.policies.importers.folding import Bounds, Folded, fold
from certify.loop.policies.importers.normalisers import load_normaliser
from certify.loop.policies.importers.observing import (
    Observed,
    observed,
    over_states,
    require_equilibrium,
    sample,
    shift,
)
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Evaluate, Observations, Reading, Values
from certify.loop.policies.importers.recognising import Content, kind_of, read_kind
from certify.loop.policies.importers.steps import Clip, Diagonal, Normalise, Step, spread
from certify.loop.policies.network import Array, Centre, PolicyNetwork

if TYPE_CHECKING:
    from certify.loop.plants import System

_ONE, _ZERO = (Fraction(1),), (Fraction(0),)


@dataclass(frozen=True, slots=True)
class Imported:
    """A policy with what its import found.

    Parameters
    ----------
    policy : the policy, with the record of its origin in `training`.
    words : the kind of file and of policy.
    formula : the file's policy as a formula, for people.
    difference : its difference from the file's own program, or, if the file has no program, from numpy with the same
        numbers, which checks only the folding.
    compared_with : the file's own program that it was compared with, for people; None without a comparison.
    assumed : without a comparison, the source of the functions between the numbers.
    not_read : the reason why each unread tensor of the file is left out, by its name.
    at_origin : pi(0) of the file's policy, shape (m,); u_eq where its own centring makes it so.
    u_eq : the plant's equilibrium input, shape (m,).
    centring : for each centring that is possible the largest change of u over the states compared.
    """

    policy: Policy
    words: str
    formula: str
    difference: Difference
    compared_with: str | None
    assumed: str
    not_read: Mapping[str, str]
    at_origin: Array
    u_eq: Array
    centring: Mapping[Centre, float]


def import_policy(
    path: Path, plant: System, options: ImportOptions | None = None, beside: str | None = None
) -> Imported:
    """Read a policy of another program for a plant.

    Parameters
    ----------
    path : the file.
    plant : the plant that it controls: its states, inputs, domain and u_eq.
    options : facts that the file does not contain.
    beside : keys of the layers of the Lyapunov network that is imported from the same file, if one is.

    Raises
    ------
    InputError : the file is of an unknown kind, a fact is missing from file and options, it has operations that are not
    proved or an unread tensor that could belong to the policy, or differs from its own program by more than rounding.
    """
    options = options if options is not None else ImportOptions()
    raw = read_bytes(path)
    try:
        return import_bytes(raw, path.name, plant, options, folder=path.parent, beside=beside)
    except InputError as error:
        raise InputError(f"policy file {path}: {error}") from error


def read_bytes(path: Path) -> bytes:
    """The bytes of a policy file.

    Raises
    ------
    InputError : it cannot be read, or is larger than any policy.
    """
    try:
        if path.is_dir():
            raise InputError(f"policy file {path} must be a file; it is {folder_described(path)}")
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"policy file {path} must have at most {MAX_BYTES >> 20} MiB; it has more.")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"policy file {path} cannot be read: {error.strerror}.") from error


def import_bytes(
    raw: bytes,
    name: str,
    plant: System,
    options: ImportOptions,
    *,
    evaluate: Evaluate | None = None,
    folder: Path | None = None,
    beside: str | None = None,
) -> Imported:
    """The same for the bytes of such a file, called `name`.

    Parameters
    ----------
    evaluate : the policy itself, if available, for the comparison.
    folder : the file's folder, if it has one; an ONNX model may have its weights in a second file there.
    beside : as in `import_policy`.

    Raises
    ------
    InputError : as `import_policy`, without the name.
    """
    kind = kind_of(raw, name, options)
    reads = observed(options.states, plant, options)
    n = reads.count
    reading = read_kind(kind, raw, name, options, n, plant.m, folder, beside)
    if evaluate is not None:
        reading = replace(reading, evaluate=_either(evaluate, reading.evaluate), program="the module itself, run")
    _require_answers(kind, reading, options, plant)
    _require_shape(reading, reads, plant)
    x_eq = [plant.exact_x_eq()[i] for i in reads.index or ()]
    moved = shift(x_eq, options)
    normaliser = _normaliser(reading, options, n)
    before = (*moved, *normaliser)
    require_equilibrium(reading, x_eq if moved else [Fraction(0)] * n)
    after = _action(options, plant.m)
    steps = (*before, *reading.steps, *after)
    u_eq = plant.exact_u_eq()
    steps, centre = _centred(steps, reading, reads, options, u_eq)
    folded = fold(steps, n, centre=centre)
    if reads.index is None and reads.may_leave(folded.inactive):
        folded = fold(steps, n, keep_clips=True, centre=centre)
    network, valid = _network(folded, reads, centre)
    if network.centre != "none":
        require_centred(network, u_eq)
    # It refuses another plant's beta, before the comparison does with less to say.
    Policy(network, plant.name, beta=reading.beta, valid=valid).beta_shift(u_eq)
    x = sample(plant, valid)
    own = "none" if options.centre and reading.beta is None else centre  # of the file's own policy
    bare = network if own != "none" else replace(network, centre="none")
    values = bare(x, u_eq)
    difference = compare_reading(reading, before, after, reads(x), values, reads.is_inexact)
    known = {"file": name, "sha256": hashlib.sha256(raw).hexdigest(), "kind": kind}
    known |= {"policy": reading.words, "states": reads.words}
    record = known | _record(reading, options, plant, reads.words, difference)
    return Imported(
        policy=Policy(network, plant.name, _parameters(plant), {"imported": record}, reading.beta, valid),
        words=reading.words,
        formula=_formula(normaliser, network, folded, reading, own if reading.program is not None else centre, u_eq),
        difference=difference,
        compared_with=reading.program,
        assumed=reading.assumed,
        not_read=reading.unread,
        at_origin=np.array(list(map(float, u_eq))) if own != "none" else np.asarray(bare(np.zeros(plant.n), u_eq)),
        u_eq=np.array(list(map(float, u_eq))),
        centring={} if own != "none" or reading.scores else _centrings(bare, u_eq, x, values),
    )


def _either(own: Evaluate, read: Evaluate) -> Evaluate:
    """A module's own values; in double precision those of its operations, where it rounds its input itself."""

    def evaluate(x: Observations, double: bool) -> Values:
        try:
            return own(x, double)
        except RuntimeError:
            if not double:
                raise
            return read(x, True)

    return evaluate


def _record(
    reading: Reading, options: ImportOptions, plant: System, words: str, difference: Difference
) -> dict[str, Any]:
    """The origin of a policy, for its file."""
    record: dict[str, Any] = {
        "plant_states": [s.name for s in plant.states],
        "options": options.given,
    }
    if isinstance(options.normaliser, Path):
        record["normaliser_sha256"] = hashlib.sha256(read_bytes(options.normaliser)).hexdigest()
    record |= _read_of(options, plant, words)
    record["compared_with"] = reading.program
    record["largest_difference" if reading.program is not None else "folding_difference"] = difference.largest
    record["not_read"] = dict(reading.unread)
    if reading.scores:
        record["scores"] = True
    if reading.beside:
        record["beside_sha256"] = dict(reading.beside)
    return record


def _read_of(options: ImportOptions, plant: System, words: str) -> dict[str, Any]:
    """The plant's facts that are in the policy's numbers: its operating point where the network reads the states'
    values, its observations where it reads these, and its parameters that `--states` names. Used with a plant that has
    others, it is another policy."""
    own = bool(plant.observations) and options.states is None
    named = {name for text in options.states or () for name in re.findall(r"[A-Za-z_]\w*", text)}
    parameters = {name: str(value) for name, value in plant.parameters.items() if name in named}
    read: dict[str, Any] = {"parameters": parameters} if parameters else {}
    if options.observes != "deviation" or own:
        read["x_eq"] = [str(q) for q in plant.exact_x_eq()]
    return read | ({"observations": words} if own else {})


def _require_answers(kind: Content, reading: Reading, options: ImportOptions, plant: System) -> None:
    """Ask for everything that the file cannot say, in one sentence."""
    wanted = []
    order = ",".join(s.name for s in plant.states)
    layers_only = kind in ("state-dict", "safetensors")
    if options.states is None and plant.n > 1 and not plant.observations:
        wanted.append(f"--states {order} (what the network reads, in its order)")
    if options.activation is None and layers_only:
        wanted.append("--activation tanh, relu or another (between the layers)")
    if options.squash is None and (layers_only or kind == "two-stage"):
        wanted.append("--squash identity, tanh or relu-tanh (after the last layer)")
    if options.normaliser is None and reading.normaliser is None and kind != "two-stage":
        wanted.append("--normaliser FILE or none (what was done to observations)")
    if options.action_scale is None and not reading.scores and not _are_bounds(reading.action, plant):
        wanted.append("--action-scale (u = scale * action + offset in the plant's units: 1 if they are the same)")
    if options.observes is None and any(plant.exact_x_eq()) and (options.states or not plant.observations):
        wanted.append(f"--observes absolute or deviation (the operating point of {plant.name} is not 0)")
    if wanted:
        raise InputError(f"the file does not fully define the policy; these options are required: {'; '.join(wanted)}.")
    for option, value, belongs in (
        ("--activation", options.activation, layers_only),
        ("--norm", options.norm, layers_only),
        ("--squash", options.squash, layers_only or kind == "two-stage"),
        ("--prefix", options.prefix, layers_only),
        ("--normaliser", options.normaliser, kind != "two-stage"),
        ("--centre", options.centre, kind != "two-stage" or options.centre == "preactivation"),
        ("--ignore", options.ignore, kind not in ("torchscript", "onnx")),
        ("--output", options.output, kind in ("onnx", "torchscript") or layers_only),
    ):
        if value is not None and not belongs:
            raise InputError(f"{option} must be left out: a file of {kind} says it itself.")
    if reading.scores:
        _require_scores(options)


def _require_shape(reading: Reading, reads: Observed, plant: System) -> None:
    """Refuse a policy that reads or gives other numbers than the plant has."""
    if reading.scores and reading.m != plant.m:
        raise InputError(
            f"the policy has a score for each of {reading.m} actions, so {plant.name} must have {reading.m} inputs, "
            f"which are these scores; it has {plant.m}. Its equations take the largest with heaviside."
        )
    if (reading.n, reading.m) != (reads.count, plant.m):
        raise InputError(
            f"the policy must read the {reads.count} {'states' if reads.index else 'observations'} {reads.words} and "
            f"command the {plant.m} inputs of {plant.name}; it reads {reading.n} and commands {reading.m}. Name what "
            "it reads with --states."
        )


def _require_scores(options: ImportOptions) -> None:
    """Refuse options that would change scores of actions."""
    given = {
        "--action-scale": options.action_scale,
        "--action-offset": options.action_offset,
        "--clip": options.clip,
        "--centre": options.centre,
    }
    for option, value in given.items():
        if value is not None:
            raise InputError(f"{option} must be left out: the outputs are scores of actions, which stay as they are.")


def _are_bounds(action: Sequence[tuple[Fraction, Fraction]] | None, plant: System) -> bool:
    """True if an action space has the plant's input bounds, in single precision, which it usually is in."""
    single = [np.array(bounds, dtype=np.float32) for bounds in (action or (), plant.input_bounds)]
    return np.array_equal(single[0], single[1])


def _normaliser(reading: Reading, options: ImportOptions, n: int) -> tuple[Step, ...]:
    if options.normaliser is None:
        found: Normalise | Diagonal | None = reading.normaliser
    elif reading.normaliser is not None:
        raise InputError("--normaliser must be left out: the file holds the normaliser of its policy.")
    elif options.normaliser == "none":
        found = None
    else:
        found = load_normaliser(options.normaliser, options.epsilon)
    if found is None:
        if options.epsilon is not None:
            raise InputError("--epsilon must go with a normaliser of rsl_rl; there is none.")
        return ()
    size = len(found.mean if isinstance(found, Normalise) else found.offset)
    if size not in (1, n):
        held = reading.normaliser is not None
        raise InputError(
            f"the normaliser {'that the file holds' if held else options.normaliser} must be of the {n} numbers that "
            f"the policy reads; it is of {size}. "
            f"{'Name what it reads with --states' if held else 'Name the one that was saved with this policy'}."
        )
    return (found,)


def _action(options: ImportOptions, m: int) -> tuple[Step, ...]:
    """The steps from the network's action to the plant's input."""
    scale = spread(options.action_scale or _ONE, m)
    offset = spread(options.action_offset or _ZERO, m)
    steps: list[Step] = []
    if options.clip is not None:
        steps.append(Clip(spread(options.clip.lo, m), spread(options.clip.hi, m)))
    if any(v != 1 for v in scale) or any(offset):
        steps.append(Diagonal(scale, offset))
    return tuple(steps)


def _centred(
    steps: tuple[Step, ...], reading: Reading, reads: Observed, options: ImportOptions, u_eq: Sequence[Fraction]
) -> tuple[tuple[Step, ...], Centre]:
    """The steps without what centres them, and the centring: the file's own, or the one that was asked for."""
    if reading.beta is not None:
        return steps, "preactivation"
    if options.centre is not None:
        return steps, options.centre
    return without_centring(steps, reads.at_origin, u_eq) or (steps, "none")


def _network(folded: Folded, reads: Observed, centre: Centre) -> tuple[PolicyNetwork, Array | None]:
    """The network over the plant's states, and the states where no observation is clipped, (n, 2), rounded inwards."""
    n = reads.plant.n
    network = PolicyNetwork(
        _over_states(folded.network, reads), folded.scale, folded.offset, folded.squash, centre, folded.clip
    )
    valid = np.tile([-math.inf, math.inf], (n, 1))
    for k, bounds in zip(reads.index or (), folded.inactive, strict=False):
        valid[k] = _inwards(bounds)
    return network, None if np.all(np.isinf(valid)) else valid


def _over_states(network: Network, reads: Observed) -> Network:
    """A network of observations as one of the plant's states."""
    n = reads.plant.n
    if reads.index is None:
        return network.behind(n, reads.step)
    first, *others = network.steps
    if isinstance(first, Affine) and not any(0 in step.of for step in others):
        return Network(n, (Affine((0,), over_states(first.weight, reads.index, n), first.bias), *others))
    if reads.index == tuple(range(n)):
        return network
    chosen = over_states(np.eye(len(reads.index)), reads.index, n)
    return network.behind(n, Affine((0,), chosen, np.zeros(len(chosen))))


def _inwards(bounds: Bounds) -> tuple[float, float]:
    largest = Fraction(sys.float_info.max)
    lo, hi = (None if v is not None and abs(v) > largest else v for v in bounds)
    if (lo, hi) != bounds:
        raise InputError("what a normaliser clips to must lie in the range of binary64.")
    low, high = -math.inf if lo is None else float(lo), math.inf if hi is None else float(hi)
    if lo is not None and Fraction(low) < lo:
        low = math.nextafter(low, math.inf)
    if hi is not None and Fraction(high) > hi:
        high = math.nextafter(high, -math.inf)
    return low, high


def _parameters(plant: System) -> dict[str, str]:
    return {name: str(value) for name, value in plant.parameters.items()}


def centring_changes(network: PolicyNetwork, plant: System) -> dict[Centre, float]:
    """The largest change of u that each possible centring would cause, over samples of the domain."""
    x, u_eq = sample(plant, None), plant.exact_u_eq()
    bare = replace(network, centre="none")
    return _centrings(bare, u_eq, x, bare(x, u_eq))


def _centrings(bare: PolicyNetwork, u_eq: tuple[Fraction, ...], x: Array, values: Array) -> dict[Centre, float]:
    """The largest change of u that each centring would cause, over the states."""
    changes: dict[Centre, float] = {}
    centres: tuple[Centre, ...] = ("output", "preactivation")
    for centre in centres:
        try:
            moved = replace(bare, centre=centre)(x, u_eq)
        except InputError:
            continue  # u_eq is outside the squash's range, or there is no squash to centre in
        changes[centre] = float(np.max(np.abs(moved - values)))
    return changes


def _formula(
    normaliser: tuple[Step, ...],
    network: PolicyNetwork,
    folded: Folded,
    reading: Reading,
    centred: Centre,
    u_eq: Sequence[Fraction],
) -> str:
    """The file's policy in the plant's units, centred so by itself, or of a file without a program as it is asked."""
    offset = [float(u) for u in u_eq] if centred == "output" else folded.offset
    observation = "o"
    if normaliser:
        divisor = "sqrt(var + epsilon)" if isinstance(normaliser[0], Normalise) else "(std + epsilon)"
        observation = f"(o - mean) / {divisor}"
    net = f"net({observation})"
    if reading.beta is not None:
        net = "net(x) - net(x_eq) + beta"
    elif centred == "preactivation":
        at_0 = any(u != Fraction(float(o)) for u, o in zip(u_eq, folded.offset, strict=True))
        net = f"{net} - net(o_eq){' + beta' if at_0 else ''}"
    inner = f"tanh({net})" if network.squash == "tanh" else net
    if centred == "output":
        inner += f" - {inner.replace(net, 'net(o_eq)')}"
    factor = f"({inner})" if centred == "output" else inner
    scaled = inner if np.all(folded.scale == 1) else f"{_short(folded.scale)} * {factor}"
    scaled = scaled if not np.any(offset) else f"{scaled} + {_short(offset)}"
    if folded.clip is None:
        return f"u = {scaled}"
    return f"u = clip({scaled}, {_short(folded.clip[0])}, {_short(folded.clip[1])})"


def _short(values: Any) -> str:
    distinct = [f"{v:.6g}" for v in values]
    return distinct[0] if len(set(distinct)) == 1 else f"[{', '.join(distinct)}]"
