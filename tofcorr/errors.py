"""The errors that a user can cause and can correct."""


class TofcorrError(Exception):
    """An error that the user can correct; its message is one sentence for a terminal."""


class ConfigError(TofcorrError, ValueError):
    """A configuration is missing, malformed or not allowed."""


class CalibrationDataError(TofcorrError, ValueError):
    """A recording is broken, or lacks the data for the task."""


class ExportError(TofcorrError, RuntimeError):
    """An exported corrector does not agree with the model it was made from."""


class FrameError(TofcorrError, ValueError):
    """A frame does not fit the camera or the model that it was given to."""


class StateError(TofcorrError, RuntimeError):
    """A saved state belongs to another model than the one that it was to be loaded into."""
