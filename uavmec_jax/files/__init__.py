"""Readers with limits, whole writes, checked archives and locks. Imports nothing of ours but the errors."""
