"""The rooms of the package and the imports between them: a picture, and counts.

    uv run python experiments/draw_imports.py [--root .] [--out imports.png]

A room is a folder of `uavmec_jax/` or a single module beside them. In the picture the rooms stand above each other so that as
few imports as possible go up: those that go down are arcs on the right, those that go up are red arcs on the left. Works on
every checkout of the package, which need not be installed.
"""

import argparse
import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "uavmec_jax"
NO_ROOM = ("", "__main__", "_version")
"""Modules beside the rooms that are none: the list of public names, `python -m uavmec_jax`, the version."""

ORDER = (
    *("cli", "interop", "reporting", "search", "runs", "studies", "scenarios", "training", "learning", "agents"),
    *("planning", "traffic", "env", "world", "cluster", "files", "errors"),
)
"""The rooms from top to bottom, with those of older checkouts; others stand above them."""

_LAYOUT_TOKENS = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT),
    *(tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER),
}


@dataclass(frozen=True)
class Import:
    """One name or module that a module imports.

    Attributes:
        importer: module, dotted.
        imported: module, dotted; a name of the package is resolved to the module that holds it.
        function: where the import stands, empty at module level.
        typing_only: whether it stands under ``if TYPE_CHECKING``.
    """

    importer: str
    imported: str
    function: str
    typing_only: bool


def modules(root: Path) -> dict[str, Path]:
    """Return the modules of the package under ``root``: dotted name -> file."""
    files = sorted((root / PACKAGE).rglob("*.py"))
    names = (file.relative_to(root).with_suffix("").parts for file in files)
    return {".".join(parts).removesuffix(".__init__"): file for parts, file in zip(names, files, strict=True)}


