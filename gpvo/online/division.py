"""How a motion's variance divides into jitter, white and bias: the same arithmetic in training and in flight."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gpvo.types import Array

PARTS = ("jitter", "white", "bias")
LN_FASTEST = float(np.log(20.0))


def divide(share: Array, growth: Array, above: Array, faster: Array) -> Array:
    """(n, 3, D) shares of jitter, white and bias, summing to one.

    ``share`` (3, D) holds at the typical speed and variance. White and bias gain on the jitter by the power
    ``growth[0]`` of the speed, whose log over the typical one is ``faster`` (n, 1), and the bias by the power
    ``growth[1]`` of the variance, whose log over the typical one is ``above`` (n, D); ``growth`` (2, D).
    """
    out = np.empty((len(above), *share.shape))
    by_speed = growth[0] * faster
    out[:, 0] = share[0]
    out[:, 1] = share[1] * np.exp(by_speed)
    # The exponent is bounded where the bias is all there is, or nothing.
    out[:, 2] = share[2] * np.exp(by_speed + np.minimum(np.maximum(growth[1] * above, -60.0), 60.0))
    return out / out.sum(axis=1, keepdims=True)


def of_calibration(variance: Array, patterns: Array, twist: Array) -> tuple[Array, Array]:
    """What a wrong calibration has of variances (n, D): its root (n, D, P), and what is left of them (n, D).

    A wrong baseline, focal length or rectification makes errors that are linear in the motion, and turn around with it:
    a scale that is 1 % off adds on the way out what it takes back on the way home. Each of ``patterns`` (P, D, 6) is
    such a way to be wrong, by its usual amount: the error of a motion at unit velocities. ``twist`` (n, 6), unknown
    ones bring nothing [m/s, rad/s]. It takes no more than all of the variance, however fast the motion.
    """
    P, D, _ = patterns.shape
    known = np.where(np.isfinite(twist), twist, 0.0)
    root = (known @ patterns.reshape(P * D, 6).T).reshape(-1, P, D).swapaxes(1, 2)
    left = variance / (variance + (root**2).sum(axis=-1))
    return root * np.sqrt(left)[..., None], variance * left


def ln_faster(v_mps: Array, ln_typical: ArrayLike) -> Array:
    """(n, 1) log of the speed of (n, 3) over the typical one, from 0 to that of twenty times it; 0 where unknown.

    Slower than typical counts as typical: by the metre alone errors would not add up at rest, but they do with time,
    and a filter that is told otherwise learns its biases from that.
    """
    speed = np.sqrt((v_mps**2).sum(axis=1, keepdims=True))
    ratio = np.log(np.maximum(speed, 1e-9)) - ln_typical
    return np.where(np.isfinite(ratio), np.minimum(np.maximum(ratio, 0.0), LN_FASTEST), 0.0)
