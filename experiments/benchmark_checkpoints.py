"""Checkpoints of a shard in training: our archive and Orbax compared by time, size and detection of flipped bits.

    uv run python experiments/benchmark_checkpoints.py --out results/checkpoints

The state is that of a shard of DQN agents with filled replay buffers. Both formats save and restore it in turn, repetition by
repetition; then a copy of each checkpoint gets one bit flipped at a random place, many times, and is restored. A flip is
*silent* if nothing is raised and the restored state differs.
"""

import argparse
import contextlib
import logging
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from reports import write_report

from uavmec_jax.errors import StudyError
from uavmec_jax.files.archives import open_checked, write_checked
from uavmec_jax.studies.population import make_agents, make_algorithm, validation_keys
from uavmec_jax.studies.study import load_study
from uavmec_jax.training import host
from uavmec_jax.training.chunks import Validation
from uavmec_jax.training.partition import partition_population
from uavmec_jax.training.population import take_padded
from uavmec_jax.training.training import Trainer, Training

SCHEMA = 1


def start_training(steps: int) -> Training:
    """Train a shard of Table 5, for ``steps`` steps less the last chunk, so that its replay buffers are filled."""
    study = load_study("table5", {"axes.seeds": 2, "steps": steps})
    algorithm, agents = make_algorithm(study), make_agents(study)
    keys = validation_keys(study)
    partition = partition_population(keys.shape[0], algorithm.agent_bytes, host.free_memory())
    members, draws = take_padded((agents, keys), 0, partition.shard_size)
    trainer = Trainer.compile(algorithm, members, draws, Validation(every=steps // 10, chunks=1), partition)
    training = trainer.start(members, draws)
    for _ in training.run(until=len(trainer.chunks) - 1):
        pass
    return training


class Archive:
    """Our checkpoint: one file, CRC-32 for each array and a SHA-256 over all."""

    def save(self, path: Path, training: Training) -> None:
        """Write a checkpoint."""
        path.mkdir()
        write_checked(path / "checkpoint.npz", SCHEMA, {}, training.arrays(), compressed=False)

    def restore(self, path: Path, training: Training) -> None:
        """Check a checkpoint and restore it."""
        with open_checked(path / "checkpoint.npz", SCHEMA, "a checkpoint", StudyError) as (_, arrays):
            training.restore(training.chunks_done, arrays)


class Orbax:
    """Orbax's standard checkpointer with its defaults (OCDBT)."""

    def __init__(self) -> None:
        self._checkpointer = ocp.StandardCheckpointer()

    def save(self, path: Path, training: Training) -> None:
        """Write a checkpoint, and wait until it is committed."""
        self._checkpointer.save(path, state_of(training))
        self._checkpointer.wait_until_finished()

    def restore(self, path: Path, training: Training) -> None:
        """Restore a checkpoint onto the devices."""
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, state_of(training))
        restored = jax.block_until_ready(self._checkpointer.restore(path, abstract))
        for batch, (state, best) in zip(training.group_batches, restored, strict=True):
            batch.state, batch.best = state, best


def state_of(training: Training) -> list[tuple[Any, Any]]:
    """Return what changes on the devices during training."""
    return [(batch.state, batch.best) for batch in training.group_batches]


def flip_bit(path: Path, rng: np.random.Generator) -> str:
    """Flip one random bit of a checkpoint, and return the name of its file; files are chosen in proportion to their sizes."""
    files = sorted(file for file in path.rglob("*") if file.is_file() and file.stat().st_size)
    sizes = np.array([file.stat().st_size for file in files], float)
    file = files[rng.choice(len(files), p=sizes / sizes.sum())]
    with file.open("r+b") as content:
        offset = int(rng.integers(file.stat().st_size))
        content.seek(offset)
        byte = content.read(1)[0]
        content.seek(offset)
        content.write(bytes([byte ^ (1 << int(rng.integers(8)))]))
    return file.name


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Return whether two states have the same bits."""
    return all(np.array_equal(a[name].view(np.uint8), b[name].view(np.uint8)) for name in a)


def measure(training: Training, repetitions: int, flips: int) -> dict[str, Any]:
    """Time both formats in turn, and count the flipped bits that each detects."""
    formats: dict[str, Any] = {"archive": Archive(), "orbax": Orbax()}
    truth = {name: leaf.copy() for name, leaf in training.arrays().items()}
    rows: dict[str, Any] = {name: {"save_s": [], "restore_s": []} for name in formats}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(repetitions):
            for name, kind in formats.items():
                path = Path(folder) / f"{name}-{number}"
                for what, action in (("save_s", kind.save), ("restore_s", kind.restore)):
                    tick = time.perf_counter()
                    action(path, training)
                    rows[name][what].append(time.perf_counter() - tick)
                assert same(truth, training.arrays()), name
                rows[name]["bytes"] = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
                if number:
                    shutil.rmtree(path)
        for name, kind in formats.items():
            rows[name]["flips"] = count_flips(kind, Path(folder) / f"{name}-0", training, truth, flips)
    for row in rows.values():
        for what in ("save_s", "restore_s"):
            row[what] = {"median": float(np.median(row[what])), "all": [round(s, 3) for s in row[what]]}
    return rows


def count_flips(kind: Any, path: Path, training: Training, truth: dict[str, np.ndarray], flips: int) -> dict[str, int]:
    """Restore copies with one flipped bit; count those that are reported, harmless, and silent."""
    counts, rng = {"reported": 0, "harmless": 0, "silent": 0}, np.random.default_rng(0)
    for _ in range(flips):
        copy = path.with_name("flipped")
        shutil.copytree(path, copy)
        flip_bit(copy, rng)
        try:
            kind.restore(copy, training)
            counts["harmless" if same(truth, training.arrays()) else "silent"] += 1
        except Exception:
            counts["reported"] += 1
        shutil.rmtree(copy)
        with contextlib.suppress(Exception):
            kind.restore(path, training)
    return counts


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20_000, help="of one agent: what the replay holds")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--flips", type=int, default=40)
    parser.add_argument("--out", type=Path, help="folder for checkpoints.json")
    arguments = parser.parse_args()
    logging.getLogger("absl").setLevel(logging.ERROR)
    host.use_all_cores()
    rows = measure(start_training(arguments.steps), arguments.repetitions, arguments.flips)
    report = {"command": " ".join(["python", *sys.argv]), "orbax": ocp.__version__, **host.describe(), "formats": rows}
    if arguments.out:
        write_report(arguments.out / "checkpoints.json", report)
    for name, row in rows.items():
        print(
            f"{name:8} {row['bytes'] / 1e6:7.1f} MB  save {row['save_s']['median']:.2f} s  "
            f"restore {row['restore_s']['median']:.2f} s  flipped bits {row['flips']}"
        )


if __name__ == "__main__":
    main()
