"""Faults of a stereo camera, each a function on a sequence of images, and the count of frames that fail in silence.

A frame fails in silence where its motion is called ``ok``, is wrong by more than a tenth and 3 cm, and lies outside the
99.9 % ellipsoid of its triangulation covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from gpvo.geometry import se3
from gpvo.types import Array, Status, StereoCamera, StereoFrame, VoRecord
from gpvo.vo.config import VoConfig
from gpvo.vo.odometry import StereoOdometry

CHI2_6_999 = 22.458


@dataclass(frozen=True)
class Footage:
    """Rectified frames of one camera with their true poses ``T_world_cam`` (N, 4, 4)."""

    camera: StereoCamera
    frames: list[StereoFrame]
    T_world_cam: Array


@dataclass(frozen=True)
class Outcome:
    """Of one run: records, true motions by their intervals, and errors of the translation [m].

    ``wrong``: the frames that are wrong and not covered, as in silence, but whatever they are called. ``findings``:
    what is said of the pair in the end.
    """

    records: list[VoRecord]
    error_m: Array
    moved_m: Array
    wrong: list[int]
    findings: list[str]

    @property
    def silent(self) -> list[int]:
        """Frames that fail in silence."""
        return [k for k in self.wrong if self.records[k].status is Status.OK]

    def count(self, status: Status) -> int:
        """How many motions have this status."""
        return sum(r.status is status for r in self.records)

    @property
    def reasons(self) -> set[str]:
        """Every reason given."""
        return {r.reason for r in self.records if r.reason}


def run(footage: Footage, config: VoConfig | None = None) -> Outcome:
    """The odometry over the footage, and where it fails in silence."""
    odometry = StereoOdometry(footage.camera, config)
    records = [odometry.step(f) for f in footage.frames]
    index = {f.t_ns: k for k, f in enumerate(footage.frames)}
    error_m, moved_m, wrong = np.zeros(len(records)), np.zeros(len(records)), []
    for k, r in enumerate(records):
        T_true = se3.inverse(footage.T_world_cam[index[r.t_prev_ns]]) @ footage.T_world_cam[k]
        xi = se3.log(se3.inverse(T_true) @ r.T_prev_cur)
        error_m[k], moved_m[k] = np.linalg.norm(xi[:3]), np.linalg.norm(T_true[:3, 3])
        if r.status is not Status.START and error_m[k] > max(0.1 * moved_m[k], 0.03):
            C = r.covariances["triangulation"]
            if xi @ np.linalg.solve(C, xi) > CHI2_6_999:
                wrong.append(k)
    return Outcome(records, error_m, moved_m, wrong, odometry.pair.findings())


def _each(change: Callable[[int, StereoFrame], StereoFrame]) -> Callable[[Footage], Footage]:
    return lambda footage: replace(footage, frames=[change(k, f) for k, f in enumerate(footage.frames)])


def _table(image: np.ndarray, grey: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    table = np.clip(np.rint(grey(np.arange(256.0))), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table), np.uint8)


def _both(frame: StereoFrame, change: Callable[[np.ndarray], np.ndarray]) -> StereoFrame:
    return replace(frame, left=change(frame.left), right=change(frame.right))


def darker_right(k: int, f: StereoFrame) -> StereoFrame:
    """The right image at 59 % of the left's light."""
    return replace(f, right=_table(f.right, lambda g: 0.59 * g))


def gamma_flicker(k: int, f: StereoFrame) -> StereoFrame:
    """A gamma of 0.5 in every second frame."""
    return f if k % 2 else _both(f, lambda i: _table(i, lambda g: 255 * (g / 255) ** 0.5))


def gain_drift(k: int, f: StereoFrame) -> StereoFrame:
    """Exposure that wanders between a half and twice, up to 8 % a frame."""
    return _both(f, lambda i: _table(i, lambda g: g * 2 ** np.sin(0.12 * k)))


def flicker(k: int, f: StereoFrame) -> StereoFrame:
    """Every third frame at half the light."""
    return _both(f, lambda i: _table(i, lambda g: 0.5 * g)) if k % 3 == 0 else f


def right_blurred(k: int, f: StereoFrame) -> StereoFrame:
    """The right image blurred over 21 columns."""
    return replace(f, right=np.asarray(cv2.blur(f.right, (21, 1)), np.uint8))


def _in_the_middle(k: int) -> bool:
    return k >= 4 and k % 12 in (4, 5)


def black(k: int, f: StereoFrame) -> StereoFrame:
    """Two black pairs of every twelve."""
    return _both(f, np.zeros_like) if _in_the_middle(k) else f


