"""The trusted checker: it decides whether a certificate's evidence establishes its claim.

It imports nothing from the rest of the project (numpy and python-flint only), searches nothing and
trusts nothing in the file. Run it as `python -I -m certify.checker FILE`. FORMAT.md has the format, the claims and the
rules; docs/mathematics/ proves that the rules imply the claims. Reading order: errors, strict, schema, document,
expression, near, functions, exact, networks, network, case, limits, processes, rules, taylor, boxes, ring, jets, ball,
pairs, decrease, local, words; then what only some certificates need: sections, clauses, demands, activations, flow,
tube, contraction, outer, invariant, periodic, ranks, data, handover.
"""
