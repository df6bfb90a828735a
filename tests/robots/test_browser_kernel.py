"""Kernel as WebAssembly, in node and in the page of the site, compared with `eliminate`."""

from __future__ import annotations

import json
import re
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.common.files import write_text
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.sample import sample_log_command

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import kernel
from browser import CHROMIUM, Page, opened

ROOT = Path(__file__).parents[2]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        find_spec("ziglang") is None, reason="there is no compiler for WebAssembly here"
    ),
]


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node here")
def test_kernel_in_node_has_the_bits_of_compensate(tmp_path):
    rows = kernel.readings(5000, seed=9)
    kernel.prepared(tmp_path, rows)
    found, _, size = kernel.in_node(tmp_path)
    assert found.tobytes() == kernel.compensated(rows).tobytes()
    assert size < 8192


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Return a page with the elements of browser.md, and its scripts."""
    folder = tmp_path_factory.mktemp("site")
    text = (ROOT / "docs" / "browser.md").read_text(encoding="utf-8")
    (body,) = re.findall(r"```\{raw\} html\n(.*?)```", text, re.S)
    (folder / "_static").mkdir()
    write_text(folder / "browser.html", f"<!doctype html><meta charset=utf-8><body>{body}")
    write_text(folder / "_static" / "kernel.js", kernel.WASM["script"]())
    shutil.copy(ROOT / "docs" / "_static" / "compensate.js", folder / "_static")
    return folder


@pytest.fixture
def page(site):
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here")
    with opened((site / "browser.html").as_uri(), "", Page) as shown:
        shown.until("typeof connect === 'function' && document.readyState === 'complete'")
        yield shown


def drop(page: Page, **files: str) -> None:
    """Drop files of this content, named by suffix."""
    made = ", ".join(
        f"new File([{json.dumps(text)}], 'file.{suffix}')" for suffix, text in files.items()
    )
    page.run(
        f"{{ const data = new DataTransfer(); for (const file of [{made}]) data.items.add(file);"
        " document.getElementById('compensate').dispatchEvent("
        "new DragEvent('drop', {dataTransfer: data, bubbles: true})); } 1"
    )


SAID = "document.querySelector('[data-part=said]').textContent"


@pytest.mark.slow
def test_the_sample_log_has_the_numbers_of_eliminate(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sample_log_command(Path("out/sample"), quiet=True)
    text = (ROOT / "docs" / "browser.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.S)
    exec(compile(code, "browser.md", "exec"), {})
    log, load = tmp_path / "touched.csv", tmp_path / "load.json"
    identify_log("out/sample/free.yaml").identification.save(load)
    drop(page, csv=log.read_text(), json=load.read_text())
    page.until("window.compensated")
    found = np.array(page.run("compensated.contact"))
    expected = eliminate_log(log, load, causal="delayed", delay=0.0)
    assert len(found) == len(expected.causal.contact)
    assert np.abs(found - expected.causal.contact).max() < 1e-12
    assert np.abs(found).max() > 1.0
    assert page.run(SAID) == f"{len(found)} samples, 0 of them invalid (contact force 0)"
    assert page.run("document.querySelector('[data-part=save]').href").startswith("blob:")
    assert not page.errors


@pytest.mark.parametrize(
    ("csv", "load", "said"),
    [
        ("t,f_x\n0,1\n", "{}", "Error: the log has no column f_y, f_z"),
        (None, '{"phi": [1]}', "Error: the identification has no phi of 10 numbers"),
        (None, "weight_removed", "Error: the robot has removed the weight"),
    ],
)
def test_unusable_files_are_named(page, csv, load, said):
    if load == "weight_removed":
        load = json.dumps({"phi": [0.0] * 10, "offsets": [0.0] * 6, "weight_removed": True})
    header = ",".join(["t", *kernel_columns()])
    drop(page, csv=csv or header + ("\n" + ",".join("0" * 16)) * 4, json=load)
    page.until(f"{SAID} !== 'No log.'")
    assert page.run(SAID).startswith(said)


def kernel_columns() -> list[str]:
    return [f"{name}_{axis}" for name in ("f", "tau", "s", "omega", "alpha") for axis in "xyz"]
