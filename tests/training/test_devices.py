"""One, two or four devices: the same bits."""

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
from uavmec_jax.agents import population
from uavmec_jax.training.partition import Partition
from uavmec_jax.studies.study import make_agents, make_algorithm, validation_keys

changes = {"axes.seeds": 2, "axes.powered": [12, 8], "axes.connected": [8, 4], "steps": 1200}
study = um.load_study("table5", changes)
blocks = Partition(count=1, size=8, groups=4, bytes=0)
assert blocks.devices == int(sys.argv[1])
validation = um.training.Validation(every=400, draws=16)
(trained,) = population.train(
    make_algorithm(study), make_agents(study), validation_keys(study), validation=validation, blocks=blocks
)
leaves = jax.tree.leaves((trained.best, trained.last, trained.validation, trained.episode_length))
print(hashlib.sha256(b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in leaves)).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.bits
def test_the_same_bits_on_one_two_and_four_devices():
    command = [sys.executable, "-c", SCRIPT]
    runs = [
        subprocess.Popen([*command, str(devices)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment())
        for devices in (1, 2, 4)
    ]
    outputs = [run.communicate(timeout=300) for run in runs]
    assert all(run.returncode == 0 for run in runs), outputs
    assert len({output for output, _ in outputs}) == 1
