"""A trained model for machines without Python: an ONNX graph, by :mod:`gpvo.publish.onnx`, or one C header: arrays as
constants, then plain C99 that needs ``math.h`` alone.
"""

from __future__ import annotations

import hashlib
import re
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from gpvo.errors import GpvoError
from gpvo.files import refuse_foreign, write_text
from gpvo.online.base import motion_noise, positions
from gpvo.online.division import LEAST_LEFT
from gpvo.online.estimate import DURATIONS_S, LEAST_VAR, LN_LARGEST, ErrorModel
from gpvo.online.predictor import Predictor
from gpvo.online.stored import LARGEST, Stored
from gpvo.publish.onnx import to_onnx

SUFFIXES = {"onnx": ".onnx", "c": ".h"}
FORMATS = tuple(SUFFIXES)
_WRITTEN = {"onnx": b"\x12\x04gpvo", "c": b"written by gpvo"}  # near the top, or as the producer
PREFIX = "gpvo"
"""Of every symbol, unless another is asked for."""
_PER_LINE = 8
_LASTING = ("bias_tau_s", "calibration_tau_s")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
# Of C23 and C++, so that a header compiles in either.
_KEYWORDS = (
    " alignas alignof and asm auto bitand bitor bool break case catch char class compl const constexpr continue default"
    " delete do double else enum explicit export extern false float for friend goto if inline int long mutable"
    " namespace new noexcept not nullptr operator or private protected public register restrict return short signed"
    " sizeof static struct switch template this throw true try typedef typeid typename typeof union unsigned using"
    " virtual void volatile wchar_t while xor main "
)
# What a comment may hold of a model file's text: nothing that could end it.
_NOT_IN_COMMENTS = re.compile(r"[^A-Za-z0-9_./^,;:=() -]")


def format_of(to: str | None, path: Path | None) -> str:
    """The format ``to``, else that which the name ``path`` tells; GpvoError where there is none or they contradict."""
    told = next((f for f in FORMATS if path is not None and path.suffix.lower() == SUFFIXES[f]), None)
    chosen = to or told
    if chosen is None:
        raise GpvoError("the format is not given", cure=f"--to with one of: {', '.join(FORMATS)}")
    if chosen not in FORMATS:
        raise GpvoError(f"cannot export to '{chosen}'", cure=f"one of: {', '.join(FORMATS)}")
    if told not in (None, chosen):
        raise GpvoError(f"is not a file name for --to {chosen}", where=path, cure=f"use --to {told}, or another -o")
    return chosen


def export_model(model: Path, path: Path, to: str, *, prefix: str = PREFIX) -> None:
    """Write the model file ``model`` as ``to`` ("onnx" or "c").

    ``prefix``: of every symbol in C, so that one program can hold several models. GpvoError for other formats or names,
    a prefix that is no C identifier, a bad file, or where ``path`` holds anything but an earlier export.
    """
    to = format_of(to, path)
    refuse_foreign(path, _WRITTEN[to], "export")  # before the work, not after it
    if prefix != PREFIX and to != "c":
        raise GpvoError(f"{to} has no symbols to prefix with '{prefix}'", cure="give it only with c")
    predictor = Predictor.load(model)
    units = tuple(str(u) for u in predictor.header.get("units") or ())
    if to == "c":
        over = "" if predictor.target == "frame" else f"; of the error over {predictor.target}, not of one motion"
        note = f"Model file SHA-256: {predictor.digest}{over}"
        to_c(predictor.model, path, name=prefix, units=units, note=note)
    else:
        metadata = {"digest": predictor.digest, "units": ",".join(units), "target": predictor.target}
        errors = predictor.model
        metadata |= {"nu": f"{float(errors.nu[0]):g}", "geometry": _geometry(errors)}
        metadata |= {name: ",".join(map(repr, getattr(errors.division, name).tolist())) for name in _LASTING}
        to_onnx(errors, path, metadata=metadata)


def _geometry(model: ErrorModel) -> str:
    """The method whose covariances it takes for the correlations, empty where it makes no use of any."""
    return (model.base.method or "") if model.division.geometry_weight[0] > 0 else ""


def to_c(model: ErrorModel, path: Path, *, name: str = PREFIX, units: tuple[str, ...] = (), note: str = "") -> None:
    """Write the header. ``name`` prefixes every symbol, so that one program can hold several models.

    ``units``: of the features, for the comment at the top; ``note``: one more line there. The numbers equal those of
    ``ErrorModel.estimate`` to about 1e-6: projections are kept in single precision. GpvoError where ``name``
    is no C identifier.
    """
    if not _NAME.fullmatch(name) or f" {name} " in _KEYWORDS:
        raise GpvoError(f"the prefix {name!r} is not a C identifier", cure="a letter first, then letters, digits, _")
    template = files("gpvo.publish").joinpath("predictor.c").read_text(encoding="utf-8")
    code = "\n".join([*_preamble(model, units, note), *_constants(model), template.rstrip(), "", "#endif", ""])
    code = re.sub("gpvo_|GPVO_", lambda m: f"{name if m[0].islower() else name.upper()}_", code)
    # Another model under the same prefix must collide, not be skipped as if it were this one included again.
    guard = hashlib.sha256(code.encode()).hexdigest()[:16].upper()
    write_text(path, code.replace(f"{name.upper()}_MODEL_H", f"{name.upper()}_{guard}_H"))


