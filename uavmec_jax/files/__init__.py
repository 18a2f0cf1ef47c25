"""Readers with limits, atomic writes, checked archives and locks. Imports nothing of ours but the errors."""
