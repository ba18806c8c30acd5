"""Multilayer perceptrons in a state_dict: `PREFIX.N.weight` and `PREFIX.N.bias`, whatever the prefix.

A state_dict holds numbers and no functions. It contains neither the activation between the layers, nor the function
after the last one, nor the treatment of observations and actions: each is asked for by the name of its option.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from fractions import Fraction
from itertools import islice

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers
from certify.loop.files.pickles import Call
from certify.loop.policies.importers.modules import numbers_in, require_said
from certify.loop.policies.importers.normalisers import normaliser_root, rsl_normaliser
from certify.loop.policies.importers.operations import WITHOUT_WEIGHT_NORM
from certify.loop.policies.importers.options import WITHOUT_NORMALISATION, ImportOptions, Output
from certify.loop.policies.importers.reading import (
    LayerNorm,
    Observations,
    Reading,
    Values,
    between,
    perceptron,
    widths,
)
from certify.loop.policies.importers.steps import (
    PARAMETERS,
    Affine,
    Clip,
    Step,
    Tanh,
    in_words,
    linear,
    parted,
    plainly,
)
from certify.loop.policies.importers.unread import known_by_name, named_by, unread

_LEAF = r"(.*[._])?"
_PARAMETERS = {
    "leaky_relu": re.compile(_LEAF + r"(slope|alpha|leak|leakiness|leaky_?relu)", re.IGNORECASE),
    "elu": re.compile(_LEAF + r"alpha", re.IGNORECASE),
    "celu": re.compile(_LEAF + r"alpha", re.IGNORECASE),
    "softplus": re.compile(_LEAF + r"beta", re.IGNORECASE),
}
"""The names that a file may give to the number of an activation."""
_KEY = re.compile(r"(?:(?P<prefix>.*)\.)?(?P<number>[0-9]{1,4})\.(?P<rest>.*)", re.DOTALL)
MEAN = "mean"
"""The `--output` of a network whose last layer gives the mean of the actions and behind it their spread."""
_COMPUTED = re.compile(r"(^|\.)(weight_(g|v|orig)|parametrizations\.weight\.original[01]?)$")
_MOST_LISTED = 12
_PARTS = ("controller.x_equilibrium", "controller.layers.0.weight", "controller.b")
_OTHERS = ("critic", "value", "vf", "v_net", "q_net", "qf", "q1", "q2", "lyapunov", "target")
_ENDS: dict[Output, tuple[Step, ...]] = {
    "identity": (),
    "tanh": (Tanh(),),
    "relu-tanh": (Tanh(), Clip((Fraction(0),), (None,))),
}
_EPSILON = Fraction(1e-5)  # torch's number
_NORMALISATION = f"A normalisation layer has such a one. {WITHOUT_NORMALISATION}"
_AS_PROGRAM = "Export the policy as TorchScript or ONNX, of which BatchNorm in evaluation is read."
_LISTED = "layers listed by --prefix"
Layers = list[Affine]


def is_two_stage(tensors: Mapping[str, Numbers]) -> bool:
    """True if a file holds the policy of a two-stage checkpoint: its layers and the data of its centring."""
    return _root(tensors) is not None


def read_two_stage(tensors: Mapping[str, Numbers], options: ImportOptions) -> Reading:
    """`u = scale * squash(net(x) - net(x_eq) + b)`, centred inside the squash, as the two-stage method writes it.

    Raises
    ------
    InputError : a tensor is missing or has another shape.
    """
    root = _root(tensors)
    if root is None:
        raise InputError(f"a two-stage file must hold {', '.join(_PARTS)} under one prefix; this one does not.")
    prefix = f"{root}controller.layers"
    layers = _layers(tensors, prefix)
    squash: Output = "tanh" if options.squash is None else options.squash
    if squash == "identity":
        raise InputError("a two-stage policy is squashed: --squash must be tanh or relu-tanh; found identity.")
    x_eq = np.asarray(tensors[f"{root}controller.x_equilibrium"]).reshape(-1)
    b = np.asarray(tensors[f"{root}controller.b"]).reshape(-1)
    if x_eq.shape != layers[0].weight.shape[1:] or b.shape != layers[-1].bias.shape:
        raise InputError(
            "controller.x_equilibrium and controller.b must have a number for each state and input; "
            f"found {x_eq.shape} and {b.shape}."
        )

    read = {*_own(tensors, prefix), *(root + part for part in _PARTS)}
    known = {"domain": "the domain of the training"}
    known |= {f"{root}controller.u_equilibrium": "the input that controller.b is made of"}
    net, relu = perceptron(layers), squash == "relu-tanh"

    def evaluate(x: Observations, double: bool) -> Values:
        squashed: Values = np.tanh(net(x, double) - net(x_eq[None], double) + b)
        return np.maximum(squashed, 0) if relu else squashed

    return Reading(
        words=f"two-stage {widths(layers)}, centred inside the squash",
        steps=(*between(layers), *_ENDS[squash]),
        evaluate=evaluate,
        assumed=f"tanh between the layers is how the two-stage method writes it, {squash} is what --squash says",
        unread=unread(tensors, read, prefix, len(b), options.ignore, known),
        beta=b.astype(np.float64),
        equilibrium=x_eq.astype(np.float64),
    )


def read_state_dict(
    tensors: Mapping[str, Numbers],
    options: ImportOptions,
    n: int,
    m: int,
    beside: str | None = None,
    modules: Mapping[str, Call] | None = None,
) -> Reading:
    """The perceptron from n observations to m actions among the tensors of a file.

    Parameters
    ----------
    beside : keys of the layers of the Lyapunov network that is imported with it, if there is one.
    modules : those that were pickled whole, by their names.

    Raises
    ------
    InputError : there is none, there are several and `--prefix` does not say which, a layer is of a kind that is
        not proved, or another tensor could belong to the policy.
    """
    listed = dict[str, list[int]]()
    if options.prefix is not None and ("," in options.prefix or f"{options.prefix}.weight" in tensors):
        names = options.prefix.split(",")
        listed = {name: _affine(tensors, name) for name in names if name in _groups(tensors)}
        tensors, prefix = _numbered(tensors, names), _LISTED
    else:
        prefix = options.prefix if options.prefix is not None else _only(tensors, n, m, options)
    norms = {} if options.norm is None else _norms(tensors, prefix, options)
    layers = _to_actions(_layers(tensors, prefix, list(norms)), m, options)
    if (layers[0].weight.shape[1], layers[-1].weight.shape[0]) != (n, m):
        raise InputError(
            f"the policy must read {n} states and command {m} inputs; {prefix} is {widths(layers)}. "
            "Name the states that it reads with --states."
        )
    squash: Output = "identity" if options.squash is None else options.squash
    groups = listed if prefix == _LISTED else {prefix: _affine(tensors, prefix)}
    require_said(modules or {}, groups, options)
    read, known = set(_own(tensors, prefix)), dict[str, str]()
    if (at := normaliser_root(tensors)) is not None:
        read |= {f"{at}_mean", f"{at}_std"}
        known |= dict.fromkeys((f"{at}_var", f"{at}count"), "of the normaliser that is read")
    known |= _stated(tensors, read, prefix, m, options)
    if beside is not None:
        known |= dict.fromkeys(_own(tensors, beside), "the Lyapunov network that is imported beside it")
    activation, placed = options.activation or "tanh", dict(norms.values())
    return Reading(
        words=f"state_dict {prefix} {widths(layers)}{' with layer normalisation' if norms else ''}",
        steps=(*between(layers, activation, placed), *_ENDS[squash]),
        evaluate=perceptron(layers, squash, activation, placed),
        normaliser=rsl_normaliser(tensors, options.epsilon),
        double=_is_double(tensors, prefix),
        assumed=_assumed(options, m, modules or {}),
        unread=unread(tensors, read, prefix, m, options.ignore, known, observed=n),
    )


def _assumed(options: ImportOptions, m: int, modules: Mapping[str, Call]) -> str:
    """The source of the functions between the layers, and the numbers of modules that were pickled whole."""
    assumed = f"{in_words(options.activation or 'tanh')} between the layers is what --activation says"
    assumed += f", {options.squash or 'identity'} behind them what --squash says"
    if modules:
        numbers = ", ".join(numbers_in(modules)[:_MOST_LISTED])
        assumed += f", of a module whose forward is not in the file{numbers and f', nor the part in it of {numbers}'}"
    if options.output == MEAN:
        assumed += f", of whose {2 * m} numbers the first {m} are the mean, as --output says"
    elif options.output is not None:
        assumed += f", of whose numbers {options.output}, counted from 0, are the actions, as --output says"
    if options.norm is not None:
        epsilon = float(options.norm_epsilon or _EPSILON)
        assumed += f", layer normalisation {options.norm[6:]} the activation, with epsilon {epsilon}, what --norm says"
    return assumed


def parameters_of(activation: str) -> re.Pattern[str] | None:
    """The names that a file may give to the number of an activation; None if it has none."""
    return _PARAMETERS.get(activation.partition(":")[0])


def _stated(
    tensors: Mapping[str, Numbers], read: Collection[str], prefix: str, m: int, options: ImportOptions
) -> dict[str, str]:
    """The reason why the number of the activation is not read from the file, by the names that it may have there.

    Raises
    ------
    InputError : the file has such a number, and `--activation` says none.
    """
    name, said = parted(options.activation or "tanh")
    names = _PARAMETERS.get(name)
    left = [key for key, t in tensors.items() if names is not None and t.size == 1 and names.fullmatch(key)]
    left = [key for key in left if key not in read and not named_by(options.ignore, key)]
    found = {key: tensors[key].item() for key in left if known_by_name(key, tensors, prefix, m) is None}
    if found and not said:
        word, usual = PARAMETERS[name]
        key, value = next(iter(found.items()))
        raise InputError(
            f"the file says {', '.join(f'{k} = {plainly(v)}' for k, v in found.items())}, which may be the {word} of "
            f"{name}. Say which is right: --activation {name}:{plainly(value)}, or --activation "
            f"{name}:{plainly(usual)} if {key} is another number."
        )
    same = f"the {PARAMETERS[name][0]} that --activation says" if found else ""
    return {key: same if v == said[0] else f"it is {plainly(v)}, not {same}" for key, v in found.items()}


def read_lyapunov(tensors: Mapping[str, Numbers], prefix: str | None, options: ImportOptions) -> Reading:
    """The layers of a Lyapunov network, without a function after the last one.

    Parameters
    ----------
    prefix : its keys up to their numbers; None for where a two-stage file has them.
    options : where the policy beside it lies, and which tensors to leave out.

    Raises
    ------
    InputError : there are no such layers, one is of a kind that is not proved, or the network has more to it than its
        layers, or may have.
    """
    x_eq, known = None, dict[str, str]()
    if prefix is None:
        root = _root(tensors)
        if root is None:
            raise InputError(f"a two-stage file must hold {', '.join(_PARTS)} under one prefix; this one does not.")
        whole, prefix = f"{root}lyapunov.", f"{root}lyapunov.layers"
        x_eq = np.asarray(tensors[f"{root}{_PARTS[0]}"]).reshape(-1).astype(np.float64)
        known = {"domain": "the domain of the training"}
    else:
        whole = _dot(prefix)
        if options.prefix is not None:
            known = dict.fromkeys(_own(tensors, options.prefix), "the policy beside it")
    if prefix not in _groups(tensors):
        raise InputError(
            f"there must be one; no tensor is called {_dot(prefix)}0.weight. "
            f"The file has layers under {', '.join(g or 'no prefix' for g in _groups(tensors)) or 'no key'}."
        )
    inside = [(name, _KEY.fullmatch(name)) for name in tensors if name.startswith(whole)]
    more = sorted(name for name, match in inside if match is None or (match["prefix"] or "") != prefix)
    if more:
        raise InputError(
            f"it must be its layers {_dot(prefix)}NUMBER alone; the file has {', '.join(more[:3])} as well, and does "
            "not say what becomes of that."
        )
    layers = _layers(tensors, prefix)
    if x_eq is not None and x_eq.shape != layers[0].weight.shape[1:]:
        raise InputError(
            f"it must read a number for each of controller.x_equilibrium's {x_eq.size}; it is {widths(layers)}."
        )
    return Reading(
        words=f"{prefix or 'no prefix'} {widths(layers)}",
        steps=between(layers),
        evaluate=perceptron(layers),
        equilibrium=x_eq,
        double=_is_double(tensors, prefix),
        assumed=f"tanh between the layers is {'what --activation says' if x_eq is None else 'how the method has it'}",
        unread=unread(tensors, _own(tensors, prefix), prefix, 1, options.ignore, known, of_policy=False),
    )


def _places(m: int, options: ImportOptions) -> list[int]:
    """The places of the actions in what the last layer gives, from 0.

    Raises
    ------
    InputError : `--output` says others than one for each input.
    """
    if options.output in (None, MEAN):
        return list(range(m))
    said = (options.output or "").split(",")
    found = {int(place): None for place in said if re.fullmatch("[0-9]{1,4}", place, re.ASCII)}
    if not len(found) == len(said) == m:
        raise InputError(
            f"--output must be mean, or the place of each of {m} actions in what the last layer gives, counted from 0, "
            f"as in {','.join(str(2 * k) for k in range(m))}; found {options.output}."
        )
    return list(found)


def _gives(count: int, m: int, options: ImportOptions) -> bool:
    """True if a last layer of so many numbers may give m actions."""
    if options.output in (None, MEAN):
        return count == (m if options.output is None else 2 * m)
    return count > max(_places(m, options))


def _to_actions(layers: Layers, m: int, options: ImportOptions) -> Layers:
    """The layers up to the actions alone, where the last one gives more: their spread.

    Raises
    ------
    InputError : `--output` says so, and the last layer does not give these; or the contrary.
    """
    last = layers[-1]
    given = len(last.bias)
    if options.output is not None:
        if not _gives(given, m, options):
            wanted = f"the first half of what the last layer gives, {2 * m} numbers for {m} inputs"
            places = f"the numbers {options.output} of what the last layer gives, counted from 0"
            raise InputError(
                f"--output {options.output} takes {wanted if options.output == MEAN else places}; it gives {given}."
            )
        places_of = _places(m, options)
        return [*layers[:-1], Affine(last.weight[places_of], last.bias[places_of])]
    if given == 2 * m:
        raise InputError(
            f"the last layer must give {m} numbers, one for each input; it gives {given}. If these are the mean of the "
            "actions and then their spread, as Brax has them, say so with --output mean; if each action's spread is "
            f"behind it, as RLlib has those of a tuple, with --output {','.join(str(2 * k) for k in range(m))}; or say "
            "the places of the actions, counted from 0."
        )
    return layers


def _numbered(tensors: Mapping[str, Numbers], names: Sequence[str]) -> dict[str, Numbers]:
    """The tensors with the layers of these names, or of these prefixes of numbered layers, in their order, numbered
    under one prefix.

    Raises
    ------
    InputError : a name is none of layers, or a layer stands there twice.
    """
    groups, places, count = _groups(tensors), dict[str, int](), 0
    for name in names:
        inside = {f"{name}.{k}": k for k in _numbers(tensors, name)} if name in groups else {name: 0}
        start, count = max(places.values(), default=-1) + 1, count + len(inside)
        places |= {layer: start + k for layer, k in inside.items()}
    if len(places) < count or any(f"{layer}.weight" not in tensors for layer in places):
        raise InputError(
            "--prefix with commas must name each layer once, or the keys of some up to their numbers, in their order; "
            f"found {','.join(names)}. Layers are {', '.join(_weights(tensors).values()) or 'none'}."
            f"{_without_norm(tensors)}"
        )
    parts = {f"{name}.{part}": f"{_LISTED}.{k}.{part}" for name, k in places.items() for part in ("weight", "bias")}
    return {parts.get(name, name): tensor for name, tensor in tensors.items()}


def _weights(tensors: Mapping[str, Numbers]) -> dict[str, str]:
    """The layers with their sizes, by their names, in the file's order."""
    found = {name.removesuffix(".weight"): w for name, w in tensors.items() if name.endswith(".weight")}
    return {name: f"{name} ({w.shape[1]} to {w.shape[0]})" for name, w in found.items() if w.ndim == 2}


