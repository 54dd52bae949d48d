"""`gausslite bench`: one module per benchmark."""
