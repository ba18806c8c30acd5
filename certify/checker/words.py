"""The claim and the verdict in words and numbers; what is printed is what was parsed."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any

from .document import PLAIN, Certificate, Partition, Policy
from .networks import Network, hashed
from .schema import Array

CLAIMS = {
    "asymptotic": "the origin is asymptotically stable, and every trajectory of the closed loop that starts in "
    "V <= {c.c2!r}{when[start]} {when[stays]} and converges to the origin",
    "practical": "every trajectory of the closed loop that starts in V <= {c.c2!r}{when[start]} {when[stays]}, enters "
    "V <= {c.c0!r} {when[enters]} and {when[remains]} from then on; nothing is claimed about what happens inside "
    "V <= {c.c0!r}, and the origin need not be an equilibrium",
}
AT_ONCE = {"start": "", "stays": "stays there", "enters": "in finite time", "remains": "stays there"}


def has_more(c: Certificate) -> bool:
    """True if clauses.py has words of the claim: it is of another kind, of steps, or states more."""
    parts = (c.outer, c.ranks, c.keep, c.data, c.samples, c.then)
    return c.claim not in PLAIN or c.step > 0 or any(parts) or not isinstance(c.evidence, Partition)


def claim(c: Certificate) -> list[str]:
    """The claim in sentences: its trajectories, and the additions."""
    if has_more(c):
        from . import clauses

        return clauses.claim(c)
    bound, latest = "V(x(t)) <= V(x(0)) exp(-2 lambda t)", "after {} units of time at the latest"
    return [said(CLAIMS[c.claim].format(c=c, when=AT_ONCE)), *falls(c, bound, latest)]


def said(trajectories: str) -> str:
    return f"claim: {trajectories}; u stays in its bounds"


def falls(c: Certificate, bound: str, latest: str) -> list[str]:
    """The bound of V under a rate, and the time to reach c0, if there is one."""
    if not c.rate:
        return []
    reached = latest.format("log(c2/c0)/(2 lambda)")
    until = f", until V <= {c.c0!r}, where the trajectory is {reached}" if "floor" in c.levels else ""
    return [f"  {bound}{until}, lambda = {c.rate!r}"]


def report(c: Certificate, answer: dict[str, Any]) -> list[str]:
    """The plant, the policy, V, what is claimed of them, what held, and the verdict, line by line."""
    if has_more(c):
        from . import clauses

        return clauses.report(c, answer)
    return [*stated(c), *claim(c), *held(answer), margins(c, answer, "Vdot"), verdict(c, answer["result"])]


def held(answer: dict[str, Any], counted: Sequence[str] = ()) -> list[str]:
    """The rules and the modules that the answer rests on."""
    rules = ", ".join(f"{rule} {count}" for rule, count in answer["rules"].items() if count)
    return [f"rules that held: {rules}", *counted, f"modules that were used: {', '.join(answer['modules'])}"]


def verdict(c: Certificate, result: str) -> str:
    inner = f"c0={c.c0!r} " if c.practical else ""
    both = f"{inner}c1={c.c1!r} c2={c.c2!r} " if c.levels else ""
    return f"{result} {both}{f'n2={c.outer.level!r} ' if c.outer else ''}sha256={c.sha256}"


def margins(c: Certificate, answer: dict[str, Any], change: str) -> str:
    """The smallest margins of the rules, `change` being what V changes by."""
    found = answer["margins"]
    change = f"({change} + 2 lambda V)" if c.rate else change
    words = {
        "local": "local {:.1%}",
        "ring": f"smallest bound of -{change} on a ring's leaf {{:.3g}}",
        "outer": "smallest bound of -N'F on a leaf of the outer set {:.3g}",
    }
    known = ((said, found.get(name)) for name, said in words.items())
    return "margins: " + "; ".join(said.format(margin) for said, margin in known if margin is not None)


def stated(c: Certificate) -> list[str]:
    """The plant, the policy and V, line by line."""
    inputs = zip(c.inputs, c.input_bounds, c.u_eq, strict=True)
    after = "+" if c.discrete else "'"
    left = "x+" if c.discrete else "xdot"
    return [
        f"plant {c.name}: {left} = f(x, u), states ({', '.join(c.states)}), inputs ({', '.join(c.inputs)})",
        *(
            f"  for every {name}({'k' if c.discrete else 't'}) in {interval(pair)}"
            for name, pair in zip(c.uncertain, c.ranges, strict=True)
        ),
        *(f"  {name}{after} = {expression(tree)}" for name, tree in zip(c.states, c.dynamics.trees, strict=True)),
        *(["  heaviside(v) is 1 where v > 0, 0 where v < 0, either where v = 0"] if c.dynamics.jumps else []),
        *(f"  domain {name} in {interval(pair)}" for name, pair in zip(c.states, c.domain, strict=True)),
        *(f"  input {name} in {interval(pair)}, u_eq = {number(u)}" for name, pair, u in inputs),
        *(f"network {network.name}: {_network(network)}" for network in c.networks),
        f"policy: network {c.policy.network.name}, squash {c.policy.squash}, centred by {c.policy.centre}, "
        f"{_clip(c.policy)}"
        f"sha256 {c.policy.sha256()}",
        *([] if c.policy.origin is None else [f"  its network reads ({matrix(c.policy.origin[None])}) + x"]),
        *([] if c.without_V else [f"V(x) = x'Px with P = {matrix(c.P)}"]),
    ]


def _network(network: Network) -> str:
    """The network's form, or its steps, of vectors v0 = x, v1, v2 and so on; by its hash reports name N too."""
    arrays = [array for step in network.steps for array in step.arrays]
    sha256 = hashed("certify-lyapunov/1\0", arrays, network.words())
    if network.is_chain:
        return f"{'-'.join(map(str, [network.reads, *network.sizes[1::2]]))} tanh, sha256 {sha256}"
    steps = (f"v{k} = {step.said(', '.join(f'v{i}' for i in step.of))}" for k, step in enumerate(network.steps, 1))
    return f"{'; '.join(steps)}; sha256 {sha256}"


def matrix(A: Array) -> str:
    return "; ".join(" ".join(map(repr, row)) for row in A.tolist())


def expression(tree: Any) -> str:
    """A tree of the grammar, with all its brackets."""
    if not isinstance(tree, list):
        return str(tree) if str(tree).isidentifier() or str(tree).isdecimal() else f"({tree})"
    name, *operands = tree
    if name == "network":
        function, entry, *arguments = operands
        return f"{function}[{entry}]({', '.join(map(expression, arguments))})"
    words = [expression(operand) for operand in operands]
    if name.isalpha():
        return f"{name}({', '.join(words)})"
    return f"(-{words[0]})" if name == "-" and len(words) == 1 else f"({f' {name} '.join(words)})"


def _clip(policy: Policy) -> str:
    if policy.clip is None:
        return ""
    ends = zip(*(end.tolist() for end in policy.clip), strict=True)
    return f"clipped to {', '.join(f'[{lo!r}, {hi!r}]' for lo, hi in ends)}, "


def interval(pair: tuple[Fraction, Fraction]) -> str:
    return f"[{number(pair[0])}, {number(pair[1])}]"


def decimal(q: Fraction) -> str:
    return f"{Decimal(q.numerator) / Decimal(q.denominator):.6g}"


def number(q: Fraction) -> str:
    return str(q) if q.denominator == 1 or len(str(q)) > 40 else f"{q} (about {float(q):.6g})"
