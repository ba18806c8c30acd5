"""Regions of attraction of plants controlled by tanh networks, proved and independently checked.

`import certify` loads nothing heavy: public names are resolved on first use (PEP 562).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from certify.api import certify_roa
    from certify.closed_loop import ClosedLoop
    from certify.errors import CertifyError, InputError
    from certify.expressions import atan, cos, exp, from_sympy, sin, sqrt, symbols, tan, tanh
    from certify.lyapunov import Neural, Polynomial, load_lyapunov, save_lyapunov
    from certify.options import RoaOptions
    from certify.policies import Policy, TanhNetwork, load_policy, save_policy
    from certify.policies.importers import ImportOptions
    from certify.results import RoaResult
    from certify.systems import System, get_system
    from certify.verdict import Verdict

_PUBLIC = {
    "CertifyError": "certify.errors",
    "InputError": "certify.errors",
    "Verdict": "certify.verdict",
    "System": "certify.systems",
    "get_system": "certify.systems",
    "symbols": "certify.expressions",
    "sin": "certify.expressions",
    "cos": "certify.expressions",
    "tan": "certify.expressions",
    "tanh": "certify.expressions",
    "exp": "certify.expressions",
    "atan": "certify.expressions",
    "sqrt": "certify.expressions",
    "from_sympy": "certify.expressions",
    "TanhNetwork": "certify.policies",
    "Policy": "certify.policies",
    "load_policy": "certify.policies",
    "save_policy": "certify.policies",
    "Neural": "certify.lyapunov",
    "Polynomial": "certify.lyapunov",
    "load_lyapunov": "certify.lyapunov",
    "save_lyapunov": "certify.lyapunov",
    "ClosedLoop": "certify.closed_loop",
    "certify_roa": "certify.api",
    "RoaResult": "certify.results",
    "RoaOptions": "certify.options",
    "ImportOptions": "certify.policies.importers",
}

__version__ = "0.2.0.dev0"  # the only place; CHANGELOG.md has the same heading
__all__ = [
    "CertifyError",
    "ClosedLoop",
    "ImportOptions",
    "InputError",
    "Neural",
    "Policy",
    "Polynomial",
    "RoaOptions",
    "RoaResult",
    "System",
    "TanhNetwork",
    "Verdict",
    "__version__",
    "atan",
    "certify_roa",
    "cos",
    "exp",
    "from_sympy",
    "get_system",
    "load_lyapunov",
    "load_policy",
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
