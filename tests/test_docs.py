"""README, docs and the READMEs of the results: their code runs, their commands parse, their links and names exist.

A code block after the HTML comment ``<!-- full -->`` takes long: it runs with the marker ``full`` only. One after
``<!-- client: gymnax -->`` needs that library: it runs where ``tests/clients/test_gymnax.py`` does.
"""

import ast
import re
import shlex
import tomllib
from dataclasses import dataclass
from pathlib import Path

import click
import pytest
import yaml

import uavmec_jax as um
from uavmec_jax.agents.registry import ALGORITHMS
from uavmec_jax.cli import main
from uavmec_jax.planning.heuristics import HEURISTICS
from uavmec_jax.planning.observation import FEATURES
from uavmec_jax.studies.study import shipped_studies

ROOT = Path(__file__).parents[1]
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/*.md", "results/**/README.md", "uavmec_jax/**/*.md")
    for page in ROOT.glob(pattern)
)
STUBS = sorted(stub.relative_to(ROOT).as_posix() for stub in ROOT.glob("uavmec_jax/**/__init__.pyi"))
FOLDERS = ("uavmec_jax", "tests", "experiments", "docs", "results", ".ci")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, the number of its first line, whether it takes long, and its client."""

    language: str
    text: str
    line: int
    full: bool
    client: str | None


def read(page):
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(page, language):
    found = []
    comment = r"(?:<!-- (?:(full)|client: (\w+)) -->\n)?"
    for fence in re.finditer(rf"^{comment}```(\w+)\n(.*?)^```$", read(page), re.MULTILINE | re.DOTALL):
        full, client, written_in, text = fence.groups()
        line = read(page)[: fence.start(4)].count("\n") + 1
        found.append(Block(written_in, text, line, full is not None, client))
    return [block for block in found if block.language == language]


def prose(page):
    """The page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", read(page), flags=re.MULTILINE | re.DOTALL)


def inline_code(page):
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose(page))]


def commands(page):
    """The commands of a page's ``sh`` blocks, as words."""
    for block in blocks(page, "sh"):
        for line in block.text.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            while words:
                end = words.index("&&") if "&&" in words else len(words)
                yield words[:end]
                words = words[end + 1 :]


def execute(page, chosen, folder, monkeypatch):
    """Run the blocks of a page in one namespace; they see the docs and work in a temporary folder."""
    (folder / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(folder)
    namespace = {"__name__": page}
    for block in chosen:
        code = "\n" * (block.line - 1) + block.text  # tracebacks name the line of the page
        exec(compile(code, str(ROOT / page), "exec"), namespace)


def mark(page):
    """Mark the pages whose code compiles for long; the README's always runs."""
    return pytest.param(page, marks=() if page == "README.md" else pytest.mark.slow)


def ours(page):
    """The page's code that needs no client."""
    return [block for block in blocks(page, "python") if block.client is None]


@pytest.mark.parametrize("page", [mark(page) for page in PAGES if not all(block.full for block in ours(page))])
def test_code_runs(page, tmp_path, monkeypatch):
    execute(page, [block for block in ours(page) if not block.full], tmp_path, monkeypatch)


@pytest.mark.full
@pytest.mark.parametrize("page", [page for page in PAGES if any(block.full for block in ours(page))])
def test_all_code_runs(page, tmp_path, monkeypatch):
    execute(page, ours(page), tmp_path, monkeypatch)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "sh")])
def test_commands_parse(page):
    for words in commands(page):
        if "uavmec" in words:
            parse(words[words.index("uavmec") + 1 :])
        for word in words:
            if word.startswith("experiments/"):
                options = {option.split("=")[0] for option in words if option.startswith("--")} - {
                    "--group",
                    "--no-default-groups",
                    "--extra",
                }
                source = read(word)
                assert [option for option in options if f'"{option}"' not in source] == [], words


