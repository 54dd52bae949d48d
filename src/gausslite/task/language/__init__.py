"""Language models as parsers: one prompt, one schema, several ways to reach a model (Sec. III-B.1)."""
