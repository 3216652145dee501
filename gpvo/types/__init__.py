"""The nouns that travel between the stages: frozen, NumPy only, SI units.

Frame of every motion, covariance, error and feature: the rectified left optical frame ``cam``
(x right, y down, z forward). Tangent order: translation xyz [m], rotation xyz [rad], right perturbation.
"""

from gpvo.types.predictions import ByStamp as ByStamp
from gpvo.types.predictions import MotionError as MotionError
from gpvo.types.predictions import Prediction as Prediction
from gpvo.types.predictions import StoredPredictions as StoredPredictions
from gpvo.types.records import CALIBRATION as CALIBRATION
from gpvo.types.records import COUNT_FIELDS as COUNT_FIELDS
from gpvo.types.records import FLOAT_FIELDS as FLOAT_FIELDS
from gpvo.types.records import IMPORTED as IMPORTED
from gpvo.types.records import IMPORTED_POSE as IMPORTED_POSE
from gpvo.types.records import IMU_FIELDS as IMU_FIELDS
from gpvo.types.records import ImuMoments as ImuMoments
from gpvo.types.records import Status as Status
from gpvo.types.records import StoredRecords as StoredRecords
from gpvo.types.records import VoLog as VoLog
from gpvo.types.records import VoRecord as VoRecord
from gpvo.types.records import frequent_reasons as frequent_reasons
from gpvo.types.sensors import MOST_MPS2 as MOST_MPS2
from gpvo.types.sensors import MOST_RADPS as MOST_RADPS
from gpvo.types.sensors import STANDARD_GRAVITY_MPS2 as STANDARD_GRAVITY_MPS2
from gpvo.types.sensors import VEHICLES as VEHICLES
from gpvo.types.sensors import Array as Array
from gpvo.types.sensors import ImuLog as ImuLog
from gpvo.types.sensors import ImuNoise as ImuNoise
from gpvo.types.sensors import Mounting as Mounting
from gpvo.types.sensors import StereoCamera as StereoCamera
from gpvo.types.sensors import StereoFrame as StereoFrame
from gpvo.types.sensors import StereoTracks as StereoTracks
from gpvo.types.sensors import TrackFrame as TrackFrame
from gpvo.types.sensors import TruthLog as TruthLog
from gpvo.types.sensors import Vehicle as Vehicle
from gpvo.types.sensors import field_names as field_names
from gpvo.types.sensors import out_of_limits as out_of_limits
from gpvo.types.sensors import within as within