def room_of(module: str) -> str:
    """Return the room of a module, empty for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def read_imports(root: Path) -> list[Import]:
    """Read all imports of all modules, also those of other packages."""
    known = modules(root)
    return [
        item
        for module, file in known.items()
        for item in _imports(module, ast.parse(file.read_text(encoding="utf-8")), known, file.name == "__init__.py")
    ]


def _imports(module: str, tree: ast.AST, known: dict[str, Path], is_package: bool) -> Iterator[Import]:
    def visit(node: ast.AST, function: str, typing_only: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                yield from visit(child, child.name, typing_only)
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                yield from visit(child, function, True)
            elif isinstance(child, ast.Import):
                for alias in child.names:
                    yield Import(module, alias.name, function, typing_only)
            elif isinstance(child, ast.ImportFrom):
                above = module.split(".")[: len(module.split(".")) - child.level + is_package] if child.level else []
                source = ".".join([*above, *filter(None, [child.module])])
                for alias in child.names:
                    name = f"{source}.{alias.name}"
                    yield Import(module, name if name in known else source, function, typing_only)
            else:
                yield from visit(child, function, typing_only)

    yield from visit(tree, "", False)


def count_between_rooms(imports: list[Import]) -> tuple[Counter[tuple[str, str]], Counter[tuple[str, str]]]:
    """Count pairs of modules by their rooms ``(importer, imported)``: at module level, and inside functions only."""
    counts: tuple[Counter, Counter] = (Counter(), Counter())
    pairs: dict[tuple[str, str], bool] = {}
    for item in imports:
        rooms = room_of(item.importer), room_of(item.imported)
        is_internal = item.imported.split(".")[0] == PACKAGE
        if is_internal and not item.typing_only and rooms[0] != rooms[1] and not set(rooms) & set(NO_ROOM):
            pair = item.importer, item.imported
            pairs[pair] = pairs.get(pair, True) and bool(item.function)
    for (importer, imported), inside in pairs.items():
        counts[inside][room_of(importer), room_of(imported)] += 1
    return counts


def order_rooms(rooms: list[str], counts: Counter[tuple[str, str]]) -> list[str]:
    """Order rooms from top to bottom so that as few imports as possible go up, then as near to :data:`ORDER` as possible.

    Exact, by dynamic programming over the sets of rooms that are at the bottom.
    """
    wish = {room: ORDER.index(room) if room in ORDER else -1 for room in rooms}
    best: dict[frozenset[str], tuple[int, int, tuple[str, ...]]] = {frozenset(): (0, 0, ())}
    for _ in rooms:
        larger: dict[frozenset[str], tuple[int, int, tuple[str, ...]]] = {}
        for below, (up, swaps, stack) in best.items():
            for room in set(rooms) - below:  # on top of those below: what they import from it goes up
                now = (
                    up + sum(counts[other, room] for other in below),
                    swaps + sum(wish[other] < wish[room] for other in below),
                    (room, *stack),
                )
                key = below | {room}
                larger[key] = min(larger.get(key, now), now)
        best = larger
    return list(best[frozenset(rooms)][2])


def count_lines(root: Path) -> tuple[Counter[str], Counter[str]]:
    """Count lines of each room: all of them, and those that hold code (no comments, docstrings or blank lines)."""
    total: Counter[str] = Counter()
    code: Counter[str] = Counter()
    for module, file in modules(root).items():
        text = file.read_text(encoding="utf-8")
        total[room_of(module)] += len(text.splitlines())
        code[room_of(module)] += len(_code_lines(text))
    return total, code


def _code_lines(text: str) -> set[int]:
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _LAYOUT_TOKENS:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


_BEND, _UNIT_IN = 0.8, 0.55
"""How far arcs bend, twice the share of their length; inches from room to room."""


def draw(rooms: list[str], counts: Counter, inside: Counter, lines: Counter[str], title: str, path: Path) -> None:
    """Draw rooms from top to bottom and an arc for each pair of rooms with imports; dashed: inside functions only."""
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyArrowPatch

    height = {room: len(rooms) - place for place, room in enumerate(rooms)}
    edge, reach = 0.8, 0.8 + _BEND / 2 * len(rooms)  # of the boxes, and of the arcs
    upwards = any(height[importer] < height[imported] for importer, imported in counts + inside)
    left = reach if upwards else edge + 0.1
    figure = Figure(figsize=(_UNIT_IN * (left + reach), _UNIT_IN * (len(rooms) + 1.5)), layout="constrained")
    axes = figure.subplots()
    axes.set_aspect("equal")
    for room in rooms:
        axes.text(0, height[room], f"{room}\n{lines[room]:,} lines", ha="center", va="center", fontsize=8, zorder=3,
                  bbox={"boxstyle": "round", "fc": "white", "ec": "0.3"})  # fmt: skip
    for pairs, style in ((counts, "-"), (inside, "--")):
        for (importer, imported), count in pairs.items():
            up = height[importer] < height[imported]
            side = -edge if up else edge
            arrow = FancyArrowPatch(
                (side, height[importer]),
                (side, height[imported]),
                connectionstyle=f"arc3,rad={-_BEND}",  # to the right on the way down, to the left on the way up
                arrowstyle="-|>",
                mutation_scale=8,
                linestyle=style,
                linewidth=0.5 + count**0.5 / 3,
                color="tab:red" if up else "tab:blue",
                alpha=0.9 if up else 0.45,
            )
            axes.add_patch(arrow)
    axes.set(xlim=(-left, reach), ylim=(0.4, len(rooms) + 0.6))
    axes.set_title(title, fontsize=8)
    axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Print the counts and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(), help="the checkout")
    parser.add_argument("--out", type=Path, help="picture: .png, .svg or .pdf")
    arguments = parser.parse_args()
    counts, inside = count_between_rooms(read_imports(arguments.root))
    total, code = count_lines(arguments.root)
    rooms = order_rooms([room for room in total if room not in NO_ROOM], counts + inside)
    print(f"{'room':12}{'lines':>8}{'code':>8}   imports from (pairs of modules; in brackets: inside functions only)")
    for room in rooms:
        targets = [other for other in rooms if counts[room, other] or inside[room, other]]
        words = [
            f"{other} {counts[room, other]}" + (f" ({inside[room, other]})" if inside[room, other] else "")
            for other in targets
        ]
        print(f"{room:12}{total[room]:8,}{code[room]:8,}   {', '.join(words)}")
    height = {room: -place for place, room in enumerate(rooms)}
    up = Counter({pair: count for pair, count in (counts + inside).items() if height[pair[0]] < height[pair[1]]})
    summary = (
        f"{sum(counts.values())} imports between rooms and {sum(inside.values())} inside functions only; "
        f"{sum(up.values())} go up\n{sum(total.values()):,} lines, {sum(code.values()):,} of code"
    )
    print(summary)
    for (importer, imported), count in up.items():
        print(f"up: {importer} imports {imported} {count} times")
    if arguments.out:
        draw(rooms, counts, inside, total, summary, arguments.out)


if __name__ == "__main__":
    main()
