"""Value types of GaussLite: frozen dataclasses over NumPy arrays, without input or output."""
