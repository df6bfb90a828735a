"""Docstrings of the project and constants of the package are in plain language."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "drake_teleop"
FOLDERS = ("tests", "tests/*", "benchmarks", "docs", "docs/_ext", "docs/gallery")
FILES = sorted(
    [*PACKAGE.rglob("*.py"), *(path for each in FOLDERS for path in ROOT.glob(f"{each}/*.py"))]
)
NOT_FIRST = {
    *("What", "Of", "By", "That", "It", "How", "Where", "Who", "Which", "For", "With", "Without"),
    *("From", "At", "To", "Towards", "If", "When", "Likewise", "As", "And", "But", "Against", "In"),
    *("Along", "Within", "Over", "Beyond", "After", "Then", "Among", "Neither", "There", "Its"),
}
"""A docstring begins with a verb or a noun phrase; exceptions: "Whether" of
properties, and questions of benchmarks."""
GLOSSARY = re.compile(
    r"\b(house|rooms?|attic|felt|feels?|told|tells?|learnt|watched|knocks?|mend(s|ed)?|wanted"
    r"|to and fro|goes over|left behind|hunts|shaken|believe[ds]?|believable|nobody|somebody"
    r"|knows?|hears?|forgets?|riddles?)\b"
)
VAGUE = re.compile(
    r"_(MOST|LEAST|NEAR|FAR|SAME|SURE|STANDS|HALF|FIRST|LAST|SMALL|LARGE|LONG|SHORT|FEW|FEWEST|MANY"
    r"|ENOUGH|OVER|BEYOND|GONE|WORTH|FITS|KEPT|RESTED|BELIEVED|BELIEVABLE|SHOWN)"
)
MAX_WORDS = 32
EXCEPTIONS = {
    "felt": "name of a column or port that users read",
    "watched": "name of a module or of a state that users read",
    "room": "attribute of a posture: distance to the nearest limit",
    "tell": "in a table of summary names",
    "knock": "case of a benchmark",
}
"""Glossary words that may be in docstrings, in at most `MAX_EXCEPTIONS` places, and why."""
MAX_EXCEPTIONS = 20


def docstrings() -> Iterator[tuple[str, str]]:
    for path in FILES:
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            if documented and (text := ast.get_docstring(node)):
                yield f"{name}: {getattr(node, 'name', '')}", text


def first_words() -> list[str]:
    return [
        f"{where}: {text.splitlines()[0]}"
        for where, text in docstrings()
        if text.split()[0].strip('`"(,.:') in NOT_FIRST and not text.splitlines()[0].endswith("?")
    ]


def sentences(text: str) -> Iterator[str]:
    """Return the sentences outside of tables, lists and code."""
    prose = re.sub(r"^(\s{2,}.*|.*={3,}.*|.*\S {2,}\S.*|- .*|\|.*)$", "", text, flags=re.M)
    for sentence in re.split(r"(?<=[.!?:;])\s+|\n\n", prose):
        if "=" not in sentence and "`" not in sentence:
            yield " ".join(sentence.split())


def long_sentences() -> list[str]:
    return [
        f"{where}: {sentence}"
        for where, text in docstrings()
        for sentence in sentences(text)
        if len(sentence.split()) > MAX_WORDS
    ]


def glossary_words() -> list[str]:
    return [
        f"{where}: {match.group()}"
        for where, text in docstrings()
        for match in GLOSSARY.finditer(text)
    ]


def vague_constants() -> list[str]:
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
        names = {token.string for token in tokens if token.type == tokenize.NAME}
        found += [f"{path.name}: {name}" for name in sorted(names) if VAGUE.fullmatch(name)]
    return found


def names_in(node: ast.ClassDef) -> set[str]:
    names = {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}
    names |= {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    return names | {each.name for each in ast.walk(node) if isinstance(each, ast.FunctionDef)}


def absent_attributes() -> list[str]:
    """Return attributes that a class lists in its docstring but does not have."""
    found = []
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            text = (ast.get_docstring(node) or "") if isinstance(node, ast.ClassDef) else ""
            section = text.partition("Attributes:\n")[2].partition("\n\n")[0]
            for line in re.findall(r"^    (\w[\w, ]*):", section, flags=re.M):
                found += [
                    f"{node.name}.{name}" for name in set(line.split(", ")) - names_in(node)
                ]  # fmt: skip
    return found


def test_documented_attributes_exist() -> None:
    assert absent_attributes() == []


def test_docstrings_begin_with_a_verb_or_a_noun() -> None:
    assert first_words() == []


def test_sentences_are_short() -> None:
    assert long_sentences() == []


def test_docstrings_use_the_terms_of_the_field() -> None:
    found = glossary_words()
    assert [line for line in found if line.rpartition(": ")[2] not in EXCEPTIONS] == []
    assert len(found) <= MAX_EXCEPTIONS


def test_constants_have_a_noun() -> None:
    assert vague_constants() == []


@pytest.mark.parametrize(
    "line", ["It tells what is felt.", "Of any.", "The hand hears of the wall to and fro."]
)
def test_a_riddle_is_found(line: str) -> None:
    assert line.split()[0] in NOT_FIRST or GLOSSARY.search(line)
