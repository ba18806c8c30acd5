"""A plant and a policy from names and files: the same rules for the command line and for Python.

A policy file says which plant it was trained for, and by which numbers; the user may say otherwise, and the user's word
counts. Notices of that go to `tell`, in lines: the command prints them on standard error, a result of Python keeps
them. If a policy's network agrees with its origin on a part of the states only, the domain is cut to that part here,
and no caller has to remember it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from certify.analysis.changes import PlantChanges
    from certify.loop.plants import System
    from certify.loop.policies import Centre, Policy
    from certify.loop.policies.importers import Imported, ImportOptions
    from certify.loop.policies.importers.comparing import Difference
    from certify.lyapunov import StoredLyapunov, Symbolic

    Array = NDArray[np.float64]

Tell = Callable[[str], None]


def policy_in(
    path: Path, importing: ImportOptions, system: System | str | None, changes: PlantChanges, tell: Tell
) -> Policy:
    """The policy in a file of this program, or of another one for the plant that `system` says, with the changes.

    Raises
    ------
    InputError : the file cannot be read or imported, is another program's and nothing says its plant, or the centring
        cannot be had.
    """
    from certify.loop.policies import load_policy
    from certify.loop.policies.importers import import_policy

    if is_own(path, importing):
        stored = load_policy(path)
        if importing.centre is None:
            return stored
        return centred(stored, importing.centre, plant_of(stored, system, changes, lambda _: None), tell)
    imported = import_policy(path, plant_for(f"the policy file {path}", system, changes), importing)
    for line in lines(imported):
        tell(line)
    return imported.policy


def plant_for(whose: str, system: System | str | None, changes: PlantChanges) -> System:
    """The plant, with the changes, of a policy that does not name its plant.

    Raises
    ------
    InputError : nothing else says it, there is no such plant, or the plant cannot have a change.
    """
    from certify.loop.plants import System, chosen_system

    if system is None:
        raise InputError(f"name the plant with --system: {whose} does not say what it controls.")
    return changes.of(system if isinstance(system, System) else chosen_system(system))


def plant_of(stored: Policy, system: System | str | None, changes: PlantChanges, tell: Tell) -> System:
    """The plant of a policy, with the changes: the policy's own unless `system` says otherwise.

    What is given counts as it stands; where the policy was trained for other numbers, `tell` is told so.

    Raises
    ------
    InputError : there is no such plant, the plant cannot have a change, or the policy would read other numbers there
        than the file that it was imported from.
    """
    from certify.analysis.suggested import commands_too_much, limited_outside
    from certify.loop.plants import System

    plant, own = (system, False) if isinstance(system, System) else named_plant(stored, system)
    plant = changes.of(plant)
    require_same_reading(stored, plant)
    if not own:
        tell_of_other(stored, plant, tell)
    plant = where_valid(stored, plant, tell)
    for notice in (commands_too_much(plant, stored.network), limited_outside(plant, stored.network)):
        if notice is not None:
            tell(notice)
    if shift := stored.beta_shift(plant.exact_u_eq()):
        tell(f"the file's rounded beta is read as the real number; this shifts u(0) by {shift:.3g}")
    return plant


def centred(stored: Policy, centre: Centre, plant: System, tell: Tell) -> Policy:
    """A policy of this program with the centring that is asked for; says by how much u changes.

    Raises
    ------
    InputError : the policy has another centring already, or this one cannot be had.
    """
    from certify.loop.policies.importers import centring_changes

    if stored.network.centre == centre:
        return stored
    if stored.network.centre != "none":
        raise InputError(f"--centre {centre} must be left out: the file's centring is {stored.network.centre}.")
    changes = centring_changes(stored.network, plant)
    if centre not in changes:
        raise InputError(f"--centre {centre} cannot be had: u_eq must lie within the policy's reach.")
    tell(f"centred: --centre {centre} changes u by up to {changes[centre]:.3g} in the domain")
    return replace(stored, network=replace(stored.network, centre=centre))


def named_plant(stored: Policy, name: str | None) -> tuple[System, bool]:
    """The plant that `name` says, or else the policy; whether it is the policy's own, with the policy's parameters.

    A policy file names a plant that ships, never a file: a plant of one's own is named each time.

    Raises
    ------
    InputError : there is no such plant.
    """
    from certify.loop.plants import available_systems, chosen_system, shipped_system

    if name is None and stored.system not in available_systems():
        raise InputError(
            f"unknown system {stored.system!r}: the policy was trained for a plant that does not ship here. Name its "
            f"file, as in --system {stored.system if stored.system.isidentifier() else 'plant'}.toml."
        )
    plant = shipped_system(stored.system) if name is None else chosen_system(name)
    own = name is None or name == stored.system
    return (plant.with_parameters(stored.parameters) if own else plant), own


def tell_of_other(stored: Policy, plant: System, tell: Tell) -> None:
    """Say so if the policy says that it was trained for another plant than this one."""
    if stored.system != plant.name:
        tell(f"the policy was trained for {stored.system!r}; it is used with {plant.name}")
        return
    try:
        off = [f"{p} = {v}" for p, v in stored.parameters.items() if plant.parameters.get(p) != Fraction(v)]
    except (ValueError, TypeError, ArithmeticError):
        off = [f"{p} = {v}" for p, v in stored.parameters.items()]
    if off:
        tell(f"the policy was trained with {', '.join(off)}; --system says otherwise, and counts")


def require_same_reading(stored: Policy, plant: System) -> None:
    """Refuse a policy whose import says that it would read something else of this plant than its file does.

    Where a file's network reads the states' values, the operating point is in the numbers of the policy, which reads
    deviations: at another operating point it is another function of the values.

    Raises
    ------
    InputError : the states come in another order, the operating point is another one, or so are the observations or the
    parameters in them.
    """
    from certify.loop.plants.system import observations_of

    record = stored.training.get("imported")
    if not isinstance(record, Mapping):
        return
    names = [s.name for s in plant.states]
    then, at, read = record.get("plant_states"), record.get("x_eq"), record.get("observations")
    if isinstance(then, list) and then != names and {*then} & {*names} and not _same_places(then, names):
        raise _other_reading(f"the states {', '.join(map(str, then))} in this order", f"{', '.join(names)}")
    now = [str(q) for q in plant.exact_x_eq()]
    if isinstance(at, list) and at != now:
        raise _other_reading(f"values of states with the operating point {', '.join(map(str, at))}", ", ".join(now))
    numbers = record.get("parameters")
    for name, value in numbers.items() if isinstance(numbers, Mapping) else ():
        if name in plant.parameters and str(plant.parameters[name]) != value:
            raise _other_reading(f"states with {name} = {value}", f"{name} = {plant.parameters[name]}")
    if isinstance(read, str) and plant.observations:
        shown = ", ".join(map(str, observations_of(plant)))
        if shown != read:
            raise _other_reading(f"the observations {read}", shown)


def _same_places(then: Sequence[Any], names: Sequence[str]) -> bool:
    """True if no state that both lists have stands at another place in the one than in the other."""
    return all(then[names.index(name)] == name for name in names if name in then and names.index(name) < len(then))


def _other_reading(then: str, now: str) -> InputError:
    return InputError(
        f"the policy was imported to read {then}; this plant has {now}. Import its file again for this plant "
        "(certify import, or the file itself for --policy)."
    )


def function_in(text: str, plant: System, tell: Tell) -> StoredLyapunov | Symbolic:
    """The content of a Lyapunov file, for this plant; a notice says so if the file names another. A text that names no
    file and has an operator is an expression of the states' values and of parameters.

    Raises
    ------
    InputError : the file cannot be read, its function has another number of states, or the text is no expression.
    """
    from certify.lyapunov import load_lyapunov

    path = Path(text)
    if not path.exists() and path.suffix != ".pt" and re.search(r"[-+*(]", text):
        return _expressed(text, plant)
    stored = load_lyapunov(path)
    if stored.function.n != plant.n:
        raise InputError(
            f"Lyapunov file {path} must have the {plant.n} states of {plant.name}; it has {stored.function.n}."
        )
    if stored.system != plant.name:
        tell(f"Lyapunov file {path} is of {stored.system}; it is proved for {plant.name}")
    return stored


def _expressed(text: str, plant: System) -> Symbolic:
    """A function as an expression over the states' values and parameters without a range."""
    from certify.loop.expressions import Number, Symbol, substitute
    from certify.loop.plants import in_deviations
    from certify.loop.plants.equations import parse_expression
    from certify.lyapunov import Symbolic

    known = [*plant.states, *(Symbol(name) for name in plant.parameters if name not in plant.ranges)]
    try:
        N = parse_expression(text, {s.name: s for s in known}, "state or parameter")
    except InputError as error:
        raise InputError(f"--lyapunov takes a file, or an expression of states and parameters: {error}") from error
    (shifted,) = in_deviations([N], plant.states, plant.x_eq)
    numbers = {Symbol(name): Number(q) for name, q in plant.parameters.items()}
    return Symbolic(substitute(shifted, numbers), plant.states)


