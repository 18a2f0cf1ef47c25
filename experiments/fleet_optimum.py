"""How far rules, planners and the upper bound are from the optimum of small fleets, by exhaustive search.

    PYTHONPATH=. uv run python experiments/fleet_optimum.py [--instances 100] [--out results/fleet]

The instances are those of the tests: two UAVs, 3 or 4 devices, a depot or none, batteries equal or not. Prints a table and
writes ``fleet_optimum.json``: where the optimum is, the gap between planners and bound is either the bound's or theirs.
"""
