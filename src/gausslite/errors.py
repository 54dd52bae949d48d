"""Every error GaussLite raises on purpose; knows neither gRPC nor exit codes."""


class GaussLiteError(Exception):
    """Base of all deliberate errors. The message is one line: what, what came, what would be right."""


class InvalidInputError(GaussLiteError):
    """A value from outside (argument, message field, array) is not acceptable."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape or type."""


class PoseError(InvalidInputError):
    """A pose is not a finite rigid transform."""


class TaskError(InvalidInputError):
    """The task text is empty, too long or names nothing."""


class DatasetError(InvalidInputError):
    """A folder or file of a sequence is missing, unreadable or inconsistent."""


class ModelFileError(InvalidInputError):
    """A model file is missing, damaged or of another kind than expected."""


class MapFileError(InvalidInputError):
    """A stored map cannot be read."""


class CodecError(InvalidInputError):
    """Encoded bytes are malformed, of an unknown version or codec, or declare impossible sizes."""


class ChecksumError(GaussLiteError):
    """Encoded bytes do not match their checksum: they were damaged on the way."""


class SessionUnknownError(GaussLiteError):
    """The server does not know this session (it restarted, or the agent left)."""


class MismatchError(GaussLiteError):
    """Two parties disagree on the grid, the world frame or the mission."""


class RevisionGoneError(GaussLiteError):
    """A revision was asked for that is no longer kept."""


class QuotaError(GaussLiteError):
    """A size or count exceeds what the receiver is willing to hold."""


class NotPermittedError(GaussLiteError):
    """The caller may not act for this agent, here or at whatever stands before the server."""


class UnavailableError(GaussLiteError):
    """A service is starting, draining or cannot be reached."""


class LanguageModelError(GaussLiteError):
    """A language model failed, took too long, or answered what is no task graph."""


class StorageError(GaussLiteError):
    """Durable storage refused a write (disk full, folder not writable)."""


class KernelError(GaussLiteError):
    """A rasterizer backend is not available or cannot run here."""
