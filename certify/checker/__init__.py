"""The trusted checker: it decides whether a certificate's evidence establishes its claim.

It imports nothing from the rest of the project (numpy and python-flint only), searches nothing and
trusts nothing in the file. Run it as `python -I -m certify.checker FILE`. FORMAT.md has the format, the claims and the
rules; docs/mathematics/ proves that the rules imply the claims. Reading order of what every certificate needs: rules,
case, exact; near, functions, jets, ball, pairs, decrease, local; networks, network, taylor, boxes, ring; then what
proves nothing: strict, schema, expression, document, errors, words. What only some need, by the chapters that
FORMAT.md has it in: smooth, activations, elementary; wiring, calls; ranges; stepping, flow; tube; contraction, held;
outer, invariant; periodic, ranks; kinks; keep; data; handover; and sections, clauses, processes for several of them.
"""
