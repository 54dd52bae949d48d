"""Word lists as running text, which is easier to read, sort and extend than quoted strings."""


def word_set(text: str) -> frozenset[str]:
    """Return the set of the words of a text."""
    return frozenset(text.split())
