"""Damaged inputs for `fuzz.py`.

Each function has as arguments a generator of random numbers, the content, and another content of
the same kind as a source of parts; it returns new content. The same random numbers give the same
content. Most changes keep the grammar, so that they reach the readers behind the parser; some
change bytes.
"""

from __future__ import annotations

import copy
import io
import json
import random
import re
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import polars
import yaml
from scipy.io import savemat

from drake_teleop.common.parquet_sizes import check_parquet_content_sizes
from drake_teleop.logs.read.array_files import read_mat

Mutation = Callable[[random.Random, bytes, bytes], bytes]

NUMBERS = (
    *("0", "-0.0", "1", "-1", "2", "3.0", "0.5", "1e-9", "5e-324", "1e5", "1e25", "-1e25", "1e300"),
    *("-1e308", "1e400", "nan", "NaN", ".nan", "inf", "-inf", ".inf", "Infinity", "-.Inf"),
    *("127", "4294967295", "4294967296", "9223372036854775808", "1" + "0" * 18, "9" * 400),
    *("010", "0x1f", "0o7", "1_000", "1:30", "1,5", "1e", "--1", "+1", "1j", "2001-01-01"),
)
WORDS = (
    *(
        "",
        " ",
        "~",
        "null",
        "true",
        "false",
        "no",
        "x",
        "x" * 3000,
        "ä",
        "\u202e",
        "\x00",
        "\x1b[31m",
    ),
    *("nan", "[]", "{}", "[1]", "[[]]", "{a: 1}", "!Touch {}", "!!python/object:os.system {}"),
    *("&a [*a]", "*a", "<<", "_tag", "_x", "0", ".", "..", "/", "/dev/zero", "a/b", "__class__"),
    *("'", '"', "%", "{x}", "{0}", "[bold]", "a: b", "a:b", "- ", "#", "|", ">", "@", "`"),
)
_NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z_0-9]*")


def _nasty(rng: random.Random) -> str:
    return rng.choice(NUMBERS if rng.random() < 0.6 else WORDS)


def _near(rng: random.Random, number: str) -> str:
    """Return a number that may replace another one; return a word unchanged."""
    try:
        return repr(float(number) * rng.choice((-1.0, 0.1, 0.5, 0.99, 2.0, 10.0)))
    except ValueError:
        return number


# Bytes and text.


