"""The trusted checker: decides whether a certificate's evidence establishes its claim.

It imports nothing from the rest of the project (numpy and python-flint only), searches for nothing and
trusts nothing in the file. Run it as `python -I -m certify.checker FILE`. The format, the claim and the
reason why each rule implies it stand in FORMAT.md. Reading order: errors, strict, schema, document, expression,
exact, float64, elementary, network, parts, case, rules, jets, local, taylor, ring, words.
"""