def _groups(tensors: Mapping[str, Numbers]) -> list[str]:
    """Prefixes under which numbered layers lie, in the file's order."""
    found = {}
    for name in tensors:
        match = _KEY.fullmatch(name)
        if match is not None and match["rest"] == "weight":
            found[match["prefix"] or ""] = True
    return list(found)


def _only(tensors: Mapping[str, Numbers], n: int, m: int, options: ImportOptions) -> str:
    """The one prefix whose layers lead from n to m and that no name calls a critic.

    It is also one that gives other numbers than `--output` takes, or without it two for each action, about which there
    is more to say.
    """
    ends = _ends(tensors)
    own = [prefix for prefix, (reads, _) in ends.items() if reads == n and not _of_another(prefix)]
    fitting = [prefix for prefix in own if _gives(ends[prefix][1], m, options)]
    said = options.output is not None or (len(own) == 1 and ends[own[0]][1] == 2 * m)
    if len(fitting) == 1 or (not fitting and len(own) == 1 and said):
        return (fitting or own)[0]
    listed = "; ".join(f"{prefix or 'no prefix'}: {reads} to {gives}" for prefix, (reads, gives) in ends.items())
    if not ends:
        layers = _weights(tensors)
        named, order = ", ".join(layers.values()), ",".join(name for name in layers if not _of_another(name))
        listed = f"layers without a number, {named}: name them in their order, as in --prefix {order or 'fc1,fc2'}"
        needed = (
            "PREFIX.NUMBER.weight (out, in) and PREFIX.NUMBER.bias, or of numpy kernel (in, out) instead of weight; "
            'write others so, numpy.savez("policy.npz", **{"0.weight": W, "0.bias": b}) with every layer, or W.T if W '
            "is (in, out); a gain K, u = -K x, is one layer, 0.weight = -K"
        )
        shapes = ", ".join(f"{name} {tensor.shape}" for name, tensor in islice(tensors.items(), _MOST_LISTED))
        listed = listed if named else f"none in {shapes or 'no tensors'} (layers must be called {needed})"
    elif policy := _named(tensors, n, m, options):
        listed += f"; if the policy is {policy.replace(',', ' and behind it ')}, say so: --prefix {policy}"
    raise InputError(
        f"a file must hold one policy from {n} states to {m} inputs; it holds {len(fitting)}. "
        f"Name its keys up to their numbers with --prefix, and its states with --states. Found {listed}. "
        "If the policy is more than layers one behind the other, export it as TorchScript or ONNX."
        f"{_without_norm(tensors)}"
    )


