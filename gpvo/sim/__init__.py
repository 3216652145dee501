"""gpvo.sim."""
