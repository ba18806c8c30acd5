"""Engines: how obligations are proved or refuted. None is trusted; the checker decides."""
