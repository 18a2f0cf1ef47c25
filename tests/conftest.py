"""Every test runs with shapes and types checked at run time, and with two CPU devices."""

import jax
from jaxtyping import install_import_hook

import tests.typechecking  # noqa: F401  (the hook below finds it by name)

jax.config.update("jax_num_cpu_devices", 2)

install_import_hook("uavmec_jax", "tests.typechecking.checked")
