"""The only home of gRPC in the library: messages, status codes, clients, servers and the uplink."""
