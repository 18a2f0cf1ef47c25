"""Every test runs with shapes and types checked at run time, and with two CPU devices."""

import tempfile

import jax
from jaxtyping import install_import_hook

import tests.typechecking  # noqa: F401  (the hook below finds it by name)

jax.config.update("jax_num_cpu_devices", 2)

# The same program is compiled once in a session, whichever test asks for it.
_cache = tempfile.TemporaryDirectory(prefix="uavmec-jax-tests-")
jax.config.update("jax_compilation_cache_dir", _cache.name)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)

install_import_hook("uavmec_jax", "tests.typechecking.checked")
