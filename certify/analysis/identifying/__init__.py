"""`certify identify`: a plant's parameters from measured transitions, read from files or taken from an environment."""
