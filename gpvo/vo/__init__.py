"""Stereo visual odometry: front ends, triangulation, motion, and the covariance of each motion."""
