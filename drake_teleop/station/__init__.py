"""Teleoperation station of the paper's Fig. 4 as a Drake Diagram, with scenario and result."""
