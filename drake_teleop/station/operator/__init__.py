"""Block "operator": hand impedance, perception, decisions and tasks."""
