"""The load's inertia: regressor, parameters, identification, compensation. No Drake in here."""
