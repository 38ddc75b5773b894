"""The errors that a user can cause, and can mend."""


class TofcorrError(Exception):
    """Something the user can mend; its message is one sentence fit for a terminal."""


class ConfigError(TofcorrError, ValueError):
    """A configuration file is not what it should be."""


class CalibrationDataError(TofcorrError, ValueError):
    """A recording is broken, or cannot support what is asked of it."""


class ExportError(TofcorrError, RuntimeError):
    """An exported corrector does not agree with the model it was made from."""


class FrameError(TofcorrError, ValueError):
    """A frame does not fit the camera or the model that it was given to."""


class StateError(TofcorrError, RuntimeError):
    """A saved state belongs to another model than the one that it was to be loaded into."""
