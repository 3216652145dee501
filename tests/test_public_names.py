"""The names that gpvo promises to keep, and what asking for them loads."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys

import gpvo
import pytest
from gpvo.errors import GpvoError

NAMES = [
    "GpvoError",
    "MotionError",
    "Prediction",
    "Predictor",
    "StereoCamera",
    "StereoFrame",
    "StereoOdometry",
    "VoRecord",
    "evaluate",
    "open_source",
    "read_run",
    "train",
]


def test_the_public_names_are_these_and_documented() -> None:
    assert sorted(gpvo.__all__) == sorted(NAMES)
    assert set(NAMES) <= set(dir(gpvo))
    for name in NAMES:
        assert callable(getattr(gpvo, name))
        assert getattr(gpvo, name).__doc__
        assert name in (gpvo.__doc__ or "")
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        _ = gpvo.trian


@pytest.mark.parametrize("then", ["", "gpvo.Prediction, gpvo.GpvoError, gpvo.VoRecord, gpvo.Predictor"])
def test_what_flies_loads_numpy_and_safetensors_at_most(then: str) -> None:
    heavy = "torch,cv2,pandas,scipy,sklearn,pyarrow,matplotlib,pydantic,yaml,typer"
    code = f"import sys, gpvo; {then or 'pass'}; print([m for m in '{heavy}'.split(',') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
    if not then:
        code = "import sys, gpvo; print('safetensors' in sys.modules)"
        assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def test_every_module_finds_what_it_imports() -> None:
    """Also those that a command imports only when it needs them; a package that is not installed is another matter."""
    for module in pkgutil.walk_packages(gpvo.__path__, "gpvo."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as e:
            if (e.name or "").startswith("gpvo"):
                raise
        except GpvoError:
            pass  # names the extra that is missing
