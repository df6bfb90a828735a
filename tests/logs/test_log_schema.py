"""The shipped JSON schema of log descriptions matches the code."""

from __future__ import annotations

import json
from pathlib import Path

from drake_teleop.logs.read.description import Description, json_schema

SHIPPED = Path(__file__).parents[2] / "docs" / "log-description.schema.json"


def test_shipped_schema_matches_the_code() -> None:
    assert json.loads(SHIPPED.read_text(encoding="utf-8")) == json.loads(json_schema())


def test_schema_contains_every_field_and_all_forms_of_gravity() -> None:
    schema = json.loads(json_schema())
    assert set(schema["properties"]) == set(Description.model_fields)
    assert schema["additionalProperties"] is False
    kinds = [form["type"] for form in schema["properties"]["gravity"]["anyOf"]]
    assert kinds == ["number", "array", "string"]
    assert "inverse" in schema["$defs"]["Orientation"]["properties"]
