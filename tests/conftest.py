"""Every test runs with shapes and types checked at run time, and with two CPU devices."""

import os
import sys
import tempfile

# The same program is compiled once in a session, whichever worker, test or subprocess asks for it: the first process
# makes the folder, the others inherit its name. AgentIds runs several sessions may give one folder to all of them.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _cache = tempfile.TemporaryDirectory(prefix="uavmec-jax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache.name
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.05"

# The tests start some hundred processes. Where Python is told to leave no bytecode beside the sources, each would
# compile all that it imports again, for seconds: it is left in a folder that goes with the session.
if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
    _bytecode = tempfile.TemporaryDirectory(prefix="uavmec-jax-bytecode-")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix = _bytecode.name
    sys.dont_write_bytecode = False

import jax
from jaxtyping import install_import_hook

import tests.typechecking  # noqa: F401  (the hook below finds it by name)

jax.config.update("jax_num_cpu_devices", 2)

install_import_hook("uavmec_jax", "tests.typechecking.checked")
