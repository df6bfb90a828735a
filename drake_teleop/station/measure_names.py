"""Names of what is measured of a task, for whoever needs neither Drake nor compiled code for it.

`task_measures.py` explains them.
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
"""Names of the measures, in the order of `task_measures`."""
