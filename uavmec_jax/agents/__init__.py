"""Learners: networks, replay, one file per algorithm, and the population that trains many agents at once."""
