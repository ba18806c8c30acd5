"""The pipeline: candidates are chosen, falsified, proved, checked and told of.

`run.py` passes an immutable state through `stages/` (setting, candidate, ring, tube and other additions, acceptance,
beyond the ellipsoid). Options: each a field of `options.py`, declared by `declaration.py`, read as text or Python by
`arguments.py` and `values.py`; `changes.py` has those that change the plant; `api.py` is `certify_roa`. P:
`candidates/` and `selection.py`. Afterwards: `acceptance.py`, `results.py` and `facts.py`, `diagnosis.py` and
`suggested.py` (limits, and what to try), `maximise.py` (longest period, largest rate), `saved_search.py`. Other
commands: `studies/` (sweep), `fitting/` (fit), `composing.py` (compose), `identifying/` (identify), `reaching/` (reach)
and `staying/` (invariant), which share `without_v.py`.
"""
