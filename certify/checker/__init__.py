"""The trusted checker: it decides whether a certificate's evidence establishes its claim.

It imports nothing from the rest of the project (numpy and python-flint only), searches nothing and
trusts nothing in the file. Run it as `python -I -m certify.checker FILE`. FORMAT.md has the format, the
claims, and the proof that the rules imply them. Reading order: errors, strict, schema, document, expression,
exact, float64, elementary, network, parts, case, rules, jets, local, taylor, ring, words.
"""
