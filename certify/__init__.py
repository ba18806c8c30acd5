"""Regions of attraction of plants controlled by neural networks, proved and independently checked.

`import certify` loads nothing heavy: public names are resolved on first use (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.analysis.api import certify_roa
    from certify.analysis.composing import compose
    from certify.analysis.identifying.api import identify
    from certify.analysis.identifying.linear import LinearStructure
    from certify.analysis.identifying.run import IdentifyResult
    from certify.analysis.options import RoaOptions
    from certify.analysis.results import RoaResult
    from certify.certificates.verdict import Verdict
    from certify.errors import CertifyError, InputError
    from certify.loop.closed_loop import ClosedLoop
    from certify.loop.expressions import (
        atan,
        clip,
        cos,
        exp,
        from_sympy,
        heaviside,
        maximum,
        minimum,
        sin,
        sqrt,
        symbols,
        tan,
        tanh,
    )
    from certify.loop.plants import System, get_system
    from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
    from certify.loop.policies.importers import ImportOptions
    from certify.lyapunov import Neural, Polynomial, load_lyapunov, save_lyapunov

_PUBLIC = {
    "CertifyError": "certify.errors",
    "InputError": "certify.errors",
    "Verdict": "certify.certificates.verdict",
    "System": "certify.loop.plants",
    "get_system": "certify.loop.plants",
    "symbols": "certify.loop.expressions",
    "sin": "certify.loop.expressions",
    "cos": "certify.loop.expressions",
    "tan": "certify.loop.expressions",
    "tanh": "certify.loop.expressions",
    "exp": "certify.loop.expressions",
    "atan": "certify.loop.expressions",
    "sqrt": "certify.loop.expressions",
    "minimum": "certify.loop.expressions",
    "maximum": "certify.loop.expressions",
    "clip": "certify.loop.expressions",
    "heaviside": "certify.loop.expressions",
    "from_sympy": "certify.loop.expressions",
    "PolicyNetwork": "certify.loop.policies",
    "Policy": "certify.loop.policies",
    "load_policy": "certify.loop.policies",
    "save_policy": "certify.loop.policies",
    "Neural": "certify.lyapunov",
    "Polynomial": "certify.lyapunov",
    "load_lyapunov": "certify.lyapunov",
    "save_lyapunov": "certify.lyapunov",
    "ClosedLoop": "certify.loop.closed_loop",
    "certify_roa": "certify.analysis.api",
    "compose": "certify.analysis.composing",
    "identify": "certify.analysis.identifying.api",
    "IdentifyResult": "certify.analysis.identifying.run",
    "LinearStructure": "certify.analysis.identifying.linear",
    "RoaResult": "certify.analysis.results",
    "RoaOptions": "certify.analysis.options",
    "ImportOptions": "certify.loop.policies.importers",
}

__version__ = "0.2.0.dev0"  # the only place; CHANGELOG.md has the same heading
__all__ = [
    "CertifyError",
    "ClosedLoop",
    "IdentifyResult",
    "ImportOptions",
    "InputError",
    "LinearStructure",
    "Neural",
    "Policy",
    "PolicyNetwork",
    "Polynomial",
    "RoaOptions",
    "RoaResult",
    "System",
    "Verdict",
    "__version__",
    "atan",
    "certify_roa",
    "clip",
    "compose",
    "cos",
    "exp",
    "from_sympy",
    "get_system",
    "heaviside",
    "identify",
    "load_lyapunov",
    "load_policy",
    "maximum",
    "minimum",
    "save_lyapunov",
    "save_policy",
    "sin",
    "sqrt",
    "symbols",
    "tan",
    "tanh",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'certify' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