def covered(k: int, f: StereoFrame) -> StereoFrame:
    """Lenses covered for the first six frames and for six of every twenty: what is left is the sensors' noise."""
    if k >= 6 and k % 20 < 14:
        return f
    rng = np.random.default_rng(k)
    return _both(f, lambda i: np.clip(np.rint(rng.normal(3, 2, i.shape)), 0, 255).astype(np.uint8))


def right_black(k: int, f: StereoFrame) -> StereoFrame:
    """Two black right images of every twelve."""
    return replace(f, right=np.zeros_like(f.right)) if _in_the_middle(k) else f


def swapped(k: int, f: StereoFrame) -> StereoFrame:
    """Left for right."""
    return replace(f, left=f.right, right=f.left)


def jpeg_30(k: int, f: StereoFrame) -> StereoFrame:
    """JPEG of quality 30."""

    def code(image: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 30])[1], 0), np.uint8)

    return _both(f, code)


def noise(sigma: float) -> Callable[[int, StereoFrame], StereoFrame]:
    """Gaussian noise of so many grey values."""

    def add(k: int, f: StereoFrame) -> StereoFrame:
        rng = np.random.default_rng(k)
        return _both(f, lambda i: np.clip(np.rint(i + rng.normal(0, sigma, i.shape)), 0, 255).astype(np.uint8))

    return add


def blur(k: int, f: StereoFrame) -> StereoFrame:
    """Out of focus: a Gaussian of 2.5 px."""
    return _both(f, lambda i: np.asarray(cv2.GaussianBlur(i, (0, 0), 2.5), np.uint8))


def every(stride: int) -> Callable[[Footage], Footage]:
    """Only each n-th frame."""
    return lambda a: Footage(a.camera, a.frames[::stride], a.T_world_cam[::stride])


def late_right(footage: Footage) -> Footage:
    """The right image is that of the frame before."""
    f = footage.frames
    frames = [replace(now, right=before.right) for before, now in pairwise(f)]
    return Footage(footage.camera, frames, footage.T_world_cam[1:])


