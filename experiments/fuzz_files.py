"""Every kind of file that the package reads: where its inputs lie, and how they are mutated."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from fuzz_archives import mutate_archive
from fuzz_corpus import library
from fuzz_judge import INFINITE
from fuzz_loaders import (
    make_restorer,
    use_evacuation,
    use_finished,
    use_place,
    use_policy,
    use_scenario,
    use_search,
    use_shard,
    use_space,
    use_state,
    use_study,
    use_unfinished,
    use_xml,
)
from fuzz_mutations import damage, mutate_csv, mutate_json, mutate_toml, mutate_xml

Mutate = Callable[[Random, list[bytes]], bytes]

_SPECIALS = ("pipe", "device", "folder", "loop", "dangling", "missing")
"""What may stand where a file should be."""

_SPECIAL_SHARE = 0.01


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        weight: share of the inputs.
        file: path of the input in its folder.
        seeds: valid files.
        mutate: makes an input of them.
        load: loads what is in the folder, and uses it a little.
        template: the folder's other files are those of this folder.
        seal: makes the other files fit the input, if chance wants it so.
        may_be_nan: whether NaN has a meaning.
        may_be_infinite: fields in which infinity has a meaning.
        writes: whether a refusal may write, as damaged checkpoints are renamed.
    """

    weight: int
    file: str
    seeds: list[bytes]
    mutate: Mutate
    load: Callable[[Path], Any]
    template: Path | None = None
    seal: Callable[[Random, Path, str], None] | None = None
    may_be_nan: bool = False
    may_be_infinite: frozenset[str] = INFINITE
    writes: bool = False


def place_input(kind: Kind, folder: Path, rng: Random) -> None:
    """Put an input into its folder, which holds the files of the template or an earlier input."""
    path = folder / kind.file
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    special = rng.choice(_SPECIALS) if rng.random() < _SPECIAL_SHARE else ""
    content = kind.mutate(rng, kind.seeds)
    if special == "pipe":
        os.mkfifo(path)
    elif special == "folder":
        path.mkdir()
    elif special in ("device", "loop", "dangling"):
        path.symlink_to({"device": "/dev/zero", "loop": path.name, "dangling": "nothing"}[special])
    elif not special:
        path.write_bytes(content)
        if kind.seal is not None:
            kind.seal(rng, folder, kind.file)


def make_folder(kind: Kind, folder: Path) -> None:
    """Make the folder of a kind anew."""
    shutil.rmtree(folder, ignore_errors=True)
    if kind.template is None:
        folder.mkdir()
    else:
        shutil.copytree(kind.template, folder)


