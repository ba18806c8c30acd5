"""Claims proved again by the Coq proof assistant: the theory, a claim's data, what leads its proof, the kernel.

The theory says in real numbers what a certificate claims (`Spec.v`) and proves a check of it sound; here a certificate
becomes Coq's data, a search finds what leads the check, and `coqc` is run. Only Coq is believed.
"""
