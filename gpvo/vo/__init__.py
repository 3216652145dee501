"""Stereo visual odometry: front ends, triangulation, motion, and the covariance of each motion."""

from gpvo.errors import require

require("cv2")
