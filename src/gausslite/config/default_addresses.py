"""The addresses on which the services listen by default, shared by the services and `gausslite doctor`."""

from typing import Final

PARSER_ADDRESS: Final = "127.0.0.1:50051"
FUSION_ADDRESS: Final = "127.0.0.1:50052"
AGENT_ADDRESS: Final = "127.0.0.1:50053"
