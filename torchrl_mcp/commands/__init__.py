"""The commands ``torchrl-mcp-*``, one module each, whose ``main`` is also ``torchrl-mcp COMMAND``."""
