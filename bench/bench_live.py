"""``gpvo live`` between two other processes: latency, messages that did not arrive, and memory over time.

A publisher at 20 Hz (pictures of 752x480, or poses), ``gpvo live``, and a subscriber, over each transport that is
installed. Latency is wall-clock time from sending to receiving, so it counts whatever else the machine does.
``GPVO_LIVE_SECONDS``: how long each lasts, 20 by default.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from gpvo.dataset.build import build
from gpvo.geometry import se3
from gpvo.geometry.se3 import T_FLU_OPTICAL
from gpvo.learning.config import TrainConfig
from gpvo.learning.train import train_sets
from gpvo.online import modelfile
from gpvo.types import Status, TruthLog, VoLog, VoRecord
from tests.vo.rendered_clip import write_pairs

from bench import Rows, row
from bench.live_peers import LEFT, POSES, RIGHT, pose

_ROOT = Path(__file__).parents[1]
sys.path += [str(_ROOT / "tests" / folder) for folder in ("clients", "live")]

from ros1_tools import has, with_gpvo  # noqa: E402
from wire_peers import place, running  # noqa: E402

_READINGS = 10


def run() -> Rows:
    """Results by name."""
    seconds = float(os.environ.get("GPVO_LIVE_SECONDS", "20"))
    rows: Rows = {}
    with tempfile.TemporaryDirectory() as folder:
        model, clip = _shim_model(Path(folder)), write_pairs(Path(folder) / "clip.npz", 60)
        for wire in _wires():
            pictures = ("--stereo", LEFT, RIGHT, "--model", str(_ROOT / "models" / "tunnel.gpvo"))
            rows |= _rows(f"{wire}, pictures", measure(wire, ["pictures", str(clip)], pictures, seconds), 25, 60)
            shim = ("--odometry", POSES, "--model", str(model))
            rows |= _rows(f"{wire}, shim", measure(wire, ["poses"], shim, seconds), None, None)
    return rows


def _rows(name: str, got: dict[str, Any], p50: float | None, p99: float | None) -> Rows:
    def beside(value: float, unit: str, goal: float | None) -> dict[str, Any]:
        return row(value, unit, None if goal is None else "goal", goal)

    rows = {
        f"{name}: latency, median": beside(got["p50_ms"], "ms", p50),
        f"{name}: latency, 99 %": beside(got["p99_ms"], "ms", p99),
        f"{name}: own latency, median": beside(got["own_ms"][0], "ms", None if p50 else 2.0),
        f"{name}: missing of {got['sent']}": row(got["missing"], "messages"),
        f"{name}: end after SIGTERM": row(got["end_s"], "s", "goal", 1.0),
        f"{name}: memory, end less second reading": row(got["rss_mb"][-1] - got["rss_mb"][1], "MB"),
    }
    print(f"{name}: memory [MB] {got['rss_mb']}, CPU {got['cpu_percent']:.0f} %", file=sys.stderr, flush=True)
    return rows


def measure(wire: str, source: list[str], options: tuple[str, ...], seconds: float) -> dict[str, Any]:
    """One run of three processes: latencies [ms], own latency by its diagnostics, memory [MB] read ten times."""
    sent = round(20 * seconds)
    with ExitStack() as held:
        at = held.enter_context(place(wire))

        def process(*words: str, wait_for: str | None = None) -> subprocess.Popen[str]:
            return held.enter_context(running(*words, wait_for=wait_for, env=at.env))

        live = process(*at.python, "-m", "gpvo", "live", *options, *at.options, wait_for="listening")
        peer = [*at.python, "-m", "bench.live_peers"]
        listener = process(*peer, "listen", wire, at.address, str(sent - 1), str(seconds + 20))
        assert listener.stdout is not None
        assert listener.stdout.readline().strip() == "ready"
        sender = process(*peer, source[0], wire, at.address, str(seconds), *source[1:])
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
    probe = "rospy, netifaces, nav_msgs.msg, sensor_msgs.msg, diagnostic_msgs.msg, numpy"
    ros1 = shutil.which("rosmaster") and has(probe, with_gpvo())
    here = {"zenoh": find_spec("zenoh"), "dds": find_spec("cyclonedds"), "ros1": ros1}
    return [wire for wire, found in here.items() if found]


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
