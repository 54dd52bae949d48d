"""The time that a sender waits before it retries: doubled after each error, or as the server states."""

from __future__ import annotations

from gausslite.domain.errors import GaussLiteError, RateLimitError

_MAX_BACKOFF_S = 5.0
_MAX_RETRY_HINT_S = 60.0


class RetryDelay:
    """Exponential backoff. Not thread-safe."""

    def __init__(self, first_s: float) -> None:
        self._first_s, self._delay_s = first_s, 0.0

    def after(self, error: GaussLiteError) -> float:
        """Return the time until the next attempt in seconds."""
        self._delay_s = min(max(2 * self._delay_s, self._first_s), _MAX_BACKOFF_S)
        if isinstance(error, RateLimitError) and error.retry_after_s is not None:
            # the server states when it accepts the next message
            return min(max(self._delay_s, error.retry_after_s), _MAX_RETRY_HINT_S)
        return self._delay_s

    def reset(self) -> None:
        """Start again with the first delay, after a success."""
        self._delay_s = 0.0