def ellipsoid_beside(stored: StoredLyapunov, plant: System) -> Array | None:
    """P (n, n) of the ellipsoid beyond which a function in a Lyapunov file was learned; None if it does not say.

    A file that says something else than a symmetric matrix says nothing: P is a hint, and what is proved with it is
    proved like any other.
    """
    return _hint(stored.training.get("learned"), plant)


def ellipsoid_trained(stored: Policy, plant: System) -> Array | None:
    """P (n, n) of the ellipsoid that a policy was trained for (`controllers flatten --curvature kept`), by its record;
    None if that does not say. It is a hint too."""
    return _hint(stored.training.get("flattened"), plant)


def _hint(record: Any, plant: System) -> Array | None:
    from certify.lyapunov.function import Quadratic

    try:
        P = Quadratic(record["P"]).P if isinstance(record, dict) and "P" in record else None
    except (InputError, KeyError, ValueError, TypeError):
        return None
    return P if P is not None and len(P) == plant.n else None


def where_valid(stored: Policy, plant: System, tell: Tell) -> System:
    """The plant on the part of its domain where the policy's network agrees with its origin; a notice says the cut.

    Raises
    ------
    InputError : the policy has bounds for another number of states.
    """
    if stored.valid is None:
        return plant
    if len(stored.valid) != plant.n:
        raise InputError(f"the policy is valid for {len(stored.valid)} states; {plant.name} has {plant.n}.")
    cut: dict[str, tuple[Fraction, Fraction]] = {}
    for symbol, (lo, hi), (low, high) in zip(plant.states, plant.domain, stored.valid.tolist(), strict=True):
        ends = (max(lo, Fraction(low)) if low > -math.inf else lo, min(hi, Fraction(high)) if high < math.inf else hi)
        if ends != (lo, hi):
            cut[symbol.name] = ends
    for name, (lo, hi) in cut.items():
        tell(f"the domain of {name} is cut to [{float(lo):.6g}, {float(hi):.6g}]: there its observation is not clipped")
    return plant.with_domain(cut)


