"""GENERATED from proto/ by tools/gen_proto.py: the messages and stubs of gausslite.v1."""
