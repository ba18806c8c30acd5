"""One plant a file: the constant `PLANT` of `NAME.py` says how the system `NAME` is trained, judged and drawn.

`controllers.options` looks into this folder, so a new file is all that a new plant needs. Files whose names begin with
an underscore are no plants.
"""
