"""Simulate a sequence: world, motion, images, IMU and truth in EuRoC's layout, with Kalibr's calibration, whole or not
at all; and a contact sheet of its images.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from gpvo.cameras.kalibr import NOISE_KEYS
from gpvo.cameras.models import CameraModel
from gpvo.cameras.rig import StereoRig
from gpvo.errors import GpvoError, OutputError
from gpvo.files import FolderLock, digest_of_file, make_folder, replacing, to_toml, write_json
from gpvo.geometry import se3
from gpvo.geometry.se3 import path_length_m
from gpvo.io.images import read_grey8
from gpvo.sim import imu, sequence_plan, vehicles
from gpvo.sim.eye import Eye, optical_flow
from gpvo.sim.imu import Motion
from gpvo.sim.rig import CAMERAS, RigError, camera_rig, mounted, true_rig
from gpvo.sim.scenario import Flight, Scenario, require_pictures
from gpvo.sim.sequence_plan import FramePlan
from gpvo.sim.worlds import build_world
from gpvo.types import Array, ImuLog

# Stamps of 19 digits, as real recordings have them.
START_NS = 1_600_000_000_000_000_000
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
_AHEAD = 16
_WIDTH_PX = 320  # of an image on the contact sheet
_HEAD_BYTES = 33  # of a PNG: its signature, and the size of the image
SHEET = (b"Software\x00gpvo simulate", "contact sheet")  # the text is a PNG's own way to say so
_CAMERA_HEAD = "#timestamp [ns],filename"
_IMU_HEAD = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_TRUTH_HEAD = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)


def simulate(
    scenario: Scenario, seed: int, target: Path, *, threads: int = 2, on_frame: Callable[[], None] = lambda: None
) -> Flight:
    """Write a sequence folder; a finished one with the same scenario and seed is left as it is.

    The folder appears under its name when it is complete. Equal seeds give equal bytes, on any number of threads.
    Raises GpvoError for a scenario of landmarks alone; where the flight crashes or leaves its world, the disk is full,
    or the folder holds something else. Raises MissingExtraError without the extra ``sim``.
    """
    require_pictures(scenario)
    resolved = to_toml({"seed": seed, **scenario.model_dump(), **_digests(scenario)})
    with _only_writer(target):
        if _is_finished(target, resolved):
            states = target / "mav0" / "state_groundtruth_estimate0" / "data.csv"
            position_m = np.loadtxt(states, delimiter=",", usecols=(1, 2, 3), ndmin=2)
            frames = sum(1 for _ in (target / "mav0" / "cam0" / "data.csv").open()) - 1
            return Flight(seed, target, frames, float(path_length_m(position_m)[-1]), redone=False)
        part = target.with_name(target.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        try:
            part.mkdir(parents=True)
            frames, distance, drawn = _write(scenario, seed, part, threads, on_frame)
            (part / "scenario.toml").write_text(resolved + "\n" + to_toml({"drawn": drawn}), encoding="utf-8")
            if target.is_dir():
                target.rmdir()
            os.replace(part, target)
        except OSError as error:
            cure = "free some space and run again" if error.errno in (errno.ENOSPC, errno.EDQUOT) else None
            raise OutputError(f"cannot be written: {error.strerror}", where=target, cure=cure) from None
        finally:
            shutil.rmtree(part, ignore_errors=True)
    return Flight(seed, target, frames, distance)


def _digests(scenario: Scenario) -> dict[str, dict[str, str]]:
    """What the files hold that a scenario names: with another content, it is another scenario."""
    files: dict[str, str] = {}
    if scenario.camera not in CAMERAS:
        rig = json.dumps(camera_rig(scenario.camera).describe(), sort_keys=True)
        files["camera"] = hashlib.sha256(rig.encode()).hexdigest()
    path = Path(scenario.trajectory or "")
    recorded = path / "vo_log.parquet" if path.is_dir() else path
    if scenario.trajectory and recorded.is_file():
        files["trajectory"] = digest_of_file(recorded)
    return {"files": files} if files else {}


@contextmanager
def _only_writer(target: Path) -> Iterator[None]:
    """Hold a lock beside the folder, so that two processes never fill one; it falls when the process dies."""
    file = target.with_name(target.name + ".lock")
    make_folder(target.parent)
    with FolderLock(file, create=True, where=target):
        try:
            yield
        finally:
            file.unlink(missing_ok=True)


def _is_finished(target: Path, resolved: str) -> bool:
    if not target.exists():
        return False
    file = target / "scenario.toml"
    if file.is_file():
        text = file.read_text(encoding="utf-8")
        if text.startswith(resolved + "\n"):
            return True
        pairs = zip(text.splitlines(), resolved.splitlines())
        difference = next((f" ({there}, not {here})" for there, here in pairs if there != here), "")
        raise GpvoError(f"holds another sequence{difference}", where=target, cure="remove it, or give another --out")
    if target.is_dir() and not any(target.iterdir()):
        return False
    raise GpvoError("exists and is not a simulated sequence", where=target, cure="give another --out")


def _write(
    scenario: Scenario, seed: int, folder: Path, threads: int, on_frame: Callable[[], None]
) -> tuple[int, float, dict[str, Any]]:
    """Fill the folder; returns frames, length of the path [m] and what was drawn."""
    # One stream per purpose: more noise must not move the path.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, 78]).spawn(5)]
    world_seed = seed if scenario.world_seed is None else scenario.world_seed
    parameters = sequence_plan.world_parameters(scenario)
    world = build_world(scenario.world, world_seed, **parameters)
    path = sequence_plan.plan_path(scenario, world, streams[0])
    motion = sequence_plan.move(scenario, path, world)
    sequence_plan.check_motion(scenario, world, motion)
    written = mounted(camera_rig(scenario.camera), scenario.vehicle, scenario.camera_pitch_deg)
    _write_calibration(folder, written, scenario.rate_hz, scenario.imu_offset_s)
    episodes = sequence_plan.plan_episodes(scenario, streams[2])
    frames = sequence_plan.plan_frames(scenario, episodes, streams[3])
    _write_states(scenario, folder, motion, frames, streams[1])
    error = RigError.draw(scenario.tolerance, streams[4], scenario.offset)
    document = {
        "schema": 1,
        "t_start_ns": START_NS,
        "episodes": [{"begin_s": e.begin_s, "end_s": e.end_s, "cause": e.cause} for e in episodes],
        "frames": {f"{k}": f.fate for k, f in enumerate(frames) if f.fate != "shown"},
    }
    write_json(folder / "episodes.json", document)
    eye = Eye(scenario, seed, world, true_rig(written, error), motion, threads)
    count = _write_images(scenario, folder, frames, eye, threads, on_frame)
    drawn = {"world_seed": world_seed, "world_params": parameters, "rig_error": asdict(error)}
    return count, float(path_length_m(motion.position_m[::50])[-1]), drawn


def _write_states(
    scenario: Scenario, folder: Path, motion: Motion, frames: list[FramePlan], rng: np.random.Generator
) -> None:
    """IMU at its rate; truth at its rate and at every frame, so that no pose of a frame need be interpolated."""
    every = max(1, round(vehicles.RATE_HZ / scenario.imu_rate_hz))
    thin = motion.thinned(every)
    gravity = sequence_plan.gravity_mps2(scenario)
    shift = START_NS + round(scenario.imu_offset_s * 1e9)
    log, bias_gyro, bias_acc = imu.measured_imu(thin, imu.PRESETS[scenario.imu], rng, shift, gravity)
    _write_imu(folder, log, vehicles.RATE_HZ / every, gravity)
    steps = np.union1d(np.arange(0, len(motion.t_s), every), [f.step for f in frames if f.step < len(motion.t_s)])
    t_ns = START_NS + np.rint(motion.t_s[steps] * 1e9).astype(np.int64)
    _write_truth(folder, t_ns, motion.at(steps), bias_gyro[steps // every], bias_acc[steps // every])


def _write_images(
    scenario: Scenario, folder: Path, frames: list[FramePlan], eye: Eye, threads: int,
    on_frame: Callable[[], None],
) -> int:  # fmt: skip
    mav = folder / "mav0"
    cameras = mav / "cam0", mav / "cam1"
    for camera in cameras:
        (camera / "data").mkdir(parents=True, exist_ok=True)
    stamps: list[int] = []
    shown = seen_before = None
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
            if scenario.depth and eye.depth_m is not None:
                pending.append(pool.submit(_save_array, mav / "depth0" / f"{stamp}.npy", eye.depth_m))
            if scenario.flow and eye.depth_m is not None and plan.fate != "frozen":
                if seen_before is not None:
                    before, depth_m, T_world_cam = seen_before
                    flow_px = optical_flow(eye.model, depth_m, eye.depth_m, T_world_cam, eye.T_world_cam)
                    pending.append(pool.submit(_save_array, mav / "flow0" / f"{before}.npy", flow_px))
                seen_before = (stamp, eye.depth_m, eye.T_world_cam)
            for camera, image in zip(cameras, shown):
                pending.append(pool.submit(_save, camera / "data" / f"{stamp}.png", image))
            while len(pending) > _AHEAD:
                pending.pop(0).result()
        for job in pending:
            job.result()
    for camera in cameras:
        lines = [_CAMERA_HEAD, *(f"{t},{t}.png" for t in stamps)]
        (camera / "data.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return len(stamps)


def _save(path: Path, image: NDArray[np.uint8]) -> None:
    path.write_bytes(cv2.imencode(".png", image, _PNG)[1].tobytes())


def _save_array(path: Path, values: NDArray[np.float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values, allow_pickle=False)


def _write_calibration(folder: Path, rig: StereoRig, rate_hz: float, offset_s: float) -> None:
    """``body.yaml``, ``cam0`` and ``cam1/sensor.yaml``, and ``dso/camchain.yaml``."""
    assert rig.T_body_left is not None
    _yaml(folder / "mav0" / "body.yaml", {"comment": "gpvo simulator", "axes": "FLU"})
    T_body_right = rig.T_body_left @ se3.inverse(rig.T_right_left)
    chain: dict[str, Any] = {}
    for i, (lens, T) in enumerate(((rig.left, rig.T_body_left), (rig.right, T_body_right))):
        values = _lens(lens, "coefficients", "radial-tangential")
        _sensor(folder / "mav0" / f"cam{i}", "camera", T, rate_hz=rate_hz, **values)
        chain[f"cam{i}"] = {
            "T_cam_imu": se3.inverse(T).tolist(),
            **_lens(lens, "coeffs", "radtan"),
            "rostopic": f"/cam{i}/image_raw",
            "timeshift_cam_imu": offset_s,
        }
    chain["cam1"]["T_cn_cnm1"] = rig.T_right_left.tolist()
    _yaml(folder / "dso" / "camchain.yaml", chain)


def _write_imu(folder: Path, log: ImuLog, rate_hz: float, gravity_mps2: float) -> None:
    """``imu0`` and ``dso/imu_config.yaml``."""
    densities = {key: getattr(log.noise, field) for key, field in NOISE_KEYS.items()}
    _sensor(folder / "mav0" / "imu0", "imu", np.eye(4), rate_hz=rate_hz, **densities, gravity_mps2=gravity_mps2)
    _yaml(folder / "dso" / "imu_config.yaml", {**densities, "update_rate": rate_hz, "rostopic": "/imu0"})
    rows = np.concatenate([log.gyro_radps, log.acc_mps2], axis=1)
    _csv(folder / "mav0" / "imu0" / "data.csv", _IMU_HEAD, log.t_ns, rows)


def _write_truth(folder: Path, t_ns: NDArray[np.int64], motion: Motion, bias_gyro: Array, bias_acc: Array) -> None:
    """``state_groundtruth_estimate0``: the body's exact states and the IMU's true biases."""
    base = folder / "mav0" / "state_groundtruth_estimate0"
    _sensor(base, "visual-inertial", np.eye(4), sigma_translation_m=0.0, sigma_rotation_rad=0.0)
    q_wxyz = np.roll(se3.rotation_to_quaternion_xyzw(motion.R_world_body), 1, axis=1)
    rows = np.concatenate([motion.position_m, q_wxyz, motion.velocity_mps, bias_gyro, bias_acc], axis=1)
    _csv(base / "data.csv", _TRUTH_HEAD, t_ns, rows)


def _lens(lens: CameraModel, coefficients: str, radtan: str) -> dict[str, Any]:
    """In the words of EuRoC or of Kalibr."""
    name = lens.distortion_model
    return {
        "camera_model": "pinhole",
        "intrinsics": lens.intrinsics_px,
        "distortion_model": radtan if name == "radtan" else name,
        f"distortion_{coefficients}": lens.coefficients,
        "resolution": [lens.width, lens.height],
    }


def _sensor(folder: Path, kind: str, T_body_sensor: Array, **values: Any) -> None:
    pose = {"cols": 4, "rows": 4, "data": T_body_sensor.ravel().tolist()}
    _yaml(folder / "sensor.yaml", {"sensor_type": kind, "T_BS": pose, **values})


def _yaml(path: Path, document: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120)
    path.write_text(text, encoding="utf-8")


def _csv(path: Path, head: str, t_ns: NDArray[np.int64], rows: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(head + "\n")
        for t, row in zip(t_ns.tolist(), rows.tolist()):
            file.write(f"{t}," + ",".join(f"{v:.12g}" for v in row) + "\n")


def contact_sheet(sequence: Path, out: Path) -> None:
    """Write three rows of two pairs, left and right side by side and spread evenly over the sequence, as a PNG."""
    files = [sorted((sequence / "mav0" / camera / "data").glob("*.png")) for camera in ("cam0", "cam1")]
    if not files[0]:
        raise GpvoError("holds no images", where=sequence)
    tiles = []
    for k in np.linspace(0, len(files[0]) - 1, 6).astype(int):
        small = []
        for file in (side[k] for side in files):
            if (image := read_grey8(file)) is None:
                raise GpvoError("is not an image", where=file)
            small.append(cv2.resize(image, (_WIDTH_PX, round(image.shape[0] * _WIDTH_PX / image.shape[1]))))
        tiles.append(np.pad(np.hstack(small), 2, constant_values=255))
    sheet = np.vstack([np.hstack(tiles[k : k + 2]) for k in (0, 2, 4)])
    png = cv2.imencode(".png", sheet)[1].tobytes()
    text = b"tEXt" + SHEET[0]
    signed = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    with replacing(out, SHEET) as temporary:
        temporary.write_bytes(png[:_HEAD_BYTES] + signed + png[_HEAD_BYTES:])
