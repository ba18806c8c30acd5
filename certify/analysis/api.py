"""`certify.certify_roa`: the pipeline for whoever works in Python, with names and files in the place of objects.

The command and this function obey the same rules (`certify.analysis.inputs`): which plant a policy belongs to, what is
asked for that a file does not say, where a domain is cut. What the command prints on standard error a result keeps as
`notices`. Nothing here decides anything: the pipeline is `certify.analysis.run`.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from certify.analysis.inputs import (
    centred,
    function_in,
    lines,
    named_plant,
    policy_in,
    tell_of_other,
    where_valid,
    with_acting,
    with_bounded_errors,
    with_period,
    with_uncertain_parameters,
)
from certify.analysis.installation import versions
from certify.analysis.options import Around, Asked, EngineName, RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import Report
from certify.analysis.run import certify_roa as run
from certify.errors import InputError
from certify.loop.plants import System, chosen_system, exact
from certify.loop.plants.equations import nearest
from certify.loop.policies import Policy, TanhNetwork
from certify.loop.policies.importers import Clip, ImportOptions, import_module, import_state_dict
from certify.lyapunov import Candidate, Neural, Polynomial, Symbolic

if TYPE_CHECKING:
    import torch

Exact = Fraction | float | int | str
"""A number: text means its decimal value, a float its binary value."""
Change = Callable[[System], System]
_NUMBERS = (Fraction, float, int, str, np.generic)
_POLICY_FILES = (".pt", ".pth", ".zip", ".onnx", ".safetensors")
_WORDS = {"--from": "kind", "--precision": "dreal_precision"}  # options that Python calls otherwise


def certify_roa(
    system: str | os.PathLike[str] | System | None,
    policy: str | os.PathLike[str] | Policy | TanhNetwork | torch.nn.Module | Mapping[str, Any],
    out: str | os.PathLike[str] | None = None,
    options: RoaOptions | None = None,
    *,
    importing: ImportOptions | Mapping[str, Any] | None = None,
    claim: Asked | None = None,
    around: Around | None = None,
    candidate: Candidate | None = None,
    Q: Sequence[float] | None = None,
    R: Sequence[float] | None = None,
    P: ArrayLike | None = None,
    level: float | None = None,
    engine: EngineName | None = None,
    dreal_precision: float | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    cluster_checks: bool | None = None,
    resume: bool | None = None,
    enlarge: bool | None = None,
    box: Mapping[str, float] | None = None,
    reach_from: Mapping[str, Fraction | float | str] | None = None,
    time_limit: float | None = None,
    max_boxes: int | None = None,
    ranges: Mapping[str, Sequence[Exact]] | None = None,
    disturbances: Mapping[str, Exact | Sequence[Exact]] | None = None,
    input_error: Exact | Mapping[str, Exact] | None = None,
    sample_time: Exact | Sequence[Exact] | None = None,
    rate: float | None = None,
    lyapunov: str | os.PathLike[str] | Neural | Polynomial | Symbolic | None = None,
    lyapunov_level: float | None = None,
    hidden: Sequence[int] | None = None,
    degree: int | None = None,
    seed: int | None = None,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
) -> RoaResult:
    """Prove a region of attraction of a plant under a policy, and have the proof checked.

    For `xdot = f(x, pi(x))` it looks for the largest set {x'Px <= c2} from which every trajectory converges to the
    origin, writes the proof down as a certificate, and asks the independent checker, in a process of its own. A policy
    that does not rest at the origin exactly gets another claim, a nearby equilibrium or practical stability:
    `result.claim` says which.

    Parameters
    ----------
    system : the plant: the name of one that ships ("pendulum"; `certify systems` lists them), the path of a TOML file,
        "FILE.py:NAME" (whose code is run), a `System`, or None for the plant that the policy names. For other
        parameters or another domain: `get_system("pendulum").with_parameters({"m": "0.2"})`, `with_domain`.
    policy : the path of a policy file, of this program or another's; a `Policy` or `TanhNetwork`; a torch module of
        Linear and Tanh layers and constant scalings; or a state_dict of such layers.
    out : folder for `certificate.json`, made if it is not there. None is a temporary folder that lives as long as the
        result does: copy the certificate, or keep the result. No report is drawn until `result.report()` asks for it.
    options : all of the options below in one `RoaOptions`, in their place.
    importing : what a policy that is not this program's own does not say: an `ImportOptions`, or a mapping with its
        names, such as `{"states": ["theta", "theta_dot"], "normaliser": "none", "action_scale": 6}`. What is missing
        is asked for by name; nothing is guessed. Text means its decimal value, a float its binary value.
    claim : "asymptotic"; "practical", which asks for no equilibrium at the origin; "nearby", which is that and, if it
        can be shown, convergence to one equilibrium where what is uncertain is constant; or "auto" (the default), the
        first where the loop rests at the origin exactly and the last where it does not.
    around : the point at which V is 0 where the loop does not rest at the origin: "rest", the stable point at which it
        does; "origin"; or "auto" (the default), the first if there is one and nothing is given around the origin. What
        the result says is about its plant, `result.system`, whose operating point that is.
    candidate : where P comes from: "auto" (the default: of several the largest proved), "lyapunov", "scaled", "lqr",
        "optimised", "robust", or "peak", which is for practical claims; "neural" and "polynomial" do as "auto" does,
        and learn a function whose set reaches beyond the ellipsoid.
    Q, R : diagonals of the weights, n and m positive numbers; ones by default.
    P : a Lyapunov matrix of one's own, (n, n), symmetric; overrides the candidate.
    level : prove exactly this level; by default the largest is looked for.
    engine : "bounds" (the default), "dreal" (its word is trusted, not checked), or "both".
    dreal_precision : dReal's delta, 1e-3 by default.
    jobs : processes of the checker, and threads of dReal; by default one of these, and where there are many leaves as
        many of those as there are cores.
    cluster : have boxes grown by the workers of a Dask cluster: "local:4" for four processes of this machine, or a
        scheduler's address, such as "tcp://host:8786"; by default by the threads of this process.
    cluster_checks : have the workers run the checker as well, each on a part of the leaves, and believe them.
    resume : go on with the search that an earlier run, which was given more than it had time for, left in `out`.
    enlarge : look for a tube of ellipsoids from a larger set into the proved one; not by default.
    box : half-widths by state: `enlarge` for the largest multiple of the ellipsoid with these half-axes.
    reach_from : a state by the states' values, those that are not named at the operating point: prove that it converges
        too, with what lies around it, by a tube around the trajectory from there into the proved set; the widest
        multiple of `box`, if that is given. PROVED only if the state lies in a proved set. Text means its decimal
        value, a float its binary value.
    time_limit : seconds for everything up to the verdict, 50 by default.
    max_boxes : boxes for the ring, 4,000,000 by default.
    ranges : pairs (lo, hi) by parameter: what is proved holds for every value in them, at any time, even if it varies.
        The parameter's value must lie in its range, or else the middle is the nominal one.
    disturbances : half-widths, or pairs (lo, hi), by disturbance of the plant (`System.disturbances`): the same for
        every function of time within them. A half-width of 0 is a disturbance that does not act.
    input_error : bound of what each input may be off by at any time, in its unit: one for all, or by input. In these
        three text means its decimal value, a float its binary value.
    sample_time : the period over which the input is held, or a pair (lo, hi): any sequence of periods between the two.
        Exact, as those three are. By default the input follows the state at once.
    rate : prove that V falls at least as exp(-2 rate t), in discrete time by the share 2 rate in each step; 0 (the
        default) says only that it falls.
    lyapunov : a function N of deviations from the operating point, or the path of its file: prove the largest {N <= n2}
        in the domain from which every trajectory enters {x'Px <= c2}; `result.outer` says what was found.
    lyapunov_level : prove exactly this n2; by default the largest is looked for.
    hidden, degree, seed : of what the candidates "neural" and "polynomial" learn: widths of the layers, (16, 16) by
        default, the even degree, 4, and the seed, 0.
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checkers ignore; by default the policy's name and versions.
    progress : called with a stage ("candidate", "ring", "check") and where the search stands, or None.

    Returns
    -------
    RoaResult : `result.verdict` is PROVED only if the checker accepted the file (`result.verdict == "PROVED"`). Then
        `result.contains(x)`, `.volume`, `.levels`, `.plot()`, `.report()`, `.certificate` (a path), `.to_dict()`.

    Raises
    ------
    InputError : an argument is of another type or value than it must be, or the closed loop cannot be used.
    BackendError : the checker process, or a solver that was asked for, is missing or failed.
    SoundnessError : two rigorous results contradict each other.

    Notes
    -----
    A policy reads deviations from the plant's operating point x_eq. Where a policy is valid on a part of the states
    only (`Policy.valid`), the domain is cut to it, and `result.notices` says so. A `TanhNetwork` says nothing of that.

    Examples
    --------
    >>> from certify import TanhNetwork, certify_roa, get_system
    >>> K = [[8.0, 2.0]]
    >>> law = TanhNetwork((-np.array(K),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    >>> system = get_system("pendulum")
    >>> result = certify_roa(system, law, candidate="lyapunov", level=1e-3)
    >>> result.verdict.value, result.contains([1e-3, 0.0]), result.contains([3.0, 0.0])
    ('PROVED', True, False)
    """
    start = time.perf_counter()
    single = {
        "claim": claim, "around": around, "candidate": candidate, "Q": Q, "R": R, "P": P, "level": level,
        "engine": engine, "dreal_precision": dreal_precision, "jobs": jobs, "enlarge": enlarge,
        "box": box,
        "cluster": cluster, "cluster_checks": cluster_checks, "resume": resume,
        "reach_from": reach_from, "time_limit": time_limit, "max_boxes": max_boxes, "rate": rate,
        "lyapunov_level": lyapunov_level, "hidden": hidden, "degree": degree, "seed": seed,
    }  # fmt: skip
    notices: list[str] = []
    try:
        unsure = _uncertainty(ranges, disturbances, input_error, sample_time)
        named = single | ({} if options is None else {"lyapunov": lyapunov})
        chosen = _options(options, {name: value for name, value in named.items() if value is not None})
        seconds = _number(load_seconds, "load_seconds")
        _require(provenance is None or isinstance(provenance, Mapping), "provenance", "a mapping", provenance)
        _require(progress is None or callable(progress), "progress", "callable", progress)
        stored = _policy(policy, system, _importing(importing), notices.append, unsure)
        plant, network = _closed(stored, system, notices.append, unsure)
        if lyapunov is not None:
            chosen = replace(chosen, lyapunov=_function(lyapunov, plant, notices.append))
        folder = _Folder() if out is None else None
        place = folder.path if folder is not None else Path(_path(out, "out"))
        result = run(
            plant,
            network,
            place,
            chosen,
            load_seconds=seconds + time.perf_counter() - start,
            provenance=_provenance(policy) if provenance is None else provenance,
            progress=progress,
        )
    except InputError as error:
        said = in_python(str(error))
        if said == str(error):
            raise
        raise InputError(said) from error
    return replace(result, notices=tuple(map(in_python, notices)), folder=folder)


def in_python(message: str) -> str:
    """A message that names options of the command line with the names that they have here.

    >>> in_python("Give --action-scale (u = scale * action); or another --Q.")
    'Give `action_scale` (u = scale * action); or another `Q`. Say `action_scale` in `importing`, a mapping.'
    """
    theirs = {f.name for f in fields(ImportOptions)}
    found: list[str] = []

    def name(match: re.Match[str]) -> str:
        option = match[0]
        known = _WORDS.get(option, option.removeprefix("--").replace("-", "_"))
        if known in theirs and known not in found:
            found.append(known)
        return f"`{known}`"

    said = re.sub(r"--[A-Za-z][A-Za-z-]*[A-Za-z]|--[A-Za-z]", name, message)
    named = ", ".join(f"`{n}`" for n in found)
    return f"{said} Say {named} in `importing`, a mapping." if found else said


class _Folder:
    """A temporary folder that goes with the last result that keeps it."""

    __slots__ = ("__weakref__", "path")

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="certify-"))
        weakref.finalize(self, _remove, self.path, os.getpid())


def _remove(path: Path, owner: int) -> None:
    """Remove a folder, unless this is a fork of the process that made it and still uses it."""
    if os.getpid() == owner:
        shutil.rmtree(path, ignore_errors=True)


def _options(options: RoaOptions | None, single: dict[str, Any]) -> RoaOptions:
    """The options, given at once or one by one."""
    if options is not None:
        if not isinstance(options, RoaOptions):
            raise InputError(f"`options` must be a RoaOptions; found {_kind(options)}. Options go by name as well.")
        if single:
            raise InputError(
                f"options must be given at once or one by one, not both; found `options` and {', '.join(single)}. "
                "Put them into `options`."
            )
        return options
    numbers = ("level", "dreal_precision", "time_limit", "rate", "lyapunov_level")
    whole = ("jobs", "max_boxes", "degree", "seed")
    readers: dict[str, Callable[[Any, str], Any]] = dict.fromkeys(single, _text)
    readers |= {"Q": _row, "R": _row, "P": _matrix, "enlarge": _flag, "box": _widths, "reach_from": _state}
    readers |= {"hidden": _counts} | dict.fromkeys(("cluster_checks", "resume"), _flag)
    readers |= dict.fromkeys(numbers, _number) | dict.fromkeys(whole, _count)
    read = {name: readers[name](value, name) for name, value in single.items()}
    return RoaOptions(**read)


def _function(given: Any, plant: System, tell: Callable[[str], None]) -> Neural | Polynomial | Symbolic:
    """A function of the states, given as such or by its file."""
    if isinstance(given, Neural | Polynomial | Symbolic):
        return given
    return function_in(Path(_path(given, "lyapunov")), plant, tell).function


def _uncertainty(ranges: Any, disturbances: Any, input_error: Any, sample_time: Any) -> Change:
    """What puts ranges, disturbances, errors of inputs and periods into a plant, from what was given, all of it read at
    once."""
    uncertain = {name: _pair(value, f"ranges[{name!r}]") for name, value in _named(ranges, "ranges", "pairs").items()}
    acting = {
        name: _exact(value, where) if isinstance(value, _NUMBERS) else _pair(value, where)
        for name, value in _named(disturbances, "disturbances", "half-widths or pairs").items()
        for where in (f"disturbances[{name!r}]",)
    }
    error: Fraction | Mapping[str, Fraction] | None = None
    if isinstance(input_error, Mapping):
        named = _named(input_error, "input_error", "bounds")
        error = {name: _exact(value, f"input_error[{name!r}]") for name, value in named.items()}
    elif input_error is not None:
        error = _exact(input_error, "input_error")

    period: Fraction | tuple[Fraction, Fraction] | None = None
    if sample_time is not None:
        single = isinstance(sample_time, _NUMBERS)
        period = _exact(sample_time, "sample_time") if single else _pair(sample_time, "sample_time")

    def change(plant: System) -> System:
        plant = with_acting(with_uncertain_parameters(plant, uncertain), acting)
        plant = plant if error is None else with_bounded_errors(plant, error)
        return plant if period is None else with_period(plant, period)

    return change


def _named(given: Any, name: str, what: str) -> dict[str, Any]:
    _require(given is None or isinstance(given, Mapping), name, f"a mapping from names to {what}", given)
    return {_text(key, name): value for key, value in (given or {}).items()}


def _pair(value: Any, where: str) -> tuple[Fraction, Fraction]:
    ends = _list(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi); found {value!r:.80}.")
    return _exact(ends[0], where), _exact(ends[1], where)


def _exact(value: Any, where: str) -> Fraction:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, Fraction | float | int | str):
        raise InputError(f"`{where}` must be a number, or text such as '0.15'; found {value!r:.60}, {_kind(value)}.")
    return exact(value, where)


def _policy(
    given: Any, system: Any, asked: ImportOptions, tell: Callable[[str], None], unsure: Change
) -> Policy | TanhNetwork:
    """The policy, whatever it was given as."""
    if isinstance(given, Policy | TanhNetwork):
        others = set(asked.given) - ({"--centre"} if isinstance(given, Policy) else set())
        if others:
            raise InputError(f"{', '.join(sorted(others))} must be left out: a {type(given).__name__} says all itself.")
        if isinstance(given, TanhNetwork) or asked.centre is None:
            return given
        return centred(given, asked.centre, _closed(given, system, lambda _: None, unsure)[0], tell)
    if isinstance(given, str | os.PathLike):
        return policy_in(
            Path(_path(given, "policy")),
            asked,
            lambda: unsure(_plant(system, "a policy of another program")),
            lambda stored: _closed(stored, system, lambda _: None, unsure)[0],
            tell,
        )
    torch = sys.modules.get("torch")  # whoever has a module of torch has loaded it
    if torch is not None and isinstance(given, torch.nn.Module):
        imported = import_module(given, unsure(_plant(system, "a module")), asked)
    elif isinstance(given, Mapping):
        imported = import_state_dict(given, unsure(_plant(system, "a state_dict")), asked)
    else:
        raise InputError(
            "`policy` must be the path of a policy file, a Policy, a TanhNetwork, a torch.nn.Module or a state_dict; "
            f"found {_kind(given)}."
        )
    for line in lines(imported):
        tell(line)
    return imported.policy


def _closed(
    policy: Policy | TanhNetwork, system: Any, tell: Callable[[str], None], unsure: Change
) -> tuple[System, TanhNetwork]:
    """Plant and network; of a policy with what it says about itself taken at its word, or told."""
    if isinstance(policy, TanhNetwork):
        return unsure(_plant(system, "a TanhNetwork")), policy
    if isinstance(system, System):
        plant, own = system, False
    else:
        plant, own = named_plant(policy, None if system is None else _name(system))
    if not own:
        tell_of_other(policy, plant, tell)
    plant = unsure(where_valid(policy, plant, tell))
    if shift := policy.beta_shift(plant.exact_u_eq()):
        tell(f"the file's rounded beta is read as the real number; this shifts u(0) by {shift:.3g}")
    return plant, policy.network


def _plant(system: Any, whose: str) -> System:
    """The plant that somebody named, for a policy that names none itself."""
    if system is None:
        raise InputError(f"`system` must name the plant: {whose} does not say what it controls; found None.")
    return system if isinstance(system, System) else chosen_system(_name(system))


def _name(system: Any) -> str:
    if not isinstance(system, str | os.PathLike):
        raise InputError(
            "`system` must be the name of a plant, the path of a TOML file, a System, or None for the policy's own; "
            f"found {_kind(system)}."
        )
    name = _path(system, "system")
    if isinstance(system, os.PathLike) and not name.endswith(".toml"):
        raise InputError(f"a path for `system` must end with .toml; found {name}. A name, or FILE.py:NAME, is text.")
    if name.endswith(_POLICY_FILES):
        raise InputError(
            f"`system` must be a plant; {name} looks like a policy file. The plant comes before the policy."
        )
    return name


def _importing(given: ImportOptions | Mapping[str, Any] | None) -> ImportOptions:
    """What is known of a policy of another program, with numbers where the fields take tuples of rationals."""
    if given is None or isinstance(given, ImportOptions):
        return given if given is not None else ImportOptions()
    if not isinstance(given, Mapping):
        raise InputError(f"`importing` must be an ImportOptions or a mapping with its names; found {_kind(given)}.")
    known = [f.name for f in fields(ImportOptions)]
    for name in given:
        if name not in known:
            close = nearest(str(name), known) or f"; known are {', '.join(known)}."
            raise InputError(f"`importing` has no {name!r}{close}")
    read: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for name, value in read.items():
        where = f"importing[{name!r}]"
        if name == "states":
            read[name] = tuple(
                _text(v, where) for v in (value.split(",") if isinstance(value, str) else _list(value, where))
            )
        elif name == "ignore":
            read[name] = tuple(_text(v, where) for v in ([value] if isinstance(value, str) else _list(value, where)))
        elif name in ("action_scale", "action_offset"):
            read[name] = _rationals(value, where)
        elif name == "epsilon":
            read[name] = exact(value, where)
        elif name == "normaliser":
            read[name] = "none" if value == "none" else Path(_path(value, where))
        elif name == "clip":
            read[name] = value if isinstance(value, Clip) else _clip(value, where)
        else:
            _text(value, where)
    return ImportOptions(**read)


def _clip(value: Any, where: str) -> Clip:
    ends = _list(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi) of numbers or of rows of numbers; found {value!r:.80}.")
    lo, hi = (_rationals(end, where) for end in ends)
    return Clip(lo, hi)


def _rationals(value: Any, where: str) -> tuple[Fraction, ...]:
    if isinstance(value, int | float | str | Fraction):
        return (exact(value, where),)
    return tuple(exact(v.item() if isinstance(v, np.generic) else v, where) for v in _list(value, where))


def _list(value: Any, where: str) -> list[Any]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__iter__"):
        raise InputError(f"`{where}` must be a sequence; found {_kind(value)}.")
    return list(value)


def _row(value: Any, name: str) -> tuple[float, ...]:
    return tuple(_number(v, name) for v in _list(value, name))


def _flag(value: Any, name: str) -> bool:
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, bool):
        raise InputError(f"`{name}` must be True or False; found {value!r:.60}, {_kind(value)}.")
    return value


def _widths(value: Any, name: str) -> dict[str, float]:
    _require(isinstance(value, Mapping), name, "a mapping from states to half-widths", value)
    return {_text(state, name): _number(width, name) for state, width in value.items()}


def _state(value: Any, name: str) -> dict[str, Fraction]:
    return {state: _exact(number, f"{name}[{state!r}]") for state, number in _named(value, name, "values").items()}


def _matrix(value: Any, name: str) -> Any:
    try:
        matrix = np.array(value, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found {_kind(value)}: {error}.") from error
    if matrix.ndim != 2:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found shape {matrix.shape}.")
    return matrix


def _number(value: Any, name: str) -> float:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"`{name}` must be a number; found {value!r:.60}, {_kind(value)}.")
    return float(value)


def _count(value: Any, name: str) -> int:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"`{name}` must be a whole number; found {value!r:.60}, {_kind(value)}.")
    return value


def _counts(value: Any, name: str) -> tuple[int, ...]:
    return tuple(_count(v, name) for v in _list(value, name))


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"`{name}` must be text; found {value!r:.60}, {_kind(value)}.")
    return value.strip()


def _path(value: Any, name: str) -> str:
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"`{name}` must be a path: text or a Path; found {_kind(value)}.")
    path = os.fspath(value)
    if not isinstance(path, str) or not path:
        raise InputError(f"`{name}` must be a path in text that is not empty; found {path!r}.")
    return path


def _require(holds: bool, name: str, what: str, value: object) -> None:
    if not holds:
        raise InputError(f"`{name}` must be {what}; found {_kind(value)}.")


def _kind(value: object) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def _provenance(policy: Any) -> dict[str, Any]:
    name = Path(policy).name if isinstance(policy, str | os.PathLike) else f"in memory, {_kind(policy)}"
    return {"policy": name, **versions()}