def _ends(tensors: Mapping[str, Numbers]) -> dict[str, tuple[int, int]]:
    """The numbers that the first of some numbered layers reads and the last one gives, by their prefixes."""
    found = {}
    for prefix in _groups(tensors):
        numbers = _numbers(tensors, prefix)
        first, last = (tensors[f"{_dot(prefix)}{numbers[k]}.weight"].shape for k in (0, -1))
        found[prefix] = first[-1] if first else 0, last[0] if last else 0
    return found


def _named(tensors: Mapping[str, Numbers], n: int, m: int, options: ImportOptions) -> str | None:
    """The layer without a number that leads from n numbers to m actions; or two, with a comma between them, of which
    one leads to the numbers that the other takes to them, prefixes of numbered layers or layers without a number. None
    if there are none, or several."""
    ends = _ends(tensors)
    numbered = {f"{_dot(prefix)}{k}" for prefix in ends for k in _numbers(tensors, prefix)}
    weights = {name.removesuffix(".weight"): w for name, w in tensors.items() if name.endswith(".weight")}
    plain = {name: (w.shape[1], w.shape[0]) for name, w in weights.items() if w.ndim == 2 and name not in numbered}
    plain = {name: pair for name, pair in plain.items() if known_by_name(f"{name}.weight", tensors, "", m) is None}
    known = {name: pair for name, pair in {**ends, **plain}.items() if name and not _of_another(name)}
    found = [name for name in plain if name in known and plain[name][0] == n and _gives(plain[name][1], m, options)]
    found += [
        f"{first},{last}"
        for first, (reads, between) in known.items()
        for last, (then, gives) in known.items()
        if first != last and reads == n and then == between and _gives(gives, m, options)
        if known_by_name(f"{last}.weight", tensors, first, m) is None
    ]
    return found[0] if len(found) == 1 else None


