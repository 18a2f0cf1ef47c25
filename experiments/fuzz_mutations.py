"""Mutations of text files: damage to their bytes, and edits of what they say, written again with any value."""

import copy
import csv
import io
import json
import tomllib
from collections.abc import Callable
from random import Random
from typing import Any
from xml.etree import ElementTree


class Raw(str):
    """Text that the writers write as it is, without quotes."""

    __slots__ = ()


NUMBERS: tuple[Any, ...] = (
    *(float("nan"), float("inf"), float("-inf"), -0.0, 0, 1, -1, 2, 0.5, -0.5, 1e-300, 1e-320, 1e300, -1e300, 1e30),
    *(2**31 - 1, 2**31, -(2**31) - 1, 2**32, 2**53 + 1, 2**63, -(2**63) - 1, 10**39, 10**41, 3.4e38, 3.5e38, 1e-45),
    *(Raw("1e400"), Raw("-1e999"), Raw("9" * 5000), Raw("1_0"), Raw("+1"), Raw("0x1F"), Raw("1.0e+00"), Raw("٣")),
)
"""Numbers at and beyond the ends of the types that hold them."""

WORDS: tuple[str, ...] = (
    *(
        "",
        " ",
        "x",
        "nan",
        "inf",
        "true",
        "None",
        "0",
        "-1",
        "1e999",
        "٣",
        "\0",
        "a\0b",
        "a\nb",
        "\r",
        "\t",
        "\x1b[31m",
    ),
    *(
        "[bold]x[/nope]",
        "[/]",
        "{0}{x}",
        "%s%n",
        "../../x",
        "/dev/zero",
        "/nowhere/x",
        "~",
        ".",
        "..",
        "-",
        "--",
        "$HOME",
    ),
    *("\ud800", "\udcff", "\u202e", "\ufeff", "é" * 90, "A" * 200, "A" * 10_000, "a.b", "a/b", "=", "a=b", "'", '"'),
    *(
        "nosuch://x",
        "uniform",
        "albany",
        "dqn",
        "none",
        "oldest-first",
        "first_failure",
        "horizon",
        "best",
        "\\",
        "__class__",
    ),
)
"""Texts that have surprised programs."""


def value(rng: Random) -> Any:
    """Return a hostile value."""
    kind = rng.random()
    if kind < 0.45:
        return rng.choice(NUMBERS)
    if kind < 0.75:
        return rng.choice(WORDS)
    if kind < 0.85:
        return rng.choice((True, False, None, Raw("1979-05-27T07:32:00Z"), Raw("07:32:00"), Raw("[[[[")))
    few = [rng.choice(NUMBERS) for _ in range(rng.randrange(4))]
    nested: Any = 1
    for _ in range(rng.choice((3, 39, 41, 60))):
        nested = [nested] if rng.random() < 0.5 else {"a": nested}
    return rng.choice(([], {}, [[]], few, [few, few], [rng.choice(WORDS)], {"a": few}, {"": 0}, nested, [0] * 2000))


def write(data: Any, form: str) -> str:
    """Write data as ``json`` or ``toml``, with NaN, infinity and anything else."""
    if isinstance(data, Raw):
        return str(data)
    if isinstance(data, dict):
        sign = ": " if form == "json" else " = "
        return "{" + ", ".join(f"{json.dumps(str(key))}{sign}{write(part, form)}" for key, part in data.items()) + "}"
    if isinstance(data, list | tuple):
        return "[" + ", ".join(write(part, form) for part in data) + "]"
    if isinstance(data, float) and form == "toml":
        return repr(data)
    if isinstance(data, str):
        return json.dumps(data, ensure_ascii=form == "json")
    return json.dumps(data) if data is None or isinstance(data, bool | int | float) else json.dumps(str(data))


def write_toml(data: dict[str, Any]) -> str:
    """Write a document, a line for each of its keys."""
    return "".join(
        f"{json.dumps(str(key), ensure_ascii=False)} = {write(part, 'toml')}\n" for key, part in data.items()
    )


