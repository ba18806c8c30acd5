"""Tanh policies: exact layers, centring, and the policy file."""

from __future__ import annotations

from certify.policies.file import Policy, load_policy, save_policy
from certify.policies.network import TanhNetwork

__all__ = ["Policy", "TanhNetwork", "load_policy", "save_policy"]
