"""Consistency statistics and their uncertainty. NumPy only."""
