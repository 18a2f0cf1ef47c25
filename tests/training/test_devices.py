"""The results are the same, to the bit, on one, two and four devices."""

import subprocess
import sys

import pytest

from tests.runs.processes import environment

SCRIPT = """
import sys
import jax

jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
import hashlib
import numpy as np
import uavmec_jax as um
from uavmec_jax.studies.population import make_agents, make_algorithm, validation_keys
from uavmec_jax.training.partition import Partition
from uavmec_jax.training.population import train_population

changes = {"axes.seeds": 2, "axes.powered": [12, 8], "axes.connected": [8, 4], "steps": 1200, "algorithm": sys.argv[2]}
if sys.argv[2] == "pqn":
    changes |= {"pqn.n_envs": 4, "pqn.n_steps": 16, "pqn.batch_size": 16}
study = um.load_study("table5", changes)
partition = Partition(shards=1, shard_size=8, groups=4, shard_bytes=0)
assert partition.devices == int(sys.argv[1])
validation = um.training.Validation(every=400, draws=16)
(trained,) = train_population(
    make_algorithm(study), make_agents(study), validation_keys(study), validation=validation, partition=partition
)
leaves = jax.tree.leaves((trained.best, trained.last, trained.validation, trained.episode_length))
print(hashlib.sha256(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in leaves)).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.bits
@pytest.mark.parametrize("algorithm", ["dqn", pytest.param("pqn", marks=pytest.mark.full)])
def test_the_same_bits_on_one_two_and_four_devices(algorithm):
    command = [sys.executable, "-c", SCRIPT]
    runs = [
        subprocess.Popen(
            [*command, str(devices), algorithm], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()
        )
        for devices in (1, 2, 4)
    ]
    outputs = [run.communicate(timeout=300) for run in runs]
    assert all(run.returncode == 0 for run in runs), outputs
    assert len({output for output, _ in outputs}) == 1
