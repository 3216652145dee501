"""Flights without images: landmarks seen as stereo pixel tracks, with noise, outliers and bad episodes.

A thousand times faster than drawing images, for Monte Carlo and for training on hundreds of flights. The vehicle
follows its path exactly (no flight dynamics); the IMU is that of the path. Each frame's pixel noise belongs to the
frame, so the two motions that share a frame share its noise, as in reality.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gpvo.cameras.rig import RIG_ERRORS, TrueRig
from gpvo.errors import GpvoError
from gpvo.files import write_arrays
from gpvo.geometry import se3
from gpvo.geometry.se3 import R_FLU_OPTICAL
from gpvo.sim import clouds, events, imu
from gpvo.sim.events import Episode, draw_episodes
from gpvo.sim.points_scenario import PointsScenario, check_values, scenarios
from gpvo.types import Array, ImuLog


@dataclass(frozen=True)
class PointsFlight:
    """A simulated flight: what ``save`` writes, and the truth behind it.

    ``frame`` (M,), ``track`` (M,), ``uv_left`` and ``uv_right`` (M, 2) observations; ``t_s`` (N,); ``T_world_cam``
    (N, 4, 4) true poses; ``motion`` the body at the IMU's rate; ``camera_true`` the rig that drew the pixels, beside
    the written one.
    """

    scenario: PointsScenario
    frame: NDArray[np.int32]
    track: NDArray[np.int32]
    uv_left: NDArray[np.float32]
    uv_right: NDArray[np.float32]
    t_s: Array
    T_world_cam: Array
    motion: imu.Motion
    imu: ImuLog
    episodes: tuple[Episode, ...]

    def save(self, path: str | Path) -> Path:
        """Write the stereo tracks, truth, IMU and episodes as ``.npz``; equal flights give equal bytes."""
        target = Path(path)
        c, noise = self.scenario.camera, self.imu.noise
        at_frames = self.motion.thinned(self.scenario.imu_samples_per_frame)
        assert noise is not None
        arrays = {
            "t_s": self.t_s, "frame": self.frame, "track": self.track,
            "uv_left": self.uv_left, "uv_right": self.uv_right,
            "fx": c.fx_px, "fy": c.fy_px, "cx": c.cx_px, "cy": c.cy_px, "baseline_m": c.baseline_m,
            "width": c.width, "height": c.height,
            "T_world_cam": self.T_world_cam, "sigma_translation_m": 0.0, "sigma_rotation_rad": 0.0,
            "R_cam_body": T_BODY_CAM[:3, :3].T, "p_body_cam_in_body_m": T_BODY_CAM[:3, 3],
            "gyro_body_radps": self.imu.gyro_radps[:: self.scenario.imu_samples_per_frame],
            "vel_body_mps": np.einsum("nji,nj->ni", at_frames.R_world_body, at_frames.velocity_mps),
            "imu_t_ns": self.imu.t_ns, "imu_gyro_radps": self.imu.gyro_radps, "imu_acc_mps2": self.imu.acc_mps2,
            "imu_noise": np.array(astuple(noise)),
            "episodes_s": np.array([[e.begin_s, e.end_s] for e in self.episodes]).reshape(-1, 2),
        }  # fmt: skip
        write_arrays(target, arrays, TRACKS)
        return target


TRACKS = (rb"episodes_s\.npy", "flight without images")
# The camera looks forward from the nose, level.
T_BODY_CAM = se3.from_rt(R_FLU_OPTICAL, np.array([0.12, 0.0, 0.02]))


def simulate_points(scenario: str | PointsScenario, seed: int = 0, **overrides: object) -> PointsFlight:
    """Fly a scenario, or that of a name of :func:`scenarios`, once; ``overrides``: single values of it.

    Raises GpvoError for an unknown scenario or value.
    """
    if isinstance(scenario, str):
        if scenario not in scenarios():
            raise GpvoError(f"unknown points scenario '{scenario}'", cure=f"choose from {', '.join(scenarios())}")
        scenario = scenarios()[scenario]
    try:
        chosen = replace(scenario, **overrides)  # type: ignore[arg-type]
    except TypeError as error:
        cure = "see gpvo.sim.points_scenario.PointsScenario"
        raise GpvoError(f"unknown scenario value: {error}", cure=cure) from None
    check_values(vars(chosen))
    # The IMU's rate is a whole multiple of the frames', the nearest, so that frames come as asked for.
    chosen = replace(chosen, imu_rate_hz=chosen.imu_samples_per_frame * chosen.rate_hz)
    # One stream per purpose: more noise must not move the path.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, 77]).spawn(7)]
    scene = streams[0]
    if chosen.world_seed is not None:
        scene = np.random.default_rng(np.random.SeedSequence([chosen.world_seed, 77]).spawn(1)[0])
    path, cloud = clouds.make(chosen, scene)
    return _fly(chosen, path.motion(chosen.imu_rate_hz), cloud, streams)


def _fly(
    scenario: PointsScenario, motion: imu.Motion, cloud: Array, streams: list[np.random.Generator]
) -> PointsFlight:
    at_frames = motion.thinned(scenario.imu_samples_per_frame)
    T_world_cam = se3.from_rt(at_frames.R_world_body, at_frames.position_m) @ T_BODY_CAM
    log, _, _ = imu.measured_imu(motion, imu.PRESETS[scenario.imu], streams[1])
    episodes = draw_episodes(
        scenario.duration_s, streams[2], scenario.episodes_share, scenario.rest_s + 1.0, scenario.causes
    )
    if scenario.texture < 1.0:
        cloud = cloud[streams[6].random(len(cloud)) < scenario.texture]
    bodies = events.draw_movers(
        at_frames.t_s, T_world_cam, streams[6], cars=scenario.cars, smoke=scenario.smoke, dust=scenario.dust
    )
    seen = observe(scenario, at_frames.t_s, T_world_cam, cloud, episodes, streams, bodies)
    track, uv_left, uv_right = (np.concatenate(of_frames) for of_frames in zip(*seen))
    frame = np.repeat(np.arange(len(seen)), [len(of_frame[0]) for of_frame in seen])
    if scenario.shared_px:
        uvd = np.column_stack([uv_left, uv_left[:, 0] - uv_right[:, 0]])
        shift = _shared_px(scenario, frame, track, uvd, streams[6])
        uv_left, uv_right = uv_left + shift[:, :2], uv_right + shift[:, :2] - shift[:, 2:] * [1.0, 0.0]
    return PointsFlight(
        scenario=scenario,
        frame=frame.astype(np.int32),
        track=track.astype(np.int32),
        uv_left=uv_left.astype(np.float32),
        uv_right=uv_right.astype(np.float32),
        t_s=at_frames.t_s,
        T_world_cam=T_world_cam,
        motion=motion,
        imu=log,
        episodes=episodes,
    )


Seen = tuple[NDArray[np.int64], Array, Array]


def observe(
    scenario: PointsScenario, t_s: Array, T_world_cam: Array, cloud: Array, episodes: tuple[Episode, ...],
    streams: list[np.random.Generator], bodies: tuple[events.Body, ...] = (),
) -> list[Seen]:  # fmt: skip
    """Tracks of each frame: identities (n,), left and right pixels (n, 2); points of ``bodies`` follow the cloud's."""
    rig = TrueRig.of(scenario.camera, scenario.tolerance, streams[3].standard_normal(RIG_ERRORS), scenario.offset)
    life, noise = streams[4], streams[5]
    quality = np.exp(scenario.spread * noise.standard_normal())
    total = len(cloud) + sum(len(b.points) for b in bodies)
    active = np.zeros(total, bool)
    generation = np.zeros(total, np.int64)
    last_uv, kept = np.full((total, 2), np.nan), _Kept(scenario, total, streams[6])
    out: list[Seen] = []
    for k, t in enumerate(t_s):
        if scenario.frozen and scenario.frozen[0] <= t < scenario.frozen[1] and out:
            out.append(out[-1])
            continue
        if scenario.dark and scenario.dark[0] <= t < scenario.dark[1]:
            active[:] = False
            out.append((np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2))))
            continue
        cause = next((e.cause for e in episodes if e.begin_s <= t < e.end_s), None)
        noisier, fewer, wronger = events.CAUSES[cause] if cause else (1.0, 1.0, 1.0)
        points = np.concatenate([cloud, *(b.at(k, streams[6]) for b in bodies)]) if bodies else cloud
        left, right, visible, depth = _visible(rig, T_world_cam[k], points, _of_frame(scenario.reach_m, k))
        if bodies:
            visible &= ~events.hidden(bodies, len(cloud), left, depth)
        wanted = int(_of_frame(scenario.tracks, k) * fewer)
        before = active.copy()
        drop = min(1.0, _of_frame(scenario.drop, k) * (3.0 if cause else 1.0))
        _renew(active, generation, visible, wanted, drop, life)
        i = np.flatnonzero(active)
        moved_px, apart_px = kept.follow(k, i, np.flatnonzero(active & ~before))
        flow = np.hypot(*(left[i] - last_uv[i]).T)
        last_uv[:] = np.nan
        last_uv[i] = left[i]
        sigma = quality * (_of_frame(scenario.sigma_px, k) + scenario.blur_px * np.nan_to_num(flow)) * noisier
        if scenario.noise_every and k % scenario.noise_every == 0:
            sigma = np.hypot(sigma, scenario.noise_px)
        n = len(i)
        uv_left = left[i] + moved_px + sigma[:, None] * noise.standard_normal((n, 2))
        uv_right = right[i] + moved_px + sigma[:, None] * noise.standard_normal((n, 2))
        uv_right[:, 0] -= apart_px
        wrong = noise.random(n) < _of_frame(scenario.outliers, k) * wronger
        jump = noise.uniform(-25, 25, (n, 2)) * wrong[:, None]
        out.append((i + generation[i] * total, uv_left + jump, uv_right + jump))
    return out