def damaged(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change, remove, repeat or exchange bytes of any file."""
    data = bytearray(content or b"\0")
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        at, size = rng.randrange(len(data) + 1), rng.choice((1, 1, 2, 4, 8, 64, 500))
        kind = rng.randrange(7)
        if kind == 0:
            data[at : at + 1] = bytes([rng.randrange(256)])
        elif kind == 1:
            data[at : at + size] = b""
        elif kind == 2:
            data[at:at] = data[at : at + size]
        elif kind == 3 and other:
            start = rng.randrange(len(other))
            data[at : at + size] = other[start : start + size]
        elif kind == 4:
            data[at : at + size] = rng.choice((b"\xff", b"\0", b"\x7f", b"\x80")) * size
        elif kind == 5 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 6 and rng.random() < 0.3:
            del data[at:]
        data = data or bytearray(b"\0")
    return bytes(data)


def text(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change numbers, words and lines of a text."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        content = rng.choice(_TEXT_EDITS)(rng, content, other)
    return content


def _other_number(rng: random.Random, content: bytes, other: bytes) -> bytes:
    def new(number: str) -> bytes:
        return (_near(rng, number) if rng.random() < 0.5 else _nasty(rng)).encode()

    return _replaced(rng, _NUMBER, content, new)


def _other_word(rng: random.Random, content: bytes, other: bytes) -> bytes:
    known = _WORD.findall(other)
    new = rng.choice(known) if known and rng.random() < 0.5 else _nasty(rng).encode()
    return _replaced(rng, _WORD, content, lambda _: new)


def _replaced(
    rng: random.Random, pattern: re.Pattern[bytes], content: bytes, new: Callable[[str], bytes]
) -> bytes:
    found = list(pattern.finditer(content)) or list(re.finditer(rb"\Z", content))
    place = rng.choice(found)
    return content[: place.start()] + new(place[0].decode()) + content[place.end() :]


def _other_lines(rng: random.Random, content: bytes, other: bytes) -> bytes:
    lines, more = content.split(b"\n"), other.split(b"\n")
    at, kind = rng.randrange(len(lines)), rng.randrange(6)
    if kind == 0:
        del lines[at]
    elif kind == 1:
        lines.insert(at, rng.choice(lines))
    elif kind == 2:
        lines.insert(at, rng.choice(more))
    elif kind == 3:
        to = rng.randrange(len(lines))
        lines[at], lines[to] = lines[to], lines[at]
    elif kind == 4:
        lines[at] = b" " * rng.randrange(9) + lines[at].lstrip()
    else:
        del lines[at:]
    return b"\n".join(lines)


def _nested(rng: random.Random, content: bytes, other: bytes) -> bytes:
    depth, at = rng.choice((1, 2, 60, 2000)), rng.randrange(len(content) + 1)
    first, last = rng.choice(((b"[", b"]"), (b"{a: ", b"}"), (b'{"a": ', b"}"), (b"- ", b"")))
    return content[:at] + first * depth + last * depth + content[at:]


_TEXT_EDITS: tuple[Mutation, ...] = (_other_number, _other_number, _other_word, _other_lines)
_TEXT_EDITS += (_other_lines, _nested, damaged)


# Trees: YAML, JSON, XML.


def yaml_text(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change nodes, tags and anchors of YAML, or its text."""
    root, more = _nodes(content), _nodes(other)
    if root is None or rng.random() < 0.3:
        return text(rng, content, other)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _edit_node(rng, root, more or root)
    try:
        return yaml.serialize(root, allow_unicode=True, width=1000).encode()
    except (yaml.YAMLError, RecursionError, AttributeError, TypeError, UnicodeEncodeError):
        return text(rng, content, other)


def json_text(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change values and names of JSON, or its text."""
    root, more = _nodes(content), _nodes(other)
    if root is None or rng.random() < 0.3:
        return text(rng, content, other)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _edit_node(rng, root, more or root)
    try:
        return _as_json(root).encode(errors="replace")
    except RecursionError:
        return text(rng, content, other)


def _as_json(node: yaml.Node) -> str:
    if isinstance(node, yaml.MappingNode):
        pairs = ", ".join(f"{_as_json(key)}: {_as_json(value)}" for key, value in node.value)
        return f"{{{pairs}}}"
    if isinstance(node, yaml.SequenceNode):
        return f"[{', '.join(map(_as_json, node.value))}]"
    return json.dumps(node.value) if node.style == '"' else node.value


def _nodes(content: bytes) -> yaml.Node | None:
    if max(map(content.count, (b"[", b"{", b"- "))) > _MOST_BRACKETS:
        return None
    try:
        return yaml.compose(content.decode(), _LOADER)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError):
        return None


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_MOST_BRACKETS = 500  # for the C parser, which the readers do not use


def _all_nodes(root: yaml.Node) -> list[yaml.Node]:
    found, ahead = [], [root]
    seen: set[int] = set()
    while ahead:
        node = ahead.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        found.append(node)
        if isinstance(node, yaml.MappingNode):
            ahead += [part for pair in node.value for part in pair]
        elif isinstance(node, yaml.SequenceNode):
            ahead += node.value
    return found


def _edit_node(rng: random.Random, root: yaml.Node, more: yaml.Node) -> None:
    nodes = _all_nodes(root)
    node = rng.choice(nodes)
    kind = rng.randrange(8)
    if kind == 0:  # the same node at two places, possibly inside itself
        _put(rng, root, node)
    elif kind == 1:
        node.tag = rng.choice(("!Touch", "!Press", "!", "!!", "tag:yaml.org,2002:int", "!x y", "?"))
    elif kind == 2:
        _put(rng, root, rng.choice(_all_nodes(more)))
    elif isinstance(node, yaml.ScalarNode) and kind < 6:
        same = [each.value for each in _all_nodes(more) if each.tag == node.tag]
        node.value = rng.choice([_near(rng, node.value), *same])
    elif isinstance(node, yaml.ScalarNode):
        node.value, node.tag = _nasty(rng), "tag:yaml.org,2002:" + rng.choice(("str", "float"))
        node.style = rng.choice((None, None, '"'))
        if node.style is None:
            resolver = yaml.SafeLoader("")
            node.tag = resolver.resolve(yaml.ScalarNode, node.value, (True, False))
    elif not node.value:
        node.value = [yaml.ScalarNode("tag:yaml.org,2002:int", "1")]
        if isinstance(node, yaml.MappingNode):
            node.value = [(node.value[0], node.value[0])]
    elif kind == 3:
        del node.value[rng.randrange(len(node.value))]
    elif kind == 4:
        node.value.insert(rng.randrange(len(node.value)), rng.choice(node.value))
    elif kind == 5:
        node.value *= rng.choice((2, 3, 30))
    elif kind == 6:
        rng.shuffle(node.value)
    else:
        _put(rng, root, yaml.SequenceNode("tag:yaml.org,2002:seq", [node]))


def _put(rng: random.Random, root: yaml.Node, new: yaml.Node) -> None:
    """Replace a random value below the root."""
    places = [node for node in _all_nodes(root) if node.value and not _is_scalar(node)]
    if places:
        node = rng.choice(places)
        at = rng.randrange(len(node.value))
        is_mapping = isinstance(node, yaml.MappingNode)
        node.value[at] = (node.value[at][0], new) if is_mapping else new


def _is_scalar(node: yaml.Node) -> bool:
    return isinstance(node, yaml.ScalarNode)


def xml(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change elements, attributes and numbers of XML, or its text."""
    try:
        root, more = ElementTree.fromstring(content), ElementTree.fromstring(other)
    except (ElementTree.ParseError, ValueError):
        return text(rng, content, other)
    if rng.random() < 0.25:
        return text(rng, content, other)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _edit_element(rng, root, more)
    return ElementTree.tostring(root)


def _edit_element(rng: random.Random, root: ElementTree.Element, more: ElementTree.Element) -> None:
    parents = {child: parent for parent in root.iter() for child in parent}
    if not parents:
        return
    element = rng.choice(list(parents))
    parent, kind = parents[element], rng.randrange(8)
    if kind == 0:
        parent.remove(element)
    elif kind == 1:
        parent.insert(rng.randrange(len(parent) + 1), element)
    elif kind == 2:
        rng.choice([*parents, root]).append(copy.deepcopy(rng.choice(list(more.iter()))))
    elif kind == 3 and element.attrib:
        del element.attrib[rng.choice(list(element.attrib))]
    elif kind == 4:
        element.tag = rng.choice(list(more.iter())).tag
    elif element.attrib and (kind < 7 or not (element.text or "").strip()):
        name = rng.choice(list(element.attrib))
        same = [each.get(name, "") for each in root.iter() if name in each.attrib]
        element.set(name, rng.choice((rng.choice(same), _vector(rng, element.attrib[name]))))
    else:
        same = [each.text or "" for each in root.iter(element.tag)]
        element.text = rng.choice((rng.choice(same), _vector(rng, element.text or "")))


def _vector(rng: random.Random, value: str) -> str:
    """Change, remove or repeat one of the numbers in a text."""
    parts = value.split() or [""]
    at = rng.randrange(len(parts))
    new = ([_near(rng, parts[at])], [_nasty(rng)], [_nasty(rng)], [], [parts[at]] * 2)
    parts[at : at + 1] = rng.choice(new)
    return "".join(c for c in " ".join(parts) if c.isprintable())


# Tables.


def table(suffix: str) -> Mutation:
    """Change columns, cells and rows of a table in a file of this suffix, or its bytes."""

    def mutated(rng: random.Random, content: bytes, other: bytes) -> bytes:
        damage = text if suffix == ".csv" else damaged
        if rng.random() < 0.25:
            return damage(rng, content, other)
        try:
            columns = decoded(suffix, content)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                for _ in range(rng.choice((1, 1, 2, 3))):
                    rng.choice(_TABLE_EDITS)(rng, columns)
            return encoded(suffix, columns)
        # Tables that the libraries cannot read or write are damaged as bytes.
        except (Exception, polars.exceptions.PanicException):
            return damage(rng, content, other)

    return mutated


def decoded(suffix: str, content: bytes) -> dict[str, np.ndarray]:
    """Return the columns of a table by their names."""
    if suffix == ".npz":
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    if suffix == ".mat":
        with tempfile.TemporaryDirectory() as folder:
            (path := Path(folder) / "x.mat").write_bytes(content)
            return read_mat(path)
    read = polars.read_csv if suffix == ".csv" else read_parquet
    return {series.name: series.to_numpy() for series in read(io.BytesIO(content))}


def read_parquet(content: io.BytesIO) -> polars.DataFrame:
    """Return a table, or raise an exception: damaged content would abort polars."""
    check_parquet_content_sizes(content.getvalue())
    return polars.read_parquet(content)


def encoded(suffix: str, columns: dict[str, np.ndarray]) -> bytes:
    """Return a table as a file of this suffix, or raise an exception if it has no such form."""
    stream = io.BytesIO()
    if suffix == ".npz":
        np.savez(stream, **columns)
        return stream.getvalue()
    if suffix == ".mat":
        savemat(stream, columns)
        return stream.getvalue()
    if suffix == ".npy":
        rows = np.empty(len(columns["t"]), [(name, x.dtype) for name, x in columns.items()])
        for name, column in columns.items():
            rows[name] = column
        np.save(stream, rows)
        return stream.getvalue()
    if suffix == ".h5":
        with h5py.File(stream, "w") as file:
            for name, column in columns.items():
                file[name] = column
        return stream.getvalue()
    frame = polars.DataFrame({name: polars.Series(name, x) for name, x in columns.items()})
    write = {".csv": frame.write_csv, ".arrow": frame.write_ipc, ".jsonl": frame.write_ndjson}
    write.get(suffix, frame.write_parquet)(stream)
    return stream.getvalue()


Columns = dict[str, np.ndarray]
_VALUES = (0.0, 1.0, -1.0, 1e-9, 5e-324, 1e9, 1e17, 1e25, 1e26, 1e300, np.nan, np.inf, -np.inf)


def _one(rng: random.Random, columns: Columns) -> str:
    return rng.choice(list(columns))


def _plant(rng: random.Random, columns: Columns) -> None:
    name = _one(rng, columns)
    column = columns[name].astype(float)
    start, size = rng.randrange(len(column)), rng.choice((1, 1, 3, 20, len(column)))
    column[start : start + size] = rng.choice(_VALUES)
    columns[name] = column


def _change(rng: random.Random, columns: Columns) -> None:
    names = list(columns) if rng.random() < 0.3 else [_one(rng, columns)]
    step, factor = rng.choice((0.01, 0.1, 1.0, 100.0)), rng.choice((-1.0, 0.0, 1e-12, 1e3, 1e9))
    kind, at = rng.randrange(8), rng.randrange(len(columns[names[0]]))
    for name in names:
        column = columns[name].astype(float)
        columns[name] = (
            np.round(column / step) * step,
            column * factor,
            column + 1e9,
            column[::-1],
            np.roll(column, at),
            np.abs(column),
            np.full_like(column, column[at]),
            np.cumsum(column),
        )[kind]


def _rows(rng: random.Random, columns: Columns) -> None:
    n = min(map(len, columns.values()))
    start = rng.randrange(n)
    count = rng.choice((0, 1, 2, 5, 15, 16, 17, n // 2))
    kept = rng.choice(
        (
            np.arange(start, min(start + count, n)),
            np.delete(np.arange(n), slice(start, start + count)),
            np.repeat(np.arange(n), 1 + (np.arange(n) == start) * count),
            np.concatenate([np.arange(n), np.arange(start)]),
            np.arange(0, n, 1 + rng.randrange(4)),
            np.array(rng.sample(range(n), n)),
        )
    )
    for name in columns:
        columns[name] = columns[name][kept]


def _names(rng: random.Random, columns: Columns) -> None:
    name, other = _one(rng, columns), _one(rng, columns)
    kind = rng.randrange(4)
    if kind == 0:
        del columns[name]
    elif kind == 1:
        columns[rng.choice((*WORDS[:14], f" {other}", other.upper(), "q_w"))] = columns.pop(name)
    elif kind == 2:
        columns[name] = columns[other]
    else:
        columns[name], columns[other] = columns[other], columns[name]


def _types(rng: random.Random, columns: Columns) -> None:
    name = _one(rng, columns)
    column = columns[name]
    kind = rng.choice(
        ("f4", "f2", "i8", "u1", "?", "c16", "U", "S", "M8[ns]", "list", "2d", "long")
    )
    if kind == "list":
        columns[name] = np.array([[x, x] for x in column])
    elif kind == "2d":
        columns[name] = np.resize(column, (len(column), rng.choice((0, 1, 3)), 2))
    elif kind == "long":
        columns[name] = np.concatenate([column, column])
    else:
        columns[name] = column.astype(kind)


_TABLE_EDITS: tuple[Callable[[random.Random, Columns], None], ...]
_TABLE_EDITS = (_plant, _plant, _change, _change, _rows, _names, _types)


# Command lines, as JSON lists of words.


def arguments(rng: random.Random, content: bytes, other: bytes) -> bytes:
    """Change the words of a command line."""
    words, more = json.loads(content), json.loads(other)
    for _ in range(rng.choice((1, 1, 2, 3))):
        at, kind = rng.randrange(len(words) + 1), rng.randrange(7)
        new: list[Any] = [_nasty(rng)]
        if kind == 0:
            new = []
        elif kind == 1:
            new = [rng.choice(more)] if more else []
        elif kind == 2:
            new = words[at : at + 1] * 2
        elif kind == 3 and at < len(words):
            new = [words[at] + rng.choice(("=", ",", "x", " ")) + _nasty(rng)]
        words[at : at + 1] = new
    return json.dumps(words).encode()
