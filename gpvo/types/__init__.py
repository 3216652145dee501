"""The nouns that travel between the stages: frozen, NumPy only, SI units.

Frame of every motion, covariance, error and feature: the rectified left optical frame ``cam``
(x right, y down, z forward). Tangent order: translation xyz [m], rotation xyz [rad], right perturbation.
"""

from gpvo.types.predictions import ByStamp, MotionError, Prediction, StoredPredictions
from gpvo.types.records import (
    COUNT_FIELDS,
    FLOAT_FIELDS,
    IMPORTED,
    IMPORTED_POSE,
    IMU_FIELDS,
    ImuMoments,
    Status,
    StoredRecords,
    VoLog,
    VoRecord,
    frequent_reasons,
)
from gpvo.types.sensors import (
    MOST_MPS2,
    MOST_RADPS,
    STANDARD_GRAVITY_MPS2,
    VEHICLES,
    Array,
    ImuLog,
    ImuNoise,
    Mounting,
    StereoCamera,
    StereoFrame,
    StereoTracks,
    TrackFrame,
    TruthLog,
    Vehicle,
    field_names,
    out_of_limits,
    within,
)

__all__ = [
    "COUNT_FIELDS",
    "FLOAT_FIELDS",
    "IMPORTED",
    "IMPORTED_POSE",
    "IMU_FIELDS",
    "MOST_MPS2",
    "MOST_RADPS",
    "STANDARD_GRAVITY_MPS2",
    "VEHICLES",
    "Array",
    "ByStamp",
    "ImuLog",
    "ImuMoments",
    "ImuNoise",
    "MotionError",
    "Mounting",
    "Prediction",
    "Status",
    "StereoCamera",
    "StereoFrame",
    "StereoTracks",
    "StoredPredictions",
    "StoredRecords",
    "TrackFrame",
    "TruthLog",
    "Vehicle",
    "VoLog",
    "VoRecord",
    "field_names",
    "frequent_reasons",
    "out_of_limits",
    "within",
]
