"""`python -m certify`: the same as the command `certify`."""

from __future__ import annotations

from certify.cli.main import main

if __name__ == "__main__":
    main()
