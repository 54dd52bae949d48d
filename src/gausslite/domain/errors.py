"""All errors that GaussLite raises deliberately; independent of gRPC and of exit codes."""


class GaussLiteError(Exception):
    """Base of all deliberate errors. The message is one line: the name, what was expected, what was received.

    retry_after_s: the time after which the same call may succeed; None if the error does not state it.
    """

    def __init__(self, *args: object, retry_after_s: float | None = None) -> None:
        super().__init__(*args)
        self.retry_after_s = retry_after_s


class InvalidInputError(GaussLiteError):
    """A value from outside (argument, message field, array) is not acceptable."""


class ShapeError(InvalidInputError):
    """An array has the wrong shape or type."""


class PoseError(InvalidInputError):
    """A pose is not a finite rigid transform."""


class TaskError(InvalidInputError):
    """The task text is empty, too long or contains no object."""


class DatasetError(InvalidInputError):
    """A folder or file of a sequence is missing, unreadable or inconsistent."""


class ModelFileError(InvalidInputError):
    """A model file is missing, damaged or of an unexpected kind."""


class MissingPluginError(InvalidInputError):
    """No package that is installed provides what was chosen."""


class MapFileError(InvalidInputError):
    """A stored map cannot be read."""


class CodecError(InvalidInputError):
    """Encoded bytes are malformed, of an unknown version or codec, or declare impossible sizes."""


class ChecksumError(GaussLiteError):
    """Bytes do not match their checksum: they were damaged in transfer or storage."""


class SessionUnknownError(GaussLiteError):
    """The server has no such session: it restarted, or the agent left."""


class MismatchError(GaussLiteError):
    """Two parties use different voxel grids, world frames, missions or settings."""


class RevisionGoneError(GaussLiteError):
    """The requested revision is no longer stored."""


class QuotaError(GaussLiteError):
    """A size or count exceeds a limit of the receiver."""


class RateLimitError(QuotaError):
    """A caller sends more in a time than the receiver accepts; it may go on after `retry_after_s`."""


class NameInUseError(GaussLiteError):
    """Another robot holds the lease of this agent name; it ends after `retry_after_s` unless the robot renews it."""


class NotPermittedError(GaussLiteError):
    """The caller is not authorised to act for this agent."""


class UnavailableError(GaussLiteError):
    """A service is starting, draining or unreachable."""


class LanguageModelError(GaussLiteError):
    """A language model failed, timed out, or did not return a task graph."""


class StorageError(GaussLiteError):
    """Durable storage refused a write, for example because the disk is full or the folder is not writable."""


class KernelError(GaussLiteError):
    """A rasterizer backend is not available on this machine."""
