"""Lens models, stereo rigs, rectification and the calibration files of the field."""
