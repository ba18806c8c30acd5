"""Engines: how conditions are proved or refuted. None is trusted; the checker decides."""
