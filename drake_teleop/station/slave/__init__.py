"""Slave side: the arm, its inverse kinematics, joint control, plant and tool."""