def parse(words):
    """Parse a command line without running it: click refuses unknown commands, options and values."""
    command, name = main, "uavmec"
    while isinstance(command, click.Group) and not words[0].startswith("-"):
        name, *words = words
        command = command.commands[name]
    if words != ["--help"]:
        command.make_context(name, list(words))


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_exist(page):
    for code in inline_code(page):
        name, *words = code.split()
        if name != "uavmec" or not words or words[0].isupper() or words[0] == "...":
            continue
        command = main
        while isinstance(command, click.Group) and words and not words[0].startswith("-"):
            command = command.commands[words.pop(0)]
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        used = {word.split("=")[0] for word in words if word.startswith("--")}
        assert used <= {*known, "--help"}, code


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" not in target:
            file, _, heading = target.partition("#")
            path = ((ROOT / page).parent / file) if file else ROOT / page
            assert path.exists(), target
            if heading:
                headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
                assert heading in [re.sub(r"[^\w -]", "", text).lower().replace(" ", "-") for text in headings], target


@pytest.mark.parametrize("page", PAGES)
def test_files_that_are_named_exist(page):
    words = [word for code in inline_code(page) for word in code.split()]
    words += [word for command in commands(page) for word in command]
    for word in words:
        if word.split("/")[0] in FOLDERS and "/" in word and not any(mark in word for mark in ("...", "NAME", "*")):
            assert (ROOT / word).exists(), word


def names_of(stub):
    """The public names of a stub."""
    imports = [node for node in ast.parse(read(stub)).body if isinstance(node, ast.ImportFrom)]
    return {alias.asname for node in imports for alias in node.names}


@pytest.mark.parametrize("stub", STUBS)
def test_every_public_name_is_in_the_api_page(stub):
    room = ".".join(("um", *Path(stub).parts[1:-1]))
    section = re.split(r"^## ", read("docs/api.md"), flags=re.MULTILINE)
    text = next(part for part in section if part.startswith(f"{room}\n"))
    listed = set(re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE))
    also = re.search(r"(?:Also here|The rooms): (.*?)\.\s", text, re.DOTALL)
    listed |= set(re.findall(r"`(\w+)`", also[1])) if also else set()
    assert listed == names_of(stub)


def table_column(page, heading, column=0):
    """The code in one column of the first table under a heading."""
    text = read(page)[read(page).index(heading) :]
    rows = re.findall(r"^\|(.*)\|$", text, re.MULTILINE)
    text = text[text.index(f"|{rows[0]}|") :].split("\n\n")[0]
    cells = [row.split("|")[column] for row in re.findall(r"^\|(.*)\|$", text, re.MULTILINE)[2:]]
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


def test_tables_list_what_there_is():
    assert table_column("docs/planning.md", "## The heuristics") == list(HEURISTICS)
    assert table_column("docs/generalist.md", "## What it observes") == [feature.name for feature in FEATURES]
    assert sorted(table_column("docs/studies.md", "These studies ship")) == sorted(shipped_studies())


@pytest.mark.parametrize("name", ALGORITHMS)
def test_settings_of_every_algorithm_are_listed(name):
    row = re.search(rf"^\| `{name}` \|(.*)\|(.*)\|$", read("docs/studies.md"), re.MULTILINE)
    traced, static = (re.findall(r"`(\w+)`", cell) for cell in row.groups())
    if row[1].startswith(" as `"):
        like, *without = traced
        traced = [setting for setting in ALGORITHMS[like].traced if setting not in without]
    assert sorted(traced) == sorted(ALGORITHMS[name].traced)
    assert sorted(static) == sorted(ALGORITHMS[name].static)


def test_readme_is_short_and_ci_runs_its_test_command():
    assert len(read("README.md").splitlines()) < 100
    command = next(block.text for block in blocks("README.md", "sh") if "pytest" in block.text).splitlines()[-1]
    assert command in read(".ci/run")


def test_the_citation_is_of_this_version():
    facts = yaml.safe_load(read("CITATION.cff"))
    project = tomllib.loads(read("pyproject.toml"))["project"]
    assert (
        (facts["version"], facts["license"])
        == (project["version"], project["license"])
        == (um.__version__, "Apache-2.0")
    )
    assert facts["keywords"] == project["keywords"]
    for form in ROOT.glob(".github/ISSUE_TEMPLATE/*.yml"):
        assert {"name", "description", "body"} == set(yaml.safe_load(form.read_text()))
