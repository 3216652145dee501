"""The whole workflow on simulated flights: fly, run VO, learn its error, predict on an unseen flight, fuse, report.

``make demo`` runs this; it takes about three minutes on two cores. Everything it writes goes to ``out/demo``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from gpvo.sim.points import simulate_points

OUT = Path("out/demo")
TRAINING, UNSEEN = (0, 1, 2, 3), 7


def gpvo(*commands: tuple[object, ...]) -> None:
    """Run commands as a user would, those that do not need one another side by side, and show what each says."""
    width = os.environ | {"COLUMNS": str(shutil.get_terminal_size().columns)}
    calls = [[sys.executable, "-m", "gpvo", *map(str, words)] for words in commands]
    running = [subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=width) for c in calls]
    for call, process in zip(calls, running, strict=True):
        print(f"\n$ gpvo {' '.join(call[3:])}", flush=True)
        sys.stdout.buffer.write(process.communicate()[0])
    for call, process in zip(calls, running, strict=True):
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, call)


def main() -> None:
    """Five flights down a tunnel in which vision fails now and then; the last one is the test."""
    began = time.monotonic()
    print("simulating five flights of 40 s (stereo tracks and IMU, no images)", flush=True)
    for seed in (*TRAINING, UNSEEN):
        simulate_points("tunnel-bursts", seed, duration_s=40.0, rate_hz=10.0).save(OUT / f"flight{seed}.npz")
    gpvo(*(("run", OUT / f"flight{seed}.npz", "-o", OUT / f"run{seed}", "--overwrite") for seed in TRAINING))
    model, unseen = OUT / "tunnel.gpvo", OUT / f"run{UNSEEN}"
    gpvo(("train", *(OUT / f"run{s}" for s in TRAINING), "-o", model, "--jobs", 2))
    gpvo(("run", OUT / f"flight{UNSEEN}.npz", "-o", unseen, "--model", model, "--overwrite"))
    gpvo(
        ("fuse", unseen, "--model", model, "--plot", OUT / "fuse.png"),
        ("report", unseen, "--model", model, "-o", OUT / "report.html"),
        ("evaluate", unseen, "--model", model, "--plots", OUT / "pictures"),
    )
    print(f"\n{time.monotonic() - began:.0f} s; now open {OUT / 'report.html'}")


if __name__ == "__main__":
    main()
