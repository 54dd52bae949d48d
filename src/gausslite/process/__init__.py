"""What every program does as an operating-system process: handle signals, and write messages to stderr."""
