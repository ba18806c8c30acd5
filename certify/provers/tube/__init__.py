"""Tubes: ellipsoids that move, from a larger set into a proved one."""
