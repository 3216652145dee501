"""Nothing in the package is dead: each name is read somewhere in it, in its tests or in its benchmarks."""

from __future__ import annotations

from pathlib import Path

import pytest

vulture = pytest.importorskip("vulture")

ROOT = Path(__file__).parents[2]
READ_BY_OTHERS = frozenset(
    {
        "__getattr__", "__dir__",  # Python's own, of a module
        "showwarning", "format_commands", "__signature__", "__annotations__", "model_config",  # hooks of libraries
        "producer_name", "typingctx",  # of ONNX and Numba
        "BagSource", "EurocSource", "KittiSource", "SklearnRegressor", "SvgpRegressor",  # named as texts in registries
        "rotvec_rad", "nll_stated_per_dim", "nees_dof_median_stated", "rmse_interval_m",
        "final_error_interval_m", "vector_residual_m", "magnitude_residual_m", "magnitude_over_rmse_interval",
        "tolerance_name", "residual_sigma_p_px", "residual_sigma_m_px",  # fields that documents and tables take by name
    }
)  # fmt: skip
"""Names that nothing calls by that name."""


def test_nothing_in_the_package_is_dead() -> None:
    finder = vulture.Vulture()
    finder.scavenge([str(ROOT / folder) for folder in ("gpvo", "tests", "bench")])
    dead = [
        f"{item.filename.relative_to(ROOT)}:{item.first_lineno} {item.name}"
        for item in finder.get_unused_code(min_confidence=60)
        if Path(item.filename).is_relative_to(ROOT / "gpvo") and item.name not in READ_BY_OTHERS
    ]
    assert dead == []