def edit(rng: Random, data: Any, times: int | None = None) -> Any:
    """Return a copy of data, parsed from JSON or TOML, with a few edits of its leaves, keys and lists."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3)) if times is None else times):
        places = list(_places(data))
        if not places:
            return value(rng)
        _edit_place(rng, places, *rng.choice(places))
    return data


def _places(data: Any) -> Any:
    """Yield every container and key inside data."""
    if isinstance(data, dict | list):
        for key in list(data) if isinstance(data, dict) else range(len(data)):
            yield data, key
            yield from _places(data[key])


def _edit_place(rng: Random, places: list[tuple[Any, Any]], container: Any, key: Any) -> None:
    old, what = container[key], rng.randrange(10)
    other, other_key = rng.choice(places)
    if what == 0:
        del container[key]
    elif what == 1:
        container[key] = copy.deepcopy(other[other_key])
    elif what == 2 and isinstance(container, dict):
        container[rng.choice((*WORDS, f"{key}_", str(key).upper(), str(other_key)))] = container.pop(key)
    elif what == 3 and isinstance(container, dict):
        container[rng.choice((*WORDS, f"{key}_"))] = copy.deepcopy(old)
    elif what == 3:
        container.insert(rng.randrange(len(container) + 1), copy.deepcopy(old))
    elif what == 4 and isinstance(old, int | float) and not isinstance(old, bool):
        container[key] = rng.choice(
            (-old, old + 1, old - 1, old * 2, old / 3, float(old), old * 1e6, old * 1e-6, old * 1e30)
        )
    elif what == 5 and isinstance(old, list):
        container[key] = rng.choice((old[::-1], old[:1], old * 2, [*old, *old[:1]], old * 200, [old], old[1:]))
    elif what == 6:
        container[key] = rng.choice(([old], {"a": old}, str(old), [old, old], {key: old}, [[old]]))
    else:
        container[key] = value(rng)


TOKENS: tuple[bytes, ...] = (
    *(
        b"\0",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"\xc3",
        b"\xed\xa0\x80",
        b"\n",
        b"\r",
        b'"',
        b"'",
        b'"""',
        b"#",
        b"=",
        b",",
    ),
    *(b";", b"\t", b"[", b"]", b"[[", b"{", b"}", b"[" * 20_000, b"{a=" * 3000, b"a." * 5000 + b"b=1\n", b"9" * 5000),
    *(b"nan", b"inf", b"NaN", b"-Infinity", b"1e999", b"1e-320", b"-1", b"null", b"true", b"<", b">", b"&x;", b"]]>"),
    *(b"<!--", b"A" * 140_000),
)
"""Pieces that are inserted into files."""


