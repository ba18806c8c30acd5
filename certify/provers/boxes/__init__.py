"""Branch and bound over boxes: search, frontier, partition, and the rule for a box."""
