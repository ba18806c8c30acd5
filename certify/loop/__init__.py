"""The closed loop that a claim is about: plant, policy, and what they do together."""
