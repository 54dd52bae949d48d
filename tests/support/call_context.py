"""A call's context, as far as it states the caller."""


class Context:
    """The two methods of a call's context that state its caller, with values as gRPC gives them."""

    def __init__(self, peer: str, **properties: bytes) -> None:
        self._peer, self._properties = peer, properties

    def peer(self) -> str:
        return self._peer

    def auth_context(self) -> dict[str, list[bytes]]:
        return {name: [value] for name, value in self._properties.items()}
