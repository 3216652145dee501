"""Memory of a long run: flat, and small."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba", reason="images need the extra gpvo[sim]")
from rendered_clip import pinhole, render_clip, wander

FRAMES = int(os.environ.get("GPVO_LONG_FRAMES", "4000"))
MOST_GROWTH_MB = 2e-3 * FRAMES
# In a process of its own: the renderer's memory is none of the odometry's.
PROGRAM = """
import sys, resource
from types import SimpleNamespace
from pathlib import Path
import numpy as np, psutil
from gpvo import runner
from gpvo.io.source import SourceReport
from gpvo.types import Mounting, StereoCamera, StereoFrame

data = np.load(sys.argv[1])
camera = StereoCamera(*data["camera"][:5], int(data["camera"][5]), int(data["camera"][6]))
left, right = data["left"], data["right"]
count = len(left)
sizes = []

class Endless:
    name, path, format, kind = "loop", Path("loop"), "memory", "images"
    mask = imu = truth = calibration = None
    mounting, report = Mounting(), SourceReport()
    camera = camera
    def __len__(self): return int(sys.argv[3])
    def __iter__(self):
        for k in range(len(self)):
            i = k % (2 * count - 2)
            i = i if i < count else 2 * count - 2 - i
            if (k + 1) % (len(self) // 10) == 0:
                sizes.append(psutil.Process().memory_info().rss / 1e6)
            yield StereoFrame((k + 1) * 50_000_000, left[i], right[i])

runner.run(Endless(), Path(sys.argv[2]))
print(max(sizes), sizes[-1] - sizes[1])
"""


@pytest.mark.slow
def test_thousands_of_frames(tmp_path: Path) -> None:
    """Forth and back through a clip: under 400 MB in all, and at most 2 kB of growth a frame after the first fifth."""
    clip = render_clip(pinhole(320, 240), wander(12, seed=2))
    c = clip.camera
    np.savez(
        tmp_path / "clip.npz",
        left=np.stack([f.left for f in clip.frames]),
        right=np.stack([f.right for f in clip.frames]),
        camera=[c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.baseline_m, c.width, c.height],
    )
    arguments = [sys.executable, "-c", PROGRAM, str(tmp_path / "clip.npz"), str(tmp_path / "run"), str(FRAMES)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    peak_mb, growth_mb = (float(x) for x in done.stdout.split())
    print(f"peak {peak_mb:.0f} MB, growth {growth_mb:.0f} MB")
    assert peak_mb < 400
    assert growth_mb < MOST_GROWTH_MB
