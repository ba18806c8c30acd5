"""Documents of format 8, in which tests write certificates and forgeries, as ones of format 9, and back.

In format 8 the policy and a neural N have layers; in format 9 these are networks, programs of steps. Whatever is wrong
in a document of format 8 is wrong in what becomes of it, at the place that its contents have now.
"""

from __future__ import annotations

from typing import Any

Document = dict[str, Any]
EARLIER, LATER = "certify-certificate/8", "certify-certificate/9"


def newer(data: Any) -> Any:
    """A document of format 8 as one of format 9; others, and what is no document, as they are."""
    if not isinstance(data, dict) or data.get("schema") != EARLIER:
        return data
    networks, states = list[Any](), data["plant"].get("states") if isinstance(data.get("plant"), dict) else None
    reads, made = len(states) if isinstance(states, list) else 1, dict[str, Any]()
    for key, value in data.items():
        if key == "policy" and isinstance(value, dict) and "layers" in value:
            networks.insert(0, {"name": "policy", "reads": reads, "steps": _steps(value["layers"])})
            value = {"network": "policy", **{k: v for k, v in value.items() if k != "layers"}}
        elif key == "claim" and isinstance(value, dict) and isinstance(value.get("outer"), dict):
            value, own = {**value, "outer": dict(value["outer"])}, value["outer"]
            if own.get("kind") == "network" and "layers" in own:
                networks.append({"name": "N", "reads": reads, "steps": _steps(own["layers"])})
                call = ["network", "N", 0, *(states if isinstance(states, list) else [])]
                value["outer"] = {"expression": call, **{k: v for k, v in own.items() if k not in ("kind", "layers")}}
            elif own.get("kind") == "expression":
                value["outer"] = {k: v for k, v in own.items() if k != "kind"}
        made[key] = LATER if key == "schema" else value
    place = list(made).index("claim") + 1 if "claim" in made else 0
    entries = list(made.items())
    return dict([*entries[:place], ("networks", networks), *entries[place:]])


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


def _layers(network: Document) -> list[Document]:
    return [{k: v for k, v in step.items() if k not in ("kind", "of")} for step in network["steps"][::2]]