def _preamble(model: ErrorModel, units: tuple[str, ...], note: str) -> list[str]:
    units, method = units or ("",) * len(model.columns), _geometry(model)
    features = [
        f" *  {i:3d}  {_comment(c)} {f'[{_comment(u)}]' if u else ''}".rstrip()
        for i, (c, u) in enumerate(zip(model.columns, units))
    ]
    return [
        "/* Error model of stereo visual odometry, written by gpvo. C99 and math.h alone; no heap; no state.",
        *([f" * {_comment(note)}"] if note else []),
        " *",
        " * Features, in order; their formulas: docs/concepts/features.rst of gpvo.",
        *features,
        " *",
        f" * Geometry: {f'the covariance by {_comment(method)}' if method else 'not used'}.",
        " */",
        "#ifndef GPVO_MODEL_H",
        "#define GPVO_MODEL_H",
        "",
        "#include <math.h>",
        "",
    ]


def _comment(text: object) -> str:
    """The text without what could leave a comment, or fool a reader of it."""
    return _NOT_IN_COMMENTS.sub("?", str(text).replace("..", " to "))[:200]


def _constants(model: ErrorModel) -> list[str]:
    gp, domain, d = model.gp, model.domain, len(model.columns)
    columns = positions(model.columns, model.base.columns)
    by_velocity, by_acceleration = motion_noise(model.columns)
    sizes = {
        "N_FEATURES": d,
        "N_INPUTS": len(model.inputs),
        "N_POINTS": len(gp.points),
        "N_DIRECTIONS": len(gp.projection),
        "N_BASE": len(columns),
        "RADIUS": _number(domain.radius[0]),
        "DT_S": _number(model.dt_s),
        "GEOMETRY_WEIGHT": _number(model.division.geometry_weight[0]),
        "TYPICAL_LN_DET": _number(model.typical_ln_det[0]),
        "OUTSIDE_POWER": _number(model.outside_power[0]),
        "LN_SPEED": _number(model.division.ln_speed[0]),
        "LN_LARGEST": _number(LN_LARGEST),
        "LARGEST": _number(LARGEST),
        "LEAST_VAR": _number(LEAST_VAR),
        "LEAST_LEFT": _number(LEAST_LEFT),
        "SHORTEST_S": _number(DURATIONS_S[0]),
        "LONGEST_S": _number(DURATIONS_S[1]),
        "NU": _number(model.nu[0]),
        **{n.upper(): f"{{{', '.join(map(_number, getattr(model.division, n)))}}}" for n in _LASTING},
    }
    return [
        *(f"#define GPVO_{key} {value}" for key, value in sizes.items()),
        "",
        *_arrays(domain, "centre", "scale", "low"),
        *_array("high_edge", domain.high),
        *_arrays(domain, "least", "most", "whitening"),
        *_array("missing", domain.charge_of_missing),
        *_array("absent", model.absent),
        *_array("input", model.inputs, "int"),
        *_array("base_column", columns, "int"),
        *_array("by_velocity", by_velocity),
        *_array("by_acceleration", by_acceleration),
        *_arrays(model.base, "theta", "theta_plain"),
        *_arrays(model.velocities, "usual_rate_var"),
        *_arrays(model, "factor", "high"),
        *_arrays(model.division, "correlation", "share", "growth", "level", "calibration_patterns"),
        *_array("gp_centre", gp.centre),
        *_array("lengthscale", gp.lengthscale),
        *_array("point", gp.points),
        *_arrays(gp, "offset", "signal_var"),
        *_array("kernel_weight", gp.weights @ gp.projection),
        *_array("reduction", gp.reduction, "float"),
        *_array("projection", gp.projection, "float"),
        "",
    ]


def _arrays(holder: Stored, *names: str) -> list[str]:
    """Those that are called in C as they are here."""
    return [line for name in names for line in _array(name, getattr(holder, name))]


def _array(name: str, values: ArrayLike, kind: str = "double") -> list[str]:
    """A constant array; ``kind`` double, float or int."""
    flat = np.asarray(values).ravel()
    text = [str(int(v)) for v in flat] if kind == "int" else [_number(v, kind == "float") for v in flat]
    lines = ["    " + ", ".join(text[i : i + _PER_LINE]) + "," for i in range(0, len(text), _PER_LINE)]
    return [f"static const {kind} gpvo_{name}[{len(text)}] = {{", *lines, "};"]


def _number(value: float, single: bool = False) -> str:
    """A C literal that reads back as the same number."""
    if not np.isfinite(value):
        return "NAN" if np.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"
    text = repr(float(value)) if not single else str(np.float32(value))
    text = text if any(c in text for c in ".e") else f"{text}.0"
    return f"{text}f" if single else text
