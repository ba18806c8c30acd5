"""`certify.certify_roa`: the pipeline for Python, which takes names and files instead of objects.

The command and this function obey the same rules (`certify.analysis.inputs`): the plant that a policy belongs to, the
facts that a file does not give and that are asked for, the cut of a domain. A result keeps as `notices` the lines that
the command prints on standard error. Nothing here decides anything: the pipeline is `certify.analysis.run`.
"""

from __future__ import annotations

import inspect
import os
import re
import shutil
import sys
import tempfile
import textwrap
import time
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from numpy.typing import ArrayLike

from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import Option, declared
from certify.analysis.inputs import centred, function_in, lines, plant_for, plant_of, policy_in
from certify.analysis.installation import versions
from certify.analysis.options import Around, Asked, EngineName, RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import Report
from certify.analysis.run import certify_roa as run
from certify.analysis.values import changes_in, import_options_in, kind_of, number, options_in, path_in, require
from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork
from certify.loop.policies.importers import ImportOptions, import_module, import_state_dict
from certify.lyapunov import Candidate, Neural, Polynomial, Symbolic

if TYPE_CHECKING:
    import torch

Exact = Fraction | float | int | str
"""A number: text means its decimal value, a float its binary value."""
_POLICY_FILES = (".pt", ".pth", ".zip", ".onnx", ".safetensors")
_WORDS = {"--from": "kind", "--precision": "dreal_precision"}  # options that Python calls otherwise


class Keywords(TypedDict, total=False):
    """The types in which Python gives what `RoaOptions` and `PlantChanges` declare; None is as if it were not given."""

    claim: Asked | None
    around: Around | None
    level: float | None
    rate: float | None
    enlarge: bool | None
    box: Mapping[str, float] | None
    reach_from: Mapping[str, Exact | tuple[Exact, Exact]] | None
    ranks: bool | None
    lyapunov: str | os.PathLike[str] | Neural | Polynomial | Symbolic | None
    lyapunov_level: float | None
    candidate: Candidate | None
    Q: Sequence[float] | None
    R: Sequence[float] | None
    P: ArrayLike | None
    hidden: Sequence[int] | None
    degree: int | None
    seed: int | None
    effort: float | None
    time_limit: float | None
    max_boxes: int | None
    engine: EngineName | None
    dreal_precision: float | None
    jobs: int | None
    cluster: str | None
    resume: bool | None
    ranges: Mapping[str, Sequence[Exact]] | None
    disturbances: Mapping[str, Exact | Sequence[Exact]] | None
    input_error: Exact | Mapping[str, Exact] | None
    sample_time: Exact | Sequence[Exact] | None
    keep: str | Sequence[str] | None
    avoid: str | Sequence[str] | None
    data: str | os.PathLike[str] | None


