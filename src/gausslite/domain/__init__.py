"""The nouns of GaussLite: frozen values over NumPy arrays, without input or output."""
