"""Commands of docs/detection.md run."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.checks

DOC = Path(__file__).parents[1] / "docs" / "detection.md"


@pytest.mark.slow
def test_the_code_notices_the_contact(capsys) -> None:
    (code,) = re.findall(r"^```python\n(.+?)^```", DOC.read_text(encoding="utf-8"), re.M | re.S)
    exec(code, {})
    assert 0.21 < float(capsys.readouterr().out.strip(" []\n")) < 0.23
