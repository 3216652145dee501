"""gpvo.learning."""
