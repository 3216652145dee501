"""Worlds, vehicles, cameras, IMU and noise: sequences whose truth is exact."""
