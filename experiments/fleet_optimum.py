"""How far rules, planners and the upper bound are from the optimum of small fleets, by exhaustive search.

    PYTHONPATH=. uv run python experiments/fleet_optimum.py [--instances 100] [--out results/fleet]

The instances are those of the tests: two UAVs, 3 or 4 devices, a depot or none, batteries equal or not. Prints a table and
writes ``fleet_optimum.json``: where the optimum is, the gap between planners and bound is either the bound's or theirs.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import numpy as np
from reports import write_report

from tests.planning.fleet_instances import Solved, solved_instance
from uavmec_jax.env.rollout import rollout
from uavmec_jax.planning.beam import beam_search
from uavmec_jax.planning.bound import upper_bound
from uavmec_jax.planning.fleet_deadlines import earliest_deadline, split_deadline
from uavmec_jax.planning.heuristics import oldest_first
from uavmec_jax.planning.rollout_planner import rollout_planner
from uavmec_jax.studies.statistics import mean_interval
