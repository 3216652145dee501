"""Images in, VO, prediction, message out: the whole of gpvo in one loop.

    python examples/live_loop.py SEQUENCE MODEL udp:127.0.0.1:14550

Replace ``open_source`` by your camera driver: anything that yields rectified ``StereoFrame`` will do.
"""

from __future__ import annotations

import sys

from gpvo.io import open_source
from gpvo.online.predictor import Predictor
from gpvo.publish.mavlink import Link
from gpvo.publish.odometry import OdometryBuilder
from gpvo.vo.odometry import StereoOdometry


def main(sequence: str, model: str, address: str) -> None:
    source = open_source(sequence)
    odometry = StereoOdometry(source.camera, mask=source.mask)
    predictor = Predictor.load(model)
    predictor.reset(source.camera)
    builder = OdometryBuilder(source.mounting.T_body_cam, method="pointing_matching")
    link = Link(address)
    for frame in source:
        record = odometry.step(frame)
        prediction = predictor.step(record)
        message = builder.step(record, prediction)
        link.send(message)
        if prediction is not None:
            print(record.t_ns, record.status.value, prediction.sigma[:3], "m", round(prediction.confidence, 2))


if __name__ == "__main__":
    main(*sys.argv[1:4])
