"""All tests run with shapes and types checked at run time, and with two CPU devices."""

import gc
import os
import sys
import tempfile
from importlib.metadata import version

# A program is compiled once per session, whichever worker, test or subprocess needs it: the first process makes the cache
# folder, the others inherit its name. Several sessions share their cache if the variable is set before they start.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="uavmec-jax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.05"

# The tests compile for longer than they run, so machine code that is made quickly will do. Those that compare two
# computations to the bit also run with the usual machine code: XLA_FLAGS= pytest -m bits. XLA ends the process if it does not
# know a flag, and only jaxlib 0.10 is sure to know the second one. (Level 1 with it makes LLVM end the process on one of our
# programs: "Cannot select: SUBV_BROADCAST_LOAD".)
if "XLA_FLAGS" not in os.environ:
    os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=2"
    if version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] += " --xla_cpu_use_fusion_emitters=false"

# The tests start about a hundred processes. If Python may not write bytecode beside the sources, each of them would compile
# its imports again, which takes seconds, so bytecode goes to a folder that is removed with the session.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    _bytecode = tempfile.TemporaryDirectory(prefix="uavmec-jax-bytecode-")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = _bytecode.name
    sys.dont_write_bytecode = False

import jax
import jaxtyping
import psutil
import pytest
from jaxtyping import install_import_hook

import tests.typechecking  # noqa: F401  (the hook below finds it by name)

jax.config.update("jax_num_cpu_devices", 2)

install_import_hook("uavmec_jax", "tests.typechecking.checked")

_MAX_RESIDENT_BYTES = 1.5e9
"""Memory with which a process lets go of its compiled programs between two files of tests: machines with many workers have
little for each, and a process may only map so many pieces of memory."""


@pytest.fixture(scope="module", autouse=True)
def _bounded_memory():
    """Drop the compiled programs of earlier files of tests once they take much memory."""
    yield
    if psutil.Process().memory_info().rss > _MAX_RESIDENT_BYTES:
        jax.clear_caches()
        gc.collect()


@pytest.fixture
def without_type_checks():
    """Run a test as users run the package, without the type checker of the tests."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