def _of_another(name: str) -> bool:
    """True if a part of a name says that it is a critic's, or a policy's of before, as tianshou has it."""
    return any(part.startswith(_OTHERS) or part.endswith("_old") for part in name.split("."))


def _without_norm(tensors: Mapping[str, Numbers]) -> str:
    """The next step for a file in which weights are computed from other tensors; empty if none is."""
    found = next(filter(_COMPUTED.search, tensors), None)
    return "" if found is None else f" The weight that {found} belongs to is computed. {WITHOUT_WEIGHT_NORM}"


def _norms(tensors: Mapping[str, Numbers], prefix: str, options: ImportOptions) -> dict[int, tuple[int, LayerNorm]]:
    """The normalisations between the layers by their own numbers: the place of the layer behind, and what they are.

    Raises
    ------
    InputError : there is none, one does not stand between two layers of its width, or their numbers show another place
        of it than `--norm`.
    """
    root, numbers, found = _dot(prefix), _numbers(tensors, prefix), dict[int, tuple[int, LayerNorm]]()
    flat = [k for k in numbers if tensors[f"{root}{k}.weight"].ndim == 1]
    affine = [k for k in numbers if k not in flat]
    for k in flat:
        weight, bias = tensors[f"{root}{k}.weight"], tensors.get(f"{root}{k}.bias")
        before, behind = [j for j in affine if j < k], [j for j in affine if j > k]
        place = len(before)
        if not before or not behind or place in (known for known, _ in found.values()):
            raise InputError(f"--norm needs one normalisation between two layers; {root}{k} stands elsewhere.")
        width = tensors[f"{root}{before[-1]}.weight"].shape[:1]
        if bias is None or not weight.shape == bias.shape == width or weight.dtype.kind != "f":
            raise InputError(
                f"a layer normalisation must have a weight and a bias of shape {width}, like the layer before it; "
                f"{root}{k} has {weight.shape} and {'no bias' if bias is None else bias.shape}."
            )
        shown = (k == before[-1] + 1) - (k + 1 == behind[0])  # 0 where the activation has no number of its own
        if shown == (-1 if options.norm == "layer-before" else 1):
            raise InputError(
                f"--norm {options.norm} does not fit the numbers {before[-1]}, {k} and {behind[0]} of the layers "
                f"around {root}{k}, where the activation stands {'behind' if shown > 0 else 'before'} it."
            )
        made = LayerNorm(
            weight.astype(np.float64),
            bias.astype(np.float64),
            options.norm_epsilon or _EPSILON,
            options.norm == "layer-before",
        )
        found[k] = place, made
    if not found:
        raise InputError(f"--norm must be left out: no layer of {prefix or 'the file'} has a weight of one dimension.")
    return found


