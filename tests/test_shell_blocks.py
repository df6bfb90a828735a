"""Every shell block of the pages is run by a test, or states above itself why not."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from shown import shell_blocks, the_block

pytestmark = pytest.mark.checks

#: Reasons in the comments of the pages: resources that a test does not have.
REASONS = {
    "it installs from the network",
    "a robot",
    "ROS 2 and a robot",
    "minutes of both cores",
    "they are the tests",
}
KNOWN = (
    *("<!-- not run by the tests: ", "<!-- run by the tests in small: "),
    "<!-- the test command -->",  # for which .ci/run searches
)


def typed() -> set[tuple[str, str]]:
    """Return (page, start) of all calls of `type_in` in the tests."""
    return {
        tuple(ast.literal_eval(argument) for argument in node.args[:2])
        for path in Path(__file__).parent.rglob("test_*.py")
        if "type_in(" in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "type_in"
    }


def test_every_command_is_typed_by_a_test_or_it_is_said_why_not():
    run = {line for place in typed() for line in the_block(*place).commands}
    missing = [
        f"{block.page}: {line}"
        for block in shell_blocks()
        if not block.left_out
        for line in block.commands
        if line not in run
    ]
    assert missing == []


def test_what_is_left_out_has_one_of_few_reasons():
    """Each reason has a block, and no comment above a block is misspelt."""
    assert {block.left_out for block in shell_blocks() if block.left_out} == REASONS
    for block in shell_blocks():
        for said in block.said.splitlines():
            assert said.startswith(KNOWN), f"{block.page}: {said}"


def test_blocks_and_what_is_said_of_them_are_found(tmp_path, monkeypatch):
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- not run by the tests: a robot -->\n```sh\na \\\n    --b\n```\n"
        "<!-- a comment -->\n```sh\n.venv/bin/a > x\nb  c\n```\n"
        "<!-- run by the tests in small: one wall -->\n<!-- a comment -->\n```sh\nd\n```\n"
    )
    monkeypatch.setattr("shown.PAGES", (str(page),))
    found = shell_blocks()
    assert [block.left_out for block in found] == ["a robot", "", ""]
    assert [block.said.count("-->") for block in found] == [1, 1, 2]
    assert [block.commands for block in found] == [["a --b"], ["a > x", "b c"], ["d"]]
    with pytest.raises(AssertionError):
        the_block(str(page), "a")
