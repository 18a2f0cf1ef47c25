"""Train the generalist and put it into the package, where `um.load_policy("generalist")` loads it.

    uv run python experiments/ship_generalist.py [--run runs/generalist] [--into FILE]

Runs the study `generalist`, or resumes its run, takes the agent that is best on the validation scenarios, and writes its best
weights as a policy file. Its model card is `uavmec_jax/scenarios/library/generalist.md`.
"""

import argparse
from pathlib import Path

from uavmec_jax.runs.run import run_or_resume
from uavmec_jax.scenarios.policies import TrainedPolicy, load_policy
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host

SHIPPED = Path(__file__).parents[1] / "uavmec_jax" / "scenarios" / "library" / "generalist.npz"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, default=Path("runs/generalist"), help="folder of the run")
    parser.add_argument("--into", type=Path, default=SHIPPED, help="policy file that is written")
    parser.add_argument("--steps", type=int, help="environment steps of one agent (default: the study's)")
    arguments = parser.parse_args()
    host.use_all_cores()

    study = load_study("generalist", {"steps": arguments.steps} if arguments.steps else {})
    results = run_or_resume(study, arguments.run, command="uv run python experiments/ship_generalist.py")
    best = results.agents.loc[results.agents["best_validation"].idxmax()]
    policy = load_policy(arguments.run, "best", seed=int(best["seed"]))
    assert isinstance(policy, TrainedPolicy)
    policy.save(arguments.into)
    table = results.agents[["seed", "best_step", "best_validation", "best_lifetime", "oldest_first_lifetime"]]
    print(table.to_string(index=False))
    print(f"seed {best['seed']} -> {arguments.into}, {arguments.into.stat().st_size:,} bytes; {results.run['seconds']}")


if __name__ == "__main__":
    main()
