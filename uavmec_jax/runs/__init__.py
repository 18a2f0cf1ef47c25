"""Runs that survive: shards, leases, snapshots, workers, status."""
