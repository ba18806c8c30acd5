"""The pipeline: candidates are chosen, falsified, proved, checked and told of."""
