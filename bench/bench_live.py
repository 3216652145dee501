"""``gpvo live`` between two other processes: latency, messages that did not arrive, and memory over time.

A publisher at 20 Hz (pictures of 752x480, or poses), ``gpvo live``, and a subscriber, over each transport that is
installed. Latency is wall-clock time from sending to receiving, so it counts whatever else the machine does.
``GPVO_LIVE_SECONDS``: how long each lasts, 20 by default.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from gpvo.dataset.build import build
from gpvo.geometry import se3
from gpvo.io.foreign import T_FLU_OPTICAL
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.online import modelfile
from gpvo.types import Status, TruthLog, VoLog, VoRecord
from tests.vo.rendered_clip import pinhole, render_clip, wander

from bench.live_peers import LEFT, POSES, RIGHT, pose

_ROOT = Path(__file__).parents[1]
_READINGS = 10
_SYSTEM_PYTHON = "/usr/bin/python3"


def run() -> dict[str, dict[str, object]]:
    """Results by name."""
    seconds = float(os.environ.get("GPVO_LIVE_SECONDS", "20"))
    rows: dict[str, dict[str, object]] = {}
    with tempfile.TemporaryDirectory() as folder:
        model, clip = _shim_model(Path(folder)), _clip(Path(folder))
        for wire in _wires():
            pictures = ("--stereo", LEFT, RIGHT, "--model", str(_ROOT / "models" / "tunnel.gpvo"))
            rows |= _rows(f"{wire}, pictures", measure(wire, ["pictures", str(clip)], pictures, seconds), 25, 60)
            shim = ("--odometry", POSES, "--model", str(model))
            rows |= _rows(f"{wire}, shim", measure(wire, ["poses"], shim, seconds), None, None)
    return rows


def _rows(name: str, got: dict[str, Any], p50: float | None, p99: float | None) -> dict[str, dict[str, object]]:
    def row(value: float, unit: str, limit: float | None) -> dict[str, object]:
        peer = {} if limit is None else {"peer": "goal", "peer_value": limit, "ratio": value / limit}
        return {"value": value, "unit": unit, **peer}

    rows = {
        f"{name}: latency, median": row(got["p50_ms"], "ms", p50),
        f"{name}: latency, 99 %": row(got["p99_ms"], "ms", p99),
        f"{name}: own latency, median": row(got["own_ms"][0], "ms", None if p50 else 2.0),
        f"{name}: missing of {got['sent']}": row(got["missing"], "messages", None),
        f"{name}: end after SIGTERM": row(got["end_s"], "s", 1.0),
        f"{name}: memory, end less second reading": row(got["rss_mb"][-1] - got["rss_mb"][1], "MB", None),
    }
    print(f"{name}: memory [MB] {got['rss_mb']}, CPU {got['cpu_percent']:.0f} %", file=sys.stderr, flush=True)
    return rows


def measure(wire: str, source: list[str], options: tuple[str, ...], seconds: float) -> dict[str, Any]:
    """One run of three processes: latencies [ms], own latency by its diagnostics, memory [MB] read ten times."""
    place, sent = _place(wire), round(20 * seconds)
    where = {"zenoh": ["--address", place], "dds": ["--domain", place], "ros1": []}[wire]
    environment = _environment(wire, place)
    with ExitStack() as held:
        if wire == "zenoh":
            held.enter_context(_router(place))
        if wire == "ros1":
            held.enter_context(_process(environment, "rosmaster", "--core", "-p", place.rpartition(":")[2]))
            time.sleep(1.0)
        python = _SYSTEM_PYTHON if wire == "ros1" else sys.executable
        command = [python, "-m", "gpvo", "live", *options, f"--{wire}", *where]
        live = held.enter_context(_process(environment, *command, ready="listening"))
        peer = [python, "-m", "bench.live_peers"]
        listen = [*peer, "listen", wire, place, str(sent - 1), str(seconds + 20)]
        listener = held.enter_context(_process(environment, *listen, ready="ready"))
        sender = held.enter_context(_process(environment, *peer, source[0], wire, place, str(seconds), *source[1:]))
        seen, rss = psutil.Process(live.pid), []
        for _ in range(_READINGS):
            time.sleep((seconds + 2) / _READINGS)
            rss.append(round(seen.memory_info().rss / 1e6, 1))
        cpu = sum(seen.cpu_times()[:2])
        sent_ns = dict(json.loads(sender.communicate(timeout=60)[0]))
        got = json.loads(listener.communicate(timeout=60)[0].splitlines()[-1])
        start = time.monotonic()
        live.send_signal(signal.SIGTERM)
        live.communicate(timeout=20)
        end_s = time.monotonic() - start
    came = got["came"]
    p50, p99 = np.percentile([(at_ns - sent_ns[stamp]) * 1e-6 for stamp, at_ns in came], [50, 99])
    own = [float(v) for v in got["health"].get("latency_ms_p50_p99", "nan nan").split()]
    missing = sent - 1 - len(came)  # the first message is no motion
    return {"p50_ms": p50, "p99_ms": p99, "own_ms": own, "sent": sent, "missing": missing, "rss_mb": rss,
            "cpu_percent": 100 * cpu / seconds, "end_s": end_s, "health": got["health"]}  # fmt: skip


def _wires() -> list[str]:
    have = [name for name, package in (("zenoh", "zenoh"), ("dds", "cyclonedds")) if importlib.util.find_spec(package)]
    probe = [_SYSTEM_PYTHON, "-c", "import rospy, netifaces, nav_msgs.msg, sensor_msgs.msg, diagnostic_msgs.msg, numpy"]
    if shutil.which("rosmaster") and Path(_SYSTEM_PYTHON).exists():
        have += ["ros1"] * (subprocess.run(probe, env=_environment("ros1", ""), capture_output=True).returncode == 0)
    return have


def _place(wire: str) -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    return {"zenoh": f"tcp/127.0.0.1:{port}", "dds": str(100 + port % 100), "ros1": f"http://localhost:{port}"}[wire]


def _environment(wire: str, place: str) -> dict[str, str]:
    path = [str(_ROOT)] + ([sysconfig.get_path("purelib")] if wire == "ros1" else [])
    ros = {"ROS_PYTHON_VERSION": "3", "ROS_HOSTNAME": "localhost", "ROS_MASTER_URI": place} if wire == "ros1" else {}
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path), **ros}


@contextmanager
def _router(place: str) -> Iterator[None]:
    from gpvo.live.rosless_wire import ZenohWire

    router = ZenohWire(f"listen:{place}", node="router")
    try:
        yield
    finally:
        router.close()


@contextmanager
def _process(environment: dict[str, str], *command: str, ready: str | None = None) -> Iterator[subprocess.Popen[str]]:
    """A process, ended at the end; ``ready``: a word of its first line."""
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True)
        try:
            for _ in range(600):
                if ready is None or process.poll() is not None:
                    break
                if ready == "ready":
                    assert process.stdout is not None
                    assert process.stdout.readline().strip() == ready
                    break
                errors.seek(0)
                if ready in errors.read():
                    break
                time.sleep(0.05)
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.communicate(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()


def _shim_model(folder: Path) -> Path:
    """A model of an odometry that flies as the publisher does."""
    rng, sets = np.random.default_rng(0), []
    T_true = np.array([pose(k / 20) for k in range(600)]) @ T_FLU_OPTICAL
    for k in range(2):
        noise = se3.exp(1e-3 * rng.standard_normal((len(T_true) - 1, 6)))
        motions = se3.inverse(T_true[:-1]) @ T_true[1:] @ noise
        t_ns = np.arange(len(T_true), dtype=np.int64) * 50_000_000
        records = [VoRecord(0, 0, Status.START, np.eye(4))]
        records += [VoRecord(int(b), int(a), Status.OK, M) for a, b, M in zip(t_ns[:-1], t_ns[1:], motions)]
        sets.append(build(VoLog(records), TruthLog(t_ns, T_true), name=f"flight{k}"))
    model = train_sets(sets, TrainConfig(features="velocity,rotation"), judge=False)
    modelfile.save(folder / "shim.gpvo", model.arrays, model.header)
    return folder / "shim.gpvo"


def _clip(folder: Path) -> Path:
    camera = pinhole(752, 480, 0.11)
    clip = render_clip(camera, wander(60))
    pairs = np.array([[f.left, f.right] for f in clip.frames], dtype=np.uint8)
    place: dict[str, Any] = {"f": camera.fx_px, "cx": camera.cx_px, "cy": camera.cy_px, "baseline_m": camera.baseline_m}
    np.savez(folder / "clip.npz", pairs=pairs, **place)
    return folder / "clip.npz"