def _layers(tensors: Mapping[str, Numbers], prefix: str, besides: Sequence[int] = ()) -> Layers:
    """The affine layers in their order, but not the numbers `besides`."""
    root, layers = _dot(prefix), []
    for k in _numbers(tensors, prefix):
        if k in besides:
            continue
        weight, bias = tensors[f"{root}{k}.weight"], tensors.get(f"{root}{k}.bias")
        if weight.ndim != 2 or weight.dtype.kind != "f":
            raise InputError(
                f"layer {root}{k} must be affine, with a weight (out, in) of floating-point numbers; its weight has "
                f"shape {weight.shape}. {_NORMALISATION if weight.ndim == 1 else ''}".rstrip()
            )
        layers.append(linear(weight, bias))
    return layers


def _numbers(tensors: Mapping[str, Numbers], prefix: str) -> list[int]:
    """The numbers of the layers under a prefix; other tensors under such a number are rejected."""
    root, numbers = _dot(prefix), set()
    for name in tensors:
        match = _KEY.fullmatch(name)
        if match is None or (match["prefix"] or "") != prefix:
            continue
        if match["rest"] not in ("weight", "bias"):
            known = (("parametrizations", WITHOUT_WEIGHT_NORM), ("weight_", WITHOUT_WEIGHT_NORM), ("", _AS_PROGRAM))
            advice = next(words for start, words in known if match["rest"].startswith(start))
            raise InputError(
                f"the layers of a policy must be affine, with weight and bias; {name} belongs to one of another kind. "
                f"{advice}"
            )
        numbers.add(number := int(match["number"]))
        if name != f"{root}{number}.{match['rest']}":
            raise InputError(
                f"layers must be called {root}0.weight, {root}0.bias and so on; found {name}, which is neither."
            )
    if not numbers or any(f"{root}{k}.weight" not in tensors for k in numbers):
        found = ", ".join(f"--prefix {name}" if name else "layers without a prefix" for name in _groups(tensors))
        raise InputError(f"there must be layers {root}0.weight and so on; found {found or ', '.join(tensors)}.")
    return sorted(numbers)


