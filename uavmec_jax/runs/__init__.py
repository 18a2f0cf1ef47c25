"""Runs that survive: shards, leases, checkpoints, workers, status."""
