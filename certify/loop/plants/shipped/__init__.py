"""One plant a file: `NAME.py` here defines a function `NAME()` that returns the `System` called `NAME`.

The registry looks into this folder, so a new file is all that a new plant needs. Files whose names begin with an
underscore are no plants.
"""
