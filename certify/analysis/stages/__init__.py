"""The stages of a run, in their order: each extends a state, and says nothing of the others."""
