"""The parser service: parses task texts into object-relation graphs for all robots of a team."""
