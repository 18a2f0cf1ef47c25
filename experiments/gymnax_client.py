"""Run a script that makes its environment with `gymnax.make`, as it is, on this environment.

    python experiments/gymnax_client.py purejaxrl/ppo.py
    python experiments/gymnax_client.py purejaxql/pqn_gymnax.py +alg=pqn_cartpole WANDB_MODE=disabled

Whatever name the script asks for, `gymnax.make` returns `FiveValueEnv` and a random layout with 8 powered and 8 connected
devices. What follows the script's path are its own arguments; its folder comes first on the path, as when it runs by itself.
It runs in an environment that has gymnax 0.0.9, what the script needs, and this package. Nothing of the script is changed.
"""

import runpy
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnax

from uavmec_jax.interop.five_values import FiveValueEnv, FiveValueParams


def make(name: str, **options: Any) -> tuple[FiveValueEnv, FiveValueParams]:
    """Return this environment in place of the one that is asked for."""
    print(f"gymnax.make({name!r}) returns {FiveValueEnv.name} (gymnax {metadata.version('gymnax')})", flush=True)
    env = FiveValueEnv()
    return env, env.default_params


def main() -> None:
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        raise SystemExit(f"{__doc__}\n{sys.argv[0]}: give the path of a script")
    gymnax.make = make
    sys.argv = sys.argv[1:]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
    tick = time.perf_counter()
    runpy.run_path(sys.argv[0], run_name="__main__")
    print(f"{Path(sys.argv[0]).name}: {time.perf_counter() - tick:.1f} s, with compilation")


if __name__ == "__main__":
    main()
