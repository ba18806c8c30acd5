"""Candidates for V: which matrices P are tried, and in which order."""
