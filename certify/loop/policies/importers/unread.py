"""Tensors of a file outside its network's layers: each is named, and must be known not to belong to the network.

A file of numbers does not contain their use. An unread tensor is left out without a question only if its name shows
that no action depends on it:

- the state of an optimiser, of a schedule of learning rates or of the run (steps, random numbers, last observations);
- the spread of the actions that training draws, and weights of losses: `log_std`, `log_alpha`, `log_sigma_...`, or
  `std` with a number for each output and no mean beside it;
- another network: it lies in a part called critic, value, Q, Lyapunov, target or old.

Every other one could belong to the network, as the K of `u = -K x + net(x)` does, and a file with such a tensor is
refused unless `--ignore` names it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from fnmatch import fnmatchcase

from certify.errors import InputError
from certify.loop.files.arrays import Numbers

_STATE = re.compile(
    r"(.*\.)?(param_groups\.[0-9]+\..*|state\.[0-9]+\."
    r"(step|exp_avg|exp_avg_sq|max_exp_avg_sq|exp_inf|momentum_buffer|square_avg|grad_avg|acc_delta|sum))"
)
_SPREAD = re.compile(r"(.*_)?log_?(std|sigma|alpha|ent_coef|temperature)s?(_.*)?|sigma_param", re.IGNORECASE)
_COUNTS = {"step", "steps", "global_step", "total_steps", "num_timesteps", "iteration", "epoch", "count"}
_SEEN = {"obs", "last_obs", "_last_obs"}
_RUN_PARTS = {"random_state", "env_random_state", "rng_state", "rng_states", "cuda_rng_state", "torch_rng_state"}
_OPTIMISER = {"optimizer", "optimizers", "optimiser", "optimisers", "optim", "scheduler", "schedulers"}
_OTHER = {"critic", "critics", "value", "values", "vf", "vnet", "qf", "qnet", "lyapunov", "privileged"}
_OF = {"net", "network", "nets", "function", "fn", "head", "mlp", "v", "q"}
_NETWORKS = _OTHER | _OF | {"actor", "policy", "pi", "controller", "model"}
_POLICY = {"actor", "policy", "pi", "controller"}
_OPTIMISER_WORDS = "the state of an optimiser or of a schedule"
_SPREAD_WORDS = "the spread of actions in training, or a weight of a loss"
_RUN_WORDS = "the state of the run"
_OTHER_WORDS = "another network: a critic, a value, a Lyapunov, a target or an old network"


def unread(
    tensors: Mapping[str, Numbers],
    read: Collection[str],
    prefix: str,
    outputs: int,
    ignored: tuple[str, ...] | None,
    known: Mapping[str, str],
    *,
    of_policy: bool = True,
    observed: int = 0,
) -> dict[str, str]:
    """The reason why each unread tensor is left out, by its name.

    Parameters
    ----------
    tensors : all tensors of the file.
    read : the names of those that the network is made of.
    prefix : the keys of its layers up to their numbers.
    outputs : number of its outputs.
    ignored : names to leave out, `*` and `?` in them as in names of files.
    known : reasons why others are left out, from a reader that knows the format.
    of_policy : True if the network is a policy, False for a Lyapunov network.
    observed : how many numbers it observes, if they may be normalised; else 0.

    Raises
    ------
    InputError : a tensor could belong to the network, or a name of `ignored` is none of a tensor that is not read.
    """
    found: dict[str, str] = {}
    could = []
    left = sorted(set(tensors) - set(read))
    for name in left:
        if named_by(ignored, name):
            found[name] = "--ignore names it"
            continue
        why = known.get(name) or known_by_name(name, tensors, prefix, outputs, of_policy=of_policy)
        if why is None:
            could.append(name)
        else:
            found[name] = why
    if of_policy:
        for pattern in ignored or ():
            if not any(fnmatchcase(name, pattern) for name in left):
                taken = "; it names what is read" if any(fnmatchcase(name, pattern) for name in read) else ""
                raise InputError(
                    f"--ignore must name tensors of the file that are not read{taken}; found {pattern!r}. "
                    f"Not read are {braced(left) or 'none'}."
                )
    if could:
        whole = "policy" if of_policy else "Lyapunov function"
        listed = ", ".join(f"{name} {tensors[name].shape}" for name in could[:8])
        more = f" and {len(could) - 8} more" if len(could) > 8 else ""
        normaliser = _normaliser(could, tensors, observed)
        rest = [name for name in could if name not in normaliser]
        options = " ".join(f"--ignore {_quoted(name)}" for name in _patterns(rest, set(tensors) - set(rest)))
        advice = f"If the layers are all of it, say so: {options}. " if rest else ""
        if normaliser:
            advice = (
                f"{' and '.join(normaliser)} have a number for each observation: if they normalise it, write them "
                f"again as obs._mean and obs._std, and add --epsilon 0 for (o - mean) / std. {advice}"
            )
        layers = prefix if " " in prefix else f"layers {_dot(prefix)}NUMBER"  # those listed have no common prefix
        raise InputError(
            f"the {layers} must be all of the {whole}, and the file holds what could belong to it: "
            f"{listed}{more}. {advice}If they are not, export the {whole} as TorchScript or ONNX, which say what "
            "becomes of each number."
        )
    return found


def named_by(ignored: tuple[str, ...] | None, name: str) -> bool:
    """True if a pattern of `--ignore` names a tensor."""
    return any(fnmatchcase(name, pattern) for pattern in ignored or ())


def known_by_name(
    name: str, tensors: Mapping[str, Numbers], prefix: str, outputs: int, *, of_policy: bool = True
) -> str | None:
    """The reason why no output depends on a tensor of this name; None if the name shows none."""
    *parts, leaf = name.split(".")
    if any(_SPREAD.fullmatch(part) for part in (leaf, *parts)):
        return _SPREAD_WORDS
    if leaf == "std" and tensors[name].size in (1, outputs) and not _has_mean(tensors, parts):
        return _SPREAD_WORDS
    if _STATE.fullmatch(name):
        return _OPTIMISER_WORDS
    counts = leaf in _COUNTS and tensors[name].size == 1
    if counts or leaf in _SEEN or any(part in _RUN_PARTS for part in (leaf, *parts)):
        return _RUN_WORDS
    own = prefix.split(".") if prefix else []
    for k, part in enumerate(parts):
        if parts[: k + 1] == own[: k + 1]:
            continue  # a part that holds the network itself
        words = {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", part)}
        if words & _OPTIMISER:
            return _OPTIMISER_WORDS
        if _names_another(part.lower(), words, leaf):
            return _OTHER_WORDS
        if not of_policy and words & _POLICY:
            return "the policy beside it"
    return None


def _names_another(part: str, words: set[str], leaf: str) -> bool:
    """True if a part of a name says that it is a critic, a value, a Lyapunov, a target or an old network."""
    if words & _OTHER:
        return True
    if words & {"target", "targ", "old"}:  # which a state to be reached is called too
        return bool(words & _NETWORKS) or leaf in ("weight", "bias")
    return part not in ("q", "v") and bool(words & {"q", "v"}) and words <= _OF  # positions and velocities are q and v


def _normaliser(names: Collection[str], tensors: Mapping[str, Numbers], observed: int) -> tuple[str, ...]:
    """A mean and a standard deviation among these names that have a number for each observation."""
    for name in names:
        for std in (name.removesuffix("mean") + end for end in ("std", "stddev")):
            if name.endswith("mean") and std in names and tensors[name].size == tensors[std].size == observed:
                return name, std
    return ()


def _has_mean(tensors: Mapping[str, Numbers], parts: list[str]) -> bool:
    beside = ".".join([*parts, ""])
    return any(f"{beside}{mean}" in tensors for mean in ("mean", "running_mean", "mu", "loc"))


def _patterns(names: Collection[str], others: Collection[str]) -> list[str]:
    """Patterns of names, as few as parts of names give, that match all of these and none of the others.

    >>> _patterns(["lo", "obs.0.bias", "obs.0.weight", "pi.K"], ["pi.0.weight"])
    ['lo', 'obs.*', 'pi.K']
    """
    found = {}
    for name in names:
        starts = [name[: match.end()] for match in re.finditer(r"\.", name)]
        own = next((start for start in starts if not any(other.startswith(start) for other in others)), name)
        found[name if sum(other.startswith(own) for other in names) == 1 else f"{own}*"] = True
    return list(found)


def braced(names: Collection[str]) -> str:
    """Names in a few words, what several of them share written once.

    >>> braced(["a.0.weight", "a.0.bias", "a.2.bias", "a.2.weight", "K"])
    'K, a.{0,2}.{bias,weight}'
    """
    return ", ".join(_branches([name.split(".") for name in sorted(names)]))


def _branches(paths: list[list[str]]) -> list[str]:
    """The same for names in parts."""
    below: dict[str, list[list[str]]] = {}
    ends = []
    for first, *rest in paths:
        if rest:
            below.setdefault(first, []).append(rest)
        else:
            ends.append(first)
    alike: dict[tuple[str, ...], list[str]] = {}
    for first, rest_of in below.items():
        alike.setdefault(tuple(_branches(rest_of)), []).append(first)
    said = [_one(ends)] if ends else []
    return [*said, *(f"{_one(firsts)}.{_one(list(rest))}" for rest, firsts in alike.items())]


def _one(words: list[str]) -> str:
    return words[0] if len(words) == 1 else "{" + ",".join(words) + "}"


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[\w.\-/]+", name) else f"'{name}'"


def _dot(prefix: str) -> str:
    return f"{prefix}." if prefix else ""
