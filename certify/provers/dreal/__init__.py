"""dReal as an engine: its word is trusted, never checked."""
