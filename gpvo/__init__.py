"""gpvo tells your filter how wrong stereo visual odometry is, right now.

The names below are those that gpvo promises to keep; they are loaded on first use.

* :func:`open_source`: frames of a recording, whatever its format. :class:`StereoCamera`, :class:`StereoFrame`.
* :class:`StereoOdometry`: visual odometry; each frame gives a :class:`VoRecord`.
* :class:`Predictor`: a trained model; each record gives a :class:`Prediction`, which is a :class:`MotionError`.
* :func:`read_run`, :func:`train`, :func:`evaluate`: a stored run, a model of several runs, and how right it is on one.
* :class:`GpvoError`: raised for bad input, with a one-line message.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gpvo.errors import GpvoError
    from gpvo.evaluation.evaluate import evaluate_run as evaluate
    from gpvo.io.run import read_run
    from gpvo.io.source import open_source
    from gpvo.learning.train import train
    from gpvo.online.predictor import Predictor
    from gpvo.types import MotionError, Prediction, StereoCamera, StereoFrame, VoRecord
    from gpvo.vo.odometry import StereoOdometry

__version__ = "0.1.0"

__all__ = [
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

_HOMES = {
    "GpvoError": "errors",
    "Predictor": "online.predictor",
    "StereoOdometry": "vo.odometry",
    "evaluate": "evaluation.evaluate:evaluate_run",
    "open_source": "io.source",
    "read_run": "io.run",
    "train": "learning.train",
}
"""Module of each name, and its name there where it is another; the rest are types."""


def __getattr__(name: str) -> Any:
    """The public names, loaded when they are first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'gpvo' has no attribute '{name}'")
    module, _, attribute = _HOMES.get(name, "types").partition(":")
    value = getattr(import_module(f"gpvo.{module}"), attribute or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
