"""Flags that every command which opens a sequence shares."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.cli.output import one_of
from gpvo.errors import GpvoError
from gpvo.types import VEHICLES, Vehicle

Kind = Annotated[str | None, typer.Option("--source", help="Override the guessed format of the sequence.")]
Calibration = Annotated[Path | None, typer.Option(help="Calibration file in place of the one found.")]
HfovDeg = Annotated[float | None, typer.Option(help="Field of view of the virtual pinhole pair [deg].")]
Size = Annotated[str | None, typer.Option(help="Size of the rectified images, WIDTHxHEIGHT.")]
MaskLeft = Annotated[Path | None, typer.Option(help="Mask image: the pixels of the left lens that may be used.")]
MaskRight = Annotated[Path | None, typer.Option(help="The same for the right lens.")]
Bits = Annotated[int | None, typer.Option(help="Depth of the samples in 16-bit images, e.g. 12.")]
RateHz = Annotated[float | None, typer.Option(help="Frame rate of an image folder whose names are numbers.")]
PairTolerance = Annotated[
    float | None, typer.Option(help="Largest difference between the stamps of a stereo pair [s].")
]
LeftTopic = Annotated[str | None, typer.Option(help="Topic of the left images in a bag.")]
RightTopic = Annotated[str | None, typer.Option(help="Topic of the right images in a bag.")]
ImuTopic = Annotated[str | None, typer.Option(help="Topic of the IMU in a bag.")]
TruthTopic = Annotated[str | None, typer.Option(help="Topic of the ground truth in a bag; none to ignore it.")]
TruthFrame = Annotated[str | None, typer.Option(help="Frame of the poses in the truth topic: imu or cam.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a finished run, once the new one is complete.")]

VehicleName = Annotated[
    str, typer.Option("--vehicle", help="What carries the camera: car, rover, multirotor, handheld or any.")
]
MaxAcceleration = Annotated[float | None, typer.Option(help="Of the vehicle in place of its kind's [m/s^2].")]
MaxTurn = Annotated[float | None, typer.Option(help="The same of its angular acceleration [rad/s^2].")]


def vehicle_of(kind: str, max_acceleration: float | None, max_turn: float | None) -> Vehicle:
    """The bounds of a kind of vehicle, or those given in their place.

    Raises GpvoError where the kind is unknown or a bound is not above 0.
    """
    known = VEHICLES[one_of("--vehicle", kind, tuple(VEHICLES))]
    bounds = (max_acceleration or known.max_acceleration_mps2, max_turn or known.max_turn_radps2)
    for flag, value in zip(("--max-acceleration", "--max-turn"), (max_acceleration, max_turn)):
        if value is not None and not 0 < value < math.inf:
            raise GpvoError(f"{flag} is {value:g}", cure="give a number above 0")
    return Vehicle(*bounds)


def source_options(size: str | None = None, **given: Any) -> dict[str, Any]:
    """Options for :func:`gpvo.io.open_source` from the flags; those that were not given are left out.

    Raises GpvoError where ``size`` is not WIDTHxHEIGHT.
    """
    options = {name: value for name, value in given.items() if value is not None}
    if size is not None:
        width, _, height = size.lower().partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise GpvoError(f"--size is '{size}'", cure="give WIDTHxHEIGHT, such as 640x480")
        options["size"] = (int(width), int(height))
    return options
