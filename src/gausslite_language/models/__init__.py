"""Language models as task parsers: one prompt, one answer schema, several backends (Sec. III-B.1)."""