def _affine(tensors: Mapping[str, Numbers], prefix: str) -> list[int]:
    """The numbers of the layers under a prefix, less those of normalisations."""
    return [k for k in _numbers(tensors, prefix) if tensors[f"{_dot(prefix)}{k}.weight"].ndim != 1]


def _own(tensors: Mapping[str, Numbers], prefix: str) -> list[str]:
    """The names of the layers' tensors under a prefix."""
    matches = ((name, _KEY.fullmatch(name)) for name in tensors)
    return [
        name
        for name, match in matches
        if match is not None and (match["prefix"] or "") == prefix and match["rest"] in ("weight", "bias")
    ]


def _root(tensors: Mapping[str, Numbers]) -> str | None:
    """The common prefix of a two-stage policy's tensor names; None unless all of them share one."""
    roots = [key.removesuffix(_PARTS[0]) for key in tensors if key.endswith(_PARTS[0])]
    if len(roots) != 1 or not all(roots[0] + part in tensors for part in _PARTS):
        return None
    return roots[0]


def _is_double(tensors: Mapping[str, Numbers], prefix: str) -> bool:
    return any(tensors[f"{_dot(prefix)}{k}.weight"].dtype == np.float64 for k in _numbers(tensors, prefix))


def _dot(prefix: str) -> str:
    return f"{prefix}." if prefix else ""
