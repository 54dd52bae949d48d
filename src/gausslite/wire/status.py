"""Convert between GaussLite errors and gRPC status codes, by one table for both directions.

The ErrorInfo's reason names the error class, so that a client raises the class that the server raised. Other clients
use the code.
"""

from __future__ import annotations

import re
from typing import Any

import grpc
from google.protobuf import any_pb2
from google.rpc import code_pb2, error_details_pb2, status_pb2  # type: ignore[import-untyped]
from grpc_status import rpc_status

from gausslite.domain import errors
from gausslite.domain.errors import GaussLiteError

DOMAIN = "gausslite"
MAX_ERROR_CHARACTERS = 1000
"""An error quotes what a caller sent; gRPC drops longer ones, and a log would keep them."""

_TABLE: tuple[tuple[type[GaussLiteError], grpc.StatusCode, str], ...] = (
    (errors.ShapeError, grpc.StatusCode.INVALID_ARGUMENT, "SHAPE"),
    (errors.PoseError, grpc.StatusCode.INVALID_ARGUMENT, "POSE"),
    (errors.TaskError, grpc.StatusCode.INVALID_ARGUMENT, "TASK"),
    (errors.DatasetError, grpc.StatusCode.INVALID_ARGUMENT, "DATASET"),
    (errors.ModelFileError, grpc.StatusCode.INVALID_ARGUMENT, "MODEL_FILE"),
    (errors.MissingPluginError, grpc.StatusCode.INVALID_ARGUMENT, "MISSING_PLUGIN"),
    (errors.MapFileError, grpc.StatusCode.INVALID_ARGUMENT, "MAP_FILE"),
    (errors.CodecError, grpc.StatusCode.INVALID_ARGUMENT, "CODEC"),
    (errors.InvalidInputError, grpc.StatusCode.INVALID_ARGUMENT, "INVALID_INPUT"),
    (errors.ChecksumError, grpc.StatusCode.DATA_LOSS, "CHECKSUM"),
    (errors.SessionUnknownError, grpc.StatusCode.NOT_FOUND, "SESSION_UNKNOWN"),
    (errors.MismatchError, grpc.StatusCode.FAILED_PRECONDITION, "MISMATCH"),
    (errors.RevisionGoneError, grpc.StatusCode.OUT_OF_RANGE, "REVISION_GONE"),
    (errors.RateLimitError, grpc.StatusCode.RESOURCE_EXHAUSTED, "RATE_LIMIT"),
    (errors.QuotaError, grpc.StatusCode.RESOURCE_EXHAUSTED, "QUOTA"),
    (errors.StorageError, grpc.StatusCode.RESOURCE_EXHAUSTED, "STORAGE"),
    (errors.NameInUseError, grpc.StatusCode.ALREADY_EXISTS, "NAME_IN_USE"),
    (errors.NotPermittedError, grpc.StatusCode.PERMISSION_DENIED, "NOT_PERMITTED"),
    (errors.UnavailableError, grpc.StatusCode.UNAVAILABLE, "UNAVAILABLE"),
    (errors.LanguageModelError, grpc.StatusCode.INTERNAL, "LANGUAGE_MODEL"),
    (errors.KernelError, grpc.StatusCode.FAILED_PRECONDITION, "KERNEL"),
    (GaussLiteError, grpc.StatusCode.INTERNAL, "INTERNAL"),
)

_BY_REASON = {reason: kind for kind, _, reason in _TABLE}
# for a status without GaussLite's ErrorInfo, from the transport, a proxy or another server
_BY_CODE: dict[grpc.StatusCode, type[GaussLiteError]] = {
    grpc.StatusCode.INVALID_ARGUMENT: errors.InvalidInputError,
    grpc.StatusCode.DATA_LOSS: errors.ChecksumError,
    grpc.StatusCode.FAILED_PRECONDITION: errors.MismatchError,
    grpc.StatusCode.OUT_OF_RANGE: errors.RevisionGoneError,
    grpc.StatusCode.RESOURCE_EXHAUSTED: errors.QuotaError,
    grpc.StatusCode.PERMISSION_DENIED: errors.NotPermittedError,
    grpc.StatusCode.UNAUTHENTICATED: errors.NotPermittedError,
    grpc.StatusCode.UNAVAILABLE: errors.UnavailableError,
    grpc.StatusCode.DEADLINE_EXCEEDED: errors.UnavailableError,
    grpc.StatusCode.CANCELLED: errors.UnavailableError,
}


