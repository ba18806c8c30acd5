"""One file per plant: `NAME.py` here defines a function `NAME()` that returns the `System` called `NAME`.

The registry reads this folder, so a new plant needs only a new file. Files whose names begin with an underscore are no
plants.
"""
