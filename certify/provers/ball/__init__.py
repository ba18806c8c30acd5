"""Proofs on a ball around the origin: models of third order and one matrix inequality."""
