"""The communication channel between master and slave."""
