"""Policies: exact networks, centring, and the policy file."""

from __future__ import annotations

from certify.loop.policies.exact import bounded_by_form, clipped_at, require_centred
from certify.loop.policies.file import Policy, load_policy, save_policy
from certify.loop.policies.network import Centre, PolicyNetwork, program_of

__all__ = [
    "Centre",
    "Policy",
    "PolicyNetwork",
    "bounded_by_form",
    "clipped_at",
    "load_policy",
    "program_of",
    "require_centred",
    "save_policy",
]