def _shared_px(
    scenario: PointsScenario, frame: NDArray[np.int64], track: NDArray[np.int64], uvd: Array, rng: np.random.Generator
) -> Array:
    """(M, 3) errors of observations (u, v, d) [px] that points share, as :mod:`gpvo.twin.common` finds them."""
    from gpvo.twin.bundle import Observations
    from gpvo.twin.common import CommonField

    index = np.unique(track, return_inverse=True)[1]
    seen = Observations(scenario.camera, frame, index, uvd, np.ones(len(frame), bool))
    variance = np.zeros((4, 2))
    variance[: len(scenario.shared_px)] = np.square(scenario.shared_px)
    return CommonField.like(variance, 1.0 / scenario.rate_hz, seen).draw(seen, rng)


def _of_frame(values: float | tuple[float, ...], k: int) -> float:
    """The value of frame ``k``: the only one, or of several in turn."""
    return values[k % len(values)] if isinstance(values, (tuple, list)) else values


class _Kept:
    """Errors that each of ``total`` points keeps while it is followed: one of its disparity, and a slip in both images
    that goes on in nearly the same direction, a first-order Gauss-Markov process in its velocity."""

    def __init__(self, scenario: PointsScenario, total: int, rng: np.random.Generator) -> None:
        self._scenario, self._rng = scenario, rng
        self._usual_px = float(np.median(scenario.sigma_px))
        self._memory = float(np.exp(-1.0 / (scenario.rate_hz * scenario.drift_s)))
        self._apart_px, self._moved_px, self._pace = np.zeros(total), np.zeros((total, 2)), np.zeros((total, 2))

    def follow(self, k: int, seen: NDArray[np.int64], new: NDArray[np.int64]) -> tuple[Array, Array]:
        """Shifts (n, 2) in both images and of the disparity (n,) [px] of the points seen in frame ``k``."""
        chosen = self._scenario
        level = _of_frame(chosen.sigma_px, k) / self._usual_px if self._usual_px else 1.0
        if chosen.persistent_px:
            self._apart_px[new] = level * chosen.persistent_px * self._rng.standard_normal(len(new))
        if chosen.drift_px:
            m = self._memory
            self._pace[seen] = m * self._pace[seen] + (1 - m * m) ** 0.5 * self._rng.standard_normal((len(seen), 2))
            self._pace[new] = self._rng.standard_normal((len(new), 2))
            self._moved_px[seen] += level * chosen.drift_px * self._pace[seen]
            self._moved_px[new] = 0.0
        return self._moved_px[seen], self._apart_px[seen]


