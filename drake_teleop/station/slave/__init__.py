"""The slave side: the arm, its inverse kinematics, joint control and wrist sensor."""
