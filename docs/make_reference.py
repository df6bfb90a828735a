"""Write the parts of docs/ about fields of scenarios and log descriptions, from the code.

Usage: `python docs/make_reference.py`.
"""

from __future__ import annotations

from pathlib import Path

from drake_teleop.logs.read import description
from drake_teleop.station import scenario_reference

DOCS = Path(__file__).parent


def main() -> None:
    texts = {
        "scenario.md": scenario_reference.reference_page(),
        "scenario.schema.json": scenario_reference.json_schema(),
        "log-description.schema.json": description.json_schema(),
    }
    for name, text in texts.items():
        (DOCS / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
