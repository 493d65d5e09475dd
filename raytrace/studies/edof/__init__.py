"""Extended depth of field behind a learned thin element."""
