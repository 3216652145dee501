"""Other people's readers of a simulated sequence: evo for the truth, rosbags after conversion."""

from dataclasses import astuple

import cv2
import numpy as np
import pytest
from gpvo.io import open_source
from gpvo.sim import sequence


def test_evo_reads_the_truth(quick, tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    sequence.simulate(quick(), 2, tmp_path / "seq")
    truth = file_interface.read_euroc_csv_trajectory(
        str(tmp_path / "seq" / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    )
    assert truth.check()[0], truth.check()[1]
    ours = open_source(tmp_path / "seq")
    T_body_cam = ours.mounting.T_body_cam
    theirs = np.array(truth.poses_se3) @ T_body_cam
    assert np.allclose(theirs, ours.truth.T_world_cam, atol=1e-9)


@pytest.mark.parametrize("camera", ["pinhole", "t265"])
def test_as_a_ros_bag(quick, tmp_path, camera, monkeypatch):
    """Images and IMU written to a bag under Kalibr's topics are the same sequence with the Kalibr file beside it."""
    bag_maker = pytest.importorskip("bag_maker")
    if camera == "t265":
        whole = sequence.Eye.see

        def large(self, index, plan):
            return tuple(cv2.resize(p, (848, 800)) for p in whole(self, index, plan))

        monkeypatch.setattr(sequence.Eye, "see", large)
    out = sequence.simulate(quick(camera=camera), 2, tmp_path / "seq").path
    maker = bag_maker.BagMaker(ros1=True)
    for k, camera_name in enumerate(("cam0", "cam1")):
        for file in sorted((out / "mav0" / camera_name / "data").glob("*.png")):
            maker.image(f"/cam{k}/image_raw", int(file.stem), cv2.imread(str(file), cv2.IMREAD_GRAYSCALE))
    maker.write(tmp_path / "seq.bag")
    bag = open_source(tmp_path / "seq.bag", calibration=out / "dso" / "camchain.yaml")
    folder = open_source(out)
    assert astuple(bag.camera) == pytest.approx(astuple(folder.camera), rel=1e-12)
    for a, b in zip(bag, folder, strict=True):
        assert a.t_ns == b.t_ns
        assert np.array_equal(a.left, b.left)
        assert np.array_equal(a.right, b.right)
