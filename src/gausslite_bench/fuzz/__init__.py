"""Fuzzing of the codec and of every call of the services with mutated messages."""
