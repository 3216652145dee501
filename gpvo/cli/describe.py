"""What any file is: the documents behind ``gpvo info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gpvo.errors import GpvoError, ModelError, SourceError, printable
from gpvo.geometry.se3 import path_length_m
from gpvo.io.bag_reader import IMAGE_TYPES, is_bag, open_bag, topics_of
from gpvo.io.foreign import guess_format, read_foreign
from gpvo.io.parquet import count_rows, read_blocks
from gpvo.io.run import read_run
from gpvo.io.run_read import is_run
from gpvo.io.source import existing, guess, open_source
from gpvo.io.trajectory import read_kitti_poses
from gpvo.types import frequent_reasons

_HEAD = 100_000


def describe(path: Path, kind: str | None = None, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """A document with ``what`` (run, model, sequence, trajectory, calibration, bag or table) and what is known of it.

    ``kind`` treats the path as a sequence of that format, ``options`` go to its source. Raises GpvoError if the path is
    nothing that gpvo knows, or is damaged.
    """
    path = existing(path)
    if kind is None and path.suffix.lower() in (".safetensors", ".gpvo"):
        return _model(path)
    if kind is None:
        if is_run(path):
            return _run(path)
        if path.suffix.lower() in (".yaml", ".yml"):
            return _calibration(path)
        if path.suffix.lower() == ".parquet":
            return {"what": "table", "rows": count_rows(path), "columns": list(next(read_blocks(path), {}))}
        if path.suffix.lower() in (".txt", ".csv", ".tum"):
            return _projections(path) or _trajectory(path)
        if is_bag(path) and guess(path) == "rosbag":
            return _bag(path, options or {})
        if path.is_file() and path.suffix.lower() != ".npz" and _is_safetensors(path):
            return _model(path)
    return _sequence(path, kind or guess(path), options or {})


def _sequence(path: Path, kind: str, options: dict[str, Any]) -> dict[str, Any]:
    source = open_source(path, kind, **options)
    camera, truth, imu = source.camera, source.truth, source.imu
    duration = (source.span_ns[1] - source.span_ns[0]) * 1e-9
    return {
        "what": "sequence",
        "format": source.format,
        "kind": source.kind,
        "frames": len(source),
        "duration_s": duration,
        "rate_hz": (len(source) - 1) / duration if duration > 0 else None,
        "camera": camera.__dict__,
        "rectified": None if source.calibration is None else source.calibration["left"]["model"],
        "truth": None if truth is None else _poses(truth.t_ns, truth.T_world_cam),
        "imu": None if imu is None else _imu(imu),
        "notes": source.report.notes,
    }


def _imu(imu: Any) -> dict[str, Any]:
    span = (imu.t_ns[-1] - imu.t_ns[0]) * 1e-9
    return {
        "samples": len(imu.t_ns),
        "rate_hz": (len(imu.t_ns) - 1) / span if span > 0 else None,
        "accelerometer": bool(np.isfinite(imu.acc_mps2).any()),
        "noise": None if imu.noise is None else imu.noise.__dict__,
    }


def _poses(t_ns: Any, T: Any) -> dict[str, Any]:
    return {
        "poses": len(t_ns),
        "duration_s": float(t_ns[-1] - t_ns[0]) * 1e-9,
        "path_length_m": float(path_length_m(T[:, :3, 3])[-1]),
    }


def _run(path: Path) -> dict[str, Any]:
    run = read_run(path)
    log = run.log
    tracks = path / "tracks.parquet"
    return {
        "what": "run",
        "name": run.name,
        "complete": bool(run.meta.get("complete")),
        "source": run.meta.get("source"),
        "frames": len(log),
        "statuses": {s: int(n) for s, n in zip(*np.unique([s.value for s in log.statuses], return_counts=True))},
        "not_ok": frequent_reasons(log.column("reason").tolist()),
        "methods": list(log.methods),
        "camera": None if log.camera is None else log.camera.__dict__,
        "odometry": _poses(log.t_ns, log.trajectory()),
        "truth": None if run.truth is None else _poses(run.truth.t_ns, run.truth.T_world_cam),
        "imu": None if run.imu is None else _imu(run.imu),
        "predictions": len(run.predictions),
        "tracks": {"observations": count_rows(tracks)} if tracks.is_file() else None,
    }


def _trajectory(path: Path) -> dict[str, Any]:
    name = guess_format(path)
    if name == "kitti":
        T = read_kitti_poses(path)
        return {"what": "trajectory", "format": name, **_poses(np.zeros(len(T)), T), "duration_s": None}
    log = read_foreign(path, name)
    return {
        "what": "trajectory",
        "format": name,
        **_poses(log.t_ns, log.trajectory.T_world_body),
        "covariance": log.covariance is not None,
        "columns": list(log.columns),
        "notes": list(log.notes),
    }


def _calibration(path: Path) -> dict[str, Any]:
    from gpvo.cameras.readers import read_stereo_yaml

    rig = read_stereo_yaml(path)
    return {"what": "calibration", "baseline_m": rig.baseline_m, **rig.describe()}


def _projections(path: Path) -> dict[str, Any] | None:
    """KITTI's ``calib.txt``, which states no size; None for any other text."""
    from gpvo.cameras.readers import read_projections

    with path.open("rb") as file:
        if not any(line.startswith((b"P0:", b"P_rect_00:")) for line in file.read(_HEAD).splitlines()):
            return None
    P = read_projections(path)
    x_m = {name: -p[0, 3] / p[0, 0] for name, p in P.items() if p[0, 0]}
    return {
        "what": "calibration",
        "format": "kitti",
        **{name: {"fx_px": p[0, 0], "fy_px": p[1, 1], "cx_px": p[0, 2], "cy_px": p[1, 2]} for name, p in P.items()},
        "baseline_m": {f"{a} {b}": x_m[b] - x_m[a] for a, b in (("P0", "P1"), ("P2", "P3")) if a in x_m and b in x_m},
    }


