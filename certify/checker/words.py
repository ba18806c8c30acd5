"""The claim and the verdict in words and numbers; what is printed is what was parsed."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

from .document import Array, Certificate, Partition, Policy
from .expression import Tape
from .networks import Network, hashed

CLAIMS = {
    "asymptotic": "the origin is asymptotically stable, and every trajectory of the closed loop that starts in "
    "V <= {c.c2!r}{when[start]} {when[stays]} and converges to the origin",
    "enlarged": "the origin is asymptotically stable; every trajectory of the closed loop that starts in V <= {c.c2!r} "
    "stays there and converges to the origin, and every one that starts in x'Sx <= 1 stays in the domain, is in "
    "V <= {c.c2!r} after {time!r} units of time at the latest, and converges to the origin",
    "reached": "the origin is asymptotically stable; every trajectory of the closed loop that starts in V <= {c.c2!r} "
    "stays there and converges to the origin, and every one that starts in (x - c)'S(x - c) <= 1 stays in the domain, "
    "is in V <= {c.c2!r} after {time!r} units of time at the latest, and converges to the origin",
    "nearby": "every trajectory of the closed loop that starts in V <= {c.c2!r} {when[stays]}, enters V <= {c.c0!r} "
    "{when[enters]} and {when[remains]} from then on; and where what is uncertain is constant in time, there is "
    "exactly one equilibrium in V <= {c.c0!r}, and all of these trajectories converge to it",
    "practical": "every trajectory of the closed loop that starts in V <= {c.c2!r}{when[start]} {when[stays]}, enters "
    "V <= {c.c0!r} {when[enters]} and {when[remains]} from then on; nothing is claimed about what happens inside "
    "V <= {c.c0!r}, and the origin need not be an equilibrium",
}

_AT_ONCE = {"start": "", "stays": "stays there", "enters": "in finite time", "remains": "stays there"}
_BY_STEPS = {
    "start": "",
    "stays": "is there at every later step",
    "enters": "after finitely many steps",
    "remains": "is there at every step",
}
_SAMPLED = {
    "start": " at a sampling instant",
    "stays": "is there at every later sampling instant, is in the domain at all times",
    "enters": "at some sampling instant",
    "remains": "is there at every sampling instant",
}
_SAMPLED_FROM_0 = {**_SAMPLED, "stays": "is there at all later times", "remains": "is there at all times"}


def claim(c: Certificate) -> list[str]:
    """The claim in sentences: its trajectories, and the additions of a sample, a rate, an outer set."""
    when = _BY_STEPS if c.discrete else _AT_ONCE
    lines = []
    if c.sample is not None:
        lo, hi = c.sample
        when = _SAMPLED if lo else _SAMPLED_FROM_0
        each = f"any sequence of periods in {interval(c.sample)}" if lo < hi else f"exactly {number(hi)}"
        lines.append(f"  the input is held from each sampling instant to the next, for {each} units of time")
    if c.rate:
        lines.append(f"  {_falls(c)}, lambda = {c.rate!r}")
    if c.outer or c.ranks or c.keep or c.data:
        from . import clauses

        lines += clauses.additions(c, when["start"])
        if c.without_V:
            return [f"claim: {clauses.without_V(c, when['start'])}", *lines]
    said = CLAIMS[c.claim].format(c=c, time=duration(c), when=when)
    return [f"claim: {said}; u stays in its bounds", *lines]


def _falls(c: Certificate) -> str:
    """The bound of V under a rate, and the time to reach c0, if there is one."""
    if c.discrete:
        bound, latest = "V(x_k) <= V(x_0) exp(-2 lambda k) after k steps", "after {} steps, rounded up, at the latest"
    elif c.sample is None:
        bound, latest = "V(x(t)) <= V(x(0)) exp(-2 lambda t)", "after {} units of time at the latest"
    else:
        bound = "V(x(t_k)) <= V(x(t_0)) exp(-2 lambda (t_k - t_0)) at sampling instants"
        latest = "at every sampling instant that comes {} units of time or more after the start"
    if "floor" not in c.levels:
        return bound
    reached = latest.format("log(c2/c0)/(2 lambda)")
    return f"{bound}, until V <= {c.c0!r}, where the trajectory is {reached}"


def _falling(c: Certificate) -> str:
    """The expression that rule `ring` bounds from above."""
    name = "Vdot" if not c.discrete and c.sample is None else "D"
    return f"({name} + 2 lambda V)" if c.rate else name


def report(c: Certificate, answer: dict[str, Any]) -> list[str]:
    """The plant, the policy, V, what is claimed of them, what held, and the verdict, line by line."""
    if c.claim == "reaches":
        rest, verdict = f"leaves {answer['ranks']['leaves']}", answer["result"]
    elif c.claim == "invariant":
        margin = answer["margins"]["outer"]
        least = "" if margin is None else f"; smallest bound of -N'F on a leaf on which N may be its level {margin:.3g}"
        rest, verdict = f"leaves {answer['outer']['leaves']}{least}", answer["result"]
    elif answer["result"] == "TRUSTED":
        rest = f"not checked, the solver's word: {', '.join(answer['answers'])}"
        verdict = f"TRUSTED {answer['solver']} {answer['version']}"
    else:
        local, ring = answer["margins"]["local"], answer["margins"]["ring"]
        margins = [] if local is None else [f"local {local:.1%}"]
        margins += [] if ring is None else [f"smallest bound of -{_falling(c)} on a ring's leaf {ring:.3g}"]
        outer = None if c.outer is None else answer["margins"]["outer"]
        margins += [] if outer is None else [f"smallest bound of -N'F on a leaf of the outer set {outer:.3g}"]
        rest, verdict = f"margins: {'; '.join(margins)}", answer["result"]
    takes_over = _taking_over(c, c.then) if c.then else []
    return [
        *stated(c),
        *takes_over,
        "rules that held: " + ", ".join(f"{rule} {count}" for rule, count in answer["rules"].items() if count),
        *([] if c.then is None else [_counted(answer["then"]["rules"])]),
        "modules that were used: " + ", ".join(answer["modules"]),
        rest,
        f"{verdict} {_levels(c)}sha256={c.sha256}",
    ]


def _taking_over(c: Certificate, then: Certificate) -> list[str]:
    from . import clauses

    return [*clauses.handed_over(c, then), *stated(then)]


def stated(c: Certificate) -> list[str]:
    """The plant, the policy, V, and what is claimed of them, line by line."""
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
        *(f"  domain {name} in {interval(pair)}" for name, pair in zip(c.states, c.domain, strict=True)),
        *(f"  input {name} in {interval(pair)}, u_eq = {number(u)}" for name, pair, u in inputs),
        *(f"network {network.name}: {_network(network)}" for network in c.networks),
        f"policy: network {c.policy.network.name}, squash {c.policy.squash}, centred by {c.policy.centre}, "
        f"{_clip(c.policy)}"
        f"sha256 {c.policy.sha256()}",
        *([] if c.policy.origin is None else [f"  its network reads ({_matrix(c.policy.origin[None])}) + x"]),
        *([] if c.without_V else [f"V(x) = x'Px with P = {_matrix(c.P)}"]),
        *([] if c.target is None else _target(c.target)),
        *([] if c.start is None else [f"S = {_matrix(c.start)}"]),
        *([] if c.centre is None else [f"c = {' '.join(map(repr, c.centre.tolist()))}"]),
        *([] if c.outer is None else [f"N(x) = {expression(c.outer.function.trees[0])}"]),
        *claim(c),
    ]


def _counted(rules: dict[str, int]) -> str:
    return "of the certificate that takes over: " + ", ".join(f"{rule} {count}" for rule, count in rules.items())


def _target(target: Tape) -> list[str]:
    """The region that is reached."""
    return [f"target: {', '.join(f'{expression(tree)} <= 0' for tree in target.trees)}"]


def _levels(c: Certificate) -> str:
    """The levels, each with a space after it."""
    inner = f"c0={c.c0!r} " if c.practical else ""
    both = f"{inner}c1={c.c1!r} c2={c.c2!r} " if c.levels else ""
    return both if c.outer is None else f"{both}n2={c.outer.level!r} "


def _network(network: Network) -> str:
    """The network's form, or its steps, of vectors v0 = x, v1, v2 and so on; by its hash reports name N too."""
    arrays = [array for step in network.steps for array in step.arrays]
    sha256 = hashed("certify-lyapunov/1\0", arrays, network.words())
    if network.is_chain:
        return f"{'-'.join(map(str, network.widths))} tanh, sha256 {sha256}"
    steps = (f"v{k} = {step.said([f'v{i}' for i in step.of])}" for k, step in enumerate(network.steps, 1))
    return f"{'; '.join(steps)}; sha256 {sha256}"


def _matrix(A: Array) -> str:
    return "; ".join(" ".join(map(repr, row)) for row in A.tolist())


def duration(c: Certificate) -> float:
    """The tube's duration, rounded up; infinite if it exceeds all binary64 numbers."""
    slabs = c.evidence.tube if isinstance(c.evidence, Partition) else ()
    try:
        return math.nextafter(math.fsum(slab.duration for slab in slabs), math.inf)
    except OverflowError:
        return math.inf


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


def number(q: Fraction) -> str:
    return str(q) if q.denominator == 1 or len(str(q)) > 40 else f"{q} (about {float(q):.6g})"