def _renew(
    active: NDArray[np.bool_], generation: NDArray[np.int64], visible: NDArray[np.bool_], wanted: int, drop: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """End and begin tracks in place: points out of sight end, some more by chance, new ones fill up to ``wanted``."""
    ending = active & (~visible | (rng.random(len(active)) < drop))
    if (surplus := int((active & ~ending).sum()) - wanted) > 0:
        ending[rng.choice(np.flatnonzero(active & ~ending), surplus, replace=False)] = True
    active[ending] = False
    generation[ending] += 1
    candidates = np.flatnonzero(visible & ~active & ~ending)
    room = min(wanted - int(active.sum()), len(candidates))
    if room > 0:
        active[rng.choice(candidates, room, replace=False)] = True


def _visible(
    rig: TrueRig, T_world_cam: Array, points: Array, reach_m: float
) -> tuple[Array, Array, NDArray[np.bool_], Array]:
    """Left and right pixels (n, 2) of world points, which are in both images from 0.4 m on, and depths (n,) [m]."""
    c = rig.camera
    depth = (points - T_world_cam[:3, 3]) @ T_world_cam[:3, 2]
    near = np.flatnonzero((depth > 0.4) & (depth < reach_m))
    seen, pixels = np.ones(len(near), bool), []
    for uv in rig.pixels(se3.transform(se3.inverse(T_world_cam), points[near])):
        u, v = uv[:, 0], uv[:, 1]
        seen &= (u > 2) & (v > 2) & (u < c.width - 3) & (v < c.height - 3)
        whole = np.full((len(points), 2), np.nan)
        whole[near] = uv
        pixels.append(whole)
    visible = np.zeros(len(points), bool)
    visible[near] = seen
    return pixels[0], pixels[1], visible, depth
