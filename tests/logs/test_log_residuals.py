"""Where the residual of the force stands, that of the torque stands too."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_log_detection import log_with_push

from drake_teleop.cli.logs import eliminate_command, identify_command


def lacking(summary: dict[str, Any], path: str = "") -> list[str]:
    """Names of what is left of the force without a name of what is left of the torque."""
    left = re.compile("residual|rms|peak")
    names = []
    for name, value in summary.items():
        if isinstance(value, dict):
            names += lacking(value, f"{path}{name}.")
        elif left.search(name) and not isinstance(value, list) and "torque" not in name:
            if name.endswith("per_channel"):  # or null
                continue
            start, _, end = name.rpartition("_")
            twins = {f"{start}_torque_{end}", name.replace("force", "torque")}
            if not (twins - {name}) & set(summary):
                names.append(path + name)
    return names


@pytest.mark.slow
def test_the_torque_is_not_forgotten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = log_with_push(tmp_path / "log.parquet", np.zeros(3), 1)
    identified = identify_command(log, tmp_path, delay=0.0)
    options = {"causal": "delayed", "delay": 0.0}
    eliminated = eliminate_command(log, tmp_path / "identification.json", tmp_path / "e", **options)
    assert lacking(identified) == [] and lacking(eliminated) == []
    assert lacking({"residual_rms_force": 1.0}) == ["residual_rms_force"]  # it can fail
    printed = capsys.readouterr().out.replace("\n", " ")
    for words in ("residual", "largest contact force", "causal: "):
        _, _, rest = printed.partition(words)
        assert re.match(r"[^;]*? N[ ,][^;]*? N m", rest), words
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "rms of the force and of the torque that" in page
