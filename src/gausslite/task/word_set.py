"""Write word lists as running text: easier to read, sort and extend than columns of quoted strings."""


def word_set(text: str) -> frozenset[str]:
    """The set of the words in a text."""
    return frozenset(text.split())
