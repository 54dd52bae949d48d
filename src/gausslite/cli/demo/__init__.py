"""The parts of `gausslite demo`: its scenario, its services as processes, and its report."""
