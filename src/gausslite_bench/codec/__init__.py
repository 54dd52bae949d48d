"""Size and loss of the subset codec beside other formats."""
