"""Policies that learn nothing: baselines, planners, bounds."""