# what the transport reports while it connects, and what that means
_NOT_CONNECTED = (
    ("Connection refused|No such file or directory", "connection refused"),
    ("CERTIFICATE_VERIFY_FAILED", "its certificate is not from an authority in tls-ca, or not for this name"),
    ("WRONG_VERSION_NUMBER", "no TLS there; expected a server with certificates, or this program without them"),
    ("Tls handshake failed", "no encrypted connection; are the certificates of both sides from one authority?"),
    (
        "failed to connect.*Socket closed",
        "it closes the connection; a server with certificates expects tls-cert, tls-key and tls-ca",
    ),
)


def code_and_reason(error: GaussLiteError) -> tuple[grpc.StatusCode, str]:
    """Return the code and ErrorInfo reason of an error; a class not in the table uses its nearest base."""
    return next((code, reason) for kind, code, reason in _TABLE if isinstance(error, kind))


def to_status(error: GaussLiteError) -> grpc.Status:
    """Return the status of an error: its code, its message, an ErrorInfo, and a RetryInfo if it has a retry time."""
    code, reason = code_and_reason(error)
    details: list[Any] = [error_details_pb2.ErrorInfo(reason=reason, domain=DOMAIN)]
    if error.retry_after_s is not None:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromMilliseconds(round(1000 * error.retry_after_s))
        details.append(retry)
    packed = [any_pb2.Any() for _ in details]
    for target, detail in zip(packed, details, strict=True):
        target.Pack(detail)
    number = code_pb2.Code.Value(code.name)
    status: grpc.Status = rpc_status.to_status(
        status_pb2.Status(code=number, message=str(error)[:MAX_ERROR_CHARACTERS], details=packed)
    )
    return status


def error_from_reason(reason: str, message: str, retry_after_s: float | None = None) -> GaussLiteError:
    """Return the error of the class that a reason names; an unknown reason gives the base class."""
    return _BY_REASON.get(reason, GaussLiteError)(message, retry_after_s=retry_after_s)


def from_rpc_error(error: grpc.RpcError, address: str) -> GaussLiteError:
    """Return the error that the server raised; an error of the transport gets the class of its code."""
    if not isinstance(error, grpc.Call | grpc.aio.AioRpcError):
        return errors.UnavailableError(f"{address}: {error}")
    code, text = error.code(), error.details() or "no details"
    reason, retry_after_s = _details(error)
    if reason is not None:
        return error_from_reason(reason, text, retry_after_s)
    if code is grpc.StatusCode.DEADLINE_EXCEEDED:
        return errors.UnavailableError(f"{address}: no answer in time")
    if code is grpc.StatusCode.UNAVAILABLE:
        meaning = next((meaning for cause, meaning in _NOT_CONNECTED if re.search(cause, text)), None)
        if meaning is not None:
            return errors.UnavailableError(f"{address}: {meaning}")
    if code is grpc.StatusCode.UNIMPLEMENTED:
        return errors.InvalidInputError(f"{address}: another service listens there, or one of another version")
    first_line = text.splitlines()[0]
    return _BY_CODE.get(code, GaussLiteError)(f"{address}: {code.name}: {first_line}")


def has_reason(error: grpc.Call) -> bool:
    """Return True if a service of this package raised the error, and not the transport."""
    return _details(error)[0] is not None


def _details(error: Any) -> tuple[str | None, float | None]:
    """Return the ErrorInfo's reason and the RetryInfo's time in seconds; None for what the status does not have."""
    try:
        status = rpc_status.from_call(error)
    except ValueError:
        # the details contradict the code, so another program sent this status
        return None, None
    reason, retry_after_s = None, None
    for detail in status.details if status is not None else ():
        info, retry = error_details_pb2.ErrorInfo(), error_details_pb2.RetryInfo()
        if detail.Unpack(info) and info.domain == DOMAIN:
            reason = str(info.reason)
        elif detail.Unpack(retry):
            retry_after_s = retry.retry_delay.ToMilliseconds() / 1000
    return reason, retry_after_s
