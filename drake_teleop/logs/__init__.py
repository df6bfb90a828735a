"""Load identification, load removal and contact detection for recorded logs, without Drake."""
