"""Scaling of motion (master to slave) and of force (slave to master)."""
