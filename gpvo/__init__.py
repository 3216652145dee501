"""gpvo tells your filter how wrong stereo visual odometry is, right now."""

__version__ = "0.1.0"
