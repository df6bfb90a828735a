"""Names of the task measures, importable without Drake and compiled code.

`task_measures.py` defines the measures.
"""

from __future__ import annotations

TASK_MEASURES = (
    "success",
    "task_time_s",
    "contact_force_overshoot_N",
    "effort_Ns",
    "task_work_J",
    "detection_time_s",
    "false_notices",
    "press_error_N",
)
"""Measures in the order of `task_measures`."""
