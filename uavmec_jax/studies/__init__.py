"""Studies: what to train, how to judge it, and what is kept of it."""