def damage(rng: Random, content: bytes, others: list[bytes]) -> bytes:
    """Return a file with a few of its bytes flipped, cut out, repeated, replaced or taken from another file."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        to = min(len(data), at + rng.choice((1, 1, 2, 8, 64, 1000)))
        what = rng.randrange(7)
        if what == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif what == 1 and at < len(data):
            data[at] = rng.randrange(256)
        elif what == 2:
            del data[at:to]
        elif what == 3:
            data[at:at] = data[at:to] * rng.choice((1, 1, 2, 50))
        elif what == 4:
            data[at:at] = rng.choice(TOKENS)
        elif what == 5 and rng.random() < 0.4:
            del data[at:]
        else:
            other = rng.choice(others)
            cut = rng.randrange(len(other) + 1)
            data[at:to] = other[cut : cut + rng.choice((1, 16, 200))]
    return bytes(data)


def _whole(rng: Random, content: bytes) -> bytes:
    """Return a file that is something else altogether."""
    text = content.decode("utf-8", "replace")
    wholes: tuple[Callable[[], bytes], ...] = (
        *(lambda: b"", lambda: b"\n", lambda: b"x", lambda: bytes(100), lambda: b"\xef\xbb\xbf" + content),
        *(lambda: text.encode("utf-16"), lambda: text.encode("utf-32"), lambda: text.upper().encode()),
        *(lambda: content.replace(b"\n", b"\r\n"), lambda: content.replace(b"\n", b"\r")),
        *(lambda: b"[]", lambda: b"null", lambda: b"1", lambda: b'"x"', lambda: b"{}", lambda: b"[" * 200_000),
        *(lambda: b'{"a":' * 30_000, lambda: content * 50, lambda: content * 2, lambda: b"PK\x03\x04" + content),
        *(lambda: b"a = " + b"[" * 20_000 + b"]" * 20_000, lambda: b"a = " + b"9" * 5000),
    )
    return rng.choice(wholes)()


def _mutator(edited: Callable[[Random, bytes], bytes]) -> Callable[[Random, list[bytes]], bytes]:
    """Return a mutation of files of one format: mostly edits of what they say, else damage."""

    def mutate(rng: Random, seeds: list[bytes]) -> bytes:
        content, kind = rng.choice(seeds), rng.random()
        if kind < 0.03:
            return _whole(rng, content)
        if kind < 0.35:
            return damage(rng, content, seeds)
        content = edited(rng, content)
        return damage(rng, content, seeds) if kind > 0.97 else content

    return mutate


def _edit_toml(rng: Random, content: bytes) -> bytes:
    data = edit(rng, tomllib.loads(content.decode()))
    text = write_toml(data) if isinstance(data, dict) else write(data, "toml")
    return text.encode("utf-8", "surrogatepass")


def _edit_json(rng: Random, content: bytes) -> bytes:
    return write(edit(rng, json.loads(content)), "json").encode("utf-8", "surrogatepass")


def _edit_csv(rng: Random, content: bytes) -> bytes:
    rows = edit(rng, list(csv.reader(io.StringIO(content.decode(), newline=""))))
    rows = [row if isinstance(row, list) else [row] for row in rows] if isinstance(rows, list) else [[rows]]
    file, cell = io.StringIO(newline=""), rng.choice((None, None, None, "A" * 140_000, "'\"'", "1;2"))
    if cell is not None and rows and rows[-1]:
        rows[-1][-1] = cell
    try:
        csv.writer(file, delimiter=rng.choice(",,,,;\t|")).writerows(rows)
    except csv.Error:
        return damage(rng, content, [content])
    return file.getvalue().encode("utf-8", "surrogatepass")


def _edit_xml(rng: Random, content: bytes) -> bytes:
    root = ElementTree.fromstring(content)
    for _ in range(rng.choice((1, 1, 2, 3))):
        parents = [one for one in root.iter() if len(one)] or [root]
        element, parent = rng.choice(list(root.iter())), rng.choice(parents)
        child = rng.choice(list(parent)) if len(parent) else element
        hostile = str(rng.choice((*NUMBERS, *WORDS)))
        what = rng.randrange(8)
        if what < 4 and element.attrib:
            name = rng.choice(list(element.attrib))
            element.set(name, rng.choice((hostile, hostile, f"-{element.get(name)}", f"{element.get(name)}9")))
            if what == 3:
                del element.attrib[name]
        elif what == 4 and child is not element:
            parent.remove(child)
        elif what == 5:
            parent.insert(0, copy.deepcopy(child))
        elif what == 6:
            element.tag = rng.choice(("node", "edge", "lane", "x", "xi:include", "configuration", root.tag, "a" * 3000))
        else:
            rng.choice(parents).append(copy.deepcopy(rng.choice((child, rng.choice(parents)))))
    text = ElementTree.tostring(root, encoding="unicode")
    encoding = rng.choice(("utf-8",) * 9 + ("utf-16", "latin-1", "nosuch", "utf-7", "cp037", "idna", "hex", "rot13"))
    head = f'<?xml version="1.0" encoding="{encoding}"?>\n' if rng.random() < 0.5 or encoding != "utf-8" else ""
    doctype = '<!DOCTYPE x [<!ENTITY a "b"><!ENTITY c "&a;&a;">]>\n' if rng.random() < 0.02 else ""
    return (head + doctype + text).encode("utf-16" if encoding == "utf-16" else "utf-8", "surrogatepass")


mutate_toml = _mutator(_edit_toml)
mutate_json = _mutator(_edit_json)
mutate_csv = _mutator(_edit_csv)
mutate_xml = _mutator(_edit_xml)