def certify_roa(
    system: str | os.PathLike[str] | System | None,
    policy: str | os.PathLike[str] | Policy | PolicyNetwork | torch.nn.Module | Mapping[str, Any],
    out: str | os.PathLike[str] | None = None,
    options: RoaOptions | None = None,
    *,
    importing: ImportOptions | Mapping[str, Any] | None = None,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    **given: Unpack[Keywords],
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
    policy : the path of a policy file, of this program or another's; a `Policy` or `PolicyNetwork`; a torch module of
        Linear layers, activations and constant scalings; or a state_dict of such layers.
    out : folder for `certificate.json`, made if it is not there. None is a temporary folder that lives as long as the
        result does: copy the certificate, or keep the result. No report is drawn until `result.report()` asks for it.
    options : all options of the run in one `RoaOptions`, instead of the keywords below.
    importing : facts that a policy of another program does not give: an `ImportOptions`, or a mapping with its names,
        such as `{"states": ["theta", "theta_dot"], "normaliser": "none", "action_scale": 6}`. A missing one is asked
        for by name; nothing is guessed.
    <options>
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checkers ignore; by default the policy's name and versions.
    progress : called with a stage ("candidate", "ring", "check") and the search's `Progress`, or None.

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
    only (`Policy.valid`), the domain is cut to it, and `result.notices` says so. A `PolicyNetwork` has no such part.
    Where a number must be exact, of the plant and of `importing`, text means its decimal value, a float its binary one.

    Examples
    --------
    >>> import numpy as np
    >>> from certify import PolicyNetwork, certify_roa, get_system
    >>> K = [[8.0, 2.0]]
    >>> law = PolicyNetwork.of_layers((-np.array(K),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none")
    >>> system = get_system("pendulum")
    >>> result = certify_roa(system, law, candidate="lyapunov", level=1e-3)
    >>> result.verdict.value, result.contains([1e-3, 0.0]), result.contains([3.0, 0.0])
    ('PROVED', True, False)
    """
    start = time.perf_counter()
    notices: list[str] = []
    try:
        changes, chosen, function = _asked(options, given)
        seconds = number(load_seconds, "load_seconds")
        require(provenance is None or isinstance(provenance, Mapping), "provenance", "a mapping", provenance)
        require(progress is None or callable(progress), "progress", "callable", progress)
        named = _system(system)
        stored = _policy(policy, named, import_options_in(importing), notices.append, changes)
        if isinstance(stored, PolicyNetwork):
            plant, network = plant_for("a PolicyNetwork", named, changes), stored
        else:
            plant, network = plant_of(stored, named, changes, notices.append), stored.network
        if function is not None:
            chosen = replace(chosen, lyapunov=_function(function, plant, notices.append))
        folder = _Folder() if out is None else None
        result = run(
            plant,
            network,
            folder.path if folder is not None else Path(path_in(out, "out")),
            chosen,
            load_seconds=seconds + time.perf_counter() - start,
            provenance=_provenance(policy) if provenance is None else provenance,
            progress=progress,
            tell=notices.append,
        )
    except InputError as error:
        said = in_python(str(error))
        if said == str(error):
            raise
        raise InputError(said) from error
    return replace(result, notices=tuple(map(in_python, notices)), folder=folder)


def _keywords() -> dict[str, Option]:
    """The declared options, by keyword."""
    options = [*declared(RoaOptions).values(), *declared(PlantChanges).values()]
    return {option.keyword: option for option in options if option.keyword}


def _asked(options: RoaOptions | None, given: Keywords) -> tuple[PlantChanges, RoaOptions, Any]:
    """The plant's changes, the options, and the second function where it is a keyword of its own.

    Raises
    ------
    TypeError : there is no such keyword.
    InputError : a value cannot be used, or options are given in both ways.
    """
    for name in given:
        if name not in _keywords():
            raise TypeError(f"certify_roa() got an unexpected keyword argument {name!r}")
    values = {name: value for name, value in given.items() if value is not None}
    changes = changes_in(values)
    single = {name: value for name, value in values.items() if name in declared(RoaOptions)}
    if options is None:
        function = single.pop("lyapunov", None)
        return changes, options_in(single), function
    if not isinstance(options, RoaOptions):
        raise InputError(f"`options` must be a RoaOptions; found {kind_of(options)}. Options go by name as well.")
    if single:
        raise InputError(
            f"options must be given at once or one by one, not both; found `options` and {', '.join(single)}. "
            "Put them into `options`."
        )
    return changes, options, None


def _signature() -> inspect.Signature:
    """The function's parameters with all keywords."""
    own = inspect.signature(certify_roa)
    fixed = [p for p in own.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    types = {name: hint.__forward_arg__ for name, hint in Keywords.__annotations__.items()}
    more = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=option.default, annotation=types[name])
        for name, option in _keywords().items()
    ]
    return own.replace(parameters=[*fixed, *more])


def _described() -> Iterator[str]:
    """The docstring's lines about the keywords."""
    for name, option in _keywords().items():
        said = in_python(" ".join(filter(None, (option.help, option.python))))
        default = "" if option.default in (None, False) else f" Default: {option.default!r}."
        yield textwrap.fill(f"{name} : {said}{default}", 116, initial_indent="    ", subsequent_indent="        ")


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


def _function(given: Any, plant: System, tell: Callable[[str], None]) -> Neural | Polynomial | Symbolic:
    """A function of the states, given as such or by its file."""
    if isinstance(given, Neural | Polynomial | Symbolic):
        return given
    found = function_in(str(path_in(given, "lyapunov")), plant, tell)
    return found if isinstance(found, Symbolic) else found.function


def _policy(
    given: Any,
    system: System | str | None,
    asked: ImportOptions,
    tell: Callable[[str], None],
    changes: PlantChanges,
) -> Policy | PolicyNetwork:
    """The policy, whatever it was given as."""
    if isinstance(given, Policy | PolicyNetwork):
        others = set(asked.given) - ({"--centre"} if isinstance(given, Policy) else set())
        if others:
            raise InputError(f"{', '.join(sorted(others))} must be left out: a {type(given).__name__} says all itself.")
        if isinstance(given, PolicyNetwork) or asked.centre is None:
            return given
        return centred(given, asked.centre, plant_of(given, system, changes, lambda _: None), tell)
    if isinstance(given, str | os.PathLike):
        return policy_in(Path(path_in(given, "policy")), asked, system, changes, tell)
    torch = sys.modules.get("torch")  # whoever has a module of torch has loaded it
    if torch is not None and isinstance(given, torch.nn.Module):
        imported = import_module(given, plant_for("a module", system, changes), asked)
    elif isinstance(given, Mapping):
        imported = import_state_dict(given, plant_for("a state_dict", system, changes), asked)
    else:
        raise InputError(
            "`policy` must be the path of a policy file, a Policy, a PolicyNetwork, a torch.nn.Module or a state_dict; "
            f"found {kind_of(given)}. A gain K, u = -K x, is the state_dict {{'0.weight': -K}}."
        )
    for line in lines(imported):
        tell(line)
    return imported.policy


def _system(given: Any) -> System | str | None:
    """The plant, or its name."""
    if given is None or isinstance(given, System):
        return given
    if not isinstance(given, str | os.PathLike):
        raise InputError(
            "`system` must be the name of a plant, the path of a TOML file, a System, or None for the policy's own; "
            f"found {kind_of(given)}."
        )
    name = path_in(given, "system")
    if isinstance(given, os.PathLike) and not name.endswith(".toml"):
        raise InputError(f"a path for `system` must end with .toml; found {name}. A name, or FILE.py:NAME, is text.")
    if name.endswith(_POLICY_FILES):
        raise InputError(
            f"`system` must be a plant; {name} looks like a policy file. The plant comes before the policy."
        )
    return name


def _provenance(policy: Any) -> dict[str, Any]:
    name = Path(policy).name if isinstance(policy, str | os.PathLike) else f"in memory, {kind_of(policy)}"
    return {"policy": name, **versions()}


certify_roa.__signature__ = _signature()  # type: ignore[attr-defined]
certify_roa.__doc__ = (certify_roa.__doc__ or "").replace("    <options>", "\n".join(_described()))
