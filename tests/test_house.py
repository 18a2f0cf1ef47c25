"""The rooms of the package: imports go down, `env` is pure JAX, and no import is hidden in a function to go up."""

import ast
import graphlib
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "experiments" / "draw_imports.py"
house = runpy.run_path(str(SCRIPT))
PACKAGE, modules, room_of = house["PACKAGE"], house["modules"], house["room_of"]
MODULES = modules(ROOT)
IMPORTS = house["read_imports"](ROOT)
OURS = [one for one in IMPORTS if one.imported.split(".")[0] == PACKAGE]

ORDER = (
    *("cli", "interop", "reporting", "search", "runs", "studies", "scenarios", "training", "agents", "planning"),
    *("traffic", "env", "cluster", "files", "errors"),
)
"""The rooms from top to bottom."""

INSIDE_FUNCTIONS = {
    "interop.gymnasium_env": ("uavmec_jax.reporting.map_figure",),  # matplotlib, for those who render
    "env.gymnax_spaces": ("gymnax.environments",),  # the caller's library
    "cluster.local": ("ray",),  # of the extra `ray`
    "cluster.worker": ("ray",),  # of the extra `ray`
    "search.folder": ("sqlalchemy", "sqlalchemy.exc"),  # of the extra `search`
    "traffic.worker": ("libsumo",),  # of the extra `traffic`
}
"""Modules with imports inside functions, beside `cli`, where they are for the sake of the start-up time."""


def test_every_room_has_its_place():
    assert {room_of(module) for module in MODULES} - set(house["NO_ROOM"]) == set(ORDER)


@pytest.mark.parametrize("room", ORDER)
def test_a_room_imports_only_rooms_below(room):
    below = {room, *ORDER[ORDER.index(room) + 1 :], "_version"}
    wrong = [(one.importer, one.imported) for one in OURS if room_of(one.importer) == room]
    assert [pair for pair in wrong if room_of(pair[1]) not in below] == []


def test_no_circle_between_modules():
    graph = {module: set() for module in MODULES}
    for one in OURS:
        if one.importer != PACKAGE and one.imported != one.importer:
            graph[one.importer].add(one.imported)
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError, which names the modules


def test_env_is_pure_jax():
    imported = {one.imported for one in IMPORTS if room_of(one.importer) == "env"}
    ours = {room_of(module) for module in imported if module.split(".")[0] == PACKAGE}
    assert ours <= {"env", "errors"}
    others = {module.split(".")[0] for module in imported} - {PACKAGE}
    assert others & {"pydantic", "pathlib", "os", "io", "json", "tomllib", "csv", "importlib", "shutil"} == set()
    for module, file in MODULES.items():
        if room_of(module) == "env":
            names = {node.id for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Name)}
            assert "open" not in names, module


def test_processes_of_ours_never_import_from_the_folder_that_they_start_in():
    """Every command that starts Python goes on with -P, or -I where the standard library is enough."""
    started = 0
    for module, file in MODULES.items():
        tree = ast.parse(file.read_text())
        names = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr == "executable"]
        commands = [
            node.elts
            for node in ast.walk(tree)
            if isinstance(node, ast.List) and any(element in names for element in node.elts)
        ]
        assert len(commands) == len(names), f"{module}: sys.executable is used outside a list of arguments"
        for python, option, *_ in commands:
            assert python in names, module
            assert isinstance(option, ast.Constant), module
            assert option.value in ("-P", "-I"), module
        started += len(commands)
        imported = {one.imported.split(".")[0] for one in IMPORTS if one.importer == module}
        assert not {"multiprocessing", "runpy"} & imported, module
    assert started >= 3


def test_imports_inside_functions_are_listed():
    found: dict[str, set[str]] = {}
    for one in IMPORTS:
        if one.function and room_of(one.importer) != "cli":
            found.setdefault(one.importer.removeprefix(f"{PACKAGE}."), set()).add(one.imported)
    assert found == {module: set(imported) for module, imported in INSIDE_FUNCTIONS.items()}


READERS = {
    *("open", "read_text", "read_bytes", "read_csv", "read_json", "read_excel", "read_table", "fromfile", "loadtxt"),
    *("genfromtxt", "memmap", "fdopen", "mmap"),
}
"""Functions and methods that open a file to read it, under any object's name."""

PARSERS = {
    *("np.load", "numpy.load", "json.load", "tomllib.load", "tomllib.loads", "pickle.load", "pickle.loads"),
    *("csv.reader", "csv.DictReader", "zipfile.ZipFile", "gzip.open", "bz2.open", "lzma.open", "os.open", "io.open"),
    *("ET.parse", "ElementTree.parse", "defusedxml.sax.parse"),
}

OPENS_ITS_OWN = {
    "runs.log": {"os.open", "os.fdopen"},  # appends to its own log
    "studies.results_files": {"pd.read_csv"},  # of bytes that were read in `files`
    "traffic.worker": {"Path(sys.argv[1]).read_text", "ElementTree.parse"},  # SUMO's child process, on our own files
    "training.host": {"open", "file.read_bytes"},  # /proc/cpuinfo; the package's own source
}
"""Modules outside `files` that open files which nobody hands in -> how."""


def test_only_the_room_files_reads_files():
    found: dict[str, set[str]] = {}
    for module, file in MODULES.items():
        if room_of(module) == "files":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Call) and _opens_a_file(name := ast.unparse(node.func)):
                found.setdefault(module.removeprefix(f"{PACKAGE}."), set()).add(name)
    assert found == OPENS_ITS_OWN


def _opens_a_file(name: str) -> bool:
    owner, _, method = name.rpartition(".")
    if owner in ("RunFolder", "webbrowser") or (not owner and method != "open"):  # a bare read_text is ours
        return False
    return method in READERS or name in PARSERS


def test_the_picture_is_drawn(tmp_path):
    command = [sys.executable, SCRIPT, "--root", ROOT, "--out", tmp_path / "imports.png"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "; 0 go up\n" in done.stdout
    assert (tmp_path / "imports.png").stat().st_size > 10_000


def test_the_order_of_an_unknown_checkout_has_as_few_imports_up_as_possible(tmp_path):
    package = tmp_path / PACKAGE
    package.mkdir()
    for room, text in {
        "a": "from uavmec_jax import b, d",
        "b": "from uavmec_jax import c",
        "c": "import uavmec_jax.a",
    }.items():
        (package / f"{room}.py").write_text(text)
    (package / "d.py").write_text("def f():\n    from uavmec_jax import a\n    from . import c\n")
    counts, inside = house["count_between_rooms"](house["read_imports"](tmp_path))
    assert counts == {("a", "b"): 1, ("a", "d"): 1, ("b", "c"): 1, ("c", "a"): 1}
    assert inside == {("d", "a"): 1, ("d", "c"): 1}
    order = house["order_rooms"](["a", "b", "c", "d"], counts + inside)
    assert sum(order.index(importer) > order.index(imported) for importer, imported in counts + inside) == 2
