"""
A study: many runs, one picture
===============================

Effects of two scenario fields on the force at the hand: every combination, with two seeds. A study
writes its rows to disk as runs finish, so that it can be stopped and continued.
"""

import tempfile
from pathlib import Path

import polars as pl

from drake_teleop.lab.studies.pictures import draw_main_effects
from drake_teleop.lab.studies.study import LoadStudy, study_command

folder = Path(tempfile.mkdtemp())
(folder / "study.yaml").write_text("""
scenario: contact_transition
factors:
  - {field: force_scaling.sigma, values: [0, 0.5, 1]}
  - {field: force_scaling.gamma, values: [0.5, 2]}
  - {field: rates.sensor_hz, values: [2000]}
  - {field: rates.hand_hz, values: [1000]}
  - {field: rates.joint_control_hz, values: [1000]}
repeats: 2
""")
study_command(folder / "study.yaml", folder / "out", jobs=1, quiet=True, progress=False)
study = LoadStudy(folder / "study.yaml")
rows = pl.read_parquet(folder / "out" / "runs.parquet")
figure = draw_main_effects(study, rows, list(study.measures)[:2])
