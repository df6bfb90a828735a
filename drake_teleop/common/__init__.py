"""Shared by all packages: errors, settings, compiled mathematics, files and pages."""
