"""All gRPC code of the library: messages, status codes, clients, servers and the uplink."""
