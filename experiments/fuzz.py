"""Mutated inputs of every kind of file and option, and calls with hostile values: nothing may get past the door.

    uv run python experiments/fuzz.py [--inputs 50000] [--calls 2000] [--seed 0] [--work FOLDER] [--out results/fuzz]
    uv run python experiments/fuzz.py --seed 0 --case 'study (TOML):123' --work FOLDER

Every input is accepted, and then holds only finite numbers, or is refused in one printable line of at most 400 characters
with nothing written, within two seconds and 300 MB (a call, which compiles, within a minute). A process works through them;
one that dies or hangs is replaced, and goes on behind the input. An input is made of the seed, its kind and number, and the
valid files alone. The folder of `--work` keeps those, and the inputs that fail; with it, `--case` does one input again, and
shows the traceback. Writes `fuzz.json` and `README.md`.
"""

import argparse
import json
import os
import shlex
import sys
import tempfile
from pathlib import Path

from fuzz_campaign import Campaign, shares
from fuzz_worker import again, corpus_in
from reports import write_report

from uavmec_jax.errors import one_line
from uavmec_jax.files.writing import write_text
from uavmec_jax.training import host


def table(report: dict) -> str:
    """Return the report as a page."""
    head = "| kind | inputs | accepted | refused | failures | slowest, s |\n|---|---:|---:|---:|---:|---:|\n"
    rows = [
        f"| {name} | {row['inputs']:,} | {row['accepted']:,} | {row['refused']:,} | {row['failures']:,} "
        f"| {row['slowest']['seconds']:.2f} |"
        for name, row in (*report["kinds"].items(), ("**all**", report["all"]))
    ]
    failures = [
        f"- {row['what']}, {row['count']} times, first in `{row['first']}`: `{one_line(row['where'])}`: "
        + one_line(row["message"][:200]).replace("`", "'")
        for row in report["failures"]
    ]
    found = "\n".join(failures) or "None."
    return (
        f"# Fuzzing\n\n```sh\n{report['command']}\n```\n\n{__doc__.split(chr(10) * 2)[2].strip()}\n\n{head}"
        + "\n".join(rows)
        + f"\n\n## Failures\n\n{found}\n"
    )


def merged(before: dict, report: dict) -> dict:
    """Return a report in which the kinds that were done again have their new rows."""
    again = report["kinds"]
    kinds = before["kinds"] | again
    failures = [one for one in before["failures"] if one["first"].rpartition(":")[0] not in again]
    rows = kinds.values()
    total = {name: sum(row[name] for row in rows) for name in ("inputs", "accepted", "refused", "failures", "seconds")}
    slowest = max((row["slowest"] for row in rows), key=lambda one: one["seconds"])
    return report | {
        "command": f"{before['command']}\n{report['command']}",
        "kinds": kinds,
        "all": total | {"slowest": slowest},
        "failures": failures + report["failures"],
    }


def main() -> None:
    """Fuzz, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=50_000, help="mutated files and command lines")
    parser.add_argument("--calls", type=int, default=2000, help="Python calls")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", nargs="*", help="only kinds whose names hold one of these; in OUT, other rows stay")
    parser.add_argument("--case", help="one input, KIND:NUMBER, again, with its traceback")
    parser.add_argument("--work", type=Path, help="folder that keeps the valid files and the inputs that fail")
    parser.add_argument("--out", type=Path, help="folder of fuzz.json and README.md")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="uavmec-fuzz-") as temporary:
        work = (arguments.work or Path(temporary)).absolute()
        if arguments.case:
            print(again(arguments.case, arguments.seed, work))
            return
        tasks = shares(arguments.inputs, arguments.calls, corpus_in(work), arguments.kinds)
        report = Campaign(arguments.seed, work, lambda line: print(line, flush=True)).run(tasks)
    machine = {name: value for name, value in host.describe().items() if name != "free_memory_gib"}
    # the folder of this machine that keeps the inputs says nothing to others
    words = ["FOLDER" if word == str(arguments.work) else word for word in sys.argv[1:]]
    command = shlex.join(["python", os.path.relpath(sys.argv[0]), *words])
    report = {"command": command, "seed": arguments.seed, **report, **machine}
    if arguments.out and arguments.kinds and (arguments.out / "fuzz.json").exists():
        report = merged(json.loads((arguments.out / "fuzz.json").read_text(encoding="utf-8")), report)
    if arguments.out:
        write_report(arguments.out / "fuzz.json", report)
        write_text(arguments.out / "README.md", table(report))
    total = report["all"]
    print(f"{total['inputs']:,} inputs, {total['failures']:,} failures in {len(report['failures'])} places")


if __name__ == "__main__":
    main()
