"""Modules for all packages: errors, settings, compiled mathematics, files and pages."""
