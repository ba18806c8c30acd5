"""Exceptions. Each message says what, the requirement, what was found, and the next step.

UNKNOWN is a verdict and never an exception; the checker has exceptions of its own.
"""

from __future__ import annotations


class CertifyError(Exception):
    """Base of everything this package raises on purpose."""


class InputError(CertifyError, ValueError):
    """The user's plant, policy or option cannot be used (exit status 2)."""


class OptionError(InputError):
    """An option cannot be used; the message names options as Python does, in backquotes, and the command line shows
    them as they are typed there."""


class CertificateFormatError(CertifyError, ValueError):
    """A certificate cannot be read."""


class BackendError(CertifyError, RuntimeError):
    """An external program (a solver, the checker process) is missing or failed."""


class SoundnessError(CertifyError, RuntimeError):
    """Two rigorous results contradict each other. Nobody catches this."""
