"""Compensation kernel as C99 for controllers, FMUs, ros2_control and WebAssembly."""
