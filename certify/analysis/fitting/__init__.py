"""Fitting of equations that nobody wrote down, with bounds of what they may be off by (`certify fit`)."""
