"""Prove claims again in the Coq proof assistant: the theory, a claim's data, the evidence, the kernel.

The theory states a certificate's claim in real numbers (`Spec.v`) and proves that a check of it is sound. This package
converts a certificate into Coq's data, searches for evidence for the check, and runs `coqc`. Only Coq is trusted.
"""
