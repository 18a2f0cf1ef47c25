"""The paper's Table 6: eleven rewards with DQN, PPO and A2C, in three cells.

    uv run python experiments/table6_rewards.py [--seeds 5] [--steps 1000000]

The same as `uavmec run table6`.
"""

from table5_grid import run

if __name__ == "__main__":
    run("table6", seeds=5, description=__doc__)
