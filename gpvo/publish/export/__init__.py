"""A trained model for machines without Python: ONNX, or one C header."""

from __future__ import annotations

import os
from pathlib import Path

from gpvo.errors import GpvoError
from gpvo.online.predictor import Predictor
from gpvo.publish.export.c import PREFIX, to_c
from gpvo.publish.export.onnx import to_onnx

__all__ = ["FORMATS", "PREFIX", "SUFFIXES", "export_model", "format_of", "to_c", "to_onnx"]

SUFFIXES = {"onnx": ".onnx", "c": ".h"}
FORMATS = tuple(SUFFIXES)


def format_of(to: str | None, path: str | os.PathLike[str] | None) -> str:
    """The format ``to``, else that which the name ``path`` tells; GpvoError where there is none or they contradict."""
    told = next((f for f in FORMATS if path is not None and Path(path).suffix.lower() == SUFFIXES[f]), None)
    chosen = to or told
    if chosen is None:
        raise GpvoError("the format is not given", cure=f"--to with one of: {', '.join(FORMATS)}")
    if chosen not in FORMATS:
        raise GpvoError(f"cannot export to '{chosen}'", cure=f"one of: {', '.join(FORMATS)}")
    if told not in (None, chosen):
        raise GpvoError(f"is not a file name for --to {chosen}", where=path, cure=f"use --to {told}, or another -o")
    return chosen


def export_model(
    model: str | os.PathLike[str],
    path: str | os.PathLike[str],
    to: str,
    *,
    prefix: str = PREFIX,
) -> None:
    """Write the model file ``model`` as ``to`` ("onnx" or "c").

    ``prefix``: of every symbol in C, so that one program can hold several models. GpvoError for other formats or names,
    a prefix that is no C identifier, or a bad file.
    """
    to = format_of(to, path)
    if prefix != PREFIX and to != "c":
        raise GpvoError(f"{to} has no symbols for a prefix '{prefix}' to go before", cure="give it only with c")
    predictor = Predictor.load(model)
    units = tuple(str(u) for u in predictor.header.get("units") or ())
    if to == "c":
        note = f"Model file SHA-256: {predictor.digest}"
        to_c(predictor.model, path, name=prefix, units=units, note=note)
    else:
        metadata = {"digest": predictor.digest, "units": ",".join(units)}
        metadata["nu"] = f"{float(predictor.model.nu[0]):g}"
        to_onnx(predictor.model, path, metadata=metadata)
