"""The errors gpvo raises on purpose: one line each that names the file, the place and the cure."""

from __future__ import annotations


class GpvoError(Exception):
    """Bad input, described for the person who can mend it.

    The command line prints it as one line and exits with code 2; library callers catch it.
    """

    def __init__(self, what: str, *, where: object = None, cure: str | None = None) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.cure = cure
        place = f"{self.where}: " if self.where else ""
        hint = f" ({cure})" if cure else ""
        super().__init__(" ".join(f"{place}{what}{hint}".split()))


class SourceError(GpvoError):
    """A sequence, log or trajectory cannot be read as what it claims to be."""


class CalibrationError(GpvoError):
    """A camera or rig calibration is missing, malformed or impossible."""


class ModelError(GpvoError):
    """A model file is damaged, too new, or does not fit the data at hand."""


class MissingExtraError(GpvoError):
    """An optional dependency is absent."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(
            f"this needs the package '{package}', which is not installed",
            cure=f"pip install 'gpvo[{extra}]'",
        )