def _model(path: Path) -> dict[str, Any]:
    from gpvo.online import modelfile

    _, header = modelfile.load(path)
    try:
        learned = {name: m.get("learned") or {} for name, m in (header.get("scores") or {}).items()}
        return {
            "what": "model",
            **{key: header.get(key) for key in ("target", "frame", "rate_hz", "base_method", "camera", "features")},
            "trained_on": [s["name"] for s in header.get("sequences") or []],
            "nees_dof_left_out": {name: m.get("nees_dof", {}).get("joint") for name, m in learned.items()},
            "versions": header.get("versions"),
            "header": header,
        }
    except (AttributeError, KeyError, TypeError):
        raise ModelError("its header is damaged", where=path) from None


def _is_safetensors(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            head = file.read(9)
    except OSError as error:
        raise SourceError(f"cannot be read: {error.strerror}", where=path) from None
    return len(head) == 9 and head[8:] == b"{" and int.from_bytes(head[:8], "little") < 100_000_000


def _bag(path: Path, options: dict[str, Any]) -> dict[str, Any]:
    with open_bag(path) as reader:
        document: dict[str, Any] = {
            "what": "bag",
            "duration_s": reader.duration * 1e-9,
            "sequence": None,
            "topics": {n: {"type": t.msgtype, "messages": t.msgcount} for n, t in sorted(reader.topics.items())},
        }
        has_images = bool(topics_of(reader, IMAGE_TYPES))
    try:
        if has_images or options:
            document["sequence"] = _sequence(path, "rosbag", options)
    except GpvoError as error:
        document["notes"] = [str(error)]
    return document


def as_lines(document: dict[str, Any], indent: str = "") -> list[str]:
    """A document as short lines for people; what is unknown or empty is left out."""
    lines = []
    for key, value in document.items():
        if value is None or value in ([], {}):
            continue
        if isinstance(value, dict) and (len(str(value)) > 90 or any(isinstance(v, dict) for v in value.values())):
            lines += [f"{indent}{key}:", *as_lines(value, indent + "  ")]
        elif isinstance(value, dict):
            lines.append(f"{indent}{key}: " + ", ".join(f"{k} {_short(v)}" for k, v in value.items()))
        elif isinstance(value, list):
            lines.append(f"{indent}{key}: " + ", ".join(_short(v) for v in value))
        else:
            lines.append(f"{indent}{key}: {_short(value)}")
    return [printable(line) for line in lines]


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
