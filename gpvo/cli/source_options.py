"""Flags that every command which opens a sequence shares."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gpvo.errors import GpvoError

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


def source_options(size: str | None = None, **given: Any) -> dict[str, Any]:
    """Options for :func:`gpvo.io.open_source` from the flags; those that were not given are left out.

    Raises
    ------
    GpvoError
        Where ``size`` is not WIDTHxHEIGHT.
    """
    options = {name: value for name, value in given.items() if value is not None}
    if size is not None:
        width, _, height = size.lower().partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise GpvoError(f"--size is '{size}'", cure="give WIDTHxHEIGHT, such as 640x480")
        options["size"] = (int(width), int(height))
    return options
