"""Simulate a sequence: world, motion, pictures, IMU and truth in EuRoC's layout, whole or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpvo.errors import GpvoError
from gpvo.io.jsonfile import write_json
from gpvo.io.toml import to_toml
from gpvo.sim import imu, sequence_files, sequence_plan, vehicles
from gpvo.sim.imu import Motion
from gpvo.sim.rig import camera_rig, draw_rig
from gpvo.sim.scenario import Scenario
from gpvo.sim.worlds import World, build_world
from gpvo.types import Array

# Stamps of 19 digits, as real recordings have them.
START_NS = 1_600_000_000_000_000_000
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_AHEAD = 16


@dataclass(frozen=True)
class SequenceInfo:
    """What was written. ``redone`` is False where the folder already held this very sequence."""

    path: Path
    scenario: str
    seed: int
    frames: int
    distance_m: float
    redone: bool


def simulate(
    scenario: Scenario,
    seed: int,
    out: str | Path,
    *,
    threads: int = 2,
    on_frame: Callable[[], None] | None = None,
) -> SequenceInfo:
    """Write a sequence folder; a finished one with the same scenario and seed is left as it is.

    The folder appears under its name when it is complete. Equal seeds give equal bytes, on any number of threads.

    Raises
    ------
    GpvoError
        Where the flight crashes or leaves its world, the disk is full, or the folder holds something else.
    MissingExtraError
        Without the extra ``sim``.
    """
    target = Path(out)
    resolved = to_toml({"seed": seed, **scenario.model_dump()})
    if _is_finished(target, resolved):
        poses = np.loadtxt(_truth_file(target), delimiter=",", usecols=(1, 2, 3), ndmin=2)
        frames = sum(1 for _ in (target / "mav0" / "cam0" / "data.csv").open()) - 1
        return SequenceInfo(target, scenario.name, seed, frames, _length(poses), False)
    part = target.with_name(target.name + ".part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir(parents=True)
        frames, distance = _write(scenario, seed, part, threads, on_frame or (lambda: None))
        (part / "scenario.toml").write_text(resolved, encoding="utf-8")
        if target.is_dir():
            target.rmdir()
        os.replace(part, target)
    except OSError as error:
        shutil.rmtree(part, ignore_errors=True)
        cure = "free some space and run again" if error.errno in (errno.ENOSPC, errno.EDQUOT) else None
        raise GpvoError(f"cannot be written: {error.strerror}", where=target, cure=cure) from None
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return SequenceInfo(target, scenario.name, seed, frames, distance, True)


def _is_finished(target: Path, resolved: str) -> bool:
    if not target.exists():
        return False
    file = target / "scenario.toml"
    if file.is_file():
        if file.read_text(encoding="utf-8") == resolved:
            return True
        raise GpvoError("holds another sequence", where=target, cure="remove it, or give another --out")
    if target.is_dir() and not any(target.iterdir()):
        return False
    raise GpvoError("exists and is no simulated sequence", where=target, cure="give another --out")


def _write(
    scenario: Scenario, seed: int, folder: Path, threads: int, on_frame: Callable[[], None]
) -> tuple[int, float]:
    # One stream per purpose: more noise must not move the path.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, 78]).spawn(5)]
    world_seed = seed if scenario.world_seed is None else scenario.world_seed
    world = build_world(scenario.world, world_seed, **scenario.world_params)
    path = sequence_plan.plan_path(scenario, world, streams[0])
    motion = sequence_plan.move(scenario, path)
    sequence_plan.check_motion(scenario, world, motion)
    written = camera_rig(scenario.camera)
    sequence_files.write_calibration(folder, written, scenario.rate_hz, scenario.imu_offset_s)
    _write_states(scenario, folder, motion, streams[1])
    episodes = sequence_plan.plan_episodes(scenario, streams[2])
    frames = sequence_plan.plan_frames(scenario, episodes, streams[3])
    write_json(
        folder / "episodes.json",
        {
            "schema": 1,
            "episodes": [{"begin_s": e.begin_s, "end_s": e.end_s, "cause": e.cause} for e in episodes],
            "frames": {f"{k}": f.fate for k, f in enumerate(frames) if f.fate != "shown"},
            "t_start_ns": START_NS,
        },
    )
    eye = _Eye(scenario, seed, world, draw_rig(written, scenario.tolerance, streams[4]), motion, threads)
    count = _write_images(scenario, folder, frames, eye, threads, on_frame)
    return count, _length(motion.position_m[::50])


def _write_states(scenario: Scenario, folder: Path, motion: Motion, rng: np.random.Generator) -> None:
    every = max(1, round(vehicles.RATE_HZ / scenario.imu_rate_hz))
    thin = motion.thinned(every)
    gravity = sequence_plan.gravity_mps2(scenario)
    shift = START_NS + round(scenario.imu_offset_s * 1e9)
    log, bias_gyro, bias_acc = imu.measured_imu(thin, imu.PRESETS[scenario.imu], rng, shift, gravity)
    sequence_files.write_imu(folder, log, vehicles.RATE_HZ / every, gravity)
    t_ns = START_NS + np.rint(thin.t_s * 1e9).astype(np.int64)
    sequence_files.write_truth(folder, t_ns, thin, bias_gyro, bias_acc)


class _Eye:
    """World to pictures: renderer and sensor of the true rig."""

    def __init__(self, scenario: Scenario, seed: int, world: World, rig: Any, motion: Motion, threads: int) -> None:
        from gpvo.sim.render import StereoRenderer
        from gpvo.sim.sensor import SensorModel, SensorParams

        self._renderer = StereoRenderer(world, rig.left, rig.right, rig.T_right_left, threads=threads)
        try:
            params = SensorParams(**scenario.sensor)
        except TypeError as error:
            raise GpvoError(f"unknown value of 'sensor': {error}") from None
        self._sensor = SensorModel(params, seed, threads=threads)
        self._motion, self._T_body_left = motion, rig.T_body_left

    def see(self, index: int, plan: sequence_plan.FramePlan) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        pose, blur = sequence_plan.camera_poses(self._motion, plan.step, plan.exposure_s, self._T_body_left)
        left, right, depth = self._renderer.render(pose, motion=blur)
        both = self._renderer.depth_right
        depths = depth if both is None else [depth, both]
        a, b = self._sensor.expose(
            left, right, index, depth=depths, darkness=plan.light, dust=plan.dust, noise_sigma=plan.noise_sigma
        )
        if plan.fate == "black":
            return np.zeros_like(a), np.zeros_like(b)
        return a, b


def _write_images(
    scenario: Scenario, folder: Path, frames: list[sequence_plan.FramePlan], eye: _Eye, threads: int,
    on_frame: Callable[[], None],
) -> int:  # fmt: skip
    for camera in ("cam0", "cam1"):
        (folder / "mav0" / camera / "data").mkdir(parents=True, exist_ok=True)
    stamps: list[int] = []
    shown = None
    pending: list[Future[None]] = []
    with ThreadPoolExecutor(max(1, threads)) as pool:
        for k, plan in enumerate(frames):
            on_frame()
            if plan.fate == "dropped":
                continue
            if shown is None or plan.fate != "frozen":
                shown = eye.see(k, plan)
            late = scenario.late_s if plan.fate == "late" else 0.0
            stamp = START_NS + plan.step * round(1e9 / vehicles.RATE_HZ) + round(late * 1e9)
            stamps.append(stamp)
            for camera, image in zip(("cam0", "cam1"), shown):
                pending.append(pool.submit(_save, folder / "mav0" / camera / "data" / f"{stamp}.png", image))
            while len(pending) > _AHEAD:
                pending.pop(0).result()
        for job in pending:
            job.result()
    for camera in ("cam0", "cam1"):
        sequence_files.write_image_list(folder, camera, stamps)
    return len(stamps)


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", image, _PNG)[1].tobytes())


def _truth_file(folder: Path) -> Path:
    return folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"


def _length(position_m: Array) -> float:
    return float(np.linalg.norm(np.diff(position_m, axis=0), axis=1).sum())
