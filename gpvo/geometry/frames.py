"""Fixed rotations between the frames of the field (REP 103, REP 105; MAVLink's MAV_FRAME)."""

from __future__ import annotations

import numpy as np

from gpvo.types import Array

# Optical (x right, y down, z forward) to FLU body (x forward, y left, z up) of a forward-looking camera.
R_FLU_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
# FLU to FRD and back: its own inverse.
R_FRD_FLU: Array = np.diag([1.0, -1.0, -1.0])
# ENU to NED and back: its own inverse.
R_NED_ENU: Array = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# RealSense T265 pose stream (x right, y up, z back) to FLU.
R_FLU_T265: Array = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
for _R in (R_FLU_OPTICAL, R_FRD_FLU, R_NED_ENU, R_FLU_T265):
    _R.setflags(write=False)


def rotate_covariance(R_new_old: Array, covariance: Array) -> Array:
    """6x6 covariance (translation, rotation), expressed in rotated axes: ``B C B^T``, B = blockdiag(R, R)."""
    B = np.zeros((6, 6))
    B[:3, :3] = B[3:, 3:] = R_new_old
    return B @ covariance @ B.T