def frozen_right(footage: Footage) -> Footage:
    """The right image stands still for ten frames of every twenty."""
    f = footage.frames
    return replace(footage, frames=[replace(f[k], right=f[k // 20 * 20 + min(k % 20, 9)].right) for k in range(len(f))])


def half_frozen(footage: Footage) -> Footage:
    """The lower half of every sixth pair is still that of the pair before."""

    def late(before: np.ndarray, now: np.ndarray) -> np.ndarray:
        return np.vstack([now[: len(now) // 2], before[len(now) // 2 :]])

    f = footage.frames
    frames = [replace(b, left=late(a.left, b.left), right=late(a.right, b.right)) for a, b in pairwise(f)]
    return replace(footage, frames=[f[0], *(frames[k - 1] if k % 6 == 0 else f[k] for k in range(1, len(f)))])


def interlaced(footage: Footage) -> Footage:
    """Every second row is that of the frame before."""

    def weave(before: np.ndarray, now: np.ndarray) -> np.ndarray:
        out = now.copy()
        out[1::2] = before[1::2]
        return out

    f = footage.frames
    frames = [replace(b, left=weave(a.left, b.left), right=weave(a.right, b.right)) for a, b in pairwise(f)]
    return replace(footage, frames=[f[0], *frames])


def knocked(degrees: tuple[float, float, float], first: int = 30) -> Callable[[Footage], Footage]:
    """From frame ``first`` on, the right camera is turned by so much about x, y and z."""

    def turn(footage: Footage) -> Footage:
        c = footage.camera
        H = c.K @ se3.so3_exp(-np.deg2rad(degrees)) @ np.linalg.inv(c.K)

        def one(k: int, f: StereoFrame) -> StereoFrame:
            if k < first:
                return f
            seen = cv2.warpPerspective(f.right, H, (c.width, c.height), flags=cv2.INTER_CUBIC, borderMode=1)
            return replace(f, right=np.asarray(seen, np.uint8))

        return _each(one)(footage)

    return turn


def half_size(footage: Footage) -> Footage:
    """Images of half the size with the calibration of the full one."""
    c = footage.camera

    def halve(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (c.width // 2, c.height // 2), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)

    frames = [_both(f, halve) for f in footage.frames]
    return Footage(replace(c, width=c.width // 2, height=c.height // 2), frames, footage.T_world_cam)


def moving_patch(u_per_frame: float, disparity_px: float = 20.0, share: float = 0.3) -> Callable[[Footage], Footage]:
    """A strong texture over ``share`` of the image that moves ``u_per_frame`` px a frame: 0 moves with the camera."""

    def paint(footage: Footage) -> Footage:
        c = footage.camera
        h, w = round(c.height * share**0.5), round(c.width * share**0.5)
        rng = np.random.default_rng(0)
        coarse = rng.integers(0, 256, (c.height // 6 + 8, c.width // 2 + 8)).astype(np.uint8)
        texture = cv2.resize(coarse, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)
        top, left = c.height - h - c.height // 10, c.width // 3

        def one(image: np.ndarray, shift: float) -> np.ndarray:
            cut = cv2.warpAffine(texture, np.array([[1, 0, -w - shift], [0, 1, 0]]), (w, h), flags=cv2.INTER_LINEAR)
            out = image.copy()
            out[top : top + h, left : left + w] = cut
            return out

        def patch(k: int, f: StereoFrame) -> StereoFrame:
            shift = u_per_frame * (k % 40)
            return replace(f, left=one(f.left, shift), right=one(f.right, shift + disparity_px))

        return _each(patch)(footage)

    return paint


def fixed(
    top: float = 0.0, first: float = 0.0, last: float = 1.0, *, mixed: float = 1.0
) -> Callable[[Footage], Footage]:
    """A texture that moves with the camera, a twentieth of the image apart: from ``top`` of the height down, between
    ``first`` and ``last`` of the width; of every grey value under it, ``mixed`` is its."""

    def paint(footage: Footage) -> Footage:
        c = footage.camera
        down, across = slice(round(top * c.height), None), slice(round(first * c.width), round(last * c.width))
        coarse = np.random.default_rng(1).integers(20, 235, (c.height // 6 + 2, c.width // 5)).astype(np.uint8)
        texture = cv2.resize(coarse, None, fx=6, fy=6, interpolation=cv2.INTER_CUBIC)

        def one(image: np.ndarray, shift: int) -> np.ndarray:
            out = image.copy()
            under = out[down, across]
            over = texture[: under.shape[0], shift : shift + under.shape[1]]
            out[down, across] = cv2.addWeighted(under, 1.0 - mixed, over, mixed, 0.0)
            return out

        return _each(lambda k, f: replace(f, left=one(f.left, 0), right=one(f.right, c.width // 20)))(footage)

    return paint


def lettering(lines: int) -> Callable[[Footage], Footage]:
    """So many lines of white text, alike in both images."""

    def one(image: np.ndarray) -> np.ndarray:
        out = image.copy()
        h, w = image.shape
        for k in range(lines):
            place = (w // 40, (k + 1) * h // (lines + 1))
            text = f"CAM 0 13:02:{k:02d} LAT 49.0113 LON 8.4229"
            cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, w / 800, 255, 1, cv2.LINE_AA)
        return out

    return _each(lambda k, f: _both(f, one))


def specks(count: int, radius_px: int = 5) -> Callable[[Footage], Footage]:
    """So many dots at the same places of both images: dots of a projector far away, or lettering."""

    def paint(footage: Footage) -> Footage:
        c, rng = footage.camera, np.random.default_rng(1)
        dots = rng.uniform([0, 0, 0.5, 20], [c.width, c.height, 1.0, 235], (count, 4))

        def one(image: np.ndarray) -> np.ndarray:
            out = image.copy()
            for x, y, size, grey in dots:
                cv2.circle(out, (int(x), int(y)), int(size * radius_px), grey, -1, cv2.LINE_AA)
            return out

        return _each(lambda k, f: _both(f, one))(footage)

    return paint


FAULTS: dict[str, Callable[[Footage], Footage]] = {
    "clean": lambda footage: footage,
    "darker right": _each(darker_right),
    "gamma flicker": _each(gamma_flicker),
    "flicker": _each(flicker),
    "gain drift": _each(gain_drift),
    "every 2nd frame": every(2),
    "every 3rd frame": every(3),
    "black": _each(black),
    "covered": _each(covered),
    "right black": _each(right_black),
    "frozen right": frozen_right,
    "late right": late_right,
    "interlaced": interlaced,
    "half size": half_size,
    "knocked about x": knocked((0.3, 0.0, 0.0)),
    "swapped": _each(swapped),
    "bonnet of 10 %": fixed(0.9),
    "bonnet of 25 %": fixed(0.75),
    "400 specks": specks(400),
    "patch at rest": moving_patch(0.0),
    "patch that moves": moving_patch(7.0),
    "JPEG 30": _each(jpeg_30),
    "noise 10": _each(noise(10)),
    "noise 25": _each(noise(25)),
    "blur": _each(blur),
    "right blurred": _each(right_blurred),
}

HELD: dict[str, Callable[[Footage], Footage]] = {
    "bonnet over 10 %": fixed(0.9),
    "bonnet over 25 %": fixed(0.75),
    "bonnet over 40 %": fixed(0.6),
    "arm over 15 %": fixed(0.0, 0.25, 0.4),
    "400 specks": specks(400),
    "1000 specks": specks(1000),
    "five lines of lettering": lettering(5),
    "reflection of 30 %": fixed(mixed=0.3),
    "reflection of 50 %": fixed(mixed=0.5),
}
"""What moves with the camera, for the table of the documentation."""
