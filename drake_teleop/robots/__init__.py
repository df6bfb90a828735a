"""Robots that stand in a lab: what was identified, in their own words."""