def file_kinds(corpus: Path) -> dict[str, Kind]:
    """Return all kinds of files by name."""
    single, young, finished = corpus / "tables", corpus / "young", corpus / "finished"
    archive = mutate_archive(corpus / "sealed.npz")

    def seeds(*names: str) -> list[bytes]:
        return [(single / name).read_bytes() for name in names]

    def found(folder: Path, pattern: str) -> tuple[str, list[bytes]]:
        path = next(iter(sorted(folder.glob(pattern))))
        return path.relative_to(folder).as_posix(), [path.read_bytes()]

    def of_run(weight: int, folder: Path, pattern: str, mutate: Mutate, load: Callable[..., Any], **more: Any) -> Kind:
        file, files = found(folder, pattern)
        return Kind(weight, file, files, mutate, partial(load, file), folder, **more)

    studies = seeds("tiny.toml") * 4 + library("uavmec_jax.studies")
    spaces = seeds("space.toml") * 4 + library("uavmec_jax.search")
    shard, checkpoint = "shards/*/result-*.npz", "shards/*/checkpoint-*.npz"
    search = partial(use_search, single)
    kinds = {
        "study (TOML)": Kind(45, "tiny.toml", studies, mutate_toml, use_study),
        "search space (TOML)": Kind(25, "space.toml", spaces, mutate_toml, use_space, _only(single, "tiny.toml")),
        "scenario (TOML)": Kind(45, "s.toml", seeds("harbour.toml", "harbour_fleet.toml"), mutate_toml, use_scenario),
        "inventory (CSV)": Kind(35, "s.csv", seeds("village.csv"), mutate_csv, use_scenario),
        "place (TOML)": Kind(35, "p.toml", seeds("albany.toml", "round_lake.toml"), mutate_toml, use_place),
        "evacuation (npz)": Kind(40, "e.npz", seeds("albany.npz", "round_lake.npz"), archive, use_evacuation),
        "policy (npz)": Kind(20, "w.npz", seeds("weights.npz"), archive, use_policy),
        "run plan (JSON)": of_run(25, young, "run_plan.json", _sealed_plan, use_unfinished),
        "study of a run (TOML)": of_run(5, young, "study.toml", mutate_toml, use_unfinished),
        "progress of a shard (JSON)": of_run(5, young, "shards/*/progress-*.json", mutate_json, use_unfinished),
        "result of a shard (npz)": of_run(
            20, young, shard, archive, use_shard, may_be_nan=True, may_be_infinite=INFINITE | {"best_validation"}
        ),
        "checkpoint (npz)": of_run(15, young, checkpoint, archive, make_restorer(young), may_be_nan=True, writes=True),
        "run.json": of_run(15, finished, "run.json", mutate_json, use_finished, may_be_nan=True),
        "agents.csv": of_run(20, finished, "agents.csv", mutate_csv, use_finished, may_be_nan=True, seal=_reseal),
        "curves.npz": of_run(15, finished, "curves.npz", archive, use_finished, may_be_nan=True, seal=_reseal),
        "evaluation.npz": of_run(15, finished, "evaluation.npz", archive, use_finished, may_be_nan=True, seal=_reseal),
        "search.json": of_run(3, corpus / "search", "search.json", mutate_json, search),
        "trials.db": of_run(3, corpus / "search", "trials.db", _damage_database, search),
    }
    for name in ("harbour", "harbour_fleet", "village"):
        load = partial(use_state, corpus / "tables", name)
        kinds[f"state of {name} (JSON)"] = Kind(14, "s.json", seeds(f"{name}_state.json"), mutate_json, load)
    for name in ("osm", "net", "nodes", "edges", "types"):
        load = partial(use_xml, name, corpus / "copy.xml")
        kinds[f"{name} (XML)"] = Kind(10, "m.xml", seeds(f"{name}.xml"), mutate_xml, load)
    return kinds


def _only(folder: Path, name: str) -> Path:
    """Return a folder that holds one file of another."""
    target = folder.with_name(f"with-{Path(name).stem}")
    target.mkdir(exist_ok=True)
    shutil.copy(folder / name, target)
    return target


def _sealed_plan(rng: Random, seeds: list[bytes]) -> bytes:
    """Mutate a run plan; half of those that are objects get a right SHA-256."""
    content = mutate_json(rng, seeds)
    try:
        facts = json.loads(content)
    except (ValueError, RecursionError):
        return content
    if not isinstance(facts, dict) or rng.random() < 0.5:
        return content
    text = json.dumps({name: part for name, part in facts.items() if name != "sha256"}, sort_keys=True)
    return json.dumps(facts | {"sha256": hashlib.sha256(text.encode()).hexdigest()}).encode()


def _reseal(rng: Random, folder: Path, file: str) -> None:
    """Give ``run.json`` the right SHA-256 of most of the inputs."""
    run = json.loads((folder / "run.json").read_bytes())
    run["sha256"][file] = hashlib.sha256((folder / file).read_bytes()).hexdigest() if rng.random() < 0.7 else "0" * 64
    (folder / "run.json").write_text(json.dumps(run))


def _damage_database(rng: Random, seeds: list[bytes]) -> bytes:
    return damage(rng, seeds[0], seeds)
