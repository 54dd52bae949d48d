"""The parser service: task text in, object-relation graph out, for every robot of a team."""
