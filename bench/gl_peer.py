"""Stereo pairs per second of MuJoCo's OpenGL renderer on the same mesh, untextured: ``python -m bench.gl_peer WAY``.

WAY is egl or osmesa; a process of its own, since that is chosen when MuJoCo is imported. CPU time over two cores, as
for ours; without lens, light map, texture, noise and sensor, so it does less. Prints a number, or fails.
"""

from __future__ import annotations

import os
import sys
import time

import numpy as np

from bench import median_s

_CORES, _FRAMES, _SIZE = 2, 12, (640, 480)


def pairs_per_second(way: str) -> float:
    """Render the tunnel from its centreline, left and right."""
    os.environ["MUJOCO_GL"] = way
    import mujoco
    from gpvo.sim.worlds import build_world

    world = build_world("tunnel", 0)
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = _SIZE
    mesh = spec.add_mesh(name="tunnel", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = np.asarray(world.mesh.vertices, np.float64).ravel()
    mesh.userface = np.asarray(world.mesh.faces, np.int32).ravel()
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="tunnel", contype=0, conaffinity=0)
    spec.worldbody.add_light(pos=world.centreline[40], castshadow=False)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, _SIZE[1], _SIZE[0])
    camera = mujoco.MjvCamera()

    def draw(k: int) -> None:
        for side in (-0.06, 0.06):
            camera.lookat[:] = world.centreline[44 + 20 * k] + [0.0, side, 0.0]
            camera.distance, camera.azimuth, camera.elevation = 0.5, 0.0, 0.0
            renderer.update_scene(data, camera)
            renderer.render()

    return _CORES / median_s(draw, _FRAMES, warm_up=2, clock=time.process_time)


if __name__ == "__main__":
    print(pairs_per_second(sys.argv[1]))
    sys.stdout.flush()
    os._exit(0)  # closing the context without a display may print errors of its own
