"""Handing VO and its predicted error to other people's filters: ROS odometry, MAVLink, and what they do with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated


@dataclass(frozen=True)
class PublishSettings:
    """What ``gpvo publish`` is asked for, each with its help; without ``to`` the name ``out`` may tell it."""

    to: Annotated[str | None, "bag (default), mcap or mavlink."] = None
    out: Annotated[
        Path | None, "File or folder to write; a suffix .bag (ROS 1), .mcap or .tlog stands in for --to."
    ] = None
    link: Annotated[str | None, "Send MAVLink to udp:HOST:PORT or serial:DEVICE:BAUD."] = None
    model: Annotated[Path | None, "Error model; default: predictions stored in the run."] = None
    method: Annotated[str, "Geometric covariance to use where there is no prediction."] = "pointing_matching"
    topic: Annotated[str, "Topic of the odometry."] = "/gpvo/odometry"
    system: Annotated[int, "MAVLink system id of the vehicle."] = 1
    consumer: Annotated[
        str | None, "For --check: px4, ardupilot, robot_localization or fusioncore; default: px4 for MAVLink."
    ] = None
    check: Annotated[
        bool, "Report what the consumer will do with the messages; writes a file only with --to or -o."
    ] = False
