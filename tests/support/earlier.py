"""Documents of format 8, in which tests write certificates and forgeries, as ones of format 9, and back.

In format 8 the policy and a neural N have layers; in format 9 these are networks, programs of steps. Whatever is wrong
in a document of format 8 is wrong in what becomes of it, at the place that its contents have now.
"""

from __future__ import annotations

import json
from typing import Any

Document = dict[str, Any]
EARLIER, LATER = "certify-certificate/8", "certify-certificate/9"


def newer(data: Any) -> Any:
    """A document of format 8 as one of format 9; others, and what is no document, as they are."""
    if not isinstance(data, dict) or data.get("schema") != EARLIER:
        return data
    states = data["plant"].get("states") if isinstance(data.get("plant"), dict) else None
    names = states if isinstance(states, list) else []
    networks, made = list[Any](), {**data, "schema": LATER}
    policy, claim = data.get("policy"), data.get("claim")
    if isinstance(policy, dict) and "layers" in policy:
        networks.append({"name": "policy", "reads": len(names) or 1, "steps": _steps(policy["layers"])})
        made["policy"] = {"network": "policy", **{k: v for k, v in policy.items() if k != "layers"}}
    if isinstance(claim, dict) and isinstance(claim.get("outer"), dict):
        made["claim"] = {**claim, "outer": _outer(claim["outer"], names, networks)}
    place = list(made).index("claim") + 1 if "claim" in made else 0
    entries = list(made.items())
    return dict([*entries[:place], ("networks", networks), *entries[place:]])


def _outer(outer: Document, names: list[Any], networks: list[Any]) -> Document:
    """N as an expression; a network of its own joins the others."""
    if outer.get("kind") == "expression":
        return {k: v for k, v in outer.items() if k != "kind"}
    if outer.get("kind") != "network" or "layers" not in outer:
        return outer
    networks.append({"name": "N", "reads": len(names) or 1, "steps": _steps(outer["layers"])})
    rest = {k: v for k, v in outer.items() if k not in ("kind", "layers")}
    return {"expression": ["network", "N", 0, *names], **rest}


def _steps(layers: Any) -> Any:
    """Layers as steps with tanh between them; what is no list of layers as it is."""
    if not isinstance(layers, list):
        return layers
    steps: list[Any] = []
    for layer in layers:
        if steps:
            steps.append({"kind": "map", "of": [len(steps)], "function": "tanh"})
        steps.append({"kind": "affine", "of": [len(steps)], **layer} if isinstance(layer, dict) else layer)
    return steps


def earlier(data: Document) -> Document:
    """A document of format 9, whose networks are layers with tanh between them, as one of format 8."""
    if data["schema"] == EARLIER:
        return data
    made = {**data, "schema": EARLIER}
    networks = {network["name"]: _layers(network) for network in made.pop("networks")}
    policy, outer = dict(data["policy"]), data["claim"]["outer"]
    made["policy"] = {"layers": networks[policy.pop("network")], **policy}
    if outer is not None:
        tree, rest = outer["expression"], {k: v for k, v in outer.items() if k != "expression"}
        called = isinstance(tree, list) and tree[0] == "network"
        stated = (
            {"kind": "network", "layers": networks[tree[1]]} if called else {"kind": "expression", "expression": tree}
        )
        made["claim"] = {**data["claim"], "outer": {**stated, **rest}}
    return made


def strictly_earlier(data: Any) -> Document:
    """The document of format 8 from which this one of format 9 comes.

    Raises
    ------
    ValueError : it comes from none.
    """
    try:
        made = earlier(data) if data["schema"] == LATER else None
        same = made is not None and json.dumps(newer(made), sort_keys=True) == json.dumps(data, sort_keys=True)
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError("no document of layers") from error
    if made is None or not same:
        raise ValueError("no document of layers")
    return made


def _layers(network: Document) -> list[Document]:
    return [{k: v for k, v in step.items() if k not in ("kind", "of")} for step in network["steps"][::2]]
