"""A trained model for machines without Python: ONNX, or one C header."""

from __future__ import annotations

import os
from collections.abc import Callable

from gpvo.errors import GpvoError
from gpvo.learning.export.c import to_c
from gpvo.learning.export.onnx import to_onnx
from gpvo.online.predictor import Predictor

__all__ = ["FORMATS", "export_model", "to_c", "to_onnx"]


def _as_onnx(predictor: Predictor, path: str | os.PathLike[str], purpose: str) -> None:
    metadata = {"digest": predictor.digest, "units": ",".join(_units(predictor)), "purpose": purpose}
    to_onnx(predictor.model, path, metadata=metadata)


def _as_c(predictor: Predictor, path: str | os.PathLike[str], purpose: str) -> None:
    to_c(predictor.model, path, units=_units(predictor), note=f"For {purpose}. Model file SHA-256: {predictor.digest}")


def _units(predictor: Predictor) -> tuple[str, ...]:
    return tuple(str(u) for u in predictor.header.get("units") or ())


FORMATS: dict[str, Callable[[Predictor, str | os.PathLike[str], str], None]] = {"onnx": _as_onnx, "c": _as_c}


def export_model(
    model: str | os.PathLike[str], path: str | os.PathLike[str], to: str, *, for_filter: bool = False
) -> None:
    """Write the model file ``model`` as ``to`` ("onnx" or "c").

    ``for_filter``: its model for filters, as ``Predictor.load`` would. GpvoError for other formats or a bad file.
    """
    if to not in FORMATS:
        raise GpvoError(f"cannot export to '{to}'", cure=f"one of: {', '.join(FORMATS)}")
    FORMATS[to](Predictor.load(model, for_filter=for_filter), path, "filters" if for_filter else "prediction")
