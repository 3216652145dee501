"""The model card's picture: stated against actual error of motions that were left out of training, as SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

_PANELS = (("translation_m", "translation [mm]"), ("rotation_rad", "rotation [mrad]"))
_COLOURS = (
    "#1f77b4",
    "#ff7f0e",
    "#2ca02c",
    "#d62728",
    "#9467bd",
    "#8c564b",
    "#e377c2",
    "#7f7f7f",
    "#bcbd22",
    "#17becf",
)
_SIZE, _LEFT, _TOP, _GAP = 260, 62, 14, 84
_TRUE = math.sqrt(2.0)
"""Sigma right within this factor counts as true, as in the verdict: NEES per degree of freedom from 0.5 to 2."""


def stated_against_actual(folds: Sequence[Mapping[str, Any]]) -> str | None:
    """SVG text; None where no fold has what the picture shows."""
    drawn = [f for f in folds if f.get("stated_and_actual")]
    if not drawn:
        return None
    height = _TOP + _SIZE + 52 + 16 * ((len(drawn) + 3) // 4)
    width = 2 * (_LEFT + _SIZE) + 40
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
        ' font-family="system-ui, sans-serif" font-size="12" fill="#333">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for k, (kind, name) in enumerate(_PANELS):
        parts += _panel(_LEFT + k * (_SIZE + _GAP), name, [f["stated_and_actual"][kind] for f in drawn])
    for k, fold in enumerate(drawn):
        x, y = _LEFT + 165 * (k % 4), _TOP + _SIZE + 54 + 16 * (k // 4)
        parts.append(f'<rect x="{x}" y="{y - 6}" width="12" height="3" fill="{_colour(k)}"/>')
        parts.append(f'<text x="{x + 16}" y="{y}">{escape(str(fold["held_out"])[:22])}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _panel(left: float, name: str, curves: Sequence[Sequence[tuple[float, float]]]) -> list[str]:
    """Logarithmic in both directions and equal in scale, with the band in which sigma counts as true."""
    values = [1e3 * v for curve in curves for pair in curve for v in pair if v > 0] or [0.1, 10.0]
    low, high = min(values) / 1.3, max(values) * 1.3

    def at(value: float) -> float:
        return _SIZE * math.log(max(value, low) / low) / math.log(high / low)

    bottom = _TOP + _SIZE
    band = (
        (low, low * _TRUE),
        (high / _TRUE, high),
        (high, high),
        (high, high / _TRUE),
        (low * _TRUE, low),
        (low, low),
    )
    points = " ".join(f"{left + at(x):.1f},{bottom - at(y):.1f}" for x, y in band)
    out = [
        f'<polygon points="{points}" fill="#2ca02c" opacity="0.13"/>',
        f'<line x1="{left}" y1="{bottom}" x2="{left + _SIZE}" y2="{_TOP}" stroke="#333" stroke-dasharray="4 4"/>',
    ]
    for v in _ticks(low, high):
        x, y = left + at(v), bottom - at(v)
        out.append(f'<line x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom}" stroke="#e5e5e5"/>')
        out.append(f'<line x1="{left}" y1="{y:.1f}" x2="{left + _SIZE}" y2="{y:.1f}" stroke="#e5e5e5"/>')
        out.append(f'<text x="{x:.1f}" y="{bottom + 15}" text-anchor="middle">{v:g}</text>')
        out.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{v:g}</text>')
    for k, curve in enumerate(curves):
        line = " ".join(f"{left + at(1e3 * s):.1f},{bottom - at(1e3 * a):.1f}" for s, a in curve)
        out.append(f'<polyline points="{line}" fill="none" stroke="{_colour(k)}" stroke-width="1.6"/>')
    out.append(f'<rect x="{left}" y="{_TOP}" width="{_SIZE}" height="{_SIZE}" fill="none" stroke="#999"/>')
    middle = _TOP + _SIZE / 2
    out.append(f'<text x="{left + _SIZE / 2}" y="{bottom + 32}" text-anchor="middle">stated {name}</text>')
    turned = f'transform="rotate(-90 {left - 44} {middle})"'
    return [*out, f'<text x="{left - 44}" y="{middle}" text-anchor="middle" {turned}>actual {name}</text>']


def _ticks(low: float, high: float) -> list[float]:
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1,) if math.log10(high / low) > 2 else (1, 3)
    return [m * 10.0**p for p in decades for m in steps if low <= m * 10.0**p <= high]


def _colour(k: int) -> str:
    return _COLOURS[k % len(_COLOURS)]