def is_own(path: Path, importing: ImportOptions) -> bool:
    """True if a file is to be read as this program's own: also one that nobody can read, whose reader says why.

    Raises
    ------
    InputError : options of other programs' files, other than a centring, are given for one of this program.
    """
    from certify.loop.policies.importers import content_of, read_bytes

    raw = read_bytes(path)
    try:
        content = content_of(raw, path.name)
    except InputError:
        if importing.given:
            raise
        return True
    others = [name for name in importing.given if name != "--centre"]
    if content == "policy" and others:
        raise InputError(f"{', '.join(others)} must be left out: {path} is a policy file of this program and says all.")
    foreign_pickle = content is None and raw[:1] == b"\x80"
    return content == "policy" or (content is None and not importing.given and not foreign_pickle)


def lines(imported: Imported) -> list[str]:
    """The findings of an import, for people."""
    found, policy, record = imported, imported.policy, imported.policy.training["imported"]
    target = _row(found.u_eq)
    origin = f"u_eq = {target}, exactly" if _centres_itself(found) else f"{_row(found.at_origin)}; u_eq {target}"
    said = [
        f"read     {found.words}; sha256 {record['sha256']}",
        f"policy   {found.formula}; o = ({record['states']})",
        *checked(found.difference, found.compared_with, found.assumed, found.not_read),
        f"pi(0)    {origin}",
        f"centring {_centring(found)}",
    ]
    if "--action-scale" not in record["options"] and not record.get("scores"):
        said.append(
            "action   its space is the plant's input bounds, so the output is taken as u; if the environment scales "
            "it, say --action-scale"
        )
    if policy.valid is not None:
        said.append(f"valid    where no observation is clipped: {_box(found)}")
    said.append(
        "proved   is the folded policy: it differs from the file's real-number policy by the rounding of folded "
        "numbers, half a unit in the last place of each at most (of a clip's ends one, inwards)"
    )
    return said


def checked(difference: Difference, compared_with: str | None, assumed: str, not_read: Mapping[str, str]) -> list[str]:
    """Say what an import was compared with, and which tensors of its file it left out."""
    from certify.loop.policies.importers.unread import braced

    numbers = (
        f"at {difference.states:,} states: largest difference {difference.largest:.3g} (rounding explains up to "
        f"{difference.explained:.3g} there), {difference.in_double:.3g} in double precision"
    )
    if compared_with is not None:
        said = [f"compared with {compared_with}, {numbers}"]
    else:
        said = [
            f"numbers  only, no program: nothing was compared with the file. {assumed}; check that against your code",
            f"folding  checked with the same numbers in numpy, {numbers}",
        ]
    reasons: dict[str, list[str]] = {}
    for name, why in not_read.items():
        reasons.setdefault(why, []).append(name)
    return [*said, *(f"not read {braced(names)}: {why}" for why, names in reasons.items())]


def _centring(found: Imported) -> str:
    centre = found.policy.network.centre
    if found.policy.training["imported"].get("scores"):
        return "none, as of scores there is none"
    if _centres_itself(found):
        return f"the file's own, {'inside the squash' if centre == 'preactivation' else 'of the output'}"
    changes = [f"{name} changes u by up to {value:.3g}" for name, value in found.centring.items()]
    if centre != "none":
        changed = f"{centre}, as asked for, which changes u by up to {found.centring[centre]:.3g}"
        return changed if found.compared_with is not None else f"{changed}, unless your code centres so itself"
    return f"none; {', '.join(f'--centre {c}' for c in changes) or 'u_eq is out of reach of any'}"


def _centres_itself(found: Imported) -> bool:
    """True if the file's policy is u_eq at the operating point by its form."""
    return found.policy.network.centre != "none" and not found.centring


def _box(found: Imported) -> str:
    states, valid = found.policy.training["imported"]["plant_states"], found.policy.valid
    pairs = zip(states, valid if valid is not None else (), strict=True)
    return ", ".join(f"{name} in [{lo:.6g}, {hi:.6g}]" for name, (lo, hi) in pairs)


def _row(values: Any) -> str:
    return ", ".join(f"{v:.9g}" for v in values)
