"""The passivity methods compared."""
