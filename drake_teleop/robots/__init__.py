"""Live streams of a real robot, and export of an identified load."""
