"""The closed loop of a claim: plant and policy together."""
